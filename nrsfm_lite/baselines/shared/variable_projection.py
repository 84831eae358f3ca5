"""Low-rank shapes over given cameras, with the atoms eliminated (Gotardo and Martinez, 2011).

For coefficients C (F, K) the best atoms are linear least squares. What is left is a function of C alone, and C is
restricted to few parameters: y = Ω Z, smooth or otherwise simple functions of the frame, and C_f a function of y_f.
Gauss–Newton with Kaufman's approximation of the Jacobian minimises it. `ksta` and `riks` differ in Ω and in that
function only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from .descent import Propose, levenberg_marquardt
from .limits import Watch
from .upgrade import stacked

_RCOND = 1e-10  # kernels can make columns of C nearly dependent
_DAMPING, _EASING = 1e-4, 100.0
_SMALL = 2e-3  # a root mean square of which less is expected on images without noise and from the model alone


@dataclass(eq=False)
class Coefficients:
    """C as a function of its parameters, at one point.

    Attributes
    ----------
    C : (F, K)
    basis : (F, d), Ω of y = Ω Z
    local : (F, K, q), derivative of C_f by y_f
    free : (F, K, m), derivative of C by further parameters; m may be 0

    The parameters are Z (d, q), row by row, and then the further ones.
    """

    C: np.ndarray
    basis: np.ndarray
    local: np.ndarray
    free: np.ndarray

    def adjoint(self, G: np.ndarray) -> np.ndarray:
        """Sums over frames and atoms of dC/dθ times G (F, K, r), for all parameters: (n, r)."""
        F, K, r = G.shape
        inner = self.local.swapaxes(1, 2) @ G  # (F, q, r)
        smooth = (self.basis.T @ inner.reshape(F, -1)).reshape(-1, r)
        return np.concatenate([smooth, self.free.reshape(F * K, -1).T @ G.reshape(F * K, r)])

    def gram(self, N: np.ndarray) -> np.ndarray:
        """dC/dθᵀ N dC/dθ for a symmetric K×K matrix per frame, N (F, K, K): (n, n)."""
        F, d = self.basis.shape
        q, m = self.local.shape[2], self.free.shape[2]
        both = self.local.swapaxes(1, 2) @ N @ self.local  # (F, q, q)
        weighted = (self.basis[:, None, None] * both[..., None]).reshape(F, -1)  # (F, q·q·d)
        smooth = (self.basis.T @ weighted).reshape(d, q, q, d).transpose(0, 1, 3, 2).reshape(d * q, d * q)
        if not m:
            return smooth
        crossed = self.adjoint(N @ self.free)  # (n, m)
        return np.block([[smooth, crossed[: d * q]], [crossed.T]])


@dataclass(eq=False)
class _State:
    theta: np.ndarray
    now: Coefficients
    solved: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # what `_together` returns


def fit(
    X: np.ndarray,
    M: np.ndarray,
    coefficients: Callable[[np.ndarray], Coefficients],
    theta: np.ndarray,
    watch: Watch,
    *,
    sequential: bool = False,
    canonical: Callable[[np.ndarray], np.ndarray] | None = None,
    iterations: int = 100,
    tolerance: float = 1e-6,
) -> tuple[np.ndarray, bool]:
    """Minimise the root mean square residual over the parameters of C, from a start.

    Parameters
    ----------
    X : (F, P, 2) centred image points
    M : (F, 3, 2) cameras
    coefficients : function, theta -> Coefficients
    theta : (n,) start
    watch : limits.Watch
    sequential : bool
        Find the atoms one after the other, each from what the others left, instead of all at once.
    canonical : function, theta -> theta, optional
        Applied after a step; it may change the parameters in ways that do not change the residual.
    iterations, tolerance : at most so many steps, until the root mean square changes by less; for images of unit scale
        Once the root mean square itself is small, as on exact data, the change must be smaller by its square.

    Returns
    -------
    S : (F, P, 3) shapes
    converged : bool
    """
    images = stacked(X)
    solve = _one_by_one if sequential else _together

    def evaluate(theta: np.ndarray) -> tuple[_State, float]:
        now = coefficients(theta)
        solved = solve(images, now.C, M)
        return _State(theta, now, solved), float(np.sqrt((solved[3] ** 2).mean()))

    def linearise(state: _State) -> Propose:
        gradient, hessian = _normal_equations(state.now, M, *state.solved)

        def propose(damping: float) -> tuple[_State, float] | None:
            try:
                step = cho_solve(cho_factor(hessian + damping * np.eye(len(hessian))), gradient)
            except LinAlgError:  # not positive, up to rounding
                return None
            theta = state.theta + step
            return evaluate(theta if canonical is None else canonical(theta))

        return propose

    state, _, converged = levenberg_marquardt(
        *evaluate(theta),
        linearise,
        lambda before, after: before - after <= tolerance * min(1, (after / _SMALL) ** 2),
        watch,
        "coefficients",
        damping=_DAMPING,
        easing=_EASING,
        iterations=iterations,
    )
    return np.einsum("fk,kip->fpi", state.now.C, state.solved[0]), converged


def linear(basis: np.ndarray, rank: int) -> tuple[Callable[[np.ndarray], Coefficients], np.ndarray]:
    """The coefficients C = Ω Z as a function of Z (d · rank,), and where to begin: the first columns of Ω."""
    F, d = basis.shape
    local, free = np.broadcast_to(np.eye(rank), (F, rank, rank)), np.zeros((F, rank, 0))

    def coefficients(theta: np.ndarray) -> Coefficients:
        return Coefficients(basis @ theta.reshape(d, rank), basis, local, free)

    return coefficients, np.eye(d, rank).ravel()


def _motion(C: np.ndarray, M: np.ndarray) -> np.ndarray:
    """(2F, K, 3): what the atoms' coordinates are multiplied by."""
    return np.einsum("fij,fk->fjki", M, C).reshape(2 * len(M), -1, 3)


def _together(
    images: np.ndarray, C: np.ndarray, M: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Atoms B (K, 3, P) by least squares; Q and P of `_normal_equations`; the residual (2F, P)."""
    K = C.shape[1]
    U, s, Vh = np.linalg.svd(_motion(C, M).reshape(-1, 3 * K), full_matrices=False)
    good = s > _RCOND * s[0]
    U = U * good
    explained = U.T @ images
    B = Vh.T @ (np.where(good, 1 / np.where(good, s, 1), 0)[:, None] * explained)
    return B.reshape(K, 3, -1), U, np.broadcast_to(U.T, (K, *U.T.shape)), images - U @ explained


def _one_by_one(
    images: np.ndarray, C: np.ndarray, M: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As `_together`, each atom from what the ones before it left."""
    motion, residual = _motion(C, M), images
    K = C.shape[1]
    B, Q = np.empty((K, 3, images.shape[1])), np.empty((K, len(images), 3))
    for k in range(K):
        Q[k], R = np.linalg.qr(motion[:, k])
        explained = Q[k].T @ residual
        B[k] = np.linalg.lstsq(R, explained, rcond=_RCOND)[0]
        residual = residual - Q[k] @ explained
    # The residual after atom k … K−1 is (I − Q P_k) of the one before, where Q has all columns side by side.
    flat = Q.transpose(1, 0, 2).reshape(-1, 3 * K)
    P = np.zeros((K + 1, 3 * K, len(images)))
    for k in reversed(range(K)):
        own = np.eye(3 * K)[:, 3 * k : 3 * k + 3]
        P[k] = P[k + 1] + (own - P[k + 1] @ Q[k]) @ Q[k].T
    return B, flat, P[:K], residual


def _normal_equations(
    now: Coefficients, M: np.ndarray, B: np.ndarray, Q: np.ndarray, P: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (n,) and Gauss–Newton matrix (n, n) of half the mean square residual, in the direction of descent.

    Atom k's share of the residual's derivative is (I − Q P_k) v, with v the images of B_k under dC.
    """
    F, K = now.C.shape
    images = np.einsum("fij,kip->fkjp", M, B)  # (F, K, 2, P)
    residual = residual.reshape(F, 1, 2, -1)
    inner = np.einsum("fkjp,fljp->fkl", images, images, optimize=True)
    columns = Q.shape[1]
    by_P = np.einsum("kmfj,fkjp->fkmp", P.reshape(K, columns, F, 2), images, optimize=True).reshape(F, K, -1)
    by_Q = np.einsum("fjm,fkjp->fkmp", Q.reshape(F, 2, columns), images, optimize=True).reshape(F, K, -1)
    T, V = now.adjoint(by_P), now.adjoint(by_Q)  # (n, 3K·P)
    overlap = (Q.T @ Q) @ T.reshape(len(T), columns, -1)
    cross = V @ T.T
    hessian = now.gram(inner) - cross - cross.T + T @ overlap.reshape(T.shape).T
    explained = np.einsum("fjm,fjp->mp", Q.reshape(F, 2, columns), residual[:, 0]).reshape(-1, 1)
    gradient = now.adjoint((images * residual).sum((2, 3))[..., None]) - T @ explained
    return gradient[:, 0] / residual.size, hessian / residual.size
