"""Rigid structure from motion by factorisation (Tomasi & Kanade, 1992)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import truth
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from .shared.completion import completed
from .shared.upgrade import metric_gram, orthonormal, stacked

_UNSEEN = 1e-4  # share of its images that a direction must have


@one_thread
def tomasi_kanade(W: Any, visible: Any = None, *, confidence: Any = None, progress: bool = True) -> Reconstruction:
    """One rigid shape for all images, and a camera per frame, as if nothing moved.

    The nearest rank-3 matrix to all frames stacked, by singular value decomposition, then the metric
    upgrade that makes the cameras' columns orthonormal in the least-squares sense (linear in the Gram
    matrix Q of the upgrade), then each camera made orthonormal on its own, and the shape by least squares for
    these cameras. Exact on rigid data without noise; else a good start, not the minimum of the reprojection
    error. Cost O(F P²).

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Factorisation has no place for missing points: they are filled in by `complete` first.
    confidence : (F, P), optional
        From 0 to 1; `complete` moves a doubtful point towards its likely place. Default: that of the Landmarks,
        else 1.
    progress : bool
        As everywhere; here nothing takes long enough to be shown.

    Returns
    -------
    Reconstruction with the same shape in every frame, in the units of W.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 3 frames or 4 points; or if all points lie in one plane or the views are
        all alike (rank below 3).

    References
    ----------
    Tomasi, Kanade (1992). Shape and motion from image streams under orthography: a factorization method.
    International Journal of Computer Vision 9(2), 137–154. doi:10.1007/BF00129684

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(60))
    >>> nl.baselines.tomasi_kanade(views).shapes.shape == views.points3d.shape
    True
    """
    truth("progress", progress)
    images = completed(read(W, visible, confidence, method="tomasi_kanade", frames=3, points=4))
    S, M = factorise(images.X)
    return images.reconstruction(np.repeat(S[None], len(M), axis=0), M, method="tomasi_kanade")


def factorise(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rigid shape (P, 3) and the cameras (F, 3, 2) of centred image points (F, P, 2), all at hand."""
    U, s, _ = np.linalg.svd(stacked(X), full_matrices=False)
    if s[2] <= 1e-9 * s[0]:
        raise ValueError("W has rank below 3: the points lie in one plane, or all views are alike.")
    motion = (U[:, :3] * np.sqrt(s[:3])).reshape(len(X), 2, 3)
    values, vectors = np.linalg.eigh(metric_gram(motion, one_scale=True))
    G = vectors * np.sqrt(np.maximum(values, 1e-6 * values.max()))
    M = orthonormal((motion @ G).transpose(0, 2, 1))
    # Not G⁻¹ times the other factor: where Q is nearly singular, as on much that is not rigid, that has no bound.
    # For the same reason, what hardly any camera sees stays flat.
    planes, spatial = np.einsum("fij,fkj->ik", M, M), np.einsum("fpj,fij->ip", X, M)
    return (np.linalg.pinv(planes, rcond=_UNSEEN, hermitian=True) @ spatial).T, M
