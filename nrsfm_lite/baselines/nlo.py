"""Non-linear optimisation: bundle adjustment of a low-rank shape (Del Bue, Smeraldi & Agapito, 2007)."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from ..cameras import rotations
from ..threads import one_thread
from .images import read
from .limits import Watch, check_cost, check_whole
from .rigid import tomasi_kanade

_DAMPING = 1e-3, 1e-12, 1e12  # at the start, the least, and where nothing is left to gain
_FLOOR = 1e-6  # of what damping scales, for unknowns that nothing sees
_ITERATIONS = 100  # for each number of atoms
_TOLERANCE = 1e-6  # relative change of the objective
_ROWS = 2048  # of the eliminated system at a time, so that they stay in the cache


@dataclass(frozen=True)
class _Problem:
    """Images (F, P, 2), what is visible in them (F, P) as 0 and 1, the priors, and the rigid shape (P, 3)."""

    X: np.ndarray
    seen: np.ndarray
    prior: float
    mean_prior: float
    mean: np.ndarray

    @property
    def on_weights(self):
        return self.prior * 3 * self.X.shape[1]

    def pull(self, atoms):
        """How strongly each atom (K, P, 3) is pulled, (K, 1, 1), and away from what."""
        strength = np.full((len(atoms), 1, 1), self.prior * len(self.X))
        strength[0] = self.mean_prior * len(self.X)
        return strength, np.concatenate([atoms[:1] - self.mean, atoms[1:]])


@dataclass(frozen=True)
class _State:
    """One point of the search: shapes S_f = B_0 + Σ_k l_fk B_k, seen as S_f Q_f[:, :2] + t_f."""

    Q: np.ndarray  # (F, 3, 3) rotations; the third column points to the viewer
    weights: np.ndarray  # (F, K), the first fixed at 1
    atoms: np.ndarray  # (K, P, 3)
    t: np.ndarray  # (F, 2)

    @property
    def cameras(self):
        return self.Q[:, :, :2]

    @property
    def shapes(self):
        return np.tensordot(self.weights, self.atoms, 1)


@one_thread
def nlo(W, visible=None, rank=3, prior=1e-2, mean_prior=1e-3, max_seconds=None, progress=True):
    """Cameras, weights and atoms together, by bundle adjustment from a rigid start.

    Objective: ``½ Σ_visible |w_fp − t_f − M_fᵀ s_fp|² + ½ prior Σ_k≥1 (3P ‖l_k‖² + F ‖B_k‖²) + ½ mean_prior F
    ‖B_0 − B_rigid‖²`` with ``S_f = B_0 + Σ_k≥1 l_fk B_k``, over cameras M_f, held exactly orthonormal as they are
    moved by rotations, weights l, atoms B and translations t. Levenberg-Marquardt; the unknowns of each frame are
    eliminated, which leaves a system in the 3 K P coordinates of the atoms. Per iteration O(F K (3KP)² + (3KP)³),
    memory O(F P K + (3KP)²); up to 100 iterations per descent, `rank` + 1 descents.

    Local, so the start counts: the rigid shape and cameras of `tomasi_kanade`, and atoms from what is left over of
    the images, laid back into space. Two descents, one with all atoms at once and one that refines before each new
    atom, compete by their objective. A minimum far from the truth can have the lower objective: on one of the five
    classic sequences (stretch) the result is worse than the rigid start.

    Assumes orthographic views of one scale that are not far from those of a rigid object; frames in any order.
    Hidden points are left out of the objective; for the start they are filled in.

    Certain from the paper is the adjustment of all unknowns with exact cameras. Its priors and its start could not
    be read. Ours are the priors' form and strengths, the weight of B_0 fixed at 1, and the two descents. Where that
    weight was free, depths grew many times over on a classic sequence (yoga), whatever the prior; fixed but with
    neither prior, they did on another (stretch). `prior` and `rank` were chosen on generated motion (three clips seen
    by a circling camera), the form of the priors with the classic sequences and their truth at hand: those figures
    are not held out. Left out are priors on smooth motion.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
    rank : int
        Number of atoms K, the mean shape B_0 counted. 2 or 3 are usual.
    prior : float
        On what deforms: lessens the amplitude of every atom by about 1.5 · prior, in units where the root mean square
        image coordinate is 1. Less is more exact where the model holds (1e-6 gives what 0 would, without noise), and
        bounds depth less where it does not.
    mean_prior : float
        How much the mean shape is held to the rigid one; raise it where depths still come out too large.
    max_seconds : float, optional
    progress : bool

    Returns
    -------
    Reconstruction in one world frame.

    Raises
    ------
    ValueError
        For a parameter out of range, or a point hidden in every frame.
    """
    images = read(W, visible, fill=False, method="nlo")
    F, P, _ = images.X.shape
    _check(rank, prior, mean_prior)
    check_cost("nlo", F, *_cost(F, P, rank), max_seconds=max_seconds, advice="Lower the rank.")
    watch = Watch("nlo", max_seconds, progress)
    rigid = _rigid(images)
    problem = _Problem(images.X, images.visible.astype(float), prior, mean_prior, rigid.atoms[0])
    found = []
    for refine in [True, False] if rank > 1 else [True]:
        state, converged = _descend(rigid, problem, watch) if refine else (rigid, True)
        for k in range(1, rank):
            if watch.over:
                break
            state = _add_atom(state, problem)
            if refine or k == rank - 1:
                state, converged = _descend(state, problem, watch)
        found.append((_objective(state, problem), state, converged))
    _, state, converged = min(found, key=lambda result: result[0])
    return images.reconstruction(state.shapes, state.cameras, "nlo", converged and not watch.over, t=state.t)


def _check(rank, prior, mean_prior):
    check_whole("rank", rank, 1, 1000)
    for name, value in [("prior", prior), ("mean_prior", mean_prior)]:
        if not 0 <= value < np.inf:
            raise ValueError(f"{name}={value}; expected a number of at least 0.")


def _cost(F, P, K):
    """Gigabytes and seconds, fitted to measurements of 1 000 to 40 000 frames, 31 to 75 points, K = 1 to 5."""

    def iteration(k):
        return 7e-8 * F * P * (k + 4) + 3.3e-11 * (F * (k + 4) * (3 * k * P) ** 2 + (3 * k * P) ** 3 / 3)

    numbers = 5 * F * P * (K + 4) + 3 * (3 * K * P) * (3 * K * P + _ROWS)
    descents = [*range(1, K + 1), K] if K > 1 else [1]
    return 8 * numbers / 2**30, _ITERATIONS * sum(map(iteration, descents))


def _rigid(images):
    """One rigid shape and its cameras, by factorisation, hidden points filled in."""
    start = tomasi_kanade(images.X, images.visible)
    return _State(rotations(start.cameras), np.ones((len(start), 1)), start.shapes[:1], start.translations)


def _add_atom(s, problem):
    """The strongest direction of what is left over, laid back into space in each image's plane."""
    F, P, _ = problem.X.shape
    laid = (_residual(s, problem) @ s.cameras.swapaxes(1, 2)).reshape(F, 3 * P)
    atom = np.linalg.eigh(laid.T @ laid)[1][:, -1]
    weight = laid @ atom
    size = max(np.sqrt(np.linalg.norm(weight)) * (3 * P / F) ** 0.25, 1e-9)  # both of one mean square
    atoms = np.concatenate([s.atoms, (atom * size).reshape(1, P, 3)])
    return replace(s, weights=np.column_stack([s.weights, weight / size]), atoms=atoms)


def _residual(s, problem):
    return (problem.X - s.t[:, None] - s.shapes @ s.cameras) * problem.seen[..., None]


def _objective(s, problem):
    fit = (_residual(s, problem) ** 2).sum()
    strength, away = problem.pull(s.atoms)
    return (fit + problem.on_weights * (s.weights[:, 1:] ** 2).sum() + (strength * away**2).sum()) / 2


def _descend(state, problem, watch):
    """Levenberg and Marquardt: steps that are shortened until they lower the objective."""
    value, damping = _objective(state, problem), _DAMPING[0]
    for _ in watch.steps(_ITERATIONS, f"rank {len(state.atoms)}"):
        new = _step(state, problem, damping)
        new_value = _objective(new, problem)
        if new_value < value:
            small = value - new_value < _TOLERANCE * value
            state, value, damping = new, new_value, max(damping / 10, _DAMPING[1])
            if small:
                return state, True
        else:
            damping *= 10
            if damping > _DAMPING[2]:
                return state, True
    return state, False


def _jacobian(s, seen):
    """Of the visible image points in each frame's own unknowns, (F, P, 2, 3 + K − 1 + 2): turn, weights, translation.

    The turn ω acts on the shape as the camera sees it: Q_f becomes Q_f exp(ω)ᵀ, and a point y moves by ω × y.
    """
    F, P = seen.shape
    K = len(s.atoms)
    J = np.zeros((F, P, 2, K + 4))
    y = s.shapes @ s.Q
    J[:, :, 0, 1], J[:, :, 0, 2] = y[..., 2], -y[..., 1]
    J[:, :, 1, 0], J[:, :, 1, 2] = -y[..., 2], y[..., 0]
    J[..., 3 : K + 2] = (s.atoms[1:].reshape(-1, 3) @ s.cameras).reshape(F, K - 1, P, 2).transpose(0, 2, 3, 1)
    J[:, :, [0, 1], [K + 2, K + 3]] = 1
    return J * seen[..., None, None]


def _step(s, problem, damping):
    """One damped Gauss-Newton step.

    Given the atoms, frames are independent of each other: their unknowns are eliminated, and a system in the
    atoms alone remains.
    """
    F, P, _ = problem.X.shape
    K = len(s.atoms)
    J = _jacobian(s, problem.seen).reshape(F, 2 * P, -1)
    r = _residual(s, problem)
    own, own_right = _frame_systems(J, r, s, problem, damping)
    matrix, right = _atom_system(r, s, problem, damping)
    root = np.linalg.inv(np.linalg.cholesky(own))  # (F, n, n), own⁻¹ = rootᵀ root
    n, size = root.shape[1], max(_ROWS // root.shape[1], 1)
    for f in range(0, F, size):
        part = slice(f, f + size)
        # How a frame's unknowns couple with an atom's point: Jᵀ times that point's Jacobian, weight · camera.
        turned = J[part].reshape(-1, P, 2, n).transpose(0, 3, 1, 2) @ s.cameras[part, None].swapaxes(2, 3)
        coupling = s.weights[part, None, :, None] * turned.reshape(-1, n, 1, 3 * P)  # (frames, n, K, 3P)
        coupling = (root[part] @ coupling.reshape(-1, n, 3 * K * P)).reshape(-1, 3 * K * P)
        matrix -= coupling.T @ coupling
        right -= (root[part] @ own_right[part]).ravel() @ coupling
    change = cho_solve(cho_factor(matrix, check_finite=False), right).reshape(K, P, 3)
    moved = np.tensordot(s.weights, change, 1) @ s.cameras  # what the atoms' change does to the images
    own_change = root.swapaxes(1, 2) @ (root @ (own_right - J.swapaxes(1, 2) @ moved.reshape(F, 2 * P, 1)))
    turn, weights, t = np.split(own_change[..., 0], [3, K + 2], axis=1)
    return _State(
        Q=s.Q @ Rotation.from_rotvec(turn).as_matrix().swapaxes(1, 2),
        weights=s.weights + np.column_stack([np.zeros(F), weights]),
        atoms=s.atoms + change,
        t=s.t + t,
    )


def _frame_systems(J, r, s, problem, damping):
    """Normal equations of every frame's own unknowns, (F, n, n) and (F, n, 1); translations are not damped."""
    F, _, n = J.shape
    matrix = J.swapaxes(1, 2) @ J
    right = J.swapaxes(1, 2) @ r.reshape(F, -1, 1)
    weights, damped = np.arange(3, n - 2), np.arange(n - 2)
    matrix[:, weights, weights] += problem.on_weights
    right[:, weights, 0] -= problem.on_weights * s.weights[:, 1:]
    matrix[:, damped, damped] += damping * (matrix[:, damped, damped] + _FLOOR * r.shape[1])
    return matrix, right


def _atom_system(r, s, problem, damping):
    """Normal equations of the atoms, (3KP, 3KP) and (3KP,): points are independent of each other."""
    F, P, _ = problem.X.shape
    K = len(s.atoms)
    planes = s.cameras @ s.cameras.swapaxes(1, 2)  # (F, 3, 3)
    products = np.einsum("fk,fl,fij->fkilj", s.weights, s.weights, planes).reshape(F, -1)
    matrix = np.zeros((K, P, 3, K, P, 3))
    point = np.arange(P)
    matrix[:, point, :, :, point, :] = (products.T @ problem.seen).T.reshape(P, K, 3, K, 3)
    matrix = matrix.reshape(3 * K * P, -1)
    right = (s.weights.T @ (r @ s.cameras.swapaxes(1, 2)).reshape(F, -1)).reshape(K, P, 3)
    strength, away = problem.pull(s.atoms)
    right -= strength * away
    diagonal = np.einsum("ii->i", matrix)  # a view
    diagonal += np.repeat(strength, 3 * P)
    diagonal += damping * (diagonal + _FLOOR * F)
    return matrix, right.ravel()
