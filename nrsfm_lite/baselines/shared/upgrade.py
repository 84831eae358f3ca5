"""From factors to cameras: metric upgrades, for videos and for frames in no order, and the signs of frames."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from scipy.optimize import minimize

from ...cameras import nearest_orthonormal
from .descent import Propose, levenberg_marquardt
from .limits import Watch

_SETTLED = 1e-6  # relative change of the cameras' misfit at which a minimum is reached


def stacked(X: np.ndarray) -> np.ndarray:
    """(F, P, 2) to (2F, P): two rows per frame, x and y."""
    return X.transpose(0, 2, 1).reshape(-1, X.shape[1])


def orthonormal(M: np.ndarray) -> np.ndarray:
    """The cameras nearest to (..., 3, 2) matrices."""
    return nearest_orthonormal(torch.as_tensor(np.ascontiguousarray(M))).numpy()


def metric_gram(rows: np.ndarray, *, one_scale: bool) -> np.ndarray:
    """Q = G Gᵀ such that the two rows of rows_f @ G are orthogonal and of one length, in the least-squares sense.

    All conditions are linear in the six entries of Q.

    Parameters
    ----------
    rows : (n, 2, 3)
    one_scale : bool
        The common length is 1 in every frame. Else each frame has its own, and Q is only known up to a factor of
        either sign: it has norm 1 as a vector of six.

    Returns
    -------
    (3, 3), symmetric, but with noise not always positive
    """
    i, j = np.triu_indices(3)

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:  # aᵀ Q b as a linear function of the entries of Q
        return np.where(i == j, 0.5, 1) * (a[:, i] * b[:, j] + a[:, j] * b[:, i])

    x, y = rows[:, 0], rows[:, 1]
    if one_scale:
        system = np.concatenate([product(x, x), product(y, y), product(x, y)])
        entries = np.linalg.lstsq(system, np.repeat([1.0, 1.0, 0.0], len(rows)), rcond=None)[0]
    else:
        system = np.concatenate([product(x, x) - product(y, y), 2 * product(x, y)])
        entries = np.linalg.svd(system, full_matrices=len(system) < 6)[2][-1]
    Q = np.zeros((3, 3))
    Q[i, j] = Q[j, i] = entries
    return Q


def trajectory_cameras(X: np.ndarray, watch: Watch) -> np.ndarray:
    """Cameras of a smooth motion, by the metric upgrade that PTA and its successors share.

    The centred images stacked (2F, P) are factored by singular value decomposition. Three columns Q
    of the upgrade are found such that each frame's two rows become orthonormal: first on the 6
    strongest components, then on 3 more at a time, each from the last result, until nothing improves. Damped
    Gauss-Newton steps polish the last one.
    Deterministic; a good minimum needs cameras that move smoothly, and exact cameras a rigid part of the shape:
    a combination of the coefficients that is constant over the frames.

    Parameters
    ----------
    X : (F, P, 2) image points, each frame centred
    watch : limits.Watch; when its time is over, no more components are added

    Returns
    -------
    (F, 3, 2), orthonormal up to what the upgrade leaves: as in the reference code, they are not corrected.
    The signs of the frames are made continuous.

    Raises
    ------
    ValueError
        With fewer than 6 points, or images of rank 3 or less: those of a rigid object, or all alike.
    """
    F = len(X)
    U, s, _ = np.linalg.svd(stacked(X), full_matrices=False)
    rank = int((s > 1e-4 * s[0]).sum())
    if rank <= 3:
        raise ValueError(f"W has rank {rank}, as a rigid object's images have: tomasi_kanade is made for these.")
    n = min(3 * int(np.ceil(rank / 3)), len(s))
    if n < 6:
        raise ValueError(f"W has {len(s)} components; the cameras of a deforming shape need at least 6 points.")
    motion = (U[:, :n] * np.sqrt(s[:n])).reshape(F, 2, n)
    Q, best = np.eye(6, 3), np.inf
    for size in watch.steps(range(6, n + 1, 3), "cameras"):
        Q = np.vstack([Q, np.zeros((size - len(Q), 3))])
        part = np.ascontiguousarray(motion[:, :, :size])
        found = minimize(_misfit, Q.ravel(), args=(part,), jac=True, method="BFGS", options={"gtol": 1e-9})
        if not found.fun < best:
            break
        Q, best, kept = found.x.reshape(size, 3), found.fun, size
    rows = motion[:, :, :kept] @ _polished(Q[:kept], motion[:, :, :kept], watch)  # (F, 2, 3)
    return continuous(rows).transpose(0, 2, 1)


def _polished(Q: np.ndarray, motion: np.ndarray, watch: Watch) -> np.ndarray:
    """The same minimum to more digits: where some directions hardly matter, quasi-Newton steps end too early."""

    def evaluate(Q: np.ndarray) -> tuple[np.ndarray, float]:
        return Q, _misfit(Q.ravel(), motion)[0]

    def linearise(Q: np.ndarray) -> Propose:
        x, y = motion[:, 0], motion[:, 1]  # (F, n)
        Qx, Qy = x @ Q, y @ Q  # (F, 3)
        residual = np.concatenate([(Qx**2).sum(1) - 1, (Qy**2).sum(1) - 1, (Qx * Qy).sum(1)])
        by_Q = [2 * x[:, :, None] * Qx[:, None], 2 * y[:, :, None] * Qy[:, None]]
        by_Q.append(x[:, :, None] * Qy[:, None] + y[:, :, None] * Qx[:, None])
        J = np.concatenate(by_Q).reshape(len(residual), -1)
        U, s, Vh = np.linalg.svd(J, full_matrices=False)  # not JᵀJ, which would halve the digits
        along = U.T @ residual

        def propose(damping: float) -> tuple[np.ndarray, float]:
            return evaluate(Q - (Vh.T @ (s / (s**2 + damping * s[0] ** 2) * along)).reshape(Q.shape))

        return propose

    def settled(before: float, after: float) -> bool:
        return before - after <= _SETTLED * after

    return levenberg_marquardt(*evaluate(Q), linearise, settled, watch, "cameras", damping=1e-6, easing=10.0)[0]


def _misfit(q: np.ndarray, motion: np.ndarray) -> tuple[float, np.ndarray]:
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


def unordered_cameras(X: np.ndarray, rank: int, starts: Iterable, rng: np.random.Generator) -> np.ndarray:
    """Cameras of shapes of low rank, in any order of the frames: the upgrade of the block matrix method.

    As in `trajectory_cameras`, three columns G of the upgrade make each frame's two rows orthonormal, here of any
    length: the sum over frames of ((a − b)² + 4 c²) / (a + b)², with a = ‖r₁‖², b = ‖r₂‖², c = r₁·r₂, is minimised
    over 3·rank components. (The authors divide by a² instead, with the same minima on the classic sequences; but then
    one frame whose points lie on a vertical line spoils all cameras.)
    Dai et al. (2014) start from a semidefinite programme. That start is poor, and what decides is the minimum that is
    reached: so we start at random, several times, and keep the lowest.

    Parameters
    ----------
    X : (F, P, 2) centred image points
    rank : int, number of shape atoms
    starts : iterable; one minimisation for each of its items
    rng : NumPy Generator

    Returns
    -------
    (F, 3, 2), orthonormal; signs as `consistent` sets them.
    """
    F = len(X)
    U, s, _ = np.linalg.svd(stacked(X), full_matrices=False)
    n = min(3 * rank, len(s))
    motion = np.ascontiguousarray((U[:, :n] * np.sqrt(s[:n])).reshape(F, 2, n))
    found = []
    for _ in starts:
        first = np.linalg.qr(rng.normal(size=(n, 3)))[0]
        how = {"method": "BFGS", "options": {"gtol": 1e-8}}
        found.append(minimize(_ratio_misfit, first.ravel(), args=(motion,), jac=True, **how))
    rows = motion @ min(found, key=lambda result: result.fun).x.reshape(n, 3)  # (F, 2, 3)
    return consistent(orthonormal(rows.transpose(0, 2, 1)), X)


def _ratio_misfit(g: np.ndarray, motion: np.ndarray) -> tuple[float, np.ndarray]:
    """How far the rows of motion_f @ G are from equal length and a right angle, and its gradient."""
    flat = motion.reshape(-1, motion.shape[2])
    r1, r2 = (flat @ g.reshape(-1, 3)).reshape(-1, 2, 3).transpose(1, 0, 2)  # (F, 3) each
    a, b, c = ((u * v).sum(1) for u, v in ((r1, r1), (r2, r2), (r1, r2)))
    size = a + b
    length, angle = (a - b) / size, 2 * c / size  # both zero for a camera
    both = 2 * (length**2 + angle**2) / size
    da, db, dc = 2 * length / size - both, -2 * length / size - both, 4 * angle / size
    by_rows = np.stack([2 * da[:, None] * r1 + dc[:, None] * r2, 2 * db[:, None] * r2 + dc[:, None] * r1], 1)
    return (length**2).sum() + (angle**2).sum(), (flat.T @ by_rows.reshape(-1, 3)).ravel()


def continuous(rows: np.ndarray) -> np.ndarray:
    """Negate frames whose camera would turn by more than 90° from the frame before: (F, 2, 3)."""
    rows = rows.copy()
    for f in range(1, len(rows)):
        if (rows[f] * rows[f - 1]).sum() < 0:
            rows[f] *= -1
    return rows


def consistent(M: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Negate cameras so that the back-projected images look alike: for frames in no order.

    A camera and its negative explain the squares of an image equally well. Each image is back-projected into its
    plane in space, X_f M_fᵀ, and a frame that correlates negatively with the mean of all is negated, until none does
    (Lee et al., 2016).

    Parameters
    ----------
    M : (F, 3, 2) cameras
    X : (F, P, 2) centred image points

    Returns
    -------
    (F, 3, 2)
    """
    spatial = (X @ M.swapaxes(1, 2)).reshape(len(X), -1)
    # Start from the main direction of all frames, whatever their signs.
    sign = np.sign(spatial @ np.linalg.eigh(spatial.T @ spatial)[1][:, -1])
    sign[sign == 0] = 1
    for _ in range(len(X)):
        signed = spatial * sign[:, None]
        wrong = signed @ signed.mean(0) < 0
        if not wrong.any():
            break
        sign[wrong] *= -1
    return M * sign[:, None, None]
