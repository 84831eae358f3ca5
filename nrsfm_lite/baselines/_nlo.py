"""Non-linear optimisation: bundle adjustment of a low-rank shape (Del Bue, Smeraldi & Agapito, 2007)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from ..cameras import rotations
from ..checks import at_least, whole
from ..data import Reconstruction
from ..images import Images, read
from ..threads import one_thread
from ._tomasi_kanade import factorise
from .shared.completion import completed
from .shared.descent import Propose, levenberg_marquardt
from .shared.limits import Watch, check_cost

_DAMPING, _EASING = 1e-3, 10.0
_FLOOR = 1e-6  # of what damping scales, for unknowns that nothing sees
_ITERATIONS = 100  # for each number of atoms
_TOLERANCE = 1e-6  # relative change of the objective
_ROWS = 2048  # of the eliminated system at a time, so that they stay in the cache


@dataclass(frozen=True)
class _Problem:
    """Images (F, P, 2), how much each point counts (F, P), the priors, and the rigid shape (P, 3)."""

    X: np.ndarray
    weight: np.ndarray
    prior: float
    mean_prior: float
    mean: np.ndarray

    @property
    def on_coefficients(self) -> float:
        return self.prior * 3 * self.X.shape[1]

    def on_atoms(self, atoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The prior's weight of each atom (K, P, 3), as (K, 1, 1), and how far it is from where the prior has it."""
        strength = np.full((len(atoms), 1, 1), self.prior * len(self.X))
        strength[0] = self.mean_prior * len(self.X)
        return strength, np.concatenate([atoms[:1] - self.mean, atoms[1:]])


@dataclass(frozen=True)
class _State:
    """One point of the search: shapes S_f = B_0 + Σ_k l_fk B_k, seen as S_f Q_f[:, :2] + t_f."""

    Q: np.ndarray  # (F, 3, 3) rotations; the third column points to the viewer
    coefficients: np.ndarray  # (F, K), the first fixed at 1
    atoms: np.ndarray  # (K, P, 3)
    t: np.ndarray  # (F, 2)

    @property
    def cameras(self) -> np.ndarray:
        return self.Q[:, :, :2]

    @property
    def shapes(self) -> np.ndarray:
        return np.tensordot(self.coefficients, self.atoms, 1)

    def moved(self, own: np.ndarray, atoms: np.ndarray) -> _State:
        """After a change of each frame's own unknowns (F, n), as in `_jacobian`, and of the atoms (K, P, 3)."""
        omega, coefficients, t = np.split(own, [3, len(self.atoms) + 2], axis=1)
        return _State(
            Q=self.Q @ Rotation.from_rotvec(omega).as_matrix().swapaxes(1, 2),
            coefficients=self.coefficients + np.column_stack([np.zeros(len(t)), coefficients]),
            atoms=self.atoms + atoms,
            t=self.t + t,
        )


@one_thread
def nlo(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    rank: int = 3,
    prior: float = 1e-2,
    mean_prior: float = 1e-3,
    max_seconds: float | None = None,
    progress: bool = True,
) -> Reconstruction:
    """Cameras, coefficients and atoms together, by bundle adjustment from a rigid start.

    Objective: ``½ Σ_fp ω_fp |w_fp − t_f − M_fᵀ s_fp|² + ½ prior Σ_k≥1 (3P ‖l_k‖² + F ‖B_k‖²) + ½ mean_prior F
    ‖B_0 − B_rigid‖²`` with ``S_f = B_0 + Σ_k≥1 l_fk B_k``, over cameras M_f, held exactly orthonormal as they are
    moved by rotations, coefficients l, atoms B and translations t; ω is the confidence, zero where hidden.
    Levenberg-Marquardt; the unknowns of each frame are eliminated, which leaves a system in the 3 K P coordinates of
    the atoms. Per iteration O(F K (3KP)² + (3KP)³), memory O(F P K + (3KP)²); up to 100 iterations per descent,
    `rank` + 1 descents.

    Local, so the start counts: the rigid shape and cameras of `tomasi_kanade`, and atoms from what is left over of
    the images, back-projected into space. Two descents, one with all atoms at once and one that refines before each
    new atom, compete by their objective. A minimum far from the truth can have the lower objective: on one of the
    five classic sequences (stretch) the result is worse than the rigid start.

    Assumes orthographic views of one scale that are not far from those of a rigid object; frames in any order.

    Certain from the paper is the adjustment of all unknowns with exact cameras. Its priors and its start could not
    be read. Ours are the priors' form and strengths, the coefficient of B_0 fixed at 1, and the two descents. Where
    that coefficient was free, depths grew many times over on a classic sequence (yoga), whatever the prior; fixed but
    with neither prior, they did on another (stretch). `prior` and `rank` were chosen on generated motion (three clips
    seen by a circling camera), the form of the priors with the classic sequences and their truth at hand: those
    figures are not held out. Left out are priors on smooth motion.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Hidden points are left out of the objective; for the start they are filled in by `complete`.
    confidence : (F, P), optional
        From 0 to 1, the weight of a point's squared residual; for the start, `complete` moves doubtful points.
        Default: that of the Landmarks, else 1.
    rank : int
        Number of atoms K, the mean shape B_0 counted. 2 or 3 are usual.
    prior : float
        On what deforms: lessens the amplitude of every atom by about 1.5 · prior, in units where the root mean square
        image coordinate is 1. Less is more exact where the model holds (1e-6 gives what 0 would, without noise), and
        bounds depth less where it does not.
    mean_prior : float
        How much the mean shape is held to the rigid one; raise it where depths still come out too large.
    max_seconds : float, optional
        Then the result so far is returned, with ``converged=False``.
    progress : bool

    Returns
    -------
    Reconstruction in one world frame, in the units of W.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 3 frames or 4 points; as `tomasi_kanade`; for a parameter out of range; or
        if memory or time would not suffice.

    References
    ----------
    Del Bue, Smeraldi, Agapito (2007). Non-rigid structure from motion using ranklet-based tracking and non-linear
    optimization. Image and Vision Computing 25(3), 297–310.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(30))
    >>> nl.baselines.nlo(views, rank=2, progress=False).shapes.shape == views.points3d.shape
    True
    """
    images = read(W, visible, confidence, method="nlo", frames=3, points=4)
    F, P, _ = images.X.shape
    rank = whole("rank", rank, 1, 1000)
    prior, mean_prior = at_least("prior", prior), at_least("mean_prior", mean_prior)
    check_cost("nlo", F, *_cost(F, P, rank), max_seconds=max_seconds, advice="Lower the rank.")
    watch = Watch("nlo", max_seconds, progress)
    rigid = _rigid(images)
    problem = _Problem(images.X, images.weight, prior, mean_prior, rigid.atoms[0])
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
    return images.reconstruction(
        state.shapes, state.cameras, state.t, method="nlo", converged=converged and not watch.over
    )


def _cost(F: int, P: int, K: int) -> tuple[float, float]:
    """Gigabytes and seconds, fitted to measurements of 1 000 to 40 000 frames, 31 to 75 points, K = 1 to 5."""

    def iteration(k: int) -> float:
        return 7e-8 * F * P * (k + 4) + 3.3e-11 * (F * (k + 4) * (3 * k * P) ** 2 + (3 * k * P) ** 3 / 3)

    numbers = 5 * F * P * (K + 4) + 3 * (3 * K * P) * (3 * K * P + _ROWS)
    descents = [*range(1, K + 1), K] if K > 1 else [1]
    return 8 * numbers / 2**30, _ITERATIONS * sum(map(iteration, descents))


def _rigid(images: Images) -> _State:
    """One rigid shape and its cameras, by factorisation of all points, in the units of `images.X`."""
    every = completed(images)
    S, M = factorise(every.X)
    return _State(
        Q=rotations(M),
        coefficients=np.ones((len(M), 1)),
        atoms=S[None] * (every.scale / images.scale),
        t=(every.mean - images.mean) / images.scale,
    )


def _add_atom(s: _State, problem: _Problem) -> _State:
    """The strongest direction of the residual, back-projected into each image's plane in space."""
    F, P, _ = problem.X.shape
    residual = _residual(s, problem) * problem.weight[..., None]
    spatial = (residual @ s.cameras.swapaxes(1, 2)).reshape(F, 3 * P)
    atom = np.linalg.eigh(spatial.T @ spatial)[1][:, -1]
    coefficient = spatial @ atom
    size = max(np.sqrt(np.linalg.norm(coefficient)) * (3 * P / F) ** 0.25, 1e-9)  # both of one mean square
    atoms = np.concatenate([s.atoms, (atom * size).reshape(1, P, 3)])
    return replace(s, coefficients=np.column_stack([s.coefficients, coefficient / size]), atoms=atoms)


def _residual(s: _State, problem: _Problem) -> np.ndarray:
    """(F, P, 2), meaningless where the weight is zero."""
    return problem.X - s.t[:, None] - s.shapes @ s.cameras


def _objective(s: _State, problem: _Problem) -> float:
    fit = (problem.weight * (_residual(s, problem) ** 2).sum(2)).sum()
    strength, away = problem.on_atoms(s.atoms)
    return (fit + problem.on_coefficients * (s.coefficients[:, 1:] ** 2).sum() + (strength * away**2).sum()) / 2


def _descend(state: _State, problem: _Problem, watch: Watch) -> tuple[_State, bool]:
    def linearise(state: _State) -> Propose:
        def propose(damping: float) -> tuple[_State, float]:
            new = _step(state, problem, damping)
            return new, _objective(new, problem)

        return propose

    state, _, converged = levenberg_marquardt(
        state,
        _objective(state, problem),
        linearise,
        lambda before, after: before - after < _TOLERANCE * before,
        watch,
        f"rank {len(state.atoms)}",
        damping=_DAMPING,
        easing=_EASING,
        iterations=_ITERATIONS,
    )
    return state, converged


def _jacobian(s: _State) -> np.ndarray:
    """Of the image points in each frame's own unknowns, (F, P, 2, 3 + K − 1 + 2): rotation, coefficients, translation.

    The rotation vector ω acts on the shape as the camera sees it: Q_f becomes Q_f exp(ω)ᵀ, and a point y moves by
    ω × y.
    """
    F, P, K = len(s.t), s.atoms.shape[1], len(s.atoms)
    J = np.zeros((F, P, 2, K + 4))
    y = s.shapes @ s.Q
    J[:, :, 0, 1], J[:, :, 0, 2] = y[..., 2], -y[..., 1]
    J[:, :, 1, 0], J[:, :, 1, 2] = -y[..., 2], y[..., 0]
    J[..., 3 : K + 2] = (s.atoms[1:].reshape(-1, 3) @ s.cameras).reshape(F, K - 1, P, 2).transpose(0, 2, 3, 1)
    J[:, :, [0, 1], [K + 2, K + 3]] = 1
    return J


def _step(s: _State, problem: _Problem, damping: float) -> _State:
    """One damped Gauss-Newton step.

    Given the atoms, frames are independent of each other: their unknowns are eliminated, and a system in the
    atoms alone remains.
    """
    F, P, _ = problem.X.shape
    K = len(s.atoms)
    J = _jacobian(s)
    weighted = (J * problem.weight[..., None, None]).reshape(F, 2 * P, -1)
    J = J.reshape(F, 2 * P, -1)
    r = _residual(s, problem)
    own, own_right = _frame_systems(J, weighted, r, s, problem, damping)
    matrix, right = _atom_system(r, s, problem, damping)
    root = np.linalg.inv(np.linalg.cholesky(own))  # (F, n, n), own⁻¹ = rootᵀ root
    n, size = root.shape[1], max(_ROWS // root.shape[1], 1)
    for f in range(0, F, size):
        part = slice(f, f + size)
        # How a frame's unknowns couple with an atom's point: Jᵀ times that point's Jacobian, coefficient · camera.
        spatial = weighted[part].reshape(-1, P, 2, n).transpose(0, 3, 1, 2) @ s.cameras[part, None].swapaxes(2, 3)
        coupling = s.coefficients[part, None, :, None] * spatial.reshape(-1, n, 1, 3 * P)  # (frames, n, K, 3P)
        coupling = (root[part] @ coupling.reshape(-1, n, 3 * K * P)).reshape(-1, 3 * K * P)
        matrix -= coupling.T @ coupling
        right -= (root[part] @ own_right[part]).ravel() @ coupling
    change = cho_solve(cho_factor(matrix, check_finite=False), right).reshape(K, P, 3)
    images = np.tensordot(s.coefficients, change, 1) @ s.cameras  # what the atoms' change does to the images
    own_change = root.swapaxes(1, 2) @ (root @ (own_right - weighted.swapaxes(1, 2) @ images.reshape(F, 2 * P, 1)))
    return s.moved(own_change[..., 0], change)


def _frame_systems(
    J: np.ndarray, weighted: np.ndarray, r: np.ndarray, s: _State, problem: _Problem, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of every frame's own unknowns, (F, n, n) and (F, n, 1); translations are not damped."""
    F, _, n = J.shape
    matrix = weighted.swapaxes(1, 2) @ J
    right = weighted.swapaxes(1, 2) @ r.reshape(F, -1, 1)
    coefficients, damped = np.arange(3, n - 2), np.arange(n - 2)
    matrix[:, coefficients, coefficients] += problem.on_coefficients
    right[:, coefficients, 0] -= problem.on_coefficients * s.coefficients[:, 1:]
    matrix[:, damped, damped] += damping * (matrix[:, damped, damped] + _FLOOR * r.shape[1])
    return matrix, right


def _atom_system(r: np.ndarray, s: _State, problem: _Problem, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the atoms, (3KP, 3KP) and (3KP,): points are independent of each other."""
    F, P, _ = problem.X.shape
    K = len(s.atoms)
    planes = s.cameras @ s.cameras.swapaxes(1, 2)  # (F, 3, 3)
    products = np.einsum("fk,fl,fij->fkilj", s.coefficients, s.coefficients, planes).reshape(F, -1)
    blocks = np.zeros((K, P, 3, K, P, 3))
    point = np.arange(P)
    blocks[:, point, :, :, point, :] = (products.T @ problem.weight).T.reshape(P, K, 3, K, 3)
    matrix = blocks.reshape(3 * K * P, -1)
    spatial = (r * problem.weight[..., None]) @ s.cameras.swapaxes(1, 2)
    right = (s.coefficients.T @ spatial.reshape(F, -1)).reshape(K, P, 3)
    strength, away = problem.on_atoms(s.atoms)
    right -= strength * away
    diagonal = np.einsum("ii->i", matrix)  # a view
    diagonal += np.repeat(strength, 3 * P)
    diagonal += damping * (diagonal + _FLOOR * F)
    return matrix, right.ravel()
