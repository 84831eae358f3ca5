"""From factors to cameras: the Euclidean upgrade of smooth motions, and the signs of its frames."""

import numpy as np
from scipy.optimize import minimize


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
    return continuous(rows).transpose(0, 2, 1)


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


def continuous(rows):
    """Negate frames whose camera would turn by more than 90° from the frame before: (F, 2, 3)."""
    rows = rows.copy()
    for f in range(1, len(rows)):
        if (rows[f] * rows[f - 1]).sum() < 0:
            rows[f] *= -1
    return rows


def consistent(M, X):
    """Negate cameras so that the images, laid back into space, look alike: for frames in no order.

    A camera and its negative explain the squares of an image equally well. Each image is laid into its plane in
    space, X_f M_fᵀ, and a frame that correlates negatively with the mean of all is negated, until none does
    (Lee et al., 2016).

    Parameters
    ----------
    M : (F, 3, 2) cameras
    X : (F, P, 2) centred image points

    Returns
    -------
    (F, 3, 2)
    """
    laid = (X @ M.swapaxes(1, 2)).reshape(len(X), -1)
    # Start from the main direction of all frames, whatever their signs.
    sign = np.sign(laid @ np.linalg.svd(laid, full_matrices=False)[2][0])
    sign[sign == 0] = 1
    for _ in range(len(X)):
        wrong = (laid * sign[:, None]) @ (laid * sign[:, None]).mean(0) < 0
        if not wrong.any():
            break
        sign[wrong] *= -1
    return M * sign[:, None, None]
