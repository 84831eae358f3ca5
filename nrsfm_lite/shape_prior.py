"""A prior over shapes, learned from images whose cameras are roughly known (chapter 10).

A trained network puts every frame into one coordinate system, though its shapes are still coarse. From
there the images themselves tell how shapes vary, because every camera hides another direction. The
coordinates of all points are taken as one Gaussian vector,

    s ~ N(mean, C),   w = A s + t + noise of variance σ²,   A: what the camera sees, without hidden points,

and expectation maximisation learns mean, C and σ from all frames at once. Torresani, Hertzmann and Bregler
(2008) do this for a basis of few shapes; here C is whole. A body that walks and sits is more than one
Gaussian: the shapes are then assigned to the components of a mixture, each learned in the same way.

Given the prior, a frame's shape is the solution of a linear system, hidden points included, and its camera
takes a few Newton steps on the likelihood of its image, in which the shape has been integrated out.

Shapes in comments: B frames, P points. Points are in the network's units. The coordinates of a shape are
ordered by axis (all x, all y, all z), so that C has nine P×P blocks and all work is products of matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

COMPONENTS = 8  # at most
_FRAMES_PER_COMPONENT = 250  # on average, at least
_ITERATIONS, _ITERATIONS_OF_A_COMPONENT, _ASSIGNMENTS = 15, 6, 2
_NEWTON_STEPS, _NEWTON_STEPS_IN_A_COMPONENT = 4, 3  # of a frame's camera
_FIRST_NOISE, _LEAST_NOISE = 1e-2, 1e-3  # σ
_FREEDOM = 1e-2  # variance that C grants every coordinate at the start, beside that of the network's shapes
_LARGEST = 10.0  # root mean square distance of a shape's points: a network that has diverged may say anything
_SHIFT = 1.0  # standard deviation of t, which stays zero unless points are hidden
_LONGEST_STEP = 0.3  # radians per Newton step
_DAMPING = 3e-3  # of a Newton step, as a share of the mean curvature
_CHUNK = 64  # frames per pass, so that their matrices stay in the cache


@dataclass(frozen=True)
class Gaussian:
    """Of shapes: mean (P, 3), covariance (3P, 3P) ordered by axis, and the variance σ² of image coordinates."""

    mean: Tensor
    covariance: Tensor
    noise: float


Prior = tuple[Gaussian, ...]  # the whole first; then, if any, the components of the mixture


def learn(X: Tensor, weight: Tensor, S: Tensor, M: Tensor) -> Prior:
    """The prior of a set of frames.

    Parameters
    ----------
    X : (B, P, 2) tensor, centred over the visible points, zero where hidden
    weight : (B, P) tensor, bool or from 0 to 1: a point of weight ω has the noise σ²/ω; 0 hides it
    S, M : (B, P, 3) and (B, 3, 2) tensors
        A network's shapes and cameras, to start from.

    Returns
    -------
    tuple of Gaussian, in double precision: first that of all shapes; then, if the frames are many enough for
    two or more, those of up to eight components.
    """
    # Imported here, since only training needs it and it takes a while.
    from scipy.cluster.vq import kmeans2

    X, S, M = X.double(), S.double(), M.double()
    B, P, _ = X.shape
    S = torch.nan_to_num(S - S.mean(1, keepdim=True))
    S = S / (S.flatten(1).norm(dim=1) / (_LARGEST * P**0.5)).clamp(min=1)[:, None, None]
    centred = torch.eye(P, dtype=X.dtype) - 1 / P  # C gives the centroid no variance: that is t's part
    start = _covariance(S) + _FREEDOM * torch.eye(3, dtype=X.dtype).kron(centred)
    whole = Gaussian(S.mean(0), start, _FIRST_NOISE**2)
    whole, M = _maximise(whole, X, weight, M, _ITERATIONS, 1)
    whole = _without_noise(whole)
    n = min(COMPONENTS, B // _FRAMES_PER_COMPONENT)
    if n < 2:
        return (whole,)
    S, M = _fit(whole, X, weight, M, 1)
    component = torch.as_tensor(kmeans2(S.flatten(1).numpy(), n, minit="++", seed=0)[1])
    mixture: list[Gaussian] = []
    for _ in range(_ASSIGNMENTS):
        if mixture:
            component, S, M = _assign(mixture, X, weight, M, 0)
        mixture = []
        for k in range(n):
            i = (component == k).nonzero()[:, 0]
            if len(i) < _FRAMES_PER_COMPONENT / 4:
                continue
            first = Gaussian(S[i].mean(0), _covariance(S[i]) + whole.covariance / 10, whole.noise)
            gaussian, M[i] = _maximise(first, X[i], weight[i], M[i], _ITERATIONS_OF_A_COMPONENT, 20)
            mixture.append(gaussian)
    return (whole, *map(_without_noise, mixture))


def apply(prior: Prior, X: Tensor, weight: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
    """Most probable shapes (B, P, 3) and cameras (B, 3, 2) of frames, in double precision; each frame on its own.

    Parameters
    ----------
    prior : what `learn` returns
    X, weight, M : as in `learn`; M is the camera to start from
    """
    X = X.double()
    S, M = _fit(prior[0], X, weight, M.double(), _NEWTON_STEPS)
    if len(prior) > 1:
        _, S, M = _assign(prior[1:], X, weight, M, _NEWTON_STEPS_IN_A_COMPONENT)
    return S, M


def negative_log_likelihood(prior: Prior, X: Tensor, weight: Tensor, M: Tensor) -> float:
    """−log p(image) per visible coordinate, mean over frames: how well a prior explains images.

    Parameters as in `apply`. Every frame is taken for the component under which it is likeliest.
    """
    X, M = X.double(), M.double()
    each = torch.stack([_negative_log_likelihood(g, X, weight, M) for g in prior[min(1, len(prior) - 1) :]])
    return float((each.amin(0) / (2 * (weight > 0).sum(1))).mean())


def _root_weight(weight):
    """√ω of every image coordinate, (B, 2P). Rows of an image times √ω all have the noise σ²; zero strikes them out."""
    return weight.double().sqrt().repeat(1, 2)


def _covariance(S):
    return torch.cov((S - S.mean(0)).mT.flatten(1).T, correction=0)


def _maximise(start, X, weight, M, iterations, strength):
    """Expectation maximisation from a Gaussian, which counts as much as `strength` frames: (Gaussian, cameras)."""
    root_weight = _root_weight(weight)
    M = M.clone()
    B, P, _ = X.shape
    gaussian = start
    for _ in range(iterations):
        C, noise = gaussian.covariance, gaussian.noise
        offset, outer, known, rest = 0.0, 0.0, 0.0, 0.0
        for part in torch.arange(B).split(_CHUNK):
            post = _posterior(gaussian, X[part], root_weight[part], M[part])
            d = (post.shapes - gaussian.mean).mT.flatten(1)  # (b, 3P)
            offset = offset + d.sum(0)
            outer = outer + d.T @ d
            known = known + post.pairs.flatten(0, 1).T @ _split(post.precision).flatten(0, 1)  # Σ Aᵀ Σ⁻¹ A
            rest = rest + post.noise
            M[part] = _newton_step(gaussian, post, M[part])
        # What the images leave open counts too: each shape's covariance given its image is C − C Aᵀ Σ⁻¹ A C.
        offset = offset / B
        new = C + (outer - C @ _join(known, 3) @ C) / B - torch.outer(offset, offset)
        new = (B * new + strength * start.covariance) / (B + strength)  # few frames do not make C singular
        noise = max(float(rest / (root_weight > 0).sum()), _LEAST_NOISE**2)
        gaussian = Gaussian(gaussian.mean + offset.view(3, P).T, (new + new.T) / 2, noise)
    return gaussian, M


def _without_noise(gaussian):
    """The Gaussian less what its covariance holds in all directions alike, which goes to σ².

    The same variance in all directions cannot be told from noise of the images, and is taken for it. It is
    read off the smallest tenth of the eigenvalues, twice, since the smallest are estimated too small.
    """
    values, vectors = torch.linalg.eigh(gaussian.covariance)
    flat = 2 * values[3:].quantile(0.1).clamp(min=0)  # the first three belong to the centroid
    C = (vectors * (values - flat).clamp(min=0)) @ vectors.T
    least = 1e-7 * float(values[-1])  # of images of single precision nothing finer can be said
    return Gaussian(gaussian.mean, C, max(gaussian.noise + float(flat), least))


def _fit(gaussian, X, weight, M, steps):
    """Shapes and cameras after some Newton steps of the cameras."""
    S, M = torch.empty(*X.shape[:2], 3, dtype=X.dtype), M.clone()
    for part in torch.arange(len(X)).split(_CHUNK):
        x, root_weight, m = X[part], _root_weight(weight[part]), M[part]
        for _ in range(steps):
            m = _newton_step(gaussian, _posterior(gaussian, x, root_weight, m), m)
        S[part], M[part] = _posterior(gaussian, x, root_weight, m).shapes, m
    return S, M


def _assign(mixture, X, weight, M, steps):
    """Every frame to the component under which its image is likeliest: that component, and shapes and cameras in it."""
    component = torch.stack([_negative_log_likelihood(g, X, weight, M) for g in mixture]).argmin(0)
    S, M = torch.empty(*X.shape[:2], 3, dtype=X.dtype), M.clone()
    for k, gaussian in enumerate(mixture):
        i = (component == k).nonzero()[:, 0]
        if len(i):
            S[i], M[i] = _fit(gaussian, X[i], weight[i], M[i], steps)
    return component, S, M


def _negative_log_likelihood(gaussian, X, weight, M):
    """−log p(image) of each frame (B,), the cameras as they are."""
    result = torch.empty(len(X), dtype=X.dtype)
    for part in torch.arange(len(X)).split(_CHUNK):
        root_weight = _root_weight(weight[part])
        y, _, factor = _marginal(gaussian, X[part], root_weight, M[part])
        half = torch.linalg.solve_triangular(factor, y[..., None], upper=False)
        hidden = root_weight == 0
        logs = factor.diagonal(dim1=1, dim2=2).log() - root_weight.masked_fill(hidden, gaussian.noise**0.5).log()
        count = (~hidden).double().sum(1)
        result[part] = half.square().sum((1, 2)) / 2 + logs.sum(1) + count * math.log(2 * math.pi) / 2
    return result


@dataclass(frozen=True)
class _Posterior:
    """What some images say about their shapes, given a Gaussian and the cameras."""

    shapes: torch.Tensor  # (B, P, 3) posterior means
    pairs: torch.Tensor  # (B, 4, 9): products of two entries of a camera, one for each block of C
    precision: torch.Tensor  # (B, 2P, 2P): √Ω Σ⁻¹ √Ω
    weighted: torch.Tensor  # (B, 2P): √Ω Σ⁻¹ √Ω (w − A mean)
    noise: torch.Tensor  # expected sum of squares of √Ω times what the images miss by, for σ²


def _marginal(gaussian, X, root_weight, M):
    """The distribution of some images with their shapes integrated out; rows are weighted by √Ω (B, 2P).

    Returns y = √Ω (w − A mean), products of camera entries, and the Cholesky factor of Σ = √Ω A C Aᵀ √Ω + σ².
    """
    B, P, _ = X.shape
    y = (X - gaussian.mean @ M).mT.reshape(B, 2 * P) * root_weight
    pairs = (M.mT[:, :, None, :, None] * M.mT[:, None, :, None, :]).reshape(B, 4, 9)
    Sigma = _join(pairs @ _split(gaussian.covariance), 2)
    if not (root_weight == 1).all():
        shift = _SHIFT**2 * torch.eye(2, dtype=X.dtype).kron(torch.ones(P, P, dtype=X.dtype))
        Sigma = (Sigma + shift) * (root_weight[:, :, None] * root_weight[:, None])
    Sigma.diagonal(dim1=1, dim2=2).add_(gaussian.noise)
    return y, pairs, torch.linalg.cholesky(Sigma)


def _posterior(gaussian, X, root_weight, M):
    """The posterior of some frames; `root_weight` as in `_marginal`."""
    B, P, _ = X.shape
    y, pairs, factor = _marginal(gaussian, X, root_weight, M)
    precision = torch.cholesky_inverse(factor)
    weighted = (precision @ y[..., None])[..., 0]
    # What an image misses by, and what is unsure about that; rows struck out add nothing.
    noise = gaussian.noise**2 * (weighted.square().sum() - _trace(precision)) + gaussian.noise * root_weight.numel()
    if not (root_weight == 1).all():
        precision = precision * (root_weight[:, :, None] * root_weight[:, None])
        weighted = weighted * root_weight
    S = (M @ weighted.view(B, 2, P)).view(B, 3 * P) @ gaussian.covariance
    return _Posterior(gaussian.mean + S.view(B, 3, P).mT, pairs, precision, weighted, noise)


def _newton_step(gaussian, post, M):
    """The cameras after one Newton step on −log p(image), by a small rotation of each."""
    B, P, _ = post.shapes.shape
    a = post.weighted
    Q = _split(post.precision - a[:, :, None] * a[:, None])  # (B, 4, P²)
    T = (Q @ _split(gaussian.covariance).T).view(B, 2, 2, 3, 3)
    g = torch.einsum("bmj,bijlm->bli", M, T) - gaussian.mean.T @ a.view(B, 2, P).mT  # by the entries of M
    gradient = torch.linalg.cross(M.mT, g.mT).sum(1)  # by a rotation about each axis
    axes = torch.eye(3, dtype=M.dtype).view(1, 3, 1, 3)
    moves = torch.linalg.cross(axes, M.mT[:, None])  # (B, 3 axes, 2, 3): what each rotation does to the camera
    J = (moves @ post.shapes.mT[:, None]).view(B, 3, 2 * P)
    curvature = J @ post.precision @ J.mT  # Fisher information, never negative
    diagonal = curvature.diagonal(dim1=1, dim2=2)
    diagonal += _DAMPING * diagonal.mean(1, keepdim=True) + 1e-9
    turn = -torch.linalg.solve(curvature, gradient)
    turn = turn * (_LONGEST_STEP / turn.norm(dim=1, keepdim=True)).clamp(max=1)
    x, y, z = turn.unbind(1)
    o = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o], 1).view(B, 3, 3)) @ M


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
