"""Sparse coding: what the network is made of, and how its dictionaries are judged.

Plain codes: a dictionary D (n, K) with one atom per column, data x (..., n), codes z (..., K).
Block codes: the first dictionary D (K, P, 3), data W (B, P, 2), codes Z (B, K, 3, 2). Everything
takes and returns tensors, any number of problems at once, and autograd passes through.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from . import checks


def soft_threshold(x: Tensor, tau: float | Tensor, *, nonnegative: bool = False) -> Tensor:
    """Move every entry towards zero by tau, and to zero if it is closer: the proximal map of τ‖·‖₁.

    Parameters
    ----------
    x : (...) tensor
    tau : float or tensor, at least 0, broadcast against x
    nonnegative : bool
        Also forbid negative values: then this is ``relu(x - tau)``.

    Returns
    -------
    (...) tensor (paper, eq. 5; chapter 03)

    Raises
    ------
    ValueError
        If tau is negative somewhere.

    Examples
    --------
    >>> nl.sparse_coding.soft_threshold(torch.tensor([-3.0, 0.5, 2.0]), 1.0)
    tensor([-2.,  0.,  1.])
    """
    tau = _threshold(tau, x)
    up = torch.relu(x - tau)
    return up if nonnegative else up - torch.relu(-x - tau)


def block_soft_threshold(Z: Tensor, tau: float | Tensor, *, exact: bool = True) -> Tensor:
    """Threshold whole blocks: the proximal map of Σ τ_k ‖Z_k‖_F, or the paper's approximation of it.

    The proximal map is that of the group lasso (Yuan & Lin, 2006, doi:10.1111/j.1467-9868.2005.00532.x).

    Parameters
    ----------
    Z : (..., K, a, b) tensor
        The last two axes are a block, 3×2 in the paper.
    tau : float or (K,) tensor, at least 0
    exact : bool
        True: each block keeps its direction and loses τ of its length, ``Z_k max(0, 1 − τ/‖Z_k‖_F)``.
        False: soft threshold on every entry (paper, eq. 18), which can also turn a block.

    Returns
    -------
    Tensor of Z's shape (chapter 04)

    Raises
    ------
    ValueError
        If tau is negative somewhere, or Z has no blocks.

    Examples
    --------
    >>> Z = torch.tensor([[[3.0, 4.0]], [[0.3, 0.4]]])  # blocks of lengths 5 and 0.5
    >>> nl.sparse_coding.block_soft_threshold(Z, 1.0).norm(dim=(1, 2)).round(decimals=3)
    tensor([4., 0.])
    """
    if Z.ndim < 3:
        raise ValueError(f"Z has shape {tuple(Z.shape)}; expected (..., K, a, b).")
    tau = _threshold(tau, Z)[..., None, None]
    if not exact:
        return soft_threshold(Z, tau)
    square = Z.square().sum((-2, -1), keepdim=True)
    nonzero = square > 0
    length = torch.where(nonzero, square, 1.0).sqrt()  # the square root has no gradient at zero
    return torch.where(nonzero, Z * torch.relu(1 - tau / length), torch.zeros_like(Z))


def lipschitz(D: Tensor) -> Tensor:
    """Largest eigenvalue of DᵀD, the Lipschitz constant of the gradient of ½‖x − Dz‖².

    D is (n, K), or a first dictionary (K, P, 3) whose atoms stand side by side in D♯ (P, 3K).
    Steps of up to 1 / lipschitz(D) never overshoot (chapter 03). Returns a scalar tensor.

    >>> nl.sparse_coding.lipschitz(2 * torch.eye(3)).round()
    tensor(4.)
    """
    if D.ndim not in (2, 3):
        raise ValueError(f"D has shape {tuple(D.shape)}; expected (n, K) or (K, P, 3).")
    return torch.linalg.matrix_norm(_sharp(D), ord=2).square()


def ista(
    D: Tensor,
    x: Tensor,
    lam: float | Tensor,
    *,
    steps: int = 1000,
    step_size: float | Tensor | None = None,
    nonnegative: bool = False,
    tol: float = 0.0,
) -> Tensor:
    """Minimise ½‖x − D z‖² + λ‖z‖₁ by iterative shrinkage and thresholding from z = 0.

    Daubechies et al., 2004, doi:10.1002/cpa.20042.

    Parameters
    ----------
    D : (n, K) tensor
    x : (..., n) tensor
    lam : float or tensor broadcast against z
    steps : int
        At most so many iterations.
    step_size : float, optional
        α; default 1 / lipschitz(D). The threshold is α λ.
    nonnegative : bool
        Only codes z >= 0.
    tol : float
        Stop when no entry of z moves by more than this.

    Returns
    -------
    z : (..., K) (paper, eq. 6; chapter 03). The error falls as 1/k.

    Raises
    ------
    ValueError
        If the shapes do not fit, λ is negative, `steps` is no whole number, or α is not above zero.

    Examples
    --------
    >>> nl.sparse_coding.ista(torch.eye(3), torch.tensor([2.0, -0.5, 0.1]), 0.2).round(decimals=3) + 0
    tensor([ 1.8000, -0.3000,  0.0000])
    """
    return _plain(D, x, lam, steps, step_size, nonnegative, tol, accelerate=False)


def fista(
    D: Tensor,
    x: Tensor,
    lam: float | Tensor,
    *,
    steps: int = 1000,
    step_size: float | Tensor | None = None,
    nonnegative: bool = False,
    tol: float = 0.0,
) -> Tensor:
    """The minimum of `ista`, found faster: with momentum, error 1/k².

    Beck & Teboulle, 2009, doi:10.1137/080716542. The momentum is set back to zero for a problem whenever it points
    uphill (O'Donoghue & Candès, 2015, doi:10.1007/s10208-013-9150-3), which makes the end of the run fast too.
    Parameters, result and errors as in `ista`.

    >>> nl.sparse_coding.fista(torch.eye(3), torch.tensor([2.0, -0.5, 0.1]), 0.2).round(decimals=3) + 0
    tensor([ 1.8000, -0.3000,  0.0000])
    """
    return _plain(D, x, lam, steps, step_size, nonnegative, tol, accelerate=True)


def block_ista(
    D: Tensor,
    W: Tensor,
    lam: float | Tensor,
    *,
    visible: Tensor | None = None,
    exact: bool = True,
    steps: int = 1000,
    step_size: float | Tensor | None = None,
    tol: float = 0.0,
    accelerate: bool = False,
) -> Tensor:
    """Minimise ½‖Ω (W − Σ_k D_k Z_k)‖_F² + Σ_k λ_k ‖Z_k‖_F over block codes Z.

    Parameters
    ----------
    D : (K, P, 3) tensor
    W : (B, P, 2) tensor; hidden points may be NaN
    lam : float or (K,) tensor
    visible : (B, P) bool tensor, optional
        The diagonal of Ω.
    exact : bool
        As in `block_soft_threshold`. With False the result minimises no stated objective unless
        λ‖·‖₁ over entries is meant.
    steps, step_size, tol : as in `ista`
    accelerate : bool
        Use the momentum of `fista`.

    Returns
    -------
    Z : (B, K, 3, 2) (paper, eqs. 15 to 19 and the masked form in the section on occlusion; chapters 04, 11)

    Raises
    ------
    ValueError
        As `ista`; also if a visible point is not a finite number.

    Examples
    --------
    >>> D = torch.zeros(2, 4, 3)
    >>> D[0, 0, 0] = D[1, 1, 1] = 1.0  # one atom for each of two points
    >>> W = torch.tensor([[[3.0, 4.0], [0.3, 0.4], [0.0, 0.0], [0.0, 0.0]]])
    >>> nl.sparse_coding.block_ista(D, W, 1.0).norm(dim=(2, 3)).round(decimals=3)
    tensor([[4., 0.]])
    """
    steps, step_size, tol = _limits(steps, step_size, tol)
    if D.ndim != 3 or W.ndim != 3 or W.shape[1:] != (D.shape[1], 2):
        raise ValueError(f"D {tuple(D.shape)} and W {tuple(W.shape)} do not fit; expected (K, P, 3) and (B, P, 2).")
    lam = _threshold(lam, D)
    sharp = _sharp(D)  # (P, 3K)
    if visible is not None:
        checks.check_shape("visible", visible, tuple(W.shape[:2]))
        if visible.dtype != torch.bool:
            raise ValueError(f"visible has values of type {visible.dtype}; expected truth values.")
        W = torch.where(visible[..., None], W, 0.0)
    if not W.isfinite().all():
        raise ValueError("W has visible points that are NaN or infinite; mark missing points as False in visible.")
    step_size = 1 / lipschitz(D) if step_size is None else step_size
    blocks = (len(W), len(D), *D.shape[2:], 2)

    def gradient(Z):
        residual = sharp @ Z - W
        return sharp.mT @ (residual if visible is None else residual * visible[..., None])

    def shrink(Z):
        return block_soft_threshold(Z.view(blocks), step_size * lam, exact=exact).view_as(Z)

    start = W.new_zeros(len(W), sharp.shape[1], 2)
    return _descend(start, gradient, shrink, step_size, steps, tol, accelerate, axes=(1, 2)).view(blocks)


def hierarchical_code(
    dictionaries: Sequence[Tensor],
    x: Tensor,
    thresholds: Sequence[float | Tensor],
    *,
    nonnegative: bool = True,
    steps: int | None = None,
) -> list[Tensor]:
    """Codes z_1 … z_N with x ≈ D_1 z_1, z_1 ≈ D_2 z_2, …, layer after layer.

    Multi-layer sparse coding of Papyan et al., 2017, arXiv:1607.08194.

    Parameters
    ----------
    dictionaries : sequence of N tensors (n, K_1), (K_1, K_2), …
    x : (..., n) tensor
    thresholds : sequence of N floats or (K_i,) tensors
    nonnegative : bool
    steps : int, optional
        None: one step of ISTA with α = 1 per layer, ``η(D_iᵀ z_{i−1}; b_i)``: the forward pass of a
        network (paper, eq. 7). A number: solve each layer by that many steps of `fista`.

    Returns
    -------
    list of N tensors (..., K_i) (chapter 05)

    Raises
    ------
    ValueError
        If there are not as many thresholds as dictionaries, or the shapes do not fit.

    Examples
    --------
    >>> first, second = nl.sparse_coding.hierarchical_code(
    ...     [torch.eye(2), torch.ones(2, 1)], torch.tensor([1.0, -1.0]), [0.2, 0.3])
    >>> first.round(decimals=3), second.round(decimals=3)
    (tensor([0.8000, 0.0000]), tensor([0.5000]))
    """
    if len(dictionaries) != len(thresholds):
        raise ValueError(f"{len(dictionaries)} dictionaries, but {len(thresholds)} thresholds.")
    codes = []
    for D, b in zip(dictionaries, thresholds, strict=True):
        _check_plain(D, x)
        if steps is None:
            x = soft_threshold(x @ D, b, nonnegative=nonnegative)
        else:
            x = fista(D, x, b, steps=steps, nonnegative=nonnegative)
        codes.append(x)
    return codes


def mutual_coherence(D: Any) -> float:
    """Largest absolute cosine between two different columns of D.

    Parameters
    ----------
    D : (n, K) tensor or array
        One atom per column; a column of zeros counts as orthogonal to all others.

    Returns
    -------
    float in [0, 1]
        0 for orthogonal columns, 1 if two are parallel.

    Raises
    ------
    ValueError
        If D is not a matrix of at least two columns.

    Examples
    --------
    >>> round(nl.sparse_coding.mutual_coherence(torch.tensor([[1.0, 3.0], [0.0, 4.0]])), 3)
    0.6
    """
    return _cosines(D).max().item()


def babel(D: Any, m: int) -> float:
    """Babel function: the largest sum of m absolute cosines between one column and m others.

    ``babel(D, 1)`` is the mutual coherence. If ``babel(D, m) + babel(D, m − 1) < 1``, every code of
    m atoms is recovered by ℓ1 (Tropp, 2004, doi:10.1109/TIT.2004.834793; chapter 05). D as in `mutual_coherence`.

    Raises
    ------
    ValueError
        If m is not a whole number between 1 and K − 1.

    Examples
    --------
    >>> round(nl.sparse_coding.babel(torch.tensor([[1.0, 3.0, 0.0], [0.0, 4.0, 1.0]]), 2), 3)
    1.4
    """
    cosines = _cosines(D)
    m = checks.whole("m", m, 1, len(cosines) - 1)
    return cosines.topk(m, dim=1).values.sum(1).max().item()


def _plain(
    D: Tensor,
    x: Tensor,
    lam: float | Tensor,
    steps: int,
    step_size: float | Tensor | None,
    nonnegative: bool,
    tol: float,
    accelerate: bool,
) -> Tensor:
    steps, step_size, tol = _limits(steps, step_size, tol)
    _check_plain(D, x)
    lam = _threshold(lam, x)
    step_size = 1 / lipschitz(D) if step_size is None else step_size

    def gradient(z: Tensor) -> Tensor:
        return (z @ D.mT - x) @ D

    def shrink(z: Tensor) -> Tensor:
        return soft_threshold(z, step_size * lam, nonnegative=nonnegative)

    start = x.new_zeros(*x.shape[:-1], D.shape[1])
    return _descend(start, gradient, shrink, step_size, steps, tol, accelerate, axes=(-1,))


def _limits(steps: int, step_size: float | Tensor | None, tol: float) -> tuple[int, float | Tensor | None, float]:
    if step_size is not None:
        checks.at_least("step_size", step_size, above=True)
    return checks.whole("steps", steps, 0), step_size, checks.at_least("tol", tol)


def _descend(
    z: Tensor,
    gradient: Callable[[Tensor], Tensor],
    shrink: Callable[[Tensor], Tensor],
    step_size: float | Tensor,
    steps: int,
    tol: float,
    accelerate: bool,
    axes: tuple[int, ...],
) -> Tensor:
    """Gradient step, then shrinkage; with momentum if accelerated. `axes` are those of one problem."""
    ahead, t = z, torch.ones_like(z.sum(axes, keepdim=True))  # where the gradient is taken; Nesterov's sequence
    for _ in range(steps):
        new = shrink(ahead - step_size * gradient(ahead))
        move = new - z
        if accelerate:
            t_new = (1 + (1 + 4 * t * t).sqrt()) / 2
            uphill = ((ahead - new) * move).sum(axes, keepdim=True) > 0  # then this problem starts its momentum anew
            ahead = torch.where(uphill, new, new + (t - 1) / t_new * move)
            t = torch.where(uphill, 1.0, t_new)
        else:
            ahead = new
        z = new
        if tol > 0 and move.detach().abs().max() <= tol:
            break
    return z


def _check_plain(D: Tensor, x: Tensor) -> None:
    if D.ndim != 2 or x.shape[-1:] != D.shape[:1]:
        raise ValueError(f"D {tuple(D.shape)} and x {tuple(x.shape)} do not fit; expected (n, K) and (..., n).")


def _threshold(tau: float | Tensor, like: Tensor) -> Tensor:
    tau = torch.as_tensor(tau, dtype=like.dtype, device=like.device)
    if not (tau >= 0).all():  # so that NaN is refused, too
        raise ValueError("a threshold is negative or NaN; expected 0 or more.")
    return tau


def _sharp(D: Tensor) -> Tensor:
    """D♯ (P, 3K) of a first dictionary (K, P, 3); a matrix stays as it is."""
    return D if D.ndim == 2 else D.permute(1, 0, 2).reshape(D.shape[1], -1)


def _cosines(D: Any) -> Tensor:
    """(K, K) absolute cosines between the columns of D, zero on the diagonal."""
    D = torch.as_tensor(D).detach()
    D = D if D.is_floating_point() else D.double()
    if D.ndim != 2 or D.shape[1] < 2:
        raise ValueError(f"D has shape {tuple(D.shape)}; expected (n, K) with K >= 2.")
    unit = torch.nn.functional.normalize(D, dim=0)
    return (unit.mT @ unit).abs().fill_diagonal_(0)
