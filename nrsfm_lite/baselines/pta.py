"""Point trajectory approach: every point moves along few cosines in time (Akhter et al., 2009)."""

import numpy as np
from scipy.fft import idct
from scipy.optimize import minimize

from ..completion import complete
from ..data import Reconstruction, as_points


def pta(W, visible=None, rank=12):
    """Smooth trajectories: the shape's change over time is a sum of `rank` discrete cosines.

    Objective: ``min_B Σ_f ‖W_f − S_f M_f‖²`` with ``S_f = Σ_k θ_fk B_k``, θ the first `rank` functions
    of the discrete cosine transform over the frames. The cameras come first, from `trajectory_cameras`;
    then the coefficients B are linear least squares. Cost O(F (3·rank)²), memory O(F · rank).

    Assumes orthographic views in *temporal order* from a slowly moving camera; on shuffled frames it
    fails, since shuffled trajectories are not smooth.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points, in temporal order
    visible : (F, P) bool, optional
        Hidden points are filled in by `complete` first.
    rank : int
        Number of cosines; 3·rank is at most 2F. Akhter et al. choose it per sequence, 5 to 13.

    Returns
    -------
    Reconstruction in one world frame for all frames.

    Raises
    ------
    ValueError
        For a rank out of range, fewer than 6 independent measurements (points or frames), or a point hidden
        in every frame.
    """
    W, visible, names, edges = as_points(W, visible)
    F, P, _ = W.shape
    if rank < 1 or 3 * rank > 2 * F:
        raise ValueError(f"rank={rank}; expected 1 … {2 * F // 3} for {F} frames.")
    W = complete(W, visible)
    t = W.mean(1)
    X = W - t[:, None]
    M = trajectory_cameras(X)  # (F, 3, 2)
    cosines = idct(np.eye(F, rank), axis=0, norm="ortho")  # (F, rank)
    # Row (f, j) of the system: x_fj = Σ_k θ_fk m_fjᵀ B_k, for all points at once.
    system = np.einsum("fij,fk->fjki", M, cosines).reshape(2 * F, 3 * rank)
    B = np.linalg.lstsq(system, X.transpose(0, 2, 1).reshape(2 * F, P), rcond=None)[0].reshape(rank, 3, P)
    S = np.einsum("fk,kip->fpi", cosines, B)
    return Reconstruction(
        shapes=S - S.mean(1, keepdims=True), cameras=M, translations=t, visible=visible, names=names, edges=edges,
        method="pta",
    )  # fmt: skip


def trajectory_cameras(X):
    """Cameras of a smooth motion, by the Euclidean upgrade that PTA and its successors share.

    The centred images stacked (2F, P) are factored by singular value decomposition. Three columns Q
    of the upgrade are found such that each frame's two rows become orthonormal: first on the 6
    strongest components, then on 3 more at a time, each from the last result, until nothing improves.
    Deterministic; a good minimum needs cameras that move smoothly.

    Parameters
    ----------
    X : (F, P, 2) image points, each frame centred

    Returns
    -------
    (F, 3, 2), orthonormal up to what the upgrade leaves: as in the reference code, they are not corrected.
    The signs of the frames are made continuous.
    """
    F, P, _ = X.shape
    U, s, _ = np.linalg.svd(X.transpose(0, 2, 1).reshape(2 * F, P), full_matrices=False)
    n = min(3 * int(np.ceil((s > 1e-4 * s[0]).sum() / 3)), len(s))
    if n < 6:
        raise ValueError(f"W has rank {n}; the upgrade needs at least 6 independent components.")
    motion = (U[:, :n] * np.sqrt(s[:n])).reshape(F, 2, n)
    Q, best = np.eye(6, 3), np.inf
    for size in range(6, n + 1, 3):
        Q = np.vstack([Q, np.zeros((size - len(Q), 3))])
        part = np.ascontiguousarray(motion[:, :, :size])
        found = minimize(_misfit, Q.ravel(), args=(part,), jac=True, method="BFGS", options={"gtol": 1e-9})
        if not found.fun < best:
            break
        Q, best, kept = found.x.reshape(size, 3), found.fun, size
    rows = motion[:, :, :kept] @ Q[:kept]  # (F, 2, 3)
    return _continuous(rows).transpose(0, 2, 1)


def _misfit(q, motion):
    """How far the rows of motion_f @ Q are from orthonormal, and its gradient."""
    Q = q.reshape(motion.shape[2], 3)
    R = (motion.reshape(-1, len(Q)) @ Q).reshape(-1, 2, 3)
    G = R @ R.transpose(0, 2, 1)
    E = G - np.eye(2)
    E[:, 0, 1] = E[:, 1, 0] = G[:, 0, 1] / np.sqrt(2)  # the product of the two rows counts once
    value = (E**2).sum() / len(R)
    weight = 4 * (G - np.eye(2))
    weight[:, 0, 1] = weight[:, 1, 0] = 2 * G[:, 0, 1]
    gradient = motion.reshape(-1, len(Q)).T @ (weight @ R).reshape(-1, 3) / len(R)
    return value, gradient.ravel()


def _continuous(rows):
    """Negate frames whose camera would turn by more than 90° from the frame before: (F, 2, 3)."""
    rows = rows.copy()
    for f in range(1, len(rows)):
        if (rows[f] * rows[f - 1]).sum() < 0:
            rows[f] *= -1
    return rows
