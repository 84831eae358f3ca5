"""Structure from category: a few atoms, each turned by a camera of its own in every frame (Kong et al., 2016)."""

from dataclasses import dataclass

import numpy as np

from ..threads import one_thread
from .images import read
from .limits import Watch, check_cost, check_whole
from .upgrade import quadratic, symmetric

_START = 1e-2, 1e-1  # weights of the two constraints M = Z and A = B at the first iteration
_GROWTH = 1.1  # of both weights, per iteration
_LARGEST = 1e5
_ITERATIONS = 300
_TOLERANCE = 3e-6  # relative change of the objective
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
    W, visible=None, rank=5, penalty=0.05, restarts=1, upgrade=False, max_seconds=None, progress=True, seed=0
):  # fmt: skip
    """A dictionary of `rank` atoms, whose 2×3 codes the spectral norm pulls towards scaled cameras.

    Objective: ``½ Σ_visible |w_fp − t_f − Σ_k M_fkᵀ b_kp|² + penalty Σ_fk ‖M_fk‖₂`` over codes M_fk (3, 2),
    translations t_f and atoms B_k (P, 3) with ‖B_k‖_F = 1, each image first divided by its norm. The spectral
    norm ‖·‖₂ is the tightest convex stand-in for "M_fk is a scale times a camera"; nothing ties the cameras of
    one frame's atoms to each other. Alternating directions with weights that grow by a tenth per iteration, about
    100 iterations: a path that freezes rather than an exact minimum. Cost O(F (K² + K P)) per iteration and
    memory O(F (K + P)); with missing points O(F (K³ + K² P)) and O(F (K² + P)).

    Assumes weak perspective: every frame has a scale of its own. Frames in any order. Hidden points are left
    out of the objective.

    Since each atom turns freely, its mirror image fits as well, and the sum of `rank` atoms has depths that agree
    only in part. The relaxation is not exact either: on a rigid object without noise at rank 1 the error was 0.06
    to 0.24, the more the longer the object. `upgrade` takes that away.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
    rank : int
        Number of atoms K. The authors take 1 to 10 by category, 5 for many.
    penalty : float
        Theirs; 0.01 to 0.1 by category, 0.05 for most.
    restarts : int
        How many random dictionaries to begin with; the result of lowest objective counts. Ours.
    upgrade : bool
        For rank 1: at the end refit the codes without penalty, and change the atom's frame of axes such that they
        come as near to scaled cameras as they can. Exact on rigid objects (error 0.006 to 0.017 with 20 % of
        the points missing), bad on what deforms much. Ours.
    max_seconds : float, optional
        For all restarts together. During the first third of the iterations the result is of little use.
    progress : bool
    seed : int

    Returns
    -------
    Reconstruction in each frame's own camera frame: as no frame has one camera, every `cameras[f]` is eye(3, 2),
    also for rank 1, and `projections` are the modelled image. z points to the viewer, for one mirror image or
    the other.

    Raises
    ------
    ValueError
        For a parameter out of range, `upgrade` at rank > 1 or where no rigid object fits the images, or a point
        hidden in every frame.
    """
    images = read(W, visible, fill=False, method="sfc")
    F, P, _ = images.X.shape
    _check(rank, penalty, restarts, upgrade)
    complete = images.visible.all()
    check_cost("sfc", F, *_cost(F, P, rank, complete, restarts), max_seconds=max_seconds, advice="Lower the rank.")
    seen = images.visible[:, None].astype(float)  # (F, 1, P)
    X = images.X.swapaxes(1, 2)  # rows: (F, 2, P)
    size = np.sqrt((X**2).sum((1, 2), keepdims=True))
    X = X / size
    watch = Watch("sfc", max_seconds, progress)
    best, best_value, converged = None, np.inf, False
    rng = np.random.default_rng(seed)
    for _ in range(restarts):
        state, value, done = _descend(_start(F, P, rank, rng), X, seen, penalty, watch)
        if best is None or (value < best_value and done):
            best, best_value, converged = state, value, done
        if watch.over:
            break
    if upgrade:
        _upgrade(best, X, seen)
    S = _shapes(best) * size
    M = np.repeat(np.eye(3, 2)[None], F, axis=0)
    return images.reconstruction(S, M, "sfc", converged, t=(best.t * size)[..., 0])


def _check(rank, penalty, restarts, upgrade):
    check_whole("rank", rank, 1, 1000)
    check_whole("restarts", restarts, 1, 1000)
    if not 0 < penalty < np.inf:
        raise ValueError(f"penalty={penalty}; expected a positive number.")
    if upgrade and rank > 1:
        raise ValueError(f"upgrade=True with rank={rank}; expected rank=1, as the upgrade is that of a rigid object.")


def _cost(F, P, K, complete, restarts):
    """Gigabytes and seconds, fitted to measurements of 1 000 to 40 000 frames at K = 1 to 10."""
    numbers = 10 * F * (P + 6 * K) + (0 if complete else 2.5 * F * (3 * K) ** 2)
    per_iteration = 1.3e-7 * F * (P + 6 * K) + (0 if complete else 2.2e-6 * F * K)
    return 8 * numbers / 2**30, 120 * restarts * per_iteration


def _start(F, P, K, rng):
    """Random centred atoms; no codes yet."""
    A = rng.normal(size=(3 * K, P))
    A = _unit(A - A.mean(1, keepdims=True))
    Z = np.zeros((F, 2, 3 * K))
    return _State(M=Z, Z=Z, A=A, B=A, t=np.zeros((F, 2, 1)), to_Z=Z, to_B=np.zeros_like(A))


def _descend(state, X, seen, penalty, watch):
    """Iterate until the objective rests: the state, its objective, and whether it did rest."""
    mu, rho = _START
    before = np.inf
    for _ in watch.steps(_ITERATIONS, "iterations"):
        _iterate(state, X, seen, penalty, mu, rho)
        value = _objective(state, X, seen, penalty)
        apart = np.abs(state.M - state.Z).max() / np.abs(state.Z).max()
        if 0 <= before - value < _TOLERANCE * value and apart < _AGREEMENT:
            return state, value, True
        before = value
        mu, rho = min(mu * _GROWTH, _LARGEST), min(rho * _GROWTH, _LARGEST)
    return state, before, False


def _iterate(s, X, seen, penalty, mu, rho):
    """One round of alternating directions; each line is the exact minimum in its variable."""
    s.M = _prox(s.Z - s.to_Z / mu, penalty / mu)
    target = (X - s.t) * seen
    s.Z = _codes(s.B, target, seen, s.to_Z + mu * s.M, mu)
    s.B = _atoms(s.Z, target, seen, s.to_B + rho * s.A, rho)
    s.A = _unit(s.B - s.to_B / rho)
    s.t = _shift(X - s.Z @ s.B, seen)
    s.to_Z = s.to_Z + mu * (s.M - s.Z)
    s.to_B = s.to_B + rho * (s.A - s.B)


def _shift(rest, seen):
    return (rest * seen).sum(2, keepdims=True) / seen.sum(2, keepdims=True)


def _codes(B, target, seen, pull, weight):
    """Ridge regression of every image on the atoms; images that show all points share one matrix."""
    n = len(B)
    right = target.reshape(-1, B.shape[1]) @ B.T + pull.reshape(-1, n)  # rows (2F, 3K)
    ridge = weight * np.eye(n)
    Z = np.linalg.solve(B @ B.T + ridge, right.T).T.reshape(pull.shape)
    part = ~seen[:, 0].all(1)
    if part.any():
        products = (B[:, None] * B).reshape(n * n, -1)  # (9K², P)
        G = (seen[part, 0] @ products.T).reshape(-1, n, n) + ridge
        Z[part] = np.linalg.solve(G, right.reshape(pull.shape)[part].swapaxes(1, 2)).swapaxes(1, 2)
    return Z


def _atoms(Z, target, seen, pull, weight):
    """Ridge regression of every point on the codes."""
    n = Z.shape[2]
    rows = Z.reshape(-1, n)
    right = rows.T @ target.reshape(len(rows), -1) + pull  # (3K, P)
    ridge = weight * np.eye(n)
    if seen.all():
        return np.linalg.solve(rows.T @ rows + ridge, right)
    products = (Z.swapaxes(1, 2) @ Z).reshape(len(Z), -1)
    G = (products.T @ seen[:, 0]).T.reshape(-1, n, n) + ridge  # per point; in this order BLAS is far quicker
    return np.linalg.solve(G, right.T[..., None])[..., 0].T


def _unit(A):
    """Every atom, three rows, divided by its norm."""
    blocks = A.reshape(-1, 3, A.shape[1])
    return (blocks / np.sqrt((blocks**2).sum((1, 2), keepdims=True))).reshape(A.shape)


def _blocks(M):
    """The two columns of every block, x and y (F, K, 3), and their cross product."""
    x, y = M.reshape(len(M), 2, -1, 3).swapaxes(0, 1)
    return x, y, np.cross(x, y)


def _singular_values(x, y, normal):
    """σ₁, σ₁ + σ₂ and σ₁ − σ₂ of blocks [x y], whose product σ₁ σ₂ is the norm of x × y."""
    square, area = (x * x + y * y).sum(-1), np.sqrt((normal**2).sum(-1))
    total, gap = np.sqrt(square + 2 * area), np.sqrt(np.maximum(square - 2 * area, 0))
    return (total + gap) / 2, total, gap


def _prox(N, threshold):
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


def _objective(s, X, seen, penalty):
    """Of the codes and atoms that keep the constraints."""
    rest = (X - s.t - s.M @ s.A) * seen
    return (rest**2).sum() / 2 + penalty * _singular_values(*_blocks(s.M))[0].sum()


def _shapes(s):
    """x and y as modelled, and z from each block's completion by a third column as long as its largest one."""
    F, K = len(s.Z), s.A.shape[0] // 3
    x, y, normal = _blocks(s.Z)
    largest = _singular_values(x, y, normal)[0]
    z = normal / np.where(largest > 0, largest, 1)[..., None]
    return (np.stack([x, y, z], 1).reshape(F, 3, 3 * K) @ s.A).swapaxes(1, 2)


def _upgrade(s, X, seen):
    """Refit the codes of one atom, and change its axes, M_f G and G⁻¹ B, such that they come near scaled cameras."""
    s.Z = _codes(s.A, (X - s.t) * seen, seen, np.zeros_like(s.Z), 1e-12)
    s.t = _shift(X - s.Z @ s.A, seen)
    x, y = s.Z.swapaxes(0, 1) / np.sqrt((s.Z**2).sum((1, 2)))[:, None]
    system = np.concatenate([quadratic(x, x) - quadratic(y, y), 2 * quadratic(x, y)])
    Q = symmetric(np.linalg.eigh(system.T @ system)[1][:, 0])
    values, vectors = np.linalg.eigh(Q * np.sign(np.trace(Q)))
    if values[0] <= 1e-6 * values[2]:
        raise ValueError("upgrade=True, but no rigid object comes near these images; expected upgrade=False for them.")
    G = vectors * np.sqrt(values)
    s.Z, s.A = s.Z @ G, np.linalg.solve(G, s.A)
