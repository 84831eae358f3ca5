"""Two ways down that several methods share: damped Gauss-Newton steps, and the momentum of proximal gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from .limits import Watch

State = TypeVar("State")

# Returns None where the damped system cannot be solved.
Propose = Callable[[float], tuple[State, float] | None]

_LEAST, _MOST = 1e-12, 1e12  # of the damping: some directions change nothing; and where nothing is left to gain


def levenberg_marquardt(
    state: State,
    value: float,
    linearise: Callable[[State], Propose],
    settled: Callable[[float, float], bool],
    watch: Watch,
    what: str,
    *,
    damping: float,
    easing: float,
    iterations: int = 100,
) -> tuple[State, float, bool]:
    """Gauss-Newton steps that are damped until they lower the objective (Levenberg, 1944; Marquardt, 1963).

    Parameters
    ----------
    state, value : where to start, and the objective there
    linearise : function of a state
        Returns the function of the damping that proposes a state and its objective, or None.
    settled : function of the objective before and after a step; True ends the descent
    watch, what : for the time and the progress bar
    damping : float, at first; tenfold after a step that does not lower the objective
    easing : float, what the damping is divided by after one that does
    iterations : int, at most

    Returns
    -------
    state, value : the best
    converged : bool, whether it settled, or no step lowers the objective
    """
    for _ in watch.steps(iterations, what):
        propose = linearise(state)
        while (tried := propose(damping)) is None or not tried[1] < value:
            damping *= 10
            if damping > _MOST:
                return state, value, True
            if watch.over:
                return state, value, False
        before, (state, value) = value, tried
        damping = max(damping / easing, _LEAST)
        if settled(before, value) and not watch.over:
            return state, value, True
    return state, value, False


def nesterov(momentum: float) -> tuple[float, float]:
    """The next of Nesterov's sequence 1, (1 + √5) / 2, …, and the share of the last move to go on with."""
    following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
    return following, (momentum - 1) / following
