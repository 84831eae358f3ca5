"""Kernel shape trajectory approach: shapes along a smooth curve in few dimensions (Gotardo and Martinez, 2011)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.fft import idct
from scipy.spatial.distance import cdist, pdist

from ..checks import whole
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from .shared.completion import completed
from .shared.limits import Watch, check_cost, choose_components, choose_rank
from .shared.upgrade import trajectory_cameras
from .shared.variable_projection import Coefficients, fit, linear

_PAIRS = 2000  # frames, drawn evenly, whose distances give the kernel its width


@one_thread
def ksta(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    rank: int | None = None,
    smoothness: float = 0.1,
    dimensions: int | None = None,
    max_seconds: float | None = None,
    progress: bool = True,
) -> Reconstruction:
    """A point wanders smoothly through few dimensions, and the shape is a smooth function of where it is.

    Objective: ``min Σ_f ‖X_f − Σ_k κ(y_f, b_k) B_k M_f‖²`` over atoms B_k, centres b_k and the curve y, where κ is
    a Gaussian kernel and y_f is a sum of few cosines of time. The cameras are those of `trajectory_cameras` and
    stay; the atoms are eliminated (`variable_projection`). The start is the same with κ(y, b_k) = y_k, the linear
    "column space fitting" of the same authors.

    With d = smoothness · F cosines and q dimensions, cost O(F d² q² + F d q · rank · P) for a step, up to 100
    steps for each of the two stages; memory O(F · rank² · P + (dq)²). Their published form holds a Jacobian of
    2FP × dq numbers; ours does not, but d grows with F, so time grows with F³.

    Assumes orthographic views in *temporal order* from a slowly moving camera.
    With too high a rank, depths explode while the images fit ever better.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points, in temporal order
    visible : (F, P) bool, optional
        Hidden points are filled in by `complete` first.
    confidence : (F, P), optional
        From 0 to 1; `complete` moves a doubtful point towards its likely place. Default: that of the Landmarks,
        else 1.
    rank : int, optional
        Number of atoms and centres K, with 3K at most P and 2F. Default: 8, or the largest possible.
    smoothness : float
        Number of cosines over the number of frames: .1 for slow, .3 for fast motion; at least `rank` are taken.
    dimensions : int, optional
        Of the curve, q, less than `rank`: 2 or 3. Default: 3 where the rank allows it.
    max_seconds : float, optional
        Then the result so far is returned, with ``converged=False``.
    progress : bool

    Returns
    -------
    Reconstruction in one world frame for all frames, in the units of W.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 6 frames or points; as `trajectory_cameras`; for a parameter out of range;
        or if memory or time would not suffice.

    Notes
    -----
    Certain, from the abstract and from the authors' code of the linear method: the kernel, the smooth curve, the
    eliminated atoms, the cameras. Reconstructed by us, as neither code nor full text could be had: the kernel's
    width (the median squared distance of the starting curve), the centres' start (farthest points of the curve) and
    the starting curve (the main directions in which the linear method's shapes vary). Rank, smoothness and dimensions
    per sequence are not known to us either.

    References
    ----------
    Gotardo, Martinez (2011). Kernel non-rigid structure from motion. ICCV, 802–809.
    doi:10.1109/ICCV.2011.6126319

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(30))
    >>> nl.baselines.ksta(views, rank=3, progress=False).shapes.shape == views.points3d.shape
    True
    """
    images = completed(read(W, visible, confidence, method="ksta", frames=6, points=6))
    F, P, _ = images.X.shape
    rank = choose_rank(rank, 8, 2, F, P)
    dimensions = min(3, rank - 1) if dimensions is None else dimensions
    dimensions = whole("dimensions", dimensions, 1, rank - 1, ", less than the rank")
    d = choose_components("smoothness", smoothness, rank, F)
    check_cost("ksta", F, *_cost(F, P, d, rank), max_seconds, "A smaller smoothness takes fewer cosines.")
    watch = Watch("ksta", max_seconds, progress)
    M = trajectory_cameras(images.X, watch)
    cosines = idct(np.eye(F, d), axis=0, norm="ortho")
    S, done = _linear(images.X, M, cosines, rank, watch)
    if not watch.over:
        S, done = _curved(images.X, M, cosines, _main_directions(S, dimensions), rank, watch)
    return images.reconstruction(S, M, method="ksta", converged=done)


def _linear(X: np.ndarray, M: np.ndarray, cosines: np.ndarray, rank: int, watch: Watch) -> tuple[np.ndarray, bool]:
    """Column space fitting: C = Ω Z. Returns shapes and whether it converged."""
    coefficients, start = linear(cosines, rank)

    def orthonormal(theta: np.ndarray) -> np.ndarray:  # the atoms undo any change of basis
        return np.linalg.qr(theta.reshape(-1, rank))[0].ravel()

    return fit(X, M, coefficients, start, watch, canonical=orthonormal)


def _main_directions(S: np.ndarray, q: int) -> np.ndarray:
    """Where the shapes are along the q directions in which they vary most: (F, q), each of variance 1."""
    flat = (S - S.mean(0)).reshape(len(S), -1)
    y = flat @ np.linalg.eigh(flat.T @ flat)[1][:, -q:]
    return y / y.std(0)


def _curved(
    X: np.ndarray, M: np.ndarray, cosines: np.ndarray, y: np.ndarray, rank: int, watch: Watch
) -> tuple[np.ndarray, bool]:
    """C = κ(Ω Z, b), from a starting curve y (F, q). Returns shapes and whether it converged."""
    (F, d), q = cosines.shape, y.shape[1]
    width = np.median(pdist(y[:: -(-F // _PAIRS)], "sqeuclidean"))
    split = d * q

    def coefficients(theta: np.ndarray) -> Coefficients:
        y, b = cosines @ theta[:split].reshape(d, q), theta[split:].reshape(rank, q)
        C = np.exp(-cdist(y, b, "sqeuclidean") / (2 * width))
        local = (b - y[:, None]) * C[..., None] / width  # (F, K, q)
        free = np.einsum("fkq,kl->fklq", -local, np.eye(rank)).reshape(F, rank, rank * q)
        return Coefficients(C, cosines, local, free)

    start = np.concatenate([(cosines.T @ y).ravel(), _spread_out(y, rank).ravel()])
    return fit(X, M, coefficients, start, watch)


def _spread_out(y: np.ndarray, n: int) -> np.ndarray:
    """n rows of y, each the farthest from those before it; the first is the farthest from the mean."""
    chosen, distance = [], np.linalg.norm(y - y.mean(0), axis=1)
    for _ in range(n):
        chosen.append(int(distance.argmax()))
        to_last = np.linalg.norm(y - y[chosen[-1]], axis=1)
        distance = to_last if len(chosen) == 1 else np.minimum(distance, to_last)
    return y[chosen]


def _cost(F: int, P: int, d: int, rank: int) -> tuple[float, float]:
    """Gigabytes and seconds, roughly."""
    n = d * rank
    gigabytes = 8 * (6 * F * rank**2 * P + 7 * n**2 + F * rank**2 * d + _PAIRS**2) / 2**30
    return gigabytes, 100 * (2 * F * n**2 + n**3 + 12 * F * rank * n * P) / 1e10
