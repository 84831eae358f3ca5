"""Structure from category: a few atoms, each turned by a camera of its own in every frame (Kong et al., 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import at_least, truth, whole
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from .shared.limits import Watch, check_cost
from .shared.upgrade import metric_gram

_START = 1e-2, 1e-1  # weights of the two constraints M = Z and A = B at the first iteration
_GROWTH = 1.1  # of both weights, per iteration
_LARGEST = 1e5
_ITERATIONS = 300
_TOLERANCE = 3e-6  # relative change of the objective
_REFITS, _SETTLED = 1000, 1e-6  # rounds of the upgrade, and the relative change of the misfit at which it rests
_RIDGE = 1e-12  # keeps a frame of few visible points solvable
_AGREEMENT = 1e-3  # of M and Z, relative: before, the objective may rest while all codes are still zero


@dataclass
class _State:
    """The splitting's variables. Codes are stacked as rows like the images: (F, 2, 3K), x and y per frame."""

    M: np.ndarray  # codes as the penalty sees them
    Z: np.ndarray  # codes as the images see them
    A: np.ndarray  # (3K, P) atoms of norm 1
    B: np.ndarray  # (3K, P) atoms as the images see them
    t: np.ndarray  # (F, 2, 1) translations
    to_Z: np.ndarray  # multipliers of M = Z
    to_B: np.ndarray  # multipliers of A = B


@one_thread
def sfc(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    rank: int = 5,
    penalty: float = 0.05,
    restarts: int = 1,
    upgrade: bool = False,
    max_seconds: float | None = None,
    progress: bool = True,
    seed: int = 0,
) -> Reconstruction:
    """A dictionary of `rank` atoms, whose 2×3 codes the spectral norm pulls towards scaled cameras.

    Objective: ``½ Σ_fp ω_fp |w_fp − t_f − Σ_k M_fkᵀ b_kp|² + penalty Σ_fk ‖M_fk‖₂`` over codes M_fk (3, 2),
    translations t_f and atoms B_k (P, 3) with ‖B_k‖_F = 1; ω is the confidence, zero where hidden. Each image is
    first divided by its norm. The spectral norm ‖·‖₂ is the tightest convex stand-in for "M_fk is a scale times a
    camera"; nothing ties the cameras of one frame's atoms to each other. Alternating directions with weights that
    grow by a tenth per iteration, about 100 iterations: a path that freezes rather than an exact minimum. Cost
    O(F (K² + K P)) per iteration and memory O(F (K + P)); with missing or doubtful points O(F (K³ + K² P)) and
    O(F (K² + P)).

    Assumes weak perspective: every frame has a scale of its own. Frames in any order.

    Since each atom turns freely, its mirror image fits as well, and the sum of `rank` atoms has depths that agree
    only in part. The relaxation is not exact either: on a rigid object without noise at rank 1 an error remains, the
    more the longer the object. `upgrade` takes that away.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Hidden points are left out of the objective.
    confidence : (F, P), optional
        From 0 to 1, the weight of a point's squared residual. Default: that of the Landmarks, else 1.
    rank : int
        Number of atoms K. The authors take 1 to 10 by category, 5 for many.
    penalty : float
        Theirs; 0.01 to 0.1 by category, 0.05 for most.
    restarts : int
        How many random dictionaries to begin with. The result of lowest objective counts, converged or not, and
        ``converged`` is its own. Ours.
    upgrade : bool
        For rank 1: at the end refit codes and atom without penalty, in turns, and change the atom's frame of axes
        such that the codes come as near to scaled cameras as they can. Exact on rigid objects, also with points
        missing; bad on what deforms much. Ours.
    max_seconds : float, optional
        For all restarts together; then the result so far is returned, with ``converged=False``. During the first
        third of the iterations it is of little use.
    progress : bool
    seed : int

    Returns
    -------
    Reconstruction in each frame's own camera frame and in the units of W. As no frame has one camera, every
    `cameras[f]` is eye(3, 2), also for rank 1, and `projections` are the modelled image. z points to the viewer, for
    one mirror image or the other.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 3 frames or 4 points; for a parameter out of range; for `upgrade` at
        rank > 1 or where no rigid object fits the images; or if memory or time would not suffice.

    References
    ----------
    Kong, Zhu, Kiani, Lucey (2016). Structure from category: a generic and prior-less approach. 3DV, 296–304.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(30))
    >>> nl.baselines.sfc(views, rank=1, progress=False).shapes.shape == views.points3d.shape
    True
    """
    images = read(W, visible, confidence, method="sfc", frames=3, points=4)
    F, P, _ = images.X.shape
    rank, restarts = whole("rank", rank, 1, 1000), whole("restarts", restarts, 1, 1000)
    penalty = at_least("penalty", penalty, above=True)
    if truth("upgrade", upgrade) and rank > 1:
        raise ValueError(f"upgrade=True with rank={rank}; expected rank=1, as the upgrade is that of a rigid object.")
    costs = _cost(F, P, rank, images.complete, restarts)
    check_cost("sfc", F, *costs, max_seconds=max_seconds, advice="Lower the rank.")
    weight = images.weight[:, None]  # (F, 1, P)
    X = images.X.swapaxes(1, 2)  # rows: (F, 2, P)
    size = np.sqrt((weight * X**2).sum((1, 2), keepdims=True))
    X = X / size
    watch = Watch("sfc", max_seconds, progress)
    rng = np.random.default_rng(seed)

    def from_random_start() -> tuple[_State, float, bool]:
        return _descend(_start(F, P, rank, rng), X, weight, penalty, watch)

    best, least, converged = from_random_start()
    for _ in range(restarts - 1):
        if watch.over:
            break
        state, value, done = from_random_start()
        if value < least:
            best, least, converged = state, value, done
    if upgrade:
        converged &= _upgrade(best, X, weight, watch)
    S = _shapes(best) * size
    M = np.repeat(np.eye(3, 2)[None], F, axis=0)
    return images.reconstruction(S, M, (best.t * size)[..., 0], method="sfc", converged=converged)


def _cost(F: int, P: int, K: int, complete: bool, restarts: int) -> tuple[float, float]:
    """Gigabytes and seconds, fitted to measurements of 1 000 to 40 000 frames at K = 1 to 10."""
    numbers = 10 * F * (P + 6 * K) + (0 if complete else 2.5 * F * (3 * K) ** 2)
    per_iteration = 1.3e-7 * F * (P + 6 * K) + (0 if complete else 2.2e-6 * F * K)
    return 8 * numbers / 2**30, 120 * restarts * per_iteration


def _start(F: int, P: int, K: int, rng: np.random.Generator) -> _State:
    """Random centred atoms; no codes yet."""
    A = rng.normal(size=(3 * K, P))
    A = _unit(A - A.mean(1, keepdims=True))
    Z = np.zeros((F, 2, 3 * K))
    return _State(M=Z, Z=Z, A=A, B=A, t=np.zeros((F, 2, 1)), to_Z=Z, to_B=np.zeros_like(A))


def _descend(
    state: _State, X: np.ndarray, weight: np.ndarray, penalty: float, watch: Watch
) -> tuple[_State, float, bool]:
    """Iterate until the objective rests: the state, its objective, and whether it did rest."""
    mu, rho = _START
    before = np.inf
    for _ in watch.steps(_ITERATIONS, "iterations"):
        _iterate(state, X, weight, penalty, mu, rho)
        value = _objective(state, X, weight, penalty)
        apart = np.abs(state.M - state.Z).max() / np.abs(state.Z).max()
        if 0 <= before - value < _TOLERANCE * value and apart < _AGREEMENT:
            return state, value, True
        before = value
        mu, rho = min(mu * _GROWTH, _LARGEST), min(rho * _GROWTH, _LARGEST)
    return state, before, False


def _iterate(s: _State, X: np.ndarray, weight: np.ndarray, penalty: float, mu: float, rho: float) -> None:
    """One round of alternating directions; each line is the exact minimum in its variable."""
    s.M = _prox(s.Z - s.to_Z / mu, penalty / mu)
    target = (X - s.t) * weight
    s.Z = _codes(s.B, target, weight, s.to_Z + mu * s.M, mu)
    s.B = _atoms(s.Z, target, weight, s.to_B + rho * s.A, rho)
    s.A = _unit(s.B - s.to_B / rho)
    s.t = _shift(X - s.Z @ s.B, weight)
    s.to_Z = s.to_Z + mu * (s.M - s.Z)
    s.to_B = s.to_B + rho * (s.A - s.B)


def _shift(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return (residual * weight).sum(2, keepdims=True) / weight.sum(2, keepdims=True)


def _codes(B: np.ndarray, target: np.ndarray, weight: np.ndarray, linear: np.ndarray, ridge: float) -> np.ndarray:
    """Ridge regression of every image on the atoms; images in which all points count fully share one matrix.

    `target` is weighted already; `linear` is what the other terms of the objective add to the right-hand side.
    """
    n = len(B)
    right = target.reshape(-1, B.shape[1]) @ B.T + linear.reshape(-1, n)  # rows (2F, 3K)
    diagonal = ridge * np.eye(n)
    Z = np.linalg.solve(B @ B.T + diagonal, right.T).T.reshape(linear.shape)
    part = (weight[:, 0] < 1).any(1)
    if part.any():
        products = (B[:, None] * B).reshape(n * n, -1)  # (9K², P)
        G = (weight[part, 0] @ products.T).reshape(-1, n, n) + diagonal
        Z[part] = np.linalg.solve(G, right.reshape(linear.shape)[part].swapaxes(1, 2)).swapaxes(1, 2)
    return Z


def _atoms(Z: np.ndarray, target: np.ndarray, weight: np.ndarray, linear: np.ndarray, ridge: float) -> np.ndarray:
    """Ridge regression of every point on the codes; arguments as in `_codes`."""
    n = Z.shape[2]
    rows = Z.reshape(-1, n)
    right = rows.T @ target.reshape(len(rows), -1) + linear  # (3K, P)
    diagonal = ridge * np.eye(n)
    if (weight == 1).all():
        return np.linalg.solve(rows.T @ rows + diagonal, right)
    products = (Z.swapaxes(1, 2) @ Z).reshape(len(Z), -1)
    G = (products.T @ weight[:, 0]).T.reshape(-1, n, n) + diagonal  # per point; in this order BLAS is far quicker
    return np.linalg.solve(G, right.T[..., None])[..., 0].T


def _unit(A: np.ndarray) -> np.ndarray:
    """Every atom, three rows, divided by its norm."""
    blocks = A.reshape(-1, 3, A.shape[1])
    return (blocks / np.sqrt((blocks**2).sum((1, 2), keepdims=True))).reshape(A.shape)


def _blocks(M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two columns of every block, x and y (F, K, 3), and their cross product."""
    x, y = M.reshape(len(M), 2, -1, 3).swapaxes(0, 1)
    return x, y, np.cross(x, y)


def _singular_values(x: np.ndarray, y: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """σ₁, σ₁ + σ₂ and σ₁ − σ₂ of blocks [x y], whose product σ₁ σ₂ is the norm of x × y."""
    square, area = (x * x + y * y).sum(-1), np.sqrt((normal**2).sum(-1))
    total, gap = np.sqrt(square + 2 * area), np.sqrt(np.maximum(square - 2 * area, 0))
    return (total + gap) / 2, total, gap


def _prox(N: np.ndarray, threshold: float) -> np.ndarray:
    """Minimise ½ ‖M − N‖² + threshold ‖M‖₂ over each block.

    Lower the larger singular value σ₁ by the threshold, but once it meets σ₂, both by the rest in equal
    parts, down to zero. What is needed is a polynomial N (α + β NᵀN), so that no singular vectors are formed.
    """
    x, y, normal = _blocks(N)
    largest, total, gap = _singular_values(x, y, normal)
    both = np.maximum(total - threshold, 0) / 2  # where they meet
    area = np.sqrt((normal**2).sum(-1))
    with np.errstate(divide="ignore", invalid="ignore"):  # each branch divides by what the other may have as zero
        meet = gap <= threshold
        beta = np.where(meet, -both / (total * area), -threshold / (largest * total * gap))
        alpha = np.where(meet, both * (total / area - 1 / total), 1 - beta * (area / largest) ** 2)
    alpha, beta = (np.where(both > 0, c, 0.0)[..., None] for c in (alpha, beta))
    xx, yy, xy = ((a * b).sum(-1, keepdims=True) for a, b in [(x, x), (y, y), (x, y)])
    return np.stack([(alpha + beta * xx) * x + beta * xy * y, beta * xy * x + (alpha + beta * yy) * y], 1).reshape(
        N.shape
    )


def _objective(s: _State, X: np.ndarray, weight: np.ndarray, penalty: float) -> float:
    """Of the codes and atoms that keep the constraints."""
    residual = X - s.t - s.M @ s.A
    return (weight * residual**2).sum() / 2 + penalty * _singular_values(*_blocks(s.M))[0].sum()


def _shapes(s: _State) -> np.ndarray:
    """x and y as modelled, and z from each block's completion by a third column as long as its largest one."""
    F, K = len(s.Z), s.A.shape[0] // 3
    x, y, normal = _blocks(s.Z)
    largest = _singular_values(x, y, normal)[0]
    z = normal / np.where(largest > 0, largest, 1)[..., None]
    return (np.stack([x, y, z], 1).reshape(F, 3, 3 * K) @ s.A).swapaxes(1, 2)


def _upgrade(s: _State, X: np.ndarray, weight: np.ndarray, watch: Watch) -> bool:
    """Refit one atom and its codes, and change its axes, M_f G and G⁻¹ B, such that they come near scaled cameras.

    Changes the state, and returns whether the refits came to rest.
    """
    before, settled = np.inf, False
    for k in watch.steps(_REFITS, "upgrade"):
        if k:
            s.A = _unit(_atoms(s.Z, (X - s.t) * weight, weight, np.zeros_like(s.A), _RIDGE))
        s.Z = _codes(s.A, (X - s.t) * weight, weight, np.zeros_like(s.Z), _RIDGE)
        s.t = _shift(X - s.Z @ s.A, weight)
        misfit = np.sqrt((weight * (X - s.t - s.Z @ s.A) ** 2).sum())
        settled = before - misfit <= _SETTLED * misfit
        if settled:
            break
        before = misfit
    Q = metric_gram(s.Z / np.sqrt((s.Z**2).sum((1, 2), keepdims=True)), one_scale=False)
    values, vectors = np.linalg.eigh(Q * np.sign(np.trace(Q)))
    if values[0] <= 1e-6 * values[2]:
        raise ValueError("upgrade=True, but no rigid object comes near these images; expected upgrade=False for them.")
    G = vectors * np.sqrt(values)
    s.Z, s.A = s.Z @ G, np.linalg.solve(G, s.A)
    return settled
