"""Sparse coding: what the network is made of, and how its dictionaries are judged.

Plain codes: a dictionary D (n, K) with one atom per column, data x (..., n), codes z (..., K).
Block codes: the first dictionary D (K, P, 3), data W (B, P, 2), codes Z (B, K, 3, 2). Everything
takes and returns tensors, any number of problems at once, and autograd passes through.
"""

import torch


def soft_threshold(x, tau, *, nonnegative=False):
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
    """
    tau = _threshold(tau, x)
    up = torch.relu(x - tau)
    return up if nonnegative else up - torch.relu(-x - tau)


def block_soft_threshold(Z, tau, *, exact=True):
    """Threshold whole blocks: the proximal map of Σ τ_k ‖Z_k‖_F, or the paper's approximation of it.

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
        If tau is negative somewhere.
    """
    tau = _threshold(tau, Z)[..., None, None]
    if not exact:
        return soft_threshold(Z, tau)
    square = Z.square().sum((-2, -1), keepdim=True)
    nonzero = square > 0
    length = torch.where(nonzero, square, 1.0).sqrt()  # the square root has no gradient at zero
    return torch.where(nonzero, Z * torch.relu(1 - tau / length), torch.zeros_like(Z))


def lipschitz(D):
    """Largest eigenvalue of DᵀD, the Lipschitz constant of the gradient of ½‖x − Dz‖².

    D is (n, K), or a first dictionary (K, P, 3) whose atoms stand side by side in D♯ (P, 3K).
    Steps of up to 1 / lipschitz(D) never overshoot (chapter 03). Returns a scalar tensor.
    """
    return torch.linalg.matrix_norm(_sharp(D), ord=2).square()


def ista(D, x, lam, *, steps=1000, step=None, nonnegative=False, tol=0.0):
    """Minimise ½‖x − D z‖² + λ‖z‖₁ by iterative shrinkage and thresholding from z = 0.

    Parameters
    ----------
    D : (n, K) tensor
    x : (..., n) tensor
    lam : float or tensor broadcast against z
    steps : int
        At most so many iterations.
    step : float, optional
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
        If the shapes do not fit or λ is negative.
    """
    return _plain(D, x, lam, steps, step, nonnegative, tol, accelerate=False)


def fista(D, x, lam, *, steps=1000, step=None, nonnegative=False, tol=0.0):
    """The minimum of `ista`, found faster: with momentum, error 1/k² (Beck & Teboulle, 2009).

    The momentum is set back to zero for a problem whenever it points uphill (O'Donoghue & Candès,
    2015), which makes the end of the run fast too. Parameters, result and errors as in `ista`.
    """
    return _plain(D, x, lam, steps, step, nonnegative, tol, accelerate=True)


def block_ista(D, W, lam, visible=None, *, exact=True, steps=1000, step=None, tol=0.0, accelerate=False):
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
    steps, step, tol : as in `ista`
    accelerate : bool
        Use the momentum of `fista`.

    Returns
    -------
    Z : (B, K, 3, 2) (paper, eqs. 15 to 19 and the masked form in the section on occlusion; chapters 04, 11)

    Raises
    ------
    ValueError
        If the shapes do not fit or λ is negative.
    """
    if D.ndim != 3 or W.ndim != 3 or W.shape[1:] != (D.shape[1], 2):
        raise ValueError(f"D {tuple(D.shape)} and W {tuple(W.shape)} do not fit; expected (K, P, 3) and (B, P, 2).")
    lam = _threshold(lam, D)
    sharp = _sharp(D)  # (P, 3K)
    if visible is not None:
        if visible.shape != W.shape[:2]:
            raise ValueError(f"visible has shape {tuple(visible.shape)}; expected {tuple(W.shape[:2])}.")
        W = torch.where(visible[..., None], W, 0.0)
    step = 1 / lipschitz(D) if step is None else step
    blocks = (len(W), len(D), *D.shape[2:], 2)

    def gradient(Z):
        residual = sharp @ Z - W
        return sharp.mT @ (residual if visible is None else residual * visible[..., None])

    def shrink(Z):
        return block_soft_threshold(Z.view(blocks), step * lam, exact=exact).view_as(Z)

    start = W.new_zeros(len(W), sharp.shape[1], 2)
    return _descend(start, gradient, shrink, step, steps, tol, accelerate, axes=(1, 2)).view(blocks)


def hierarchical_code(dictionaries, x, thresholds, *, nonnegative=True, steps=None):
    """Codes z_1 … z_N with x ≈ D_1 z_1, z_1 ≈ D_2 z_2, …, layer after layer.

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


def mutual_coherence(D):
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
    """
    return _cosines(D).max().item()


def babel(D, m):
    """Babel function: the largest sum of m absolute cosines between one column and m others.

    ``babel(D, 1)`` is the mutual coherence. If ``babel(D, m) + babel(D, m − 1) < 1``, every code of
    m atoms is recovered by ℓ1 (Tropp, 2004; chapter 05). D as in `mutual_coherence`.

    Raises
    ------
    ValueError
        If m is not between 1 and K − 1.
    """
    cosines = _cosines(D)
    if not 1 <= m < len(cosines):
        raise ValueError(f"m={m}; expected 1 … {len(cosines) - 1}.")
    return cosines.topk(m, dim=1).values.sum(1).max().item()


def _plain(D, x, lam, steps, step, nonnegative, tol, accelerate):
    _check_plain(D, x)
    lam = _threshold(lam, x)
    step = 1 / lipschitz(D) if step is None else step

    def gradient(z):
        return (z @ D.mT - x) @ D

    def shrink(z):
        return soft_threshold(z, step * lam, nonnegative=nonnegative)

    start = x.new_zeros(*x.shape[:-1], D.shape[1])
    return _descend(start, gradient, shrink, step, steps, tol, accelerate, axes=(-1,))


def _descend(z, gradient, shrink, step, steps, tol, accelerate, axes):
    """Gradient step, then shrinkage; with momentum if accelerated. `axes` are those of one problem."""
    ahead, t = z, torch.ones_like(z.sum(axes, keepdim=True))  # where the gradient is taken; Nesterov's sequence
    for _ in range(steps):
        new = shrink(ahead - step * gradient(ahead))
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


def _check_plain(D, x):
    if D.ndim != 2 or x.shape[-1:] != D.shape[:1]:
        raise ValueError(f"D {tuple(D.shape)} and x {tuple(x.shape)} do not fit; expected (n, K) and (..., n).")


def _threshold(tau, like):
    tau = torch.as_tensor(tau, dtype=like.dtype, device=like.device)
    if (tau < 0).any():
        raise ValueError("a threshold is negative; expected 0 or more.")
    return tau


def _sharp(D):
    """D♯ (P, 3K) of a first dictionary (K, P, 3); a matrix stays as it is."""
    return D if D.ndim == 2 else D.permute(1, 0, 2).reshape(D.shape[1], -1)


def _cosines(D):
    """(K, K) absolute cosines between the columns of D, zero on the diagonal."""
    D = torch.as_tensor(D).detach()
    if D.ndim != 2 or D.shape[1] < 2:
        raise ValueError(f"D has shape {tuple(D.shape)}; expected (n, K) with K >= 2.")
    unit = torch.nn.functional.normalize(D, dim=0)
    return (unit.mT @ unit).abs().fill_diagonal_(0)
