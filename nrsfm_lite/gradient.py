"""The loss and its gradient, written out: what autograd would do, in the fewest operations.

Half the time of a training step on small batches is autograd's bookkeeping, not arithmetic. The
network is a chain of matrix products, so its gradient is one too, and fits on a page (chapter 08).
`model.DeepNRSfM` is the definition; the tests hold the two together.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .cameras import polar, polar_gradient
from .model import DeepNRSfM

_relu_backward = torch.ops.aten.threshold_backward.grad_input


@torch.no_grad()
def backpropagate(
    net: DeepNRSfM,
    image: Tensor,
    weight: Tensor | None = None,
    *,
    size: Tensor | None = None,
    pull: float = 0.0,
    X: Tensor | None = None,
) -> Tensor:
    """The training loss of a batch (paper, eq. 27); its gradient is left in the parameters' ``.grad``.

    ``mean_f ‖Ω (W_f − S_f M_f − 1 t_fᵀ)‖_F / size_f``, with the network's shape and camera of each frame and the
    translation that fits them best. On complete, centred images of a network without translations t is left
    out, as it is zero but for the shapes' centroid, which the loss then draws to zero.

    Parameters
    ----------
    net : DeepNRSfM
    image : (B, P, 2) tensor
        What the encoder takes.
    weight : (B, P) tensor, optional
        Bool, or numbers from 0 to 1, of which Ω holds the square roots. Default: everything.
    size : (B,) tensor, optional
        Default: ‖X_f‖_F, as in the authors' code. Ones give the paper's own loss.
    pull : float
        Weight of a second term, ``mean_f ‖S_f − S̄‖_F / size_f``, which draws shapes to the mean shape S̄.
    X : (B, P, 2) tensor, optional
        Normalised points that the loss compares with, if they are not the image itself.

    Returns
    -------
    Scalar tensor: the loss without the pull.
    """
    B, P, _ = image.shape
    X = image if X is None else X
    size = X.flatten(1).norm(dim=1) if size is None else size
    D0, *D = net.D
    b0, *b = net.encoder_threshold
    c = list(net.decoder_threshold)
    beta, gamma = net.beta, net.gamma
    soft = net.config.threshold == "soft"
    rows = net.config.block_rows

    # Forward, as in `model`. Every code is kept; thresholds work in place.
    rows_of_image = image.mT.reshape(2 * B, P)
    first = net.first_dictionary()  # (P, rows K₁)
    codes = [_threshold((rows_of_image @ first).view(2 * rows * B, -1).sub_(b0), b0, soft)]
    for Di, bi in zip(D, b, strict=True):
        codes.append(_threshold(torch.addmm(bi, codes[-1], Di, beta=-1), bi, soft))  # (2 rows B, K_i)
    Z = codes[-1]
    found = polar((Z @ gamma).view(B, 2, rows)[:, :, :3].mT.contiguous())
    M = found[0]
    psi = Z.view(B, -1) @ beta if net.config.beta == "full" else beta @ Z.view(B, 2 * rows, -1)
    sign = psi.sign() if soft else None
    decoded = [psi.abs() if soft else psi]
    for Di, ci in zip(D[::-1], c[::-1], strict=True):
        decoded.append(_threshold(torch.addmm(ci, decoded[-1], Di.mT, beta=-1), ci, soft))  # (B, K_{i-1})
    S = torch.addmm(net.output_bias.view(-1), decoded[-1], D0.view(len(D0), -1)).view(B, P, 3)
    R = torch.baddbmm(X, S, M, beta=-1)
    if weight is not None:
        share = weight.to(R.dtype)[..., None]
        t = (R * share).sum(1, keepdim=True) / share.sum(1, keepdim=True)
        root = share.sqrt()
        R = R.sub_(t).mul_(root)
    elif net.config.translation:
        R -= R.mean(1, keepdim=True)
    missed = R.flatten(1).norm(dim=1)

    # Backward. g is always the gradient of what the forward pass made at this point. At the best t the
    # loss does not change with t, so t counts as a constant.
    minus = X.new_full((2 * rows * B,), -1.0)  # sums up columns, as a product
    g = R.mul_((1 / (B * size * missed.clamp(min=1e-12)))[:, None, None])
    if weight is not None:
        g *= root
    gM = S.mT @ g
    g = (g @ M.mT).view(B, -1)
    _set(net.output_bias, g.sum(0).view(P, 3))
    if pull:
        away = (S - net.output_bias).view(B, -1)
        g.addcmul_(away, (pull / (B * size * away.norm(dim=1).clamp(min=1e-12)))[:, None])
    dD0 = (decoded[-1].mT @ g).view_as(D0)
    g = g @ D0.view(len(D0), -1).mT
    dD = []
    for i, Di in enumerate(D):
        g = _mask(g, decoded[-1 - i], c[i], soft, minus)
        dD.append(g.mT @ decoded[-2 - i])
        g = g @ Di
    g = g * sign if soft else g
    gA = polar_gradient(gM, found).mT
    if rows == 4:
        gA = torch.nn.functional.pad(gA, (0, 1))  # no camera in the fourth row
    gA = gA.reshape(-1)
    if net.config.beta == "full":
        _set(beta, Z.view(B, -1).mT @ g)
        g = (g @ beta.mT).view(2 * rows * B, -1)
    else:
        _set(beta, torch.einsum("bjk,bk->j", Z.view(B, 2 * rows, -1), g))
        g = (beta[:, None] * g[:, None]).reshape(2 * rows * B, -1)
    _set(gamma, Z.mT @ gA)
    g.addr_(gA, gamma)
    for i in range(len(D) - 1, -1, -1):
        g = _mask(g, codes[i + 1], b[i], soft, minus)
        D[i].grad = dD[i].addmm_(codes[i].mT, g)
        g = g @ D[i].mT
    g = _mask(g, codes[0], b0, soft, minus).view(2 * B, -1)
    encoder = (rows_of_image.mT @ g).view(P, rows, -1)[:, :3]
    if net.config.translation:
        encoder = encoder - encoder.mean(0)  # its atoms are centred
    dD0 += encoder.permute(2, 0, 1)
    D0.grad = dD0
    return (missed / size).mean()


def _set(parameter, gradient):
    parameter.grad = gradient if parameter.requires_grad else None


def _threshold(x, b, soft):
    """η(x + b; b), in place: the caller has taken b off already."""
    if not soft:
        return x.relu_()
    below = torch.relu(-x - 2 * b)
    return x.relu_().sub_(below)


def _mask(g, code, b, soft, minus):
    """Gradient before the threshold, in place; leaves that of b in ``b.grad``."""
    if soft:
        sign = code.sign()
        b.grad = torch.mv((g * sign).mT, minus[: len(g)])
        return g.mul_(sign).mul_(sign)
    _relu_backward(g, code, 0, grad_input=g)
    b.grad = torch.mv(g.mT, minus[: len(g)])
    return g
