"""Consensus of non-rigid reconstructions: many small groups of points, then one shape (Lee, Cho & Oh, 2016)."""

from __future__ import annotations

from itertools import chain
from math import comb
from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from ..checks import at_least, whole
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from ._cns_groups import weak_depths
from .shared.completion import completed
from .shared.limits import Watch, check_cost

_GROUPS = 32  # at a time: few large operations in place of many small ones
_BATCH = 2**22  # but no more numbers in one array
_COLUMNS = 2**18  # numbers in one array of the consensus, so that it stays close to the processor
_GROWTH = 1.01  # of the consensus' penalty, per iteration
_GAP = 1e-10  # squared distance per frame at which the consensus ends
_STEPS = 10_000


@one_thread
def cns(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    group_size: int = 10,
    groups_per_point: int = 50,
    locality: float = 0.1,
    max_seconds: float | None = None,
    progress: bool = True,
    seed: int | np.random.Generator = 0,
) -> Reconstruction:
    """Depths of many small groups of points, each by low rank, and the shape that most of them agree on.

    Objective: with the depths z_gf of group g in frame f, up to a translation t_gf, and P_g picking its points,

        min_{z_f, t_f} Σ_g ‖z_gf − P_g z_f − t_gf 1‖₁    for each frame f .

    Four steps: `sample_groups` draws groups of points that move alike; `weak_depths` finds the depths of each group
    on its own; `group_signs` mirrors groups such that they agree; `consensus` solves the problem above. There are
    about 6 · groups_per_point · P / (5 · group_size) groups. Cost: about 800 iterations of O(F group_size²) for
    each, and 1,300 of O(F · groups · group_size); memory O(F · groups · group_size).

    Assumes near-orthographic views; scale may change from frame to frame. The order of the frames does not
    matter. Depth is told from how points move, so the views must differ. Everything happens in the frame of the
    camera: image points are kept as they are, and a depth is added. Groups compare *sums* over the frames, so the
    longer the sequence, the more local they are; where no group joins two parts of the shape, the depth between
    these is not known.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Hidden points are filled in by `complete` first.
    confidence : (F, P), optional
        From 0 to 1; `complete` moves a doubtful point towards its likely place. Default: that of the Landmarks,
        else 1.
    group_size : int
        Points per group, at least 4; with no more points than that, all are a single group, and nothing is left to
        agree on. As this, `groups_per_point` and `locality`, the default is that of the authors' program.
    groups_per_point : int
        The least number of groups that a point is in, as far as there are enough different ones.
    locality : float
        How much a group prefers points that are close to each other; 0 draws uniformly.
    max_seconds : float, optional
        When this time is over, the groups finished so far are made to agree, which on many frames can take longer than
        the groups did; but never fewer groups than cover all points.
    progress : bool
    seed : int, or NumPy Generator

    Returns
    -------
    Reconstruction in the frame of the camera, in the units of W: all cameras are (1, 0, 0), (0, 1, 0).

    Raises
    ------
    ValueError
        As `images.read`, with fewer frames than half a group's points or fewer than 4 points; for a parameter out
        of range; or if it takes more memory than there is, or more than an hour without `max_seconds`.

    Notes
    -----
    The steps, parameters and stop rules are those of the authors' program. Three things are done otherwise, with
    the same result: singular values come from small Gram matrices of centred points, the common signs from Lanczos'
    method in place of the power method, and the consensus starts where its penalty begins to matter. On data
    without noise the cameras of a group, not quite determined, converge so slowly that they are stopped.

    References
    ----------
    Lee, Cho, Oh (2016). Consensus of non-rigid reconstructions. CVPR, 4670–4678.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(30))
    >>> rec = nl.baselines.cns(views, groups_per_point=1, progress=False)
    >>> rec.shapes.shape == views.points3d.shape
    True
    """
    group_size = whole("group_size", group_size, 4, 1000)
    groups_per_point = whole("groups_per_point", groups_per_point, 1, 10_000)
    locality = at_least("locality", locality)
    images = completed(read(W, visible, confidence, method="cns", frames=max(3, (group_size + 1) // 2), points=4))
    F, P, _ = images.X.shape
    watch = Watch("cns", max_seconds, progress)
    n = min(group_size, P)
    m = 1.3 * groups_per_point * P / n  # about so many groups
    numbers = 48 / 8 * F * m * n + 3 * (P + m) ** 2
    check_cost("cns", F, 8 * numbers / 2**30, m * (0.03 + 2.4e-4 * F), max_seconds, "Fewer groups_per_point cost less.")
    groups = sample_groups(images.X, n, groups_per_point, locality, np.random.default_rng(seed))
    depths, finished = _depths(images.X, groups, watch)
    groups = groups[: len(depths)]
    depths *= group_signs(depths, groups)[:, None, None]
    z = consensus(depths, groups)
    S = np.concatenate([images.X, z.T[..., None]], 2)
    return images.reconstruction(S, np.tile(np.eye(3, 2), (F, 1, 1)), method="cns", converged=finished)


def sample_groups(X: np.ndarray, size: int, per_point: int, locality: float, rng: np.random.Generator) -> np.ndarray:
    """Groups of points that look alike in all frames, no two the same, until every point is in `per_point`.

    A group starts with any of the points that are used least. Every further point j is drawn with a probability
    in proportion to exp(−locality / (2 size) Σ_i d_ij), i over the points of the group so far, where
    d_ij = Σ_f ‖x_fi − x_fj‖² after each frame is whitened (the covariance of its points made the identity).

    Parameters
    ----------
    X : (F, P, 2) centred points
    size, per_point : int
    locality : float
    rng : NumPy Generator

    Returns
    -------
    (m, size) indices of points; those of a group in ascending order
    """
    F, P, _ = X.shape
    covariance = X.mT @ X / (P - 1)
    covariance += 1e-9 * np.trace(covariance, axis1=1, axis2=2)[:, None, None] * np.eye(2)  # points on one line
    white = np.linalg.solve(np.linalg.cholesky(covariance), X.mT).reshape(2 * F, P)
    inner = white.T @ white
    log_p = -locality / (2 * size) * (inner.diagonal()[:, None] + inner.diagonal() - 2 * inner)
    np.fill_diagonal(log_p, -np.inf)
    per_point = min(per_point, comb(P - 1, size - 1))  # a point cannot be in more different groups
    groups = np.zeros((0, P), bool)
    used = groups.sum(0)
    while used.min() < per_point:
        chosen = [rng.choice(np.flatnonzero(used == used.min()))]
        same = groups[groups[:, chosen[0]]]  # earlier groups with all points chosen so far
        for taken in range(1, size):
            total = log_p[chosen].sum(0)
            # Leave out a point if all groups that could follow are there already.
            total[same.sum(0) >= comb(P - taken - 1, size - taken - 1)] = -np.inf
            chosen.append((total + rng.gumbel(size=P)).argmax())  # Gumbel's trick: a draw in proportion to exp(total)
            same = same[same[:, chosen[-1]]]
        groups = np.vstack([groups, np.isin(np.arange(P), chosen)])
        used = groups.sum(0)
    return np.nonzero(groups)[1].reshape(-1, size)


def _depths(X: np.ndarray, groups: np.ndarray, watch: Watch) -> tuple[np.ndarray, bool]:
    """Depths (m, n, F) of the groups for which there is time, but of enough to cover all points; all done?"""
    F, P, _ = X.shape
    images = torch.as_tensor(X)
    per_batch = max(1, min(_GROUPS, _BATCH // (2 * F * comb(groups.shape[1], 2))))

    def batches(groups: np.ndarray) -> list[np.ndarray]:
        return [groups[k : k + per_batch] for k in range(0, len(groups), per_batch)]

    enough = max((groups == p).any(1).argmax() for p in range(P)) + 1
    patient = Watch(watch.method, progress=watch.progress).steps(batches(groups[:enough]), "first groups")
    done = [
        weak_depths(images[:, batch].transpose(0, 1)).numpy()
        for batch in chain(patient, watch.steps(batches(groups[enough:]), "groups"))
    ]
    depths = np.concatenate(done)
    return depths, len(depths) == len(groups)


def group_signs(depths: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Signs of the groups such that their depths agree where they overlap.

    With unit depths z_g and one sequence u of depths for all points, maximises Σ_g ⟨z_g, u⟩² less the variation
    of u inside the groups that z_g does not explain: the first eigenvector of a symmetric matrix, which is
    never formed. The sign of a group is that of ⟨z_g, u⟩.

    Parameters
    ----------
    depths : (m, n, F), zero mean over the points of a group
    groups : (m, n)

    Returns
    -------
    (m,), 1 or −1
    """
    m, n, F = depths.shape
    P = groups.max() + 1
    depths = depths / np.linalg.norm(depths, axis=(1, 2), keepdims=True).clip(1e-12)
    picks = sparse.csr_array((np.ones(m * n), groups.ravel(), np.arange(m * n + 1)), shape=(m * n, P))
    together = (picks.T @ sparse.kron(sparse.eye_array(m), np.ones((n, n)), format="csr") @ picks).toarray()
    count = together.diagonal()  # groups that a point is in
    kept = np.diag(count.max() - count) + together / n  # most groups of a point, less the centring of every group

    def explained(U: np.ndarray) -> np.ndarray:
        return np.einsum("gnf,gnf->g", depths, U.reshape(P, F)[groups])

    def times(U: np.ndarray) -> np.ndarray:
        new = picks.T @ (explained(U)[:, None, None] * depths).reshape(m * n, F)
        return (kept @ U.reshape(P, F) + new).ravel()

    start = picks.T @ depths.reshape(m * n, F)
    U = eigsh(LinearOperator((P * F, P * F), times, dtype=float), 1, which="LA", v0=start.ravel(), tol=1e-6)[1]
    return np.where(explained(U) < 0, -1.0, 1.0)


def consensus(depths: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The depths of all points on which most groups agree, by least absolute differences.

    min ‖y − A x‖₁ for each frame, where x holds the depths of the points and one translation per group, y the depths
    of the groups and a zero: the sum of the points. By a linearised alternating direction method of multipliers
    with a growing penalty.

    Parameters
    ----------
    depths : (m, n, F)
    groups : (m, n)

    Returns
    -------
    (P, F)
    """
    m, n, F = depths.shape
    P = groups.max() + 1
    row = np.arange(m * n)
    rows = np.concatenate([row, row, np.full(P, m * n)])
    columns = np.concatenate([groups.ravel(), P + row // n, np.arange(P)])
    A = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(m * n + 1, P + m))
    At = A.T.tocsr()
    slope = eigsh(At @ A, 1, v0=np.ones(P + m), return_eigenvectors=False)[0]
    start = np.linalg.inv((At @ A).toarray() + 1e-9 * np.eye(P + m))  # regular even if no group joins two parts
    z = np.zeros((P, F))
    width = max(1, _COLUMNS // (m * n))
    for first in range(0, F, width):
        y = depths[..., first : first + width].reshape(m * n, -1)
        y = np.vstack([y, np.zeros(y.shape[1])])
        z[:, first : first + width] = _least_absolute(A, At, y, start @ (At @ y), slope)[:P]
    return z


def _least_absolute(
    A: sparse.csr_array, At: sparse.csr_array, y: np.ndarray, x: np.ndarray, slope: float
) -> np.ndarray:
    """x that minimises ‖y − A x‖₁ column by column, from the least-squares solution."""
    residual = y - A @ x
    # While the penalty is small, nothing is an outlier, x stays the least-squares solution, and the multipliers L
    # settle at residual / (_GROWTH − 1). So begin where the largest reaches the bound, 1 / penalty.
    L = residual / (_GROWTH - 1)
    bound = np.abs(residual + L).max(0)
    for step in range(_STEPS):
        inside = np.minimum(np.maximum(residual + L, -bound), bound)  # the part of residual + L that is not an outlier
        move = At @ inside / slope
        x += move
        change = A @ move
        residual -= change
        new = inside - change  # the new multipliers: L + residual − outliers
        if step % 10 == 0 and (np.square(new - L).sum(0) <= _GAP).all():
            break
        L, bound = new / _GROWTH, bound / _GROWTH
    return x
