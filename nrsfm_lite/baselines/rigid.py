"""Rigid structure from motion by factorisation (Tomasi & Kanade, 1992)."""

import numpy as np
import torch

from ..cameras import nearest_orthonormal
from ..threads import one_thread
from .images import read, stacked
from .upgrade import quadratic, symmetric

_UNSEEN = 1e-4  # share of its images that a direction must have


@one_thread
def tomasi_kanade(W, visible=None):
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

    Returns
    -------
    Reconstruction with the same shape in every frame.

    Raises
    ------
    ValueError
        With fewer than 3 frames or 4 points, a point hidden in every frame, or if all points lie in one
        plane or the views are all alike (rank below 3).
    """
    images = read(W, visible, method="tomasi_kanade")
    F = len(images.X)
    U, s, _ = np.linalg.svd(stacked(images.X), full_matrices=False)
    if s[2] <= 1e-9 * s[0]:
        raise ValueError("W has rank below 3: the points lie in one plane, or all views are alike.")
    motion = (U[:, :3] * np.sqrt(s[:3])).reshape(F, 2, 3)
    G = _metric_upgrade(motion)
    M = nearest_orthonormal(torch.as_tensor((motion @ G).transpose(0, 2, 1).copy())).numpy()  # (F, 3, 2)
    # Not G⁻¹ times the other factor: where Q is nearly singular, as on much that is not rigid, that has no bound.
    # For the same reason, what hardly any camera sees stays flat.
    planes, laid = np.einsum("fij,fkj->ik", M, M), np.einsum("fpj,fij->ip", images.X, M)
    S = (np.linalg.pinv(planes, rcond=_UNSEEN, hermitian=True) @ laid).T  # (P, 3)
    return images.reconstruction(np.repeat(S[None], F, axis=0), M, "tomasi_kanade")


def _metric_upgrade(motion):
    """G (3, 3) such that the rows of motion_f @ G are orthonormal, in the least-squares sense."""
    x, y = motion[:, 0], motion[:, 1]
    system = np.concatenate([quadratic(x, x), quadratic(y, y), quadratic(x, y)])
    target = np.repeat([1.0, 1.0, 0.0], len(motion))
    values, vectors = np.linalg.eigh(symmetric(np.linalg.lstsq(system, target, rcond=None)[0]))
    return vectors * np.sqrt(np.maximum(values, 1e-6 * values.max()))
