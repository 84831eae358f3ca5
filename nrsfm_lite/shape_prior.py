"""A prior over shapes, learned from images whose cameras are roughly known (chapter 10).

A trained network puts every frame into one coordinate system, though its shapes are still coarse. From
there the images themselves tell how shapes vary, because every camera hides another direction. The
coordinates of all points are taken as one Gaussian vector,

    s ~ N(mean, C),   w = A s + t + noise of variance σ²,   A: what the camera sees, without hidden points,

and expectation maximisation learns mean, C and σ from all frames at once. Torresani, Hertzmann and Bregler
(2008) do this for a basis of few shapes; here C is whole. A body that walks and sits is more than one
Gaussian: the shapes are then sorted into kinds, and each kind gets a Gaussian of its own in the same way.

Given the prior, a frame's shape is the solution of a linear system, hidden points included, and its camera
takes a few Newton steps on the likelihood of its image, in which the shape has been integrated out.

Shapes in comments: B frames, P points. Points are in the network's units. The coordinates of a shape are
ordered by axis (all x, all y, all z), so that C has nine P×P blocks and all work is products of matrices.
"""

import math
from dataclasses import dataclass

import torch
from scipy.cluster.vq import kmeans2

KINDS = 8  # at most
_FRAMES_PER_KIND = 250  # on average, at least
_ITERATIONS, _ITERATIONS_OF_A_KIND, _SORTINGS = 15, 6, 2
_TURNS, _TURNS_IN_A_KIND = 4, 3  # Newton steps of a frame's camera
_FIRST_NOISE, _LEAST_NOISE = 1e-2, 1e-3  # σ
_FREEDOM = 1e-2  # variance that C grants every coordinate at the start, beside that of the network's shapes
_LARGEST = 10.0  # root mean square distance of a shape's points: a network that has diverged may say anything
_SHIFT = 1.0  # standard deviation of t, which stays zero unless points are hidden
_LONGEST_TURN = 0.3  # radians per Newton step
_DAMPING = 3e-3  # of a Newton step, as a share of the mean curvature
_CHUNK = 64  # frames per pass, so that their matrices stay in the cache


@dataclass(frozen=True)
class Gaussian:
    """Of shapes: mean (P, 3), covariance (3P, 3P) ordered by axis, and the variance σ² of image coordinates."""

    mean: torch.Tensor
    covariance: torch.Tensor
    noise: float


def learn(X, visible, S, M):
    """The prior of a set of frames.

    Parameters
    ----------
    X : (B, P, 2) tensor, centred over the visible points, zero where hidden
    visible : (B, P) tensor, bool or weights from 0 to 1: a point of weight ω has the noise σ²/ω
    S, M : (B, P, 3) and (B, 3, 2) tensors
        A network's shapes and cameras, to start from.

    Returns
    -------
    tuple of Gaussian, in double precision: first that of all shapes; then, if the frames are many enough for
    two or more, those of up to eight kinds.
    """
    X, S, M = X.double(), S.double(), M.double()
    B, P, _ = X.shape
    S = torch.nan_to_num(S - S.mean(1, keepdim=True))
    S = S / (S.flatten(1).norm(dim=1) / (_LARGEST * P**0.5)).clamp(min=1)[:, None, None]
    centred = torch.eye(P, dtype=X.dtype) - 1 / P  # C gives the centroid no variance: that is t's part
    start = _covariance(S) + _FREEDOM * torch.eye(3, dtype=X.dtype).kron(centred)
    whole = Gaussian(S.mean(0), start, _FIRST_NOISE**2)
    whole, M = _maximise(whole, X, visible, M, _ITERATIONS, 1)
    whole = _without_noise(whole)
    n = min(KINDS, B // _FRAMES_PER_KIND)
    if n < 2:
        return (whole,)
    S, M = _fit(whole, X, visible, M, 1)
    kind = torch.as_tensor(kmeans2(S.flatten(1).numpy(), n, minit="++", seed=0)[1])
    kinds = []
    for _ in range(_SORTINGS):
        if kinds:
            kind, S, M = _sort(kinds, X, visible, M, 0)
        kinds = []
        for k in range(n):
            i = (kind == k).nonzero()[:, 0]
            if len(i) < _FRAMES_PER_KIND / 4:
                continue
            start = Gaussian(S[i].mean(0), _covariance(S[i]) + whole.covariance / 10, whole.noise)
            gaussian, M[i] = _maximise(start, X[i], visible[i], M[i], _ITERATIONS_OF_A_KIND, 20)
            kinds.append(gaussian)
    return (whole, *map(_without_noise, kinds))


def apply(prior, X, visible, M):
    """Shapes (B, P, 3) and cameras (B, 3, 2) of frames, in double precision; each frame on its own.

    Parameters
    ----------
    prior : what `learn` returns
    X, visible, M : as in `learn`; M is the camera to start from
    """
    X = X.double()
    S, M = _fit(prior[0], X, visible, M.double(), _TURNS)
    if len(prior) > 1:
        _, S, M = _sort(prior[1:], X, visible, M, _TURNS_IN_A_KIND)
    return S, M


def surprise(prior, X, visible, M):
    """−log p(image) per visible coordinate, mean over frames: how well a prior foresees images.

    Parameters as in `apply`. Every frame is taken for the kind that foresees it best.
    """
    X, M = X.double(), M.double()
    each = torch.stack([_surprise(g, X, visible, M) for g in prior[min(1, len(prior) - 1) :]])
    return float((each.amin(0) / (2 * (visible > 0).sum(1))).mean())


def _root_weight(visible):
    """√ω of every image coordinate, (B, 2P). Rows of an image times √ω all have the noise σ²; zero strikes them out."""
    return visible.double().sqrt().repeat(1, 2)


def _covariance(S):
    return torch.cov((S - S.mean(0)).mT.flatten(1).T, correction=0)


def _maximise(start, X, visible, M, iterations, weight):
    """Expectation maximisation from a Gaussian, which counts as much as `weight` frames: (Gaussian, cameras)."""
    seen = _root_weight(visible)
    M = M.clone()
    B, P, _ = X.shape
    gaussian = start
    for _ in range(iterations):
        C, noise = gaussian.covariance, gaussian.noise
        offset, outer, known, rest = 0.0, 0.0, 0.0, 0.0
        for part in torch.arange(B).split(_CHUNK):
            post = _look(gaussian, X[part], seen[part], M[part])
            d = (post.shapes - gaussian.mean).mT.flatten(1)  # (b, 3P)
            offset = offset + d.sum(0)
            outer = outer + d.T @ d
            known = known + post.pairs.flatten(0, 1).T @ _split(post.precision).flatten(0, 1)  # Σ Aᵀ Σ⁻¹ A
            rest = rest + post.noise
            M[part] = _turn(gaussian, post, M[part])
        # What the images leave open counts too: each shape's covariance given its image is C − C Aᵀ Σ⁻¹ A C.
        offset = offset / B
        new = C + (outer - C @ _join(known, 3) @ C) / B - torch.outer(offset, offset)
        new = (B * new + weight * start.covariance) / (B + weight)  # few frames do not make C singular
        noise = max(float(rest / (seen > 0).sum()), _LEAST_NOISE**2)
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
    least = 1e-7 * float(values[-1])  # what rounding to single precision, in which networks keep it, may do to C
    return Gaussian(gaussian.mean, C, max(gaussian.noise + float(flat), least))


def _fit(gaussian, X, visible, M, turns):
    """Shapes and cameras after some turns of the cameras."""
    S, M = torch.empty(*X.shape[:2], 3, dtype=X.dtype), M.clone()
    for part in torch.arange(len(X)).split(_CHUNK):
        x, seen, m = X[part], _root_weight(visible[part]), M[part]
        for _ in range(turns):
            m = _turn(gaussian, _look(gaussian, x, seen, m), m)
        S[part], M[part] = _look(gaussian, x, seen, m).shapes, m
    return S, M


def _sort(kinds, X, visible, M, turns):
    """Every frame in the kind that its image surprises least: that kind, and shapes and cameras in it."""
    kind = torch.stack([_surprise(g, X, visible, M) for g in kinds]).argmin(0)
    S, M = torch.empty(*X.shape[:2], 3, dtype=X.dtype), M.clone()
    for k, gaussian in enumerate(kinds):
        i = (kind == k).nonzero()[:, 0]
        if len(i):
            S[i], M[i] = _fit(gaussian, X[i], visible[i], M[i], turns)
    return kind, S, M


def _surprise(gaussian, X, visible, M):
    """−log p(image) of each frame (B,), the cameras as they are."""
    result = torch.empty(len(X), dtype=X.dtype)
    for part in torch.arange(len(X)).split(_CHUNK):
        seen = _root_weight(visible[part])
        y, _, root = _foresee(gaussian, X[part], seen, M[part])
        half = torch.linalg.solve_triangular(root, y[..., None], upper=False)
        hidden = seen == 0
        logs = root.diagonal(dim1=1, dim2=2).log() - seen.masked_fill(hidden, gaussian.noise**0.5).log()
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


def _foresee(gaussian, X, seen, M):
    """What a Gaussian expects of some images, their rows weighted by √Ω, which is `seen` (B, 2P).

    Returns y = √Ω (w − A mean), products of camera entries, and the Cholesky factor of Σ = √Ω A C Aᵀ √Ω + σ².
    """
    B, P, _ = X.shape
    y = (X - gaussian.mean @ M).mT.reshape(B, 2 * P) * seen
    pairs = (M.mT[:, :, None, :, None] * M.mT[:, None, :, None, :]).reshape(B, 4, 9)
    Sigma = _join(pairs @ _split(gaussian.covariance), 2)
    if not (seen == 1).all():
        shift = _SHIFT**2 * torch.eye(2, dtype=X.dtype).kron(torch.ones(P, P, dtype=X.dtype))
        Sigma = (Sigma + shift) * (seen[:, :, None] * seen[:, None])
    Sigma.diagonal(dim1=1, dim2=2).add_(gaussian.noise)
    return y, pairs, torch.linalg.cholesky(Sigma)


def _look(gaussian, X, seen, M):
    """The posterior of some frames; `seen` as in `_foresee`."""
    B, P, _ = X.shape
    y, pairs, root = _foresee(gaussian, X, seen, M)
    precision = torch.cholesky_inverse(root)
    weighted = (precision @ y[..., None])[..., 0]
    # What an image misses by, and what is unsure about that; rows struck out add nothing.
    noise = gaussian.noise**2 * (weighted.square().sum() - _trace(precision)) + gaussian.noise * seen.numel()
    if not (seen == 1).all():
        precision = precision * (seen[:, :, None] * seen[:, None])
        weighted = weighted * seen
    S = (M @ weighted.view(B, 2, P)).view(B, 3 * P) @ gaussian.covariance
    return _Posterior(gaussian.mean + S.view(B, 3, P).mT, pairs, precision, weighted, noise)


def _turn(gaussian, post, M):
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
    turn = turn * (_LONGEST_TURN / turn.norm(dim=1, keepdim=True)).clamp(max=1)
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
