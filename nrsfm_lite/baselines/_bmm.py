"""Block matrix method: shapes of least nuclear norm, with no other prior (Dai, Li and He, 2012 and 2014)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import whole
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from .shared.completion import completed
from .shared.descent import nesterov
from .shared.limits import Watch, check_cost, choose_rank
from .shared.upgrade import unordered_cameras

_LEVELS = 20  # of the weight μ, each a quarter of the one before
_FIRST, _LAST = 1.0, 1e-10  # its limits, for points of unit scale
_TOLERANCE = 1e-5  # relative change of the shapes at which a level ends
_ITERATIONS = 5000  # at most, per level


@one_thread
def bmm(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    rank: int | None = None,
    restarts: int = 10,
    max_seconds: float | None = None,
    progress: bool = True,
    seed: int = 0,
) -> Reconstruction:
    """Cameras from a low-rank factorisation; then, of all shapes that fit the images, those of least nuclear norm.

    Objective: ``min_S μ‖S♯‖_* + ½ Σ_f ‖X_f − S_f M_f‖²`` for μ → 0, where S♯ (F, 3P) holds a shape per row. Its
    nuclear norm, the sum of its singular values, stands for its rank. The problem is convex; proximal gradient
    steps with momentum solve it level by level, and in the end S♯ is cut to its `rank` largest singular values.

    Cost O(F (3P)²) for a step, some 20 to 100 steps per level; memory O(F · 3P). Singular values are taken from
    the (3P, 3P) Gram matrix, so nothing grows with F². The published code forms F×F and 2F×3F matrices; that, and
    not the method, is why it is said to fail beyond some thousand frames.

    Assumes orthographic views of shapes of low rank; frames may be in any order.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Hidden points are filled in by `complete` first.
    confidence : (F, P), optional
        From 0 to 1; `complete` moves a doubtful point towards its likely place. Default: that of the Landmarks,
        else 1.
    rank : int, optional
        Number of shape atoms K, with 3K at most P and 2F. Dai et al. choose it per sequence, 4 to 12. Default:
        10, or the largest possible.
    restarts : int
        Random starts of the cameras' upgrade (`unordered_cameras`), of which the best is kept. Most starts find the
        same minimum where this was counted (yoga).
    max_seconds : float, optional
        Then the result so far is returned, with ``converged=False``.
    progress : bool
    seed : int

    Returns
    -------
    Reconstruction in one world frame for all frames, in the units of W.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 4 frames or 6 points; for a parameter out of range; or if memory or time
        would not suffice.

    Notes
    -----
    Certain: objective, weights and ranks, from the authors' code. Ours: random starts instead of their
    semidefinite programme, a symmetric form of the cameras' misfit, signs without temporal order, and momentum, which
    hardly changes the errors on the classic sequences. Their second method, smoothness in time, is left out.

    References
    ----------
    Dai, Li, He (2014). A simple prior-free method for non-rigid structure-from-motion factorization. International
    Journal of Computer Vision 107(2), 101–122.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(30))
    >>> rec = nl.baselines.bmm(views, rank=3, restarts=1, progress=False)
    >>> rec.shapes.shape == views.points3d.shape
    True
    """
    images = completed(read(W, visible, confidence, method="bmm", frames=4, points=6))
    F, P, _ = images.X.shape
    rank = choose_rank(rank, 10, 2, F, P)
    restarts = whole("restarts", restarts, 1, 1000)
    check_cost("bmm", F, 8 * (80 * F * P + 5 * (3 * P) ** 2) / 2**30, 3.5e-6 * F * P**2 + 2e-6 * P**3, max_seconds)
    watch = Watch("bmm", max_seconds, progress)
    S, M, converged = shapes_and_cameras(images.X, rank, restarts, watch, seed)
    return images.reconstruction(S, M, method="bmm", converged=converged)


def shapes_and_cameras(
    X: np.ndarray, rank: int, restarts: int, watch: Watch, seed: int
) -> tuple[np.ndarray, np.ndarray, bool]:
    """`bmm` of centred image points (F, P, 2), all at hand: (F, P, 3), (F, 3, 2), and whether all steps settled."""
    M = unordered_cameras(X, rank, watch.steps(restarts, "cameras"), np.random.default_rng(seed))
    S, converged = _least_nuclear_norm(X, M, rank, watch)
    return S, M, converged


def _least_nuclear_norm(X: np.ndarray, M: np.ndarray, rank: int, watch: Watch) -> tuple[np.ndarray, bool]:
    """Shapes (F, P, 3) for given cameras, and whether all levels were gone through."""
    F, P, _ = X.shape
    A = _cut((X @ M.swapaxes(1, 2)).reshape(F, 3 * P), rank)
    weights = np.maximum(_LAST, _FIRST * 0.25 ** np.arange(_LEVELS))
    levels = 0
    for mu in watch.steps(weights, "shapes"):
        ahead, momentum = A, 1.0
        for _ in range(_ITERATIONS):
            S = ahead.reshape(F, P, 3)
            new = _shrink((S - (S @ M - X) @ M.swapaxes(1, 2)).reshape(F, 3 * P), mu)
            change = np.linalg.norm(new - A) / max(1.0, float(np.linalg.norm(A)))
            if ((ahead - new) * (new - A)).sum() > 0:  # the momentum points uphill: start it anew
                momentum = 1.0
            momentum, share = nesterov(momentum)
            ahead, A = new + share * (new - A), new
            if change < _TOLERANCE or watch.over:
                break
        levels += bool(change < _TOLERANCE)
    return _cut(A, rank).reshape(F, P, 3), levels == _LEVELS


def _shrink(A: np.ndarray, threshold: float) -> np.ndarray:
    """All singular values of A (F, n) smaller by the threshold, at least 0; from the Gram matrix, for F ≫ n."""
    values, V = np.linalg.eigh(A.T @ A)
    size = np.sqrt(np.maximum(values, 0))
    kept = size > threshold
    V = V[:, kept]
    return (A @ (V * (1 - threshold / size[kept]))) @ V.T


def _cut(A: np.ndarray, rank: int) -> np.ndarray:
    """The nearest matrix of that rank."""
    V = np.linalg.eigh(A.T @ A)[1][:, -rank:]
    return A @ V @ V.T
