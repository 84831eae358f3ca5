"""The likely place of hidden image points, from the visible ones of the same frame (chapter 11).

Turn an image in its plane, and x becomes y: over many cameras both are draws from one distribution. It is
taken for Gaussian: a row x of P coordinates is N(t, G) with a translation t that may be anything. The P×P
matrix G is learned from the visible points alone, by expectation maximisation, and the hidden coordinates
of a frame are then a linear function of its visible ones. Nothing here knows of 3D.

Unlike completion by low rank, which shrinks, G keeps every direction at its own variance, and fills a frame
in without asking the others.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

_ITERATIONS = 30
_FRAMES = 4000  # at most, drawn evenly
_SHIFT = 1.0  # variance of t, in the network's units: anything a centred frame can need
_NOISE = 1e-4  # variance of visible points, relative to the same; keeps matrices away from singular
_DOUBT = 1e-2  # variance of a point of confidence ω, relative to the frame's highest, is this times 1/ω − 1
_CHUNK = 64


def learn(X: Tensor, weight: Tensor) -> Tensor:
    """Covariance of the points' image coordinates.

    Parameters
    ----------
    X : (F, P, 2) tensor, centred over the visible points, of unit scale, zero where hidden
    weight : (F, P) tensor, bool or from 0 to 1; every point is visible somewhere

    Returns
    -------
    G : (P, P) tensor in double precision; its rows sum to zero, as the centroid belongs to t.
    """
    step = -(-len(X) // _FRAMES)
    X, weight = X[::step].double(), _relative(weight[::step].double())
    F, P, _ = X.shape
    if (weight == 1).all():
        X = X - X.mean(1, keepdim=True)
        rows = X.mT.reshape(2 * F, P)
        return rows.T @ rows / (2 * F)
    G = torch.eye(P, dtype=X.dtype, device=X.device) - 1 / P
    for _ in range(_ITERATIONS):
        outer = known = torch.zeros_like(G)
        for x, w in _parts(X, weight):
            a, precision = _posterior(G, x, w)
            rows = (G @ a).mT.reshape(-1, P)  # what x and y are expected to be
            outer = outer + rows.T @ rows
            known = known + 2 * precision.sum(0)
        G = G + (outer - G @ known @ G) / (2 * F)
        G = (G + G.T) / 2
    return G


def fill(G: Tensor, X: Tensor, weight: Tensor) -> Tensor:
    """Points with the hidden ones at their likely place, and each frame centred again over all its points.

    The visible points of a frame are taken in one after the other, each moving the expectation of all that are
    left. A point of less than full confidence moves towards its own, too.

    Parameters
    ----------
    G : what `learn` returns
    X, weight : as in `learn`

    Returns
    -------
    (F, P, 2) tensor of X's type
    """
    P = X.shape[1]
    filled = []
    for x, w in [(X, weight)] if torch.compiler.is_exporting() else _parts(X, weight):
        x, w = x.to(G), _relative(w.to(G))
        share, noise = _trust(w)
        mean = torch.zeros_like(x)
        Sigma = (G + _SHIFT).expand(x.shape[0], P, P)  # not len(x), which `torch.export` would fix
        for k in range(P):
            gain = share[:, k, None] * Sigma[:, :, k] / (Sigma[:, k, k] + noise[:, k])[:, None]
            mean = mean + gain[..., None] * (x[:, k] - mean[:, k])[:, None]
            Sigma = Sigma - gain[..., None] * Sigma[:, k, None]
        filled.append(torch.where((w == 1)[..., None], x, mean))
    whole = torch.cat(filled)
    return (whole - whole.mean(1, keepdim=True)).to(X.dtype)


def _parts(X: Tensor, weight: Tensor) -> Iterable[tuple[Tensor, Tensor]]:
    """A few frames at a time, so that their matrices stay in the cache."""
    return zip(X.split(_CHUNK), weight.split(_CHUNK), strict=True)


def _relative(weight: Tensor) -> Tensor:
    """Weights relative to the frame's largest: doubt about all points alike says nothing about where one is."""
    return weight / weight.amax(1, keepdim=True).clamp(min=1e-12)


def _trust(weight: Tensor) -> tuple[Tensor, Tensor]:
    """One where visible, else zero; and the variance of each point's noise."""
    return (weight > 0).to(weight), _NOISE + _DOUBT * (1 / torch.where(weight > 0, weight, 1.0) - 1)


def _posterior(G: Tensor, X: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Σ⁻¹ x and Σ⁻¹ for the visible rows of each frame, zero elsewhere; Σ = G + shift + noise."""
    share, noise = _trust(weight)
    both = share[:, :, None] * share[:, None]
    Sigma = (G + _SHIFT) * both
    Sigma.diagonal(dim1=1, dim2=2).add_(noise + (1 - share))
    precision = torch.cholesky_inverse(torch.linalg.cholesky(Sigma)) * both
    return precision @ X, precision
