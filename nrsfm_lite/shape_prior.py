"""A Gaussian prior over shapes, learned from images whose cameras are roughly known (chapter 10).

A trained network puts every frame into one coordinate system, though its shapes are still coarse. From
there the images themselves tell how shapes vary, because every camera hides another direction. The
coordinates of all points are taken as one Gaussian vector,

    s ~ N(mean, C),   w = A s + t + noise of variance σ²,   A: what the camera sees, without hidden points,

and expectation maximisation learns mean, C and σ from all frames at once. Torresani, Hertzmann and Bregler
(2008) do this for a basis of few shapes; here C is whole. Given the prior, a frame's shape is the solution
of a linear system, hidden points included, and its camera takes a few Newton steps on the likelihood of its
image, in which the shape has been integrated out.

Shapes in comments: B frames, P points. Points are in the network's units. The coordinates of a shape are
ordered by axis (all x, all y, all z), so that C has nine P×P blocks and all work is products of matrices.
"""

import math
from dataclasses import dataclass

import torch

_ITERATIONS = 15
_TURNS = 4  # Newton steps of a frame's camera
_FIRST_NOISE, _LEAST_NOISE = 1e-2, 1e-3  # σ
_FREEDOM = 1e-3  # variance that C grants every coordinate at the start, beside that of the network's shapes
_SHIFT = 1.0  # standard deviation of t, which stays zero unless points are hidden
_LONGEST_TURN = 0.3  # radians per Newton step
_DAMPING = 3e-3  # of a Newton step, as a share of the mean curvature
_CHUNK = 64  # frames per pass, so that their matrices stay in the cache


@dataclass(frozen=True)
class ShapePrior:
    """Gaussian over shapes: mean (P, 3), covariance (3P, 3P) ordered by axis, σ² of the image coordinates."""

    mean: torch.Tensor
    covariance: torch.Tensor
    noise: float


def learn(X, visible, S, M):
    """The prior of a set of frames, by expectation maximisation.

    Parameters
    ----------
    X : (B, P, 2) tensor, centred, zero where hidden
    visible : (B, P) bool tensor
    S, M : (B, P, 3) and (B, 3, 2) tensors
        A network's shapes and cameras, to start from.

    Returns
    -------
    ShapePrior, in double precision.
    """
    X, S, M = X.double(), S.double(), M.double().clone()
    seen = visible.double().repeat(1, 2)  # (B, 2P)
    B, P, _ = X.shape
    S = S - S.mean(1, keepdim=True)
    mean = S.mean(0)
    centred = torch.eye(P, dtype=X.dtype) - 1 / P  # C gives the centroid no variance: that is t's part
    start = torch.cov((S - mean).mT.flatten(1).T, correction=0)
    start = start + _FREEDOM * torch.eye(3, dtype=X.dtype).kron(centred)
    prior = ShapePrior(mean, start, _FIRST_NOISE**2)
    for _ in range(_ITERATIONS):
        C, noise = prior.covariance, prior.noise
        offset, outer, known, rest = 0.0, 0.0, 0.0, 0.0
        for part in torch.arange(B).split(_CHUNK):
            post = _look(prior, X[part], seen[part], M[part])
            d = (post.shapes - prior.mean).mT.flatten(1)  # (b, 3P)
            offset = offset + d.sum(0)
            outer = outer + d.T @ d
            known = known + post.pairs.flatten(0, 1).T @ _split(post.precision).flatten(0, 1)  # Σ Aᵀ Σ⁻¹ A
            # σ²: what an image misses by, and what is unsure about that
            rest = rest + noise**2 * (post.weighted.square().sum() - _trace(post.precision)) + noise * seen[part].sum()
            M[part] = _turn(prior, post, seen[part], M[part])
        # What the images leave open counts too: each shape's covariance given its image is C − C Aᵀ Σ⁻¹ A C.
        # One part of the start in B + 1 keeps few frames from a C without variance.
        offset = offset / B
        new = C + (outer - C @ _join(known, 3) @ C) / B - torch.outer(offset, offset)
        new = (B * new + start) / (B + 1)
        noise = max(float(rest / seen.sum()), _LEAST_NOISE**2)
        prior = ShapePrior(prior.mean + offset.view(3, P).T, (new + new.T) / 2, noise)
    C, flat = _without_noise(prior.covariance)
    return ShapePrior(prior.mean, C, prior.noise + flat)


def apply(prior, X, visible, M):
    """Shapes (B, P, 3) and cameras (B, 3, 2) of frames, in double precision; each frame on its own.

    Parameters
    ----------
    prior : ShapePrior
    X, visible, M : as in `learn`; M is the camera to start from
    """
    S, M = torch.empty(*X.shape[:2], 3, dtype=torch.float64), M.double().clone()
    for part in torch.arange(len(X)).split(_CHUNK):
        x, seen, m = X[part].double(), visible[part].double().repeat(1, 2), M[part]
        for _ in range(_TURNS):
            m = _turn(prior, _look(prior, x, seen, m), seen, m)
        S[part], M[part] = _look(prior, x, seen, m).shapes, m
    return S, M


def surprise(prior, X, visible, M):
    """−log p(image) per visible coordinate, mean over frames: how well a prior foresees images.

    Parameters as in `apply`; the cameras are taken as they are.
    """
    total = 0.0
    for part in torch.arange(len(X)).split(_CHUNK):
        seen = visible[part].double().repeat(1, 2)
        post = _look(prior, X[part].double(), seen, M[part].double())
        total += float((post.surprise / seen.sum(1)).sum())
    return total / len(X)


@dataclass(frozen=True)
class _Posterior:
    """What some images say about their shapes, given the prior and the cameras."""

    shapes: torch.Tensor  # (B, P, 3) posterior means
    pairs: torch.Tensor  # (B, 4, 9): products of two entries of a camera, one for each block of C
    precision: torch.Tensor  # (B, 2P, 2P): Σ⁻¹, zero where hidden
    weighted: torch.Tensor  # (B, 2P): Σ⁻¹ (w − A mean)
    surprise: torch.Tensor  # (B,): −log p(image)


def _look(prior, X, seen, M):
    """The posterior of some frames. `seen` (B, 2P) is one where visible, else zero."""
    B, P, _ = X.shape
    y = (X - prior.mean @ M).mT.reshape(B, 2 * P) * seen
    both = seen[:, :, None] * seen[:, None]
    pairs = (M.mT[:, :, None, :, None] * M.mT[:, None, :, None, :]).reshape(B, 4, 9)
    Sigma = _join(pairs @ _split(prior.covariance), 2)
    if not seen.all():
        Sigma = (Sigma + _SHIFT**2 * torch.eye(2, dtype=X.dtype).kron(torch.ones(P, P, dtype=X.dtype))) * both
    Sigma.diagonal(dim1=1, dim2=2).add_(prior.noise)
    root = torch.linalg.cholesky(Sigma)
    precision = torch.cholesky_inverse(root) * both
    weighted = (precision @ y[..., None])[..., 0]
    S = (M @ weighted.view(B, 2, P)).view(B, 3 * P) @ prior.covariance
    logs = 2 * root.diagonal(dim1=1, dim2=2).log() + math.log(2 * math.pi)
    hidden = (1 - seen).sum(1) * math.log(2 * math.pi * prior.noise)
    surprise = ((y * weighted).sum(1) + logs.sum(1) - hidden) / 2
    return _Posterior(prior.mean + S.view(B, 3, P).mT, pairs, precision, weighted, surprise)


def _turn(prior, post, seen, M):
    """The cameras after one Newton step on −log p(image), by a small rotation of each."""
    B, P, _ = post.shapes.shape
    a = post.weighted
    Q = _split(post.precision - a[:, :, None] * a[:, None])  # (B, 4, P²)
    T = (Q @ _split(prior.covariance).T).view(B, 2, 2, 3, 3)
    g = torch.einsum("bmj,bijlm->bli", M, T) - prior.mean.T @ a.view(B, 2, P).mT  # by the entries of M
    gradient = torch.linalg.cross(M.mT, g.mT).sum(1)  # by a rotation about each axis
    axes = torch.eye(3, dtype=M.dtype).view(1, 3, 1, 3)
    moves = torch.linalg.cross(axes, M.mT[:, None])  # (B, 3 axes, 2, 3): what each rotation does to the camera
    J = (moves @ post.shapes.mT[:, None]).view(B, 3, 2 * P) * seen[:, None]
    curvature = J @ post.precision @ J.mT  # Fisher information, never negative
    curvature = curvature + _DAMPING * curvature.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(
        3, dtype=M.dtype
    )
    curvature.diagonal(dim1=1, dim2=2).add_(1e-9)
    turn = -torch.linalg.solve(curvature, gradient)
    turn = turn * (_LONGEST_TURN / turn.norm(dim=1, keepdim=True)).clamp(max=1)
    x, y, z = turn.unbind(1)
    o = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o], 1).view(B, 3, 3)) @ M


def _without_noise(C):
    """C less what it holds in all directions alike, and that variance.

    The same variance in all directions cannot be told from noise of the images, and is taken for it. It is
    read off the smallest tenth of the eigenvalues, twice, since the smallest are estimated too small.
    """
    values, vectors = torch.linalg.eigh(C)
    flat = 2 * values[3:].quantile(0.1).clamp(min=0)  # the first three belong to the centroid
    return (vectors * (values - flat).clamp(min=0)) @ vectors.T, float(flat)


def _trace(A):
    return A.diagonal(dim1=1, dim2=2).sum()


def _split(C):
    """Matrices of n×n blocks of P×P, as rows: (..., nP, nP) -> (..., n², P²). n is 3 for shapes, 2 for images."""
    n = 3 if C.ndim == 2 else 2
    P = C.shape[-1] // n
    return C.unflatten(-1, (n, P)).unflatten(-3, (n, P)).transpose(-3, -2).flatten(-4, -3).flatten(-2)


def _join(rows, n):
    """The way back: (..., n², P²) -> (..., nP, nP)."""
    P = round(rows.shape[-1] ** 0.5)
    blocks = rows.unflatten(-1, (P, P)).unflatten(-3, (n, n)).transpose(-3, -2)
    return blocks.flatten(-2).flatten(-3, -2)
