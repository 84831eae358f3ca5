"""The depths of a few points by low rank alone: the building block of consensus (Lee, Cho & Oh, 2016)."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import helmert
from torch import Tensor

from ..cameras import nearest_orthonormal
from .shared.descent import nesterov

_ENERGY = 1 - 1e-5  # of the images, that the columns for the cameras hold
_EPS = torch.finfo(torch.float64).eps
_UPGRADE_STEPS = 20_000  # at most; the original has no bound, and data without noise would take millions
_DEPTH_STEPS = 5_000  # at most; it takes 700 to 1,000
_GROWTH = 1.02  # of the penalty, per iteration
_GAP = 1e-10  # squared distance of the shapes from their low-rank copies, at which they count as equal


def weak_depths(W: Tensor) -> Tensor:
    """Depths of groups of points, each group on its own and up to its sign.

    Cameras first: the images of a group, stacked (2F, n), are factored, and a positive matrix Q of trace one and
    rank three is sought in which the two rows of every frame are orthogonal and equally long. Then the depths z,
    with the cameras given: the shapes in space, X_f(z) = [W_f, z_f] R_fᵀ, are as low in rank as they can,

        min_z ‖X(z) − mean over the frames‖_* ,    one row X_f per frame,

    by an alternating direction method of multipliers with a growing penalty.

    Parameters
    ----------
    W : (G, F, n, 2) tensor in double precision; G groups

    Returns
    -------
    (G, n, F), the unit that of W, zero mean over the points
    """
    n = W.shape[2]
    # Centred points have one coordinate less than points: shorter matrices, the same singular values.
    basis = torch.as_tensor(helmert(n))  # (n − 1, n), orthonormal rows with zero sum
    W = basis @ W
    size = W.norm(dim=(2, 3), keepdim=True).clamp(min=1e-12)
    W = W / size
    M, scale = group_cameras(W)
    spatial = W / scale[:, :, None, None] @ M.mT  # (G, F, n − 1, 3): the images in their planes in space
    sign = _alike(spatial)[..., None, None]
    view = torch.linalg.cross(M[..., 0], M[..., 1])  # the same for a camera and its negative
    z = lowest_rank_depths((spatial * sign).permute(0, 3, 2, 1).contiguous(), view.mT.contiguous())
    return basis.T @ (z * (size[:, :, 0, 0] * scale)[:, None])


def group_cameras(W: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras (G, F, 3, 2) of centred images W (G, F, q, 2), and the scale of each frame, 1 or more: (G, F).

    The upgrade is found on three columns of the factor first, then on three more at a time, until it is
    exact or the columns hold nearly all of the images.
    """
    G, F, q, _ = W.shape
    U, s, _ = torch.linalg.svd(W.mT.reshape(G, 2 * F, q), full_matrices=False)
    U = U.view(G, F, 2, q)
    share = s.square().cumsum(1) / s.square().sum(1, keepdim=True)
    columns = (((share < _ENERGY).sum(1) + 3) // 3 * 3).clamp(max=q).numpy()
    factor = np.zeros((G, q, 3))
    growing = np.arange(G)
    for K in [*range(3, q, 3), q]:
        growing = growing[columns[growing] >= K]
        if not len(growing):
            break
        A, size = constraints(U[growing, :, :, :K])
        start = np.tile(np.eye(3), (len(A), 1, 1)) if K == 3 else factor[growing, :K]
        factor[growing, :K], cost = upgrade(A, start, accelerate=K == 3)
        growing = growing[cost * size >= _EPS]
    blocks = (U.view(G, 2 * F, q) @ torch.as_tensor(factor)).view(G, F, 2, 3).mT
    M = nearest_orthonormal(blocks)
    scale = (M * blocks).sum((2, 3))  # twice the mean of the two singular values
    # A block without extent says nothing about the scale; it must not blow up all others.
    scale = scale.clamp(min=1e-3 * scale.median(1, keepdim=True).values)
    return M, scale / scale.amin(1, keepdim=True)


def constraints(U: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """What Q has to make zero in every frame: m₁ᵀ Q m₁ − m₂ᵀ Q m₂ and 2 m₁ᵀ Q m₂, as a matrix of unit norm.

    Parameters
    ----------
    U : (G, F, 2, K) tensor, the rows m₁ and m₂ of every frame

    Returns
    -------
    A : (G, r, K²) array, r ≤ K (K + 1) / 2: as many equations as there are unknowns, with the same sum of squares
    size : (G,) array, the square of the norm that A was divided by
    """
    m1, m2 = U.unbind(2)  # (G, F, K)
    K = U.shape[3]
    i, j = torch.triu_indices(K, K)
    # Off the diagonal, an entry times √2 stands for the two equal ones, so that all norms are kept.
    weight = torch.where(i == j, 1.0, 2.0**0.5).double()
    length = (m1[..., i] * m1[..., j] - m2[..., i] * m2[..., j]) * weight
    angle = (m1[..., i] * m2[..., j] + m1[..., j] * m2[..., i]) * weight
    A = torch.linalg.qr(torch.cat([length, angle], 1), mode="r").R
    norm = torch.linalg.matrix_norm(A, 2)
    A = A / weight / norm[:, None, None]
    full = A.new_zeros(*A.shape[:2], K, K)
    full[..., i, j] = full[..., j, i] = A
    return full.flatten(2).numpy(), norm.square().numpy()


def upgrade(A: np.ndarray, factor: np.ndarray, accelerate: bool) -> tuple[np.ndarray, np.ndarray]:
    """min ‖A vec(Q)‖² over positive Q of trace one and rank three, by projected gradients.

    With three columns the set is convex, and the steps are accelerated (Nesterov); with more it is not, and plain
    steps go down from the start. In NumPy, which starts small operations faster.

    Parameters
    ----------
    A : (G, r, K²) array of unit norm
    factor : (G, K, 3) array, of the Q to start from
    accelerate : bool

    Returns
    -------
    factor : (G, K, 3) array
    cost : (G,) array
    """
    result, costs = factor.copy(), np.zeros(len(A))
    left = np.arange(len(A))  # groups not yet finished
    factor = factor / np.linalg.norm(factor, axis=(1, 2), keepdims=True)
    Q = factor @ factor.swapaxes(1, 2)
    ahead, momentum = Q, 1.0
    image = residual = _apply(A, Q)
    cost = np.square(image).sum(1)
    for step in range(_UPGRADE_STEPS):
        Q_before, image_before, cost_before = Q, image, cost
        factor = _nearest_factor(ahead - (residual[:, None] @ A).reshape(Q.shape))
        Q = factor @ factor.swapaxes(1, 2)
        image = _apply(A, Q)
        cost = np.square(image).sum(1)
        if accelerate:
            bound = np.square(Q - ahead).sum((1, 2)) + cost - np.square(image - residual).sum(1)
            done = (bound <= (1 + 1e-12) * cost) | (bound <= _EPS)
            momentum, share = nesterov(momentum)
            ahead, residual = Q + share * (Q - Q_before), image + share * (image - image_before)
        else:
            done = cost_before <= (1 + 1e-6) * cost
            ahead, residual = Q, image
        if done.any() or step == _UPGRADE_STEPS - 1:
            result[left], costs[left] = factor, cost
            left, A, Q, image, cost, ahead, residual = (x[~done] for x in (left, A, Q, image, cost, ahead, residual))
            if not len(left):
                break
    return result, costs


def lowest_rank_depths(X: Tensor, view: Tensor) -> Tensor:
    """Depths that make shapes in space low in rank.

    Parameters
    ----------
    X : (G, 3, q, F), the images in their planes in space; the frames come last, so that they lie side by side
    view : (G, 3, F), the direction of depth

    Returns
    -------
    (G, q, F)
    """
    G, _, q, F = X.shape
    C = X - X.mean(3, keepdim=True)  # the shapes at the present depths, without their mean
    L = torch.zeros_like(C)  # multipliers over the penalty
    z = torch.zeros(G, q, F, dtype=X.dtype)
    result = torch.zeros_like(z)
    left, penalty = torch.arange(G), 1.0
    view = view[:, :, None]
    for _ in range(_DEPTH_STEPS):
        # The low-rank copy is Y = A − D: the singular values of A = C − L are lowered by 1 / penalty. Of A Aᵀ,
        # which is small, the eigenvectors suffice: D keeps the share min(1, 1 / (penalty · σ)) of each.
        A = (C - L).view(-1, 3 * q, F)
        values, vectors = torch.linalg.eigh(A @ A.mT)
        share = 1 / (penalty * values.clamp(min=0).sqrt()).clamp(min=1)
        D = ((vectors * share[:, None]) @ vectors.mT @ A).view(-1, 3, q, F)
        step = (D * view).sum(1)  # towards the copy, as far as depth can go
        z = z - step
        move = step[:, None] * view
        move -= move.mean(3, keepdim=True)
        # New depths C − move, and new multipliers L + Y − (C − move) = move − D.
        new = move - D
        gap = (new - L).square().sum((1, 2, 3))  # = ‖Y − (C − move)‖²
        C, L, penalty = C - move, new / _GROWTH, penalty * _GROWTH
        done = gap <= _GAP
        if done.any():
            result[left[done]] = z[done]
            left, C, L, z, view = (x[~done] for x in (left, C, L, z, view))
            if not len(left):
                break
    else:
        result[left] = z
    return result


def _alike(spatial: Tensor) -> Tensor:
    """Signs (G, F) that make every frame of back-projected images (G, F, q, 3) correlate with the mean of its group."""
    spatial = spatial.flatten(2)
    sign = torch.ones(spatial.shape[:2], dtype=spatial.dtype)
    mean = spatial[:, 0]
    for _ in range(spatial.shape[1]):
        wrong = sign * (spatial @ mean[..., None])[..., 0] < 0
        if not wrong.any():
            break
        sign = torch.where(wrong, -sign, sign)
        mean = (sign[..., None] * spatial).mean(1)
    return sign


def _nearest_factor(Q: np.ndarray) -> np.ndarray:
    """The factor (G, K, 3) of the positive matrix of rank three and trace one nearest to Q (G, K, K)."""
    values, vectors = np.linalg.eigh(Q)
    values, vectors = values[:, :-4:-1], vectors[:, :, :-4:-1]  # the three largest, in descending order
    # Onto the simplex: lower all by the same, such that what stays positive sums to one.
    lower = ((values.cumsum(1) - 1) / (1, 2, 3)).max(1, keepdims=True)
    return vectors * np.sqrt((values - lower).clip(0))[:, None]


def _apply(A: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """A vec(Q), for each group: (G, r)."""
    return (A @ Q.reshape(len(Q), -1, 1))[..., 0]
