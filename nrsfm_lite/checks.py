"""What public functions ask of their arguments, and the sentences in which they refuse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np


def as_array(name: str, value: Any, dtype: type) -> np.ndarray:
    """A copy of an array or tensor as float, int or bool.

    Whole numbers must be whole (0.9 is not 0), and a mask must hold truth values or 0 and 1. Raises ValueError.
    """
    try:
        if hasattr(value, "detach"):
            value = value.detach().cpu()
            value = (value.double() if value.is_floating_point() else value).numpy()  # NumPy has no bfloat16
        if np.iscomplexobj(value):
            raise ValueError  # NumPy would drop the imaginary part with a warning only
        with np.errstate(invalid="ignore"):  # NaN as a whole number: refused in the next line
            array = np.array(value, dtype)
        if dtype is not float and not np.array_equal(np.asarray(value, float), array):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        kind = {float: "numbers", int: "whole numbers", bool: "truth values"}[dtype]
        raise ValueError(f"{name} cannot be read as an array of {kind}.") from None
    return array


def as_edges(name: str, value: Any, n_points: int) -> np.ndarray:
    """Pairs of points as an (E, 2) int array; None or nothing is no edge. Raises ValueError."""
    edges = as_array(name, () if value is None else value, int)
    if edges.size == 0:
        return edges.reshape(0, 2)
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise ValueError(f"{name} has shape {edges.shape}; expected (E, 2).")
    if edges.min() < 0 or edges.max() >= n_points:
        raise ValueError(f"{name} refers to a point outside 0 … {n_points - 1}.")
    return edges


def check_shape(name: str, array: Any, expected: tuple[int, ...]) -> None:
    """Raise ValueError unless an array has the expected shape."""
    if tuple(array.shape) != tuple(expected):
        raise ValueError(f"{name} has shape {tuple(array.shape)}; expected {tuple(expected)}.")


def check_finite(name: str, array: np.ndarray) -> None:
    """Raise ValueError if a value is NaN or infinite, naming the first frame (the first axis)."""
    bad = ~np.isfinite(array)
    if bad.any():
        frame = int(np.argwhere(bad)[0, 0])
        raise ValueError(
            f"{name} has {int(bad.sum())} values that are not finite numbers (the first in frame {frame})."
        )


def check_visible_finite(name: str, points: np.ndarray, visible: np.ndarray) -> None:
    """Raise ValueError if a visible point of `points` (F, P, d) is not finite, naming the first frame."""
    bad = visible & ~np.isfinite(points).all(-1)
    if bad.any():
        frame = int(np.argwhere(bad)[0, 0])
        raise ValueError(
            f"{name} has {int(bad.sum())} visible points that are NaN or infinite (the first in frame {frame}); "
            "mark missing points as False in visible."
        )


def whole(name: str, value: Any, least: int, most: int | None = None, circumstance: str = "") -> int:
    """An argument as an int: a Python or NumPy integer, or a float like 3.0, from `least` to `most`.

    Raises ValueError for everything else; nothing is cut silently.
    """
    number = None
    if not isinstance(value, (bool, np.bool_, str)):
        try:
            number = int(value)
        except (TypeError, ValueError, OverflowError):
            number = None
    if number is None or number != value or number < least or (most is not None and number > most):
        allowed = f"{least} … {most}" if most is not None else f"at least {least}"
        raise ValueError(f"{name}={value!r}; expected a whole number, {allowed}{circumstance}.")
    return number


def at_least(name: str, value: Any, least: float = 0.0, *, above: bool = False) -> float:
    """An argument as a finite number of at least `least`, or above it. Raises ValueError."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number) or number < least or (above and number == least):
        raise ValueError(f"{name}={value!r}; expected a number {'above' if above else 'of at least'} {least:g}.")
    return number


def one_of(name: str, value: Any, options: Sequence[Any]) -> None:
    """Raise ValueError unless an argument is one of a few words."""
    if not any(value is option or (type(value) is type(option) and value == option) for option in options):
        raise ValueError(f"{name}={value!r}; expected one of {', '.join(map(str, options))}.")


def truth(name: str, value: Any) -> bool:
    """An argument as True or False, and nothing else. Raises ValueError."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}={value!r}; expected True or False.")
    return bool(value)
