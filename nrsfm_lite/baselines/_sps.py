"""Structure from motion of shapes that are compressible, without another prior (Kong & Lucey, 2016)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..cameras import rotations
from ..checks import whole
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from ._sps_dictionary import learn_atoms
from .shared.completion import completed
from .shared.limits import Watch, check_cost
from .shared.upgrade import consistent, metric_gram, orthonormal

_FRAMES_PER_ATOM = 5  # three determine an upgrade; the authors sample five
_PRESENT = 0.05  # share of an image's norm below which an atom's code is too short to tell a camera
_AGREE = 0.1  # ‖M − M'‖_F of two cameras that are taken for one (authors' code)
_OVERLAP = 3  # frames that two atoms must share before their agreement says anything
_TRIALS = 200  # frames tried as the hypothesis that turns one atom into another's frame
_GOOD = 1e-4  # relative reprojection error that makes further starts needless


@one_thread
def sps(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    atoms: int = 10,
    active: int = 2,
    restarts: int = 5,
    max_seconds: float | None = None,
    progress: bool = True,
    seed: int = 0,
) -> Reconstruction:
    """Every shape is the sum of few atoms out of many, and nothing else is assumed.

    Objective: ``min Σ_f ‖W_f − Σ_j c_fj B_j M_f‖²`` with at most `active` of the c_f non-zero. First each frame is
    factored into `active` subspaces U_j out of `atoms`, with codes Z_fj of size 3×2 (`learn_atoms`: a convex start,
    then block K-SVD). Then each atom gets its own metric upgrade G_j, linear in Q_j = G_j G_jᵀ, that makes the columns
    of G_jᵀ Z_fj orthogonal and of one length: its cameras M_fj up to sign, and B_j = U_j G_j⁻ᵀ. Last the atoms are
    glued: one with frames in common with those already there is turned by the rotation that most of these frames
    agree on, and gives its cameras to its other frames; next comes the one with the most common frames. Given atoms
    and cameras, the c_f are linear least squares. Cost O(F · atoms · P) per step, up to 500 steps per start; memory
    O(F · (atoms + P)).

    Assumes orthographic views in any order, and shapes that are *exactly* sums of `active` atoms, each seen in many
    frames and in company of others. On such data it is exact, cameras up to their signs. Shapes that are only nearly
    so, as all real ones, make upgrades Q_j indefinite and atoms disagree. Then the result is finite and not converged:
    of an indefinite Q_j the absolute eigenvalues are taken; atoms that disagree are turned as well as they can be; and
    frames that no atom in common ties to the rest keep the cameras of their own atom, in a world frame of their own.
    On the classic sequences the errors vary a lot, with cameras that hardly agree across frames: `results/classic.csv`
    and chapter 02 have them.

    A camera and its negative, with the mirrored shape, explain an image equally well, and the signs of c_f are free:
    per frame `consistent` decides.

    The starts are random, and not each finds the atoms. They are compared by the reprojection error of the finished
    reconstruction, which is small only if factors, upgrades and gluing all fit; the first that is exact ends the
    search.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Hidden points are filled in by `complete` first.
    confidence : (F, P), optional
        From 0 to 1; `complete` moves a doubtful point towards its likely place. Default: that of the Landmarks,
        else 1.
    atoms : int
        Number of atoms L; 3·L may exceed P. The authors' tests with motion capture take 10 to 33.
    active : int
        Atoms in one frame, 2 in the authors' tests; at most (P − 2) / 3, or every image would fit.
    restarts : int
        Random starts at most.
    max_seconds : float, optional
        After that the best result so far comes back, not converged.
    progress : bool
    seed : int

    Returns
    -------
    Reconstruction in the units of W, ``converged`` only if the factorisation settled, all upgrades were definite, and
    each atom's cameras agreed with those of the others. That is no proof that every frame got its right atoms; a
    large reprojection error tells.

    Raises
    ------
    ValueError
        As `images.read`, with fewer frames than three atoms need or fewer than 3 · active + 2 points; for a parameter
        out of range; or if memory or time would not suffice.

    Notes
    -----
    From the authors' code: the stages, the scores, and the rules of K-SVD and of gluing. Chosen here, since the code
    changes them per experiment or has no such thing: the weight of sparsity and the length of the convex start, the
    median in gluing, the order of atoms that do not agree, and the choice among starts. On exact data with 2 active
    atoms the first start is nearly always exact. With more dimensions than points, 8 atoms in 20 points, some sets
    need several starts, and in some no start is exact, as the greedy choice takes wrong atoms in a few frames.

    References
    ----------
    Kong, Lucey (2016). Prior-less compressible structure from motion. CVPR, 4123–4131.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(60))
    >>> rec = nl.baselines.sps(views, atoms=4, restarts=1, progress=False)
    >>> rec.shapes.shape == views.points3d.shape
    True
    """
    active = whole("active", active, 1, 100)
    least = active + (active > 1)  # atoms that are always in company cannot be told apart
    fewest = -(-_FRAMES_PER_ATOM * least // active)
    images = completed(read(W, visible, confidence, method="sps", frames=fewest, points=3 * active + 2))
    F, P, _ = images.X.shape
    atoms = whole("atoms", atoms, least, F * active // _FRAMES_PER_ATOM, f" for {F} frames with active={active}")
    restarts = whole("restarts", restarts, 1, 1000)
    gigabytes = 2 * F * (30 * atoms + 10 * P + 9 * active**2) * 8 / 2**30
    # Measured with 2,000 to 10,500 frames: the convex start, and the 50 steps of K-SVD that are common (500 at most).
    seconds = restarts * F * (1.2e-4 * atoms + 3e-4 * active) * max(1, P / 31)
    check_cost("sps", F, gigabytes, seconds, max_seconds, "Fewer restarts or atoms take less.")
    watch = Watch("sps", max_seconds, progress)
    S, M, converged, _ = _best(images.X, atoms, active, restarts, np.random.default_rng(seed), watch)
    signed = consistent(M, images.X)
    sign = np.sign((signed * M).sum((1, 2)))[:, None, None]
    return images.reconstruction(sign * S, signed, method="sps", converged=converged)


def _best(
    X: np.ndarray, atoms: int, active: int, restarts: int, rng: np.random.Generator, watch: Watch
) -> tuple[np.ndarray, np.ndarray, bool, int]:
    """Of the start with the lowest reprojection error S, M, and whether all went well; and the number of starts."""
    rows = X.swapaxes(1, 2).copy()
    best: Any = None
    least, used = np.inf, 0
    while used < restarts and not (used and watch.over):
        used += 1
        U, support, codes, _, settled = learn_atoms(rows, atoms, active, rng, watch, f"start {used}")
        B, cameras, definite = _upgrade(U, support, codes)
        M, B, glued = _glue(B, cameras, support, codes, definite, rng)
        S = _shapes(B, M, support, X)
        error = float(np.linalg.norm(X - S @ M) / np.linalg.norm(X))
        if error < least:
            best, least = (S, M, settled and glued and not watch.over), error
        if least < _GOOD:
            break
    return *best, used


def _upgrade(U: np.ndarray, support: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each atom in Euclidean space, by itself.

    Returns
    -------
    B : (atoms, P, 3)
    cameras : (F, active, 3, 2), of each frame's atoms, each in the atom's own frame and up to sign
    definite : (atoms,) bool, whether the atom's upgrade exists
    """
    B, definite = np.zeros_like(U), np.zeros(len(U), bool)
    cameras = codes.swapaxes(2, 3).copy()
    for j in range(len(U)):
        f, k = np.nonzero(support == j)
        if len(f) == 0:
            continue
        G, definite[j] = _metric(codes[f, k])
        cameras[f, k] = G.T @ cameras[f, k]
        B[j] = np.linalg.solve(G, U[j].T).T
    return B, orthonormal(cameras), definite


def _metric(rows: np.ndarray) -> tuple[np.ndarray, bool]:
    """G (3, 3) such that the two rows of rows_f @ G (n, 2, 3) are orthogonal and of one length; and if it exists."""
    values, vectors = np.linalg.eigh(metric_gram(rows, one_scale=False))
    definite = len(rows) >= _FRAMES_PER_ATOM and abs(np.sign(values).sum()) == 3
    size = np.abs(values)
    return vectors * np.sqrt(np.maximum(size, 1e-6 * size.max())), definite


def _glue(
    B: np.ndarray,
    cameras: np.ndarray,
    support: np.ndarray,
    codes: np.ndarray,
    definite: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """One frame of reference for all atoms, and a camera for each frame of the sequence.

    Returns
    -------
    M : (F, 3, 2)
    B : (atoms, P, 3), rotated
    glued : bool, whether all atoms are definite, and agree with those before them
    """
    F, atoms = len(support), len(B)
    length = np.sqrt(np.square(codes).sum((2, 3)))
    present = length > _PRESENT * length.max(1, keepdims=True)
    frames = [np.nonzero((support == j) & present) for j in range(atoms)]  # per atom: frames, and place in support
    T = np.repeat(np.eye(3)[None], atoms, axis=0)
    M, known = np.zeros((F, 3, 2)), np.zeros(F, bool)
    left, glued = [j for j in range(atoms) if len(frames[j][0])], True
    while left:
        options = [_fit(j, frames[j], cameras, M, known, definite, rng) for j in left]
        # Those that agree first, by their overlap; then by how well they agree; a new root if there is no overlap.
        order, T_best, j = min(options, key=lambda option: option[0])
        first = not known.any()
        glued &= bool(definite[j]) and (first or order[0] == 0)
        T[j] = T_best
        f, k = (x[~known[frames[j][0]]] for x in frames[j])
        M[f] = T[j] @ cameras[f, k]
        known[f] = True
        left.remove(j)
    return M, B @ T.swapaxes(1, 2), glued


def _fit(
    j: int,
    frames: tuple[np.ndarray, ...],
    cameras: np.ndarray,
    M: np.ndarray,
    known: np.ndarray,
    definite: np.ndarray,
    rng: np.random.Generator,
) -> tuple[tuple, np.ndarray, int]:
    """How atom j would join those already glued: what to sort by, its rotation, and j."""
    f, k = frames
    common = known[f]
    if not common.any():
        return (2, not definite[j], -len(f)), np.eye(3), j
    T, distance = _rotation(cameras[f, k][common], M[f][common], rng)
    agrees = definite[j] and common.sum() >= _OVERLAP and distance < _AGREE
    return (0, -common.sum(), 0) if agrees else (1, not definite[j], distance), T, j


def _rotation(cameras: np.ndarray, M: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """The rotation T with T cameras_f = ±M_f for as many frames as possible, and the median of the distances.

    One frame and its sign determine T; each of some frames makes two hypotheses, and the one of the lowest median
    is refined on the nearer half.
    """
    tried = rng.permutation(len(M))[:_TRIALS]
    own, common = rotations(cameras[tried]), rotations(M[tried])
    negated = common * [-1, -1, 1]  # the viewing direction m₁ × m₂ does not change with the sign of m₁ and m₂
    T = np.concatenate([common, negated]) @ np.concatenate([own, own]).swapaxes(1, 2)
    pairs = M @ cameras.swapaxes(1, 2)  # (n, 3, 3); ⟨T cameras_f, M_f⟩ = ⟨T, pairs_f⟩

    def distances(T: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(4 - 2 * np.abs(T.reshape(-1, 9) @ pairs.reshape(-1, 9).T), 0))

    T = T[np.median(distances(T), axis=1).argmin()]
    for _ in range(3):
        d = distances(T)[0]
        near = d <= np.median(d)
        sign = np.sign(np.einsum("ij,fij->f", T, pairs[near]))
        U, _, Vh = np.linalg.svd(np.einsum("f,fij->ij", sign, pairs[near]))
        T = U @ Vh
    return T, np.median(distances(T))


def _shapes(B: np.ndarray, M: np.ndarray, support: np.ndarray, X: np.ndarray) -> np.ndarray:
    """(F, P, 3): each frame's atoms with the coefficients that fit its image best, given its camera."""
    parts = B[support]  # (F, active, P, 3)
    images = (parts @ M[:, None]).reshape(*support.shape, -1)
    gram = images @ images.swapaxes(1, 2)
    c = np.linalg.pinv(gram, rcond=1e-10, hermitian=True) @ (images @ X.reshape(len(X), -1, 1))
    return np.einsum("fk,fkpi->fpi", c[..., 0], parts)
