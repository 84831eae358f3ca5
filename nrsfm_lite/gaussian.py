"""One Gaussian over shapes, seen by cameras: what images say about it, and about the shapes and cameras (chapter 10).

The coordinates of all points are one Gaussian vector, and an image is what a camera sees of it,

    s ~ N(mean, C),   w = A s + t + noise of variance σ²,   A: what the camera sees, without hidden points.

Given the Gaussian, a frame's shape is the solution of a linear system, hidden points included, and its camera takes
a few Newton steps on the likelihood of its image, in which the shape has been integrated out. Given the images,
expectation maximisation finds the Gaussian. Torresani, Hertzmann and Bregler (2008) do this for a basis of few
shapes; here C is whole, or of a given rank and the same in all other directions.

Shapes in comments: B frames, P points. The coordinates of a shape are ordered by axis (all x, all y, all z), so that
C has nine P×P blocks and all work is products of matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

LEAST_NOISE = 1e-3  # σ
_SHIFT = 1.0  # standard deviation of t: anything that a centred frame can need
_TURN = 1.0  # radians, standard deviation of a camera about which its image says nothing
_LONGEST_STEP = 0.3  # radians per Newton step
_DAMPING = 3e-3  # of a Newton step, as a share of the mean curvature
_ARRIVED = 3e-3  # radians: a Newton step shorter than this is the last
FIRST_SPREAD, _LEAST_SPREAD = 0.3, 0.01  # of log scales, if every frame has a scale of its own
_CHUNK = 64  # frames per pass, so that their matrices stay in the cache
_HOPEFUL_SIDES, _STEPS_FROM_A_SIDE = 6, 3  # of the 24 sides, those that are followed for some Newton steps
_STEPS_OF_THE_OTHER_HAND = 1, 4  # Newton steps before and after those are dropped that have no chance
_NO_CHANCE = 150.0  # by which −log p of the other hand is higher
_FREEDOM = 10.0  # of Student's t: as many coordinates speak for a frame's covariance being of the usual size
_NARROWEST = 0.75  # times a covariance: images that were learned from are nearer than they should be


@dataclass(frozen=True)
class Gaussian:
    """Of shapes: mean (P, 3), covariance (3P, 3P) ordered by axis, and the variance σ² of image coordinates.

    Of a mixture, `share` is the part of the frames that belong to it. `spread` is the standard deviation of the
    logarithm of a frame's own scale; 0: there is one scale for all. A camera M is a rotation's two columns times the
    scale of its frame.
    """

    mean: Tensor
    covariance: Tensor
    noise: float
    share: float = 1.0
    spread: float = 0.0


def _root_weight(weight):
    """√ω of every image coordinate, (B, 2P). Rows of an image times √ω all have the noise σ²; zero strikes them out."""
    return weight.double().sqrt().repeat(1, 2)


def covariance(S: Tensor) -> Tensor:
    """Of shapes (B, P, 3): (3P, 3P)."""
    return torch.cov((S - S.mean(0)).mT.flatten(1).T, correction=0)


def maximise(
    start: Gaussian, X: Tensor, weight: Tensor, M: Tensor, *, iterations: int, strength: float, rank: int | None = None
) -> tuple[Gaussian, Tensor]:
    """Expectation maximisation: (Gaussian, cameras).

    Parameters
    ----------
    start : Gaussian, which counts as much as `strength` frames
    X, weight, M : tensors (B, P, 2), (B, P) and (B, 3, 2)
        The cameras take one Newton step in each iteration.
    rank : int, optional
        Directions in which shapes vary; in all others C has one variance. Default: all.
    """
    root_weight = _root_weight(weight)
    M = M.clone()
    B, P, _ = X.shape
    gaussian = limited(start, rank)
    for _ in range(iterations):
        C, noise = gaussian.covariance, gaussian.noise
        offset, outer = X.new_zeros(3 * P), X.new_zeros(3 * P, 3 * P)
        known, rest, unsure = X.new_zeros(9, P * P), X.new_zeros(()), X.new_zeros(())
        for part in torch.arange(B).split(_CHUNK):
            post = _posterior(gaussian, X[part], root_weight[part], M[part])
            d = (post.shapes - gaussian.mean).mT.flatten(1)  # (b, 3P)
            offset = offset + d.sum(0)
            outer = outer + d.T @ d
            known = known + post.pairs.flatten(0, 1).T @ _split(post.precision).flatten(0, 1)  # Σ Aᵀ Σ⁻¹ A
            rest = rest + post.noise
            # The camera is in doubt, too: what a likely turn of it does to the shape, and to what the image misses by.
            turns = _turns(gaussian, post, M[part])
            moved = (M[part][:, None] @ turns.doubt.unflatten(2, (2, P))).view(-1, 3 * P) @ C
            outer = outer + moved.T @ moved
            missed = turns.doubt / root_weight[part, None].clamp(min=1e-6)
            rest = rest + noise**2 * missed.square().sum()
            M[part] = _newton_step(gaussian, post, M[part], turns)
            if gaussian.spread:
                unsure = unsure + torch.cholesky_inverse(turns.factor)[:, -1, -1].sum()
        # What the images leave open counts too: each shape's covariance given its image is C − C Aᵀ Σ⁻¹ A C.
        offset = offset / B
        new = C + (outer - C @ _join(known, 3) @ C) / B - torch.outer(offset, offset)
        new = (B * new + strength * start.covariance) / (B + strength)  # few frames do not make C singular
        noise = max(float(rest / (root_weight > 0).sum()), LEAST_NOISE**2)
        new = replace(gaussian, mean=gaussian.mean + offset.view(3, P).T, covariance=(new + new.T) / 2, noise=noise)
        gaussian = limited(new, rank)
        if gaussian.spread:
            gaussian, M = _of_mean_scale(gaussian, M, float(unsure / B))
    return gaussian, M


def _of_mean_scale(gaussian, M, unsure):
    """The same where scales have the geometric mean one, or shapes would grow while scales shrink, and their spread."""
    logs = scales(M).log()
    size = float(logs.mean().exp())
    spread = min(max(float(logs.var(correction=0) + unsure) ** 0.5, _LEAST_SPREAD), FIRST_SPREAD)
    C = gaussian.covariance * size**2
    return replace(gaussian, mean=gaussian.mean * size, covariance=C, spread=spread), M / size


def scales(M: Tensor) -> Tensor:
    """The scales (B,) of cameras (B, 3, 2)."""
    return M.flatten(1).norm(dim=1) / math.sqrt(2)


def limited(gaussian: Gaussian, rank: int | None) -> Gaussian:
    """The same with the largest `rank` directions of C, and one variance in all others: their mean (PPCA's M-step)."""
    values, vectors = _directions(gaussian)
    if rank is None or rank >= len(values):
        return gaussian
    flat = values[: len(values) - rank].mean()
    C = _along(vectors, values - flat, rank) + flat * _about_the_centroid(len(gaussian.mean))
    return replace(gaussian, covariance=C)


def without_noise(gaussian: Gaussian, rank: int | None = None, *, share: float = 0.0) -> Gaussian:
    """The Gaussian less what its covariance holds in all directions alike, which goes to σ².

    The same variance in all directions cannot be told from noise of the images, and is taken for it. With a rank, it
    is that of the other directions; else it is read off the smallest tenth of the eigenvalues, twice, since the
    smallest are estimated too small. Where that is still too little, it is the eigenvalue below which a `share` of
    all lie.
    """
    values, vectors = _directions(gaussian)
    if rank is None or rank >= len(values):
        flat = torch.maximum(2 * values.quantile(0.1), values.quantile(share))
        every, basis = torch.linalg.eigh(gaussian.covariance)
        C = (basis * (every - flat).clamp(min=0)) @ basis.T
    else:
        flat = values[: len(values) - rank].mean()
        C = _along(vectors, values - flat, rank)
    least = 1e-7 * float(values[-1])  # of images of single precision nothing finer can be said
    return replace(gaussian, covariance=C, noise=max(gaussian.noise + float(flat), least))


def _directions(gaussian):
    """Eigenvalues, rising, and eigenvectors of C, without those that say nothing about a shape.

    Three move the centroid, which is t's part. Three turn the mean: the cameras take those, so that C has hardly any
    variance there, and not even the noise of the images.
    """
    mean = gaussian.mean
    axes = torch.eye(3, dtype=mean.dtype)
    moves = axes[:, None].expand(3, len(mean), 3)
    turns = torch.linalg.cross(axes[:, None].expand_as(moves), mean.expand_as(moves))
    Q = torch.linalg.qr(torch.cat([moves, turns]).mT.flatten(1).T)[0]
    rest = torch.eye(len(Q), dtype=mean.dtype) - Q @ Q.T
    values, vectors = torch.linalg.eigh(rest @ gaussian.covariance @ rest)
    return values[6:].clamp(min=0), vectors[:, 6:]


def _along(vectors, values, rank):
    """V diag(values) Vᵀ of the last `rank` directions."""
    V = vectors[:, vectors.shape[1] - rank :]
    return (V * values[len(values) - rank :].clamp(min=0)) @ V.T


def _about_the_centroid(P):
    """Unit variance for every coordinate, and none for the centroid: that is t's part."""
    eye = torch.eye(P, dtype=torch.double)
    return torch.eye(3, dtype=torch.double).kron(eye - 1 / P)


def fit(gaussian: Gaussian, X: Tensor, weight: Tensor, M: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Most probable shapes (B, P, 3), and cameras after some Newton steps; each frame on its own."""
    S, M = torch.empty(*X.shape[:2], 3, dtype=X.dtype), turn(gaussian, X, weight, M, steps)
    for part in torch.arange(len(X)).split(_CHUNK):
        root_weight = _root_weight(weight[part])
        y, _, factor = _marginal(gaussian, X[part], root_weight, M[part])
        weighted = torch.cholesky_solve(y[..., None], factor)[..., 0] * root_weight
        S[part] = _shapes(gaussian, weighted, M[part])
    return S, M


def turn(gaussian: Gaussian, X: Tensor, weight: Tensor, M: Tensor, steps: int) -> Tensor:
    """Cameras after at most so many Newton steps; one that has arrived stays."""
    M = M.clone()
    away = torch.arange(len(X))  # those that are still on their way
    for _ in range(steps):
        before = M[away]
        for i in away.split(_CHUNK):
            post = _posterior(gaussian, X[i], _root_weight(weight[i]), M[i])
            M[i] = _newton_step(gaussian, post, M[i], _turns(gaussian, post, M[i]))
        away = away[(M[away] - before).flatten(1).norm(dim=1) > _ARRIVED]
    return M


def search(gaussian: Gaussian, X: Tensor, weight: Tensor, M: Tensor) -> Tensor:
    """Cameras from all sides: of those that some Newton steps reach, and M, the likeliest of each frame."""
    every = torch.arange(len(X))
    sides = _sides()[:, None] * scales(M)[:, None, None]
    value = torch.stack([negative_log_likelihood(gaussian, X, weight, m) for m in sides])
    hopeful = value.topk(_HOPEFUL_SIDES, 0, largest=False).indices
    tried = [M, *(turn(gaussian, X, weight, sides[k, every], _STEPS_FROM_A_SIDE) for k in hopeful)]
    value = torch.stack([negative_log_likelihood(gaussian, X, weight, m) for m in tried])
    return torch.stack(tried)[value.argmin(0), every]


def _sides():
    """Cameras (24, 3, 2) along the axes: every pair of two of them, in both directions."""
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return torch.stack([torch.stack([a, b], 1) for a in axes for b in axes if a @ b == 0])


def negative_log_likelihood(gaussian: Gaussian, X: Tensor, weight: Tensor, M: Tensor) -> Tensor:
    """−log p(image | camera) of each frame (B,), the cameras as they are."""
    return _likelihood(gaussian, X, weight, M)[1]


def astray(gaussian: Gaussian, X: Tensor, weight: Tensor, M: Tensor) -> Tensor:
    """By how many standard deviations each image (B,) is farther from the mean than it should be.

    Under the Gaussian, the squared distance of an image has a known distribution. A frame that is far outside it has a
    camera that has ended in a wrong minimum, or does not belong here.
    """
    count = 2 * (weight > 0).sum(1)
    return (_likelihood(gaussian, X, weight, M)[0] - count) / (2 * count).sqrt()


def _likelihood(gaussian, X, weight, M):
    """Squared distance of each image from the mean, in standard deviations, and −log p of the image: (B,) each."""
    distance, result = (torch.empty(len(X), dtype=X.dtype) for _ in range(2))
    for part in torch.arange(len(X)).split(_CHUNK):
        root_weight = _root_weight(weight[part])
        y, _, factor = _marginal(gaussian, X[part], root_weight, M[part])
        half = torch.linalg.solve_triangular(factor, y[..., None], upper=False)
        distance[part] = half.square().sum((1, 2))
        hidden = root_weight == 0
        logs = factor.diagonal(dim1=1, dim2=2).log() - root_weight.masked_fill(hidden, gaussian.noise**0.5).log()
        count = (~hidden).double().sum(1)
        result[part] = distance[part] / 2 + logs.sum(1) + count * math.log(2 * math.pi) / 2
    if gaussian.spread:
        result += (scales(M).log() / gaussian.spread).square() / 2 + math.log(gaussian.spread * math.sqrt(2 * math.pi))
    return distance, result


def negative_log_evidence(gaussian: Gaussian, X: Tensor, weight: Tensor, M: Tensor) -> Tensor:
    """−log p(image) of each frame (B,), integrated over all cameras by Laplace's method around M, the likeliest.

    Three angles fitted to an image of few points explain much of its noise. To compare Gaussians, this is what makes
    up for it; the likelihood at the best camera favours the one that follows the noise.
    """
    result = negative_log_likelihood(gaussian, X, weight, M)
    for part in torch.arange(len(X)).split(_CHUNK):
        post = _posterior(gaussian, X[part], _root_weight(weight[part]), M[part])
        curvature = _turns(gaussian, post, M[part]).curvature + _of_the_camera(gaussian)
        result[part] += (torch.logdet(curvature) - len(curvature[0]) * math.log(2 * math.pi)) / 2
    return result + math.log(8 * math.pi**2)  # the volume of all rotations


def right_hand(
    gaussian: Gaussian, X: Tensor, weight: Tensor, S: Tensor, M: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Frames of the other hand, repaired by likelihood.

    A shape and its mirror image in depth have the same image. The mirror image is turned onto the mean by the best
    rotation, its camera refined, and the hand with the higher likelihood stays.

    Parameters
    ----------
    X, weight : as in `maximise`
    S, M : what `fit` returns

    Returns
    -------
    S, M, and for each frame (B,) whether it was mirrored, and by how much −log p of the other hand was higher; the
    other hand of a frame that had no chance was not refined to its end.
    """
    mirrored = S @ with_depth(M) * torch.tensor([1, 1, -1])  # as the camera sees it, depth with the other sign
    U, _, Vh = torch.linalg.svd(gaussian.mean.T @ mirrored)
    sign = torch.linalg.det(U @ Vh)
    turned = (torch.cat([U[..., :2], U[..., 2:] * sign[:, None, None]], 2) @ Vh)[..., :2] * scales(M)[:, None, None]
    first, last = _STEPS_OF_THE_OTHER_HAND
    here = negative_log_likelihood(gaussian, X, weight, M)
    turned = turn(gaussian, X, weight, turned, first)
    higher = negative_log_likelihood(gaussian, X, weight, turned) - here
    i = (higher < _NO_CHANCE).nonzero()[:, 0]
    other_S, other_M = fit(gaussian, X[i], weight[i], turned[i], last)
    higher[i] = negative_log_likelihood(gaussian, X[i], weight[i], other_M) - here[i]
    flipped = higher < 0
    S, M, better = S.clone(), M.clone(), flipped[i]
    S[i[better]], M[i[better]] = other_S[better], other_M[better]
    return S, M, flipped, higher.abs()


def doubt(gaussian: Gaussian, X: Tensor, weight: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
    """Most probable shapes (B, P, 3), and how far each point may be off: covariances (B, P, 3, 3).

    They are in the frame of each one's camera, whose third axis is the depth.

    What an image leaves open of its shape, and what its camera's own doubt adds: by Laplace's method, J H⁻¹ Jᵀ with J
    how the shape, as the camera sees it, follows a turn of the camera, and H the Fisher information about the turn.

    All of it times how far the image is from the mean, squared, over how far it should be. So it is where every frame
    has a covariance of its own size, C times a factor with an inverse gamma prior, which makes shapes Student's t; but
    hardly narrower than C says.
    """
    B, P, _ = X.shape
    S, result = torch.empty(B, P, 3, dtype=X.dtype), torch.empty(B, P, 3, 3, dtype=X.dtype)
    for part in torch.arange(B).split(_CHUNK):
        post = _posterior(gaussian, X[part], _root_weight(weight[part]), M[part])
        S[part] = post.shapes
        rows = with_depth(M[part]).mT  # (b, 3, 3)
        C = _join(_pairs(rows) @ _split(gaussian.covariance), 3)  # as the camera sees it: (b, 3P, 3P)
        seen = C[:, : 2 * P]
        within = C.view(-1, 3, P, 3, P).diagonal(dim1=2, dim2=4)  # (b, 3, 3, P)
        told = torch.einsum("brip,brjp->bijp", seen.unflatten(2, (3, P)), (post.precision @ seen).unflatten(2, (3, P)))
        moved = (_moves(gaussian, rows) @ post.shapes.mT[:, None]).flatten(2)  # (b, directions, 3P)
        follows = moved - moved[..., : 2 * P] @ post.precision @ seen  # the shape gives way to the turn
        turns = _turns(gaussian, post, M[part])
        follows = torch.linalg.solve_triangular(turns.factor, follows, upper=False).unflatten(2, (3, P))
        each = within - told + torch.einsum("baip,bajp->bijp", follows, follows)
        distance = (post.weighted * (X[part] - gaussian.mean @ M[part]).mT.flatten(1)).sum(1)
        factor = ((_FREEDOM + distance) / (_FREEDOM + 2 * (weight[part] > 0).sum(1))).clamp(min=_NARROWEST)
        result[part] = (factor[:, None, None, None] * each).permute(0, 3, 1, 2)
    return S, result


def with_depth(M: Tensor) -> Tensor:
    """Cameras (B, 3, 2) with the viewing direction as a third column: rotations (B, 3, 3), times the same scale."""
    return torch.cat([M, (torch.linalg.cross(M[..., 0], M[..., 1]) / scales(M)[:, None])[..., None]], 2)


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
    pairs = _pairs(M.mT)
    Sigma = _join(pairs @ _split(gaussian.covariance), 2)
    Sigma += _SHIFT**2 * torch.eye(2, dtype=X.dtype).kron(torch.ones(P, P, dtype=X.dtype))
    if not (root_weight == 1).all():
        Sigma = Sigma * (root_weight[:, :, None] * root_weight[:, None])
    Sigma.diagonal(dim1=1, dim2=2).add_(gaussian.noise)
    return y, pairs, torch.linalg.cholesky(Sigma)


def _pairs(rows):
    """Products of two entries of a camera's rows (B, n, 3), one for each block of C: (B, n², 9)."""
    return (rows[:, :, None, :, None] * rows[:, None, :, None, :]).flatten(3).flatten(1, 2)


def _posterior(gaussian, X, root_weight, M):
    """The posterior of some frames; `root_weight` as in `_marginal`."""
    y, pairs, factor = _marginal(gaussian, X, root_weight, M)
    precision = torch.cholesky_inverse(factor)
    weighted = (precision @ y[..., None])[..., 0]
    # What an image misses by, and what is unsure about that; rows struck out add nothing.
    noise = gaussian.noise**2 * (weighted.square().sum() - _trace(precision)) + gaussian.noise * root_weight.numel()
    if not (root_weight == 1).all():
        precision = precision * (root_weight[:, :, None] * root_weight[:, None])
        weighted = weighted * root_weight
    return _Posterior(_shapes(gaussian, weighted, M), pairs, precision, weighted, noise)


def _shapes(gaussian, weighted, M):
    """Posterior means: mean + C Aᵀ √Ω Σ⁻¹ √Ω (w − A mean)."""
    B, P = len(M), len(gaussian.mean)
    S = (M @ weighted.view(B, 2, P)).view(B, 3 * P) @ gaussian.covariance
    return gaussian.mean + S.view(B, 3, P).mT


@dataclass(frozen=True)
class _Turns:
    """What turning the camera about each axis does to some images; n is 3, or 4 with the frame's scale."""

    curvature: torch.Tensor  # (B, n, n): Fisher information about the camera, never negative
    factor: torch.Tensor  # (B, n, n): Cholesky factor L of the curvature with its prior
    doubt: torch.Tensor  # (B, n, 2P): L⁻¹ J √Ω Σ⁻¹ √Ω with J how an image moves


def _moves(gaussian, rows):
    """What each rotation does to the rows (B, k, 3) of a camera, and a change of its scale: (B, n, k, 3)."""
    axes = torch.eye(3, dtype=rows.dtype).view(1, 3, 1, 3)
    turned = torch.linalg.cross(axes, rows[:, None])
    return torch.cat([turned, rows[:, None]], 1) if gaussian.spread else turned


def _of_the_camera(gaussian):
    """What is known of a camera before its image is seen: the diagonal matrix of n inverse variances."""
    known = [1 / _TURN**2] * 3 + ([1 / gaussian.spread**2] if gaussian.spread else [])
    return torch.tensor(known, dtype=gaussian.mean.dtype).diag()


def _turns(gaussian, post, M):
    J = (_moves(gaussian, M.mT) @ post.shapes.mT[:, None]).flatten(2)  # (B, n, 2P)
    weighted = J @ post.precision
    curvature = weighted @ J.mT
    factor = torch.linalg.cholesky(curvature + _of_the_camera(gaussian))
    return _Turns(curvature, factor, torch.linalg.solve_triangular(factor, weighted, upper=False))


def _newton_step(gaussian, post, M, turns):
    """The cameras after one Newton step on −log p(image), by a small rotation, and by its scale if it is free."""
    B, P, _ = post.shapes.shape
    a = post.weighted
    Q = _split(post.precision - a[:, :, None] * a[:, None])  # (B, 4, P²)
    T = (Q @ _split(gaussian.covariance).T).view(B, 2, 2, 3, 3)
    g = torch.einsum("bmj,bijlm->bli", M, T) - gaussian.mean.T @ a.view(B, 2, P).mT  # by the entries of M
    gradient = torch.linalg.cross(M.mT, g.mT).sum(1)  # by a rotation about each axis
    damping = _DAMPING * turns.curvature.diagonal(dim1=1, dim2=2).mean(1) + 1e-9
    damped = turns.curvature + damping[:, None, None] * torch.eye(turns.curvature.shape[1], dtype=M.dtype)
    if gaussian.spread:
        by_scale = (M * g).sum((1, 2)) + scales(M).log() / gaussian.spread**2
        gradient = torch.cat([gradient, by_scale[:, None]], 1)
        damped[:, 3, 3] += 1 / gaussian.spread**2
    step = -torch.linalg.solve(damped, gradient)
    step = step * (_LONGEST_STEP / step.norm(dim=1, keepdim=True)).clamp(max=1)
    x, y, z = step[:, :3].unbind(1)
    o = torch.zeros_like(x)
    M = torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o], 1).view(B, 3, 3)) @ M
    return M * step[:, 3].exp()[:, None, None] if gaussian.spread else M


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
