"""Dictionaries whose atoms are subspaces: block orthogonal matching pursuit and block K-SVD (Kong & Lucey, 2016).

A frame is its two image rows (2, P). An atom is an orthonormal basis U_j (P, 3), and a frame is the sum of a few:
rows_f ≈ Σ_k codes_fk U_jᵀ with j = support_fk and codes of size 2×3, one block per active atom.
"""

from __future__ import annotations

import numpy as np

from .shared.limits import Watch

# The convex start (lengths relative to that of a mean image row)
_START_STEPS = 300  # the penalty on the atoms' split has grown to where they no longer move
_SPARSITY = 0.3
_CODE_PENALTY, _CODE_GROWTH, _CODE_LIMIT = 0.1, 1.001, 10.0
_ATOM_PENALTY, _ATOM_GROWTH, _ATOM_LIMIT = 30.0, 1.01, 1e6
# Block K-SVD
_STEPS = 500
_EXACT = 1e-6  # residual relative to the images, below which the fit is exact
_SETTLED = 1e-3  # relative decrease of the residual over the last _PATIENCE steps, below which nothing more is coming
_PATIENCE, _WARM_UP = 10, 30
_RARE = 0.2  # an atom that is used by less than this share of an atom's mean number of frames is replaced
_RIDGE = 1e-10  # keeps the fit on two coinciding atoms solvable


def learn_atoms(
    rows: np.ndarray, atoms: int, active: int, rng: np.random.Generator, watch: Watch, what: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, bool]:
    """Subspaces that represent every frame by few of them: ADMM for a start, then block K-SVD.

    Parameters
    ----------
    rows : (F, 2, P) centred images
    atoms, active : int, number of atoms, and of those in one frame
    rng : NumPy Generator, for the random start
    watch : Watch, ends both loops when the time is over
    what : str, for the progress bar

    Returns
    -------
    U : (atoms, P, 3), orthonormal columns
    support : (F, active) int, the atoms of each frame
    codes : (F, active, 2, 3)
    residual : float, what is left relative to the images' norm
    settled : bool, False if a limit of steps or time came first
    """
    U = convex_start(rows, atoms, rng, watch, what)
    size, history, settled = np.linalg.norm(rows), [], False
    for _ in watch.steps(_STEPS, f"{what}, block K-SVD"):
        support, codes, residual = block_omp(U, rows, active)
        history.append(np.linalg.norm(residual) / size)
        stale = len(history) > _WARM_UP and history[-1 - _PATIENCE] - history[-1] < _SETTLED * history[-1]
        settled = bool(history[-1] < _EXACT or stale)
        if settled:
            break
        _update_atoms(U, rows, support, codes, residual, rng)
    support, codes, residual = block_omp(U, rows, active)
    return U, support, codes, float(np.linalg.norm(residual) / size), settled


def convex_start(rows: np.ndarray, atoms: int, rng: np.random.Generator, watch: Watch, what: str) -> np.ndarray:
    """Atoms from ``min ½‖W − C A‖² + γ Σ ‖C_fj‖_F``, rows of A at most of length 1, by ADMM from a random start.

    W are the images stacked (2F, P), C (2F, 3·atoms) has blocks C_fj of 2×3. Both factors are split from their
    copies that carry the constraint, and both penalties grow, which ends it: not a minimum, but a good start.

    Returns
    -------
    (atoms, P, 3), orthonormal columns
    """
    F, _, P = rows.shape
    W = rows.reshape(2 * F, P) / np.sqrt(np.square(rows).sum() / (2 * F))
    A = rng.normal(size=(3 * atoms, P))
    A /= np.linalg.norm(A, axis=1, keepdims=True)
    C = rng.normal(size=(2 * F, 3 * atoms))
    sparse, short = C.copy(), A.copy()  # the copies that carry the constraints
    dual_c, dual_a = np.zeros_like(C), np.zeros_like(A)
    rho, mu, eye = _CODE_PENALTY, _ATOM_PENALTY, np.eye(3 * atoms)
    for _ in watch.steps(_START_STEPS, f"{what}, convex start"):
        C = np.linalg.solve(A @ A.T + rho * eye, (W @ A.T + rho * (sparse - dual_c)).T).T
        sparse = _shrink(C + dual_c, _SPARSITY / rho, atoms)
        A = np.linalg.solve(C.T @ C + mu * eye, C.T @ W + mu * (short - dual_a))
        short = (A + dual_a) / np.maximum(1, np.linalg.norm(A + dual_a, axis=1, keepdims=True))
        dual_c, dual_a = dual_c + C - sparse, dual_a + A - short
        # Scaled duals are divided by the penalty, so that they shrink when it grows.
        larger = min(rho * _CODE_GROWTH, _CODE_LIMIT), min(mu * _ATOM_GROWTH, _ATOM_LIMIT)
        dual_c, dual_a = dual_c * (rho / larger[0]), dual_a * (mu / larger[1])
        rho, mu = larger
    return np.linalg.qr(short.reshape(atoms, 3, P).transpose(0, 2, 1))[0]


def _shrink(C: np.ndarray, threshold: float, atoms: int) -> np.ndarray:
    """Block soft threshold: every 2×3 block shorter by `threshold`, or zero."""
    blocks = C.reshape(-1, 2, atoms, 3)
    length = np.sqrt(np.einsum("fijk,fijk->fj", blocks, blocks))[:, None, :, None]
    return (blocks * np.maximum(0, 1 - threshold / np.maximum(length, 1e-12))).reshape(C.shape)


def block_omp(U: np.ndarray, rows: np.ndarray, active: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The atoms of every frame, one after the other, all frames at once.

    The next atom is the one in whose subspace most of the residual lies, max_j ‖r_f U_j‖_F; then the codes of all
    atoms so far are fitted anew, by one small linear system per frame.

    Returns
    -------
    support, codes : as in `learn_atoms`
    residual : (F, 2, P), the residual
    """
    (F, _, P), atoms = rows.shape, len(U)
    D = U.transpose(1, 0, 2).reshape(P, 3 * atoms)
    gram = D.T @ D
    inner = (rows.reshape(2 * F, P) @ D).reshape(F, 2, 3 * atoms)
    left, support = inner, np.zeros((F, 0), int)
    for size in range(1, active + 1):
        score = np.einsum("fijk,fijk->fj", *2 * [left.reshape(F, 2, atoms, 3)])
        np.put_along_axis(score, support, -1.0, 1)
        support = np.concatenate([support, score.argmax(1)[:, None]], 1)
        columns = (3 * support[:, :, None] + np.arange(3)).reshape(F, 3 * size)
        system = gram[columns[:, :, None], columns[:, None]] + _RIDGE * np.eye(3 * size)
        right = np.take_along_axis(inner, columns[:, None], 2)
        codes = np.linalg.solve(system, right.swapaxes(1, 2)).swapaxes(1, 2)  # (F, 2, 3·size)
        if size < active:
            left = inner - codes @ gram[columns]
    codes = codes.reshape(F, 2, active, 3).swapaxes(1, 2).copy()
    residual = rows - sum(codes[:, k] @ U.swapaxes(1, 2)[support[:, k]] for k in range(active))
    return support, codes, residual


def _update_atoms(
    U: np.ndarray,
    rows: np.ndarray,
    support: np.ndarray,
    codes: np.ndarray,
    residual: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """One pass over the atoms, in place: each becomes the best subspace for the frames that use it.

    An atom that hardly any frame uses becomes one of the 20 worst represented frames and a random direction.
    """
    P, mean_uses = rows.shape[2], support.size / len(U)
    for j in range(len(U)):
        f, k = np.nonzero(support == j)
        if len(f) < _RARE * mean_uses:
            worst = rng.choice(np.argsort(-np.square(residual).sum((1, 2)))[:20])
            U[j] = np.linalg.qr(np.vstack([rows[worst], rng.normal(size=P)]).T)[0]
            continue
        alone = residual[f] + codes[f, k] @ U[j].T  # what the other atoms leave to this one
        flat = alone.reshape(-1, P)
        U[j] = np.linalg.eigh(flat.T @ flat)[1][:, -3:]
        codes[f, k] = alone @ U[j]
        residual[f] = alone - codes[f, k] @ U[j].T
