"""A prior over shapes, learned from images whose cameras are roughly known (chapter 10).

A trained network, or any other method, puts every frame into one coordinate system, though its shapes are still
coarse. From there the images themselves tell how shapes vary, because every camera hides another direction:
expectation maximisation learns one Gaussian over all shapes (`gaussian`), and frames that are mirrored against the
others are found and repaired. A body that walks and sits is more than one Gaussian, and a collection of six chairs is
six rigid shapes. So the shapes are then shared out among the components of a mixture, each learned in the same way.
How far the one Gaussian, and each component, may vary, and how many components there are, is decided by the likelihood
of images that were kept back.

Shapes in comments: B frames, P points. Points are in the units of whoever calls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .gaussian import (
    FIRST_SPREAD,
    Gaussian,
    astray,
    covariance,
    doubt,
    fit,
    maximise,
    negative_log_evidence,
    right_hand,
    search,
    turn,
    with_depth,
    without_noise,
)
from .gaussian import negative_log_likelihood as of_each_frame
from .metrics import normalized_error
from .normalizer import center, weighted_mean

MOST_FRAMES = 20_000  # that `learn` takes a look at
_KEPT_BACK, _LEAST_KEPT_BACK = 300, 20  # frames, for decisions: a tenth, at most and at least so many
_FRAMES_OF_THE_WHOLE = 2000  # more add little to one Gaussian
_FRAMES_OF_A_TRIAL = 800
_FRAMES_PER_COMPONENT = 250  # on average, at least
_ROUNDS, _ITERATIONS_OF_A_ROUND = 4, 4  # of the whole; between rounds mirrored frames are repaired
_ROUNDS_WITH_SCALES = 10  # scales are learned slowly
_RANKS = (16, 8, 4, 2, 1, 0)  # that are tried for the whole, beside all directions, as long as there is hope
_RIGID = 16  # components of rank zero to begin with, at most, before those that are alike are joined
_FRAMES_PER_RIGID = 25  # on average, at least, to begin with
_SHARES_OF_NOISE = (0.0, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # of the directions, that are tried for few frames
_HOPELESS = 0.5  # by which −log p per coordinate is above the best, so that nothing of the kind is tried any further
_ALIKE = 4e-3  # by which joining two components may raise −log p per coordinate
_BORROWED, _SHARE_OF_THE_WIDER = 0.3, 0.1  # of the pooled covariance in a wider twin, and how many frames need one
_NEAREST = 8  # components whose likelihood is asked for, by the distance of their means
_NEWTON_STEPS = 12  # of a frame's camera, at most
_LEAST_SHARE = 0.01  # of a component in a frame, to count for its uncertainty
_STEPS_OF_ANOTHER = 2  # Newton steps from one component's camera to another's
_WIDER = 1.35  # bands, so that nine of ten points lie in their 90 % band on motion and salsa: the prior is in doubt
_LOST = 6.0  # standard deviations by which an image is too far off, so that its camera is looked for from all sides
_MOST_LOOKED_FOR = 1000  # frames, while learning
_FIRST_NOISE = 1e-2  # σ
_FREEDOM = 1e-2  # variance that C grants every coordinate at the start, beside that of the shapes to start from
_LARGEST = 10.0  # root mean square distance of a shape's points: a network that has diverged may say anything

_Frames = tuple[Tensor, Tensor, Tensor, Tensor]  # X, weight, S and M
Prior = tuple[Gaussian, ...]  # the whole first; then, if any, the components of the mixture


def learn(X: Tensor, weight: Tensor, S: Tensor, M: Tensor, *, free_scale: bool = False) -> Prior:
    """The prior of a set of frames.

    Parameters
    ----------
    X : (B, P, 2) tensor, centred over the visible points, zero where hidden
    weight : (B, P) tensor, bool or from 0 to 1: a point of weight ω has the noise σ²/ω; 0 hides it
    S, M : (B, P, 3) and (B, 3, 2) tensors
        Shapes and cameras to start from, such as a network's.
    free_scale : bool
        Every frame has a scale of its own, found with its camera.

    Returns
    -------
    tuple of Gaussian, in double precision: first that of all shapes; then, where images that were kept back are
    likelier under a mixture, its components.
    """
    X, S, M = X.double(), _checked(S.double()), M.double().clone()
    kept, rest = _kept_back(len(X))
    if not len(kept):
        return (_of_few(X, weight, S, M, free_scale),)

    def at(i: Tensor) -> _Frames:
        return X[i], weight[i], S[i], M[i]

    some = rest[:_FRAMES_OF_THE_WHOLE]
    first, M[some] = _whole(*at(some), free_scale)
    S, M = _apply_whole(without_noise(first), X, weight, M)
    whole, rank = _best_rank(first, at(some), at(kept))
    if rank is not None:
        S, M = _apply_whole(whole, X, weight, M)
    best: Prior = (whole,)
    lowest = _unlikeliness(best, at(kept))
    rigid = _rigid_components(at(some), whole, at(kept), lowest)
    if rigid and (value := _unlikeliness((whole, *rigid), at(kept))) < lowest:
        best, lowest = (whole, *rigid), value
    most = len(rest) // _FRAMES_PER_COMPONENT
    for n in (most, most // 3, most // 9):  # as many as the frames can feed; fewer where that is not better
        if n > 1:
            frames = at(rest[: n * _FRAMES_PER_COMPONENT])
            mixture = _components(n, frames, whole, replace(_FREELY, rank=rank))
            if mixture and _unlikeliness((whole, *mixture), at(kept)) < lowest:
                return (whole, *mixture)
    return best


def choose(
    X: Tensor, weight: Tensor, starts: Sequence[tuple[Tensor, Tensor]], *, free_scale: bool = False
) -> tuple[int, float | None]:
    """Which of several starts leads to the prior under which images that it has not seen are likeliest.

    From each, a few iterations for one Gaussian; frames kept back judge, with their own cameras from the same start.
    With few frames, hidden-away frames would be too few, and all of them judge.

    Parameters
    ----------
    X, weight, free_scale : as in `learn`
    starts : pairs of S and M, as in `learn`

    Returns
    -------
    Its number; and how far its shapes of the frames that judge are from those of the start that comes nearest to it,
    as a mean normalised error. None if there is no other.
    """
    kept, rest = _kept_back(len(X))
    kept, rest = kept if len(kept) else rest, rest[: 2 * _FRAMES_OF_A_TRIAL]
    frames = X[kept].double(), weight[kept]
    values, shapes = [], []
    for S, M in starts:
        S, M = _checked(S.double()), M.double().clone()
        whole = without_noise(_whole(X[rest].double(), weight[rest], S[rest], M[rest], free_scale)[0])
        S, M = _apply_whole(whole, *frames, M[kept])
        values.append(_unlikeliness((whole,), (*frames, S, M)))
        shapes.append(S)
    best = int(torch.tensor(values).nan_to_num(math.inf).argmin())
    others = [S for k, S in enumerate(shapes) if k != best and math.isfinite(values[k])]
    return best, min((float(normalized_error(S, shapes[best]).mean()) for S in others), default=None)


def adapt(prior: Prior, X: Tensor, weight: Tensor, S: Tensor, M: Tensor) -> Prior:
    """The prior of new frames: their own, if it says better than the given one what it has not seen; else that one.

    Their own is learned from the start that is given, such as what `apply` makes of them. What it has not seen are
    frames kept back; below 200 frames, one or two points of each frame, hidden while it is learned.

    Parameters
    ----------
    prior : what `learn` returned for other frames
    X, weight, S, M : as in `learn`
    """
    X, M = X.double(), M.double()
    kept, _ = _kept_back(len(X))
    free = prior[0].spread > 0
    if len(kept):
        own = learn(X, weight, S, M, free_scale=free)
        frames = X[kept], weight[kept]
        here, there = (_unlikeliness(p, (*frames, *apply(p, *frames, M[kept]))) for p in (own, prior))
        return own if here < there else prior
    hidden = _points_kept_back(weight)
    left = torch.where(hidden, 0, weight)
    part = center(X, left)[0], left
    here, there = (_missed(X, hidden, left, *apply(p, *part, M)) for p in (learn(*part, S, M, free_scale=free), prior))
    return learn(X, weight, S, M, free_scale=free) if here < there else prior


def apply(prior: Prior, X: Tensor, weight: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
    """Most probable shapes (B, P, 3) and cameras (B, 3, 2) of frames, in double precision; each frame on its own.

    If every frame has a scale of its own, its camera's columns have that length.

    Parameters
    ----------
    prior : what `learn` returns
    X, weight, M : as in `learn`; M is the camera to start from
    """
    X, M = X.double(), M.double()
    mixture = _mixture(prior)
    component, S, M = _follow(prior, mixture, X, weight, M)
    lost = (_of_each_component(astray, mixture, component, X, weight, M) > _LOST).nonzero()[:, 0]
    if len(lost):
        part = X[lost], weight[lost]
        other, other_S, other_M = _follow(prior, mixture, *part, search(prior[0], *part, M[lost]))
        better = _unlikely(mixture, other, *part, other_M) < _unlikely(mixture, component[lost], *part, M[lost])
        S[lost[better]], M[lost[better]] = other_S[better], other_M[better]
    return S, M


def uncertainty(prior: Prior, X: Tensor, weight: Tensor, S: Tensor, M: Tensor) -> Tensor:
    """How far each point may be from where `apply` put it: covariances (B, P, 3, 3) in the frame of its camera.

    Within a component, what the image and the camera leave open (`gaussian.doubt`); between components, how their
    shapes differ, each as likely as its image makes it. Axes: the image's two, then depth. That the whole shape may be
    mirrored in depth is not in it.

    Parameters
    ----------
    prior, X, weight : as in `apply`
    S, M : what `apply` returned
    """
    X, mixture = X.double(), _mixture(prior)
    near, value = _nearest(mixture, X, weight, S, M)
    share = torch.softmax(-value, 1)
    own = share.argmax(1)
    share = torch.where(share > _LEAST_SHARE, share, 0.0)
    share = share / share.sum(1, keepdim=True)
    seen = S @ with_depth(M)
    result = X.new_zeros(*S.shape, 3)
    for k, gaussian in enumerate(mixture):
        i, column = ((near == k) & (share > 0)).nonzero(as_tuple=True)
        if len(i):
            part = X[i], weight[i]
            other_M, other = M[i], column != own[i]
            other_M[other] = turn(gaussian, X[i[other]], weight[i[other]], M[i[other]], _STEPS_OF_ANOTHER)
            other_S, each = doubt(gaussian, *part, other_M)
            apart = other_S @ with_depth(other_M) - seen[i]
            each = each + apart[..., :, None] * apart[..., None, :]
            result[i] += share[i, column][:, None, None, None] * each
    return _WIDER**2 * result


def negative_log_likelihood(prior: Prior, X: Tensor, weight: Tensor, M: Tensor) -> float:
    """−log p(image) per visible coordinate, mean over frames: how well a prior explains images.

    Parameters as in `apply`. Every frame is taken for the component under which it is likeliest.
    """
    X, M = X.double(), M.double()
    mixture = _mixture(prior)
    component = _assign(mixture, X, weight, fit(prior[0], X, weight, M, 0)[0], M)
    each = _unlikely(mixture, component, X, weight, M)
    return float((each / (2 * (weight > 0).sum(1))).mean())


def _mixture(prior):
    """The components, each of them twice, or the whole where there are none.

    New frames are never quite like those that a component was learned from. So each has a wider twin, which borrows
    from the covariance of all components; the image decides between the two.
    """
    components = prior[1:]
    if not components:
        return prior
    pooled = sum(g.share * g.covariance for g in components) / sum(g.share for g in components)
    wider = [replace(g, covariance=torch.lerp(g.covariance, pooled, _BORROWED)) for g in components]
    return (
        *(replace(g, share=g.share * (1 - _SHARE_OF_THE_WIDER)) for g in components),
        *(replace(g, share=g.share * _SHARE_OF_THE_WIDER) for g in wider),
    )


def _checked(S):
    """Centred, and of a finite size."""
    S = torch.nan_to_num(S - S.mean(1, keepdim=True))
    return S / (S.flatten(1).norm(dim=1) / (_LARGEST * S.shape[1] ** 0.5)).clamp(min=1)[:, None, None]


def _follow(prior, mixture, X, weight, M):
    """Component, shape and camera of every frame: first under the whole, in the hand that is likelier."""
    S, M = fit(prior[0], X, weight, M, _NEWTON_STEPS)
    S, M, _, _ = right_hand(prior[0], X, weight, S, M)
    if len(prior) == 1:
        return torch.zeros(len(X), dtype=torch.long), S, M
    component = _assign(mixture, X, weight, S, M)
    return component, *_fit_each(mixture, component, X, weight, M, _NEWTON_STEPS)


def _apply_whole(gaussian, X, weight, M):
    """`apply` for learning. Frames of several kinds are not one Gaussian, so only the farthest are looked for."""
    M = turn(gaussian, X, weight, M, _NEWTON_STEPS)
    far, i = astray(gaussian, X, weight, M).topk(min(len(X), _MOST_LOOKED_FOR))
    i = i[far > _LOST]
    M[i] = search(gaussian, X[i], weight[i], M[i])
    S, M = fit(gaussian, X, weight, M, 0)
    return right_hand(gaussian, X, weight, S, M)[:2]


def _kept_back(n):
    """Which of n frames are kept back, for decisions, and which are learned from. Of few frames, none are kept."""
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0))[:MOST_FRAMES]
    count = min(_KEPT_BACK, len(order) // 10)
    count = count if count >= _LEAST_KEPT_BACK else 0
    return order[:count], order[count:]


def _points_kept_back(weight):
    """(B, P) bool: two visible points of each frame, or one or none where few are visible."""
    visible = weight > 0
    rank = torch.rand(weight.shape, generator=torch.Generator().manual_seed(0)).masked_fill(~visible, 2.0).argsort(1)
    count = visible.sum(1, keepdim=True)
    return rank.argsort(1) < (count >= 5).long() + (count >= 8).long()


def _missed(X, hidden, left, S, M):
    """By how much hidden points of the images are missed, if translations fit those that are left; mean over points."""
    rest = X - S @ M
    return float((rest - weighted_mean(rest, left)[:, None])[hidden].norm(dim=1).mean())


def _whole(X, weight, S, M, free_scale):
    """One Gaussian, its noise still in C, and the cameras; mirrored frames repaired between rounds."""
    if free_scale:  # the sizes of shapes are those of their frames
        size = S.flatten(1).norm(dim=1)
        size = size / size.log().mean().exp()
        S, M = S / size[:, None, None], M * size[:, None, None]
    P = X.shape[1]
    centred = torch.eye(P, dtype=X.dtype) - 1 / P  # C gives the centroid no variance: that is t's part
    start = covariance(S) + _FREEDOM * torch.eye(3, dtype=X.dtype).kron(centred)
    gaussian = Gaussian(S.mean(0), start, _FIRST_NOISE**2, spread=FIRST_SPREAD if free_scale else 0.0)
    for _ in range(_ROUNDS_WITH_SCALES if free_scale else _ROUNDS):
        gaussian, M = maximise(gaussian, X, weight, M, iterations=_ITERATIONS_OF_A_ROUND, strength=1)
        S, M = fit(gaussian, X, weight, M, 0)
        _, M, _, _ = right_hand(gaussian, X, weight, S, M)
    return gaussian, M


def _of_few(X, weight, S, M, free_scale):
    """One Gaussian of too few frames to keep some back: how much of it is noise is decided by points kept back.

    From few frames, C takes up noise in directions of its own, and the smallest eigenvalues do not show it.
    """
    hidden = _points_kept_back(weight)
    left = torch.where(hidden, 0, weight)
    part = center(X, left)[0]
    first, part_M = _whole(part, left, S, M, free_scale)
    surprise = []  # −log p(points kept back | the others), cameras from the others
    for share in _SHARES_OF_NOISE:
        gaussian = without_noise(first, share=share)
        _, found = _apply_whole(gaussian, part, left, part_M)
        both = of_each_frame(gaussian, X, weight, found) - of_each_frame(gaussian, part, left, found)
        surprise.append(float(both.sum()))
    best = int(torch.tensor(surprise).nan_to_num(math.inf).argmin())
    return without_noise(_whole(X, weight, S, M, free_scale)[0], share=_SHARES_OF_NOISE[best])


def _best_rank(first, frames, kept):
    """One Gaussian without noise, and in how many directions it varies; None: in all."""

    def limited(rank, n, rounds):
        X, weight, _, M = (x[:n] for x in frames)
        gaussian, _ = maximise(first, X, weight, M, iterations=rounds * _ITERATIONS_OF_A_ROUND, strength=1, rank=rank)
        return without_noise(gaussian, rank)

    best, chosen = without_noise(first), None
    lowest = _unlikeliness((best,), kept)
    for rank in _RANKS:
        value = _unlikeliness((limited(rank, _FRAMES_OF_A_TRIAL, 1),), kept)
        if value > lowest + _HOPELESS:
            break
        if value < lowest:
            lowest, chosen = value, rank
    return (best, None) if chosen is None else (limited(chosen, len(frames[0]), _ROUNDS), chosen)


@dataclass(frozen=True)
class _Plan:
    """How the components of a mixture are learned."""

    rank: int | None
    iterations: tuple[int, ...]  # of a component in each round; before a round, the frames are shared out anew
    strength: float  # frames that a component's start counts for
    least: int  # frames of a component


_FREELY = _Plan(rank=None, iterations=(2, 8), strength=20, least=_FRAMES_PER_COMPONENT // 4)
_RIGIDLY = _Plan(rank=0, iterations=(6, 6, 6), strength=0.1, least=8)


def _components(n, frames, whole, plan):
    """A mixture of up to n Gaussians, from the shapes under the whole."""
    # Imported here, since only training needs it and it takes a while.
    from scipy.cluster.vq import kmeans2

    first = kmeans2(frames[2].flatten(1).numpy(), n, minit="++", seed=0)[1]
    return _learn_each(torch.as_tensor(first), frames, whole, plan)


def _learn_each(component, frames, whole, plan):
    """The Gaussians of a mixture, each from its frames, which are shared out anew after every round."""
    X, weight, S, M = frames
    M = M.clone()
    mixture: list[Gaussian] = []
    for iterations in plan.iterations:
        if mixture:
            component = _assign(mixture, X, weight, S, M)
            S, M = _fit_each(mixture, component, X, weight, M, 0)
        before, mixture = mixture, []
        for k in component.unique().tolist():
            i = (component == k).nonzero()[:, 0]
            if len(i) >= plan.least:
                start = _start(S[i], whole)
                if before:  # go on, but let go of some of what was learned from other frames
                    start = replace(before[k], covariance=(start.covariance + before[k].covariance) / 2)
                how = {"iterations": iterations, "strength": plan.strength, "rank": plan.rank}
                gaussian, M[i] = maximise(start, X[i], weight[i], M[i], **how)
                mixture.append(replace(gaussian, share=len(i) / len(X)))
    return tuple(without_noise(g, plan.rank) for g in mixture)


def _start(S, whole):
    """A component to begin with."""
    return replace(whole, mean=S.mean(0), covariance=covariance(S) + whole.covariance / 10)


def _rigid_components(frames, whole, kept, lowest):
    """A mixture of rigid shapes, or nothing if others explain images better; components that are alike are joined."""
    few, some = (tuple(x[:n] for x in frames) for n in (_FRAMES_OF_A_TRIAL, 2 * _FRAMES_OF_A_TRIAL))
    n = min(_RIGID, len(few[0]) // _FRAMES_PER_RIGID)
    if n < 2:
        return ()
    first = _components(n, few, whole, replace(_RIGIDLY, iterations=_RIGIDLY.iterations[:1]))
    if not first or _unlikeliness((whole, *first), kept) > lowest + _HOPELESS:
        return ()
    mixture = _components(n, some, whole, _RIGIDLY)
    value = _unlikeliness((whole, *mixture), kept)
    if value >= lowest:
        return ()
    X, weight, S, M = some
    while len(mixture) > 1:
        means = torch.stack([g.mean for g in mixture]).flatten(1)
        apart = torch.cdist(means, means).fill_diagonal_(torch.inf)
        pair = divmod(int(apart.argmin()), len(mixture))
        i = torch.isin(_assign(mixture, *some), torch.tensor(pair)).nonzero()[:, 0]
        fewer = tuple(g for k, g in enumerate(mixture) if k not in pair)
        if len(i):  # else no frame is of either, any more
            start = replace(_start(S[i], whole), share=sum(mixture[k].share for k in pair))
            joined, _ = maximise(
                start, X[i], weight[i], M[i], iterations=sum(_RIGIDLY.iterations), strength=_RIGIDLY.strength, rank=0
            )
            fewer = (*fewer, without_noise(joined, 0))
        new = _unlikeliness((whole, *fewer), kept)
        if new > value + _ALIKE:
            break
        mixture, value = fewer, new
    return _learn_each(_assign(mixture, *frames), frames, whole, _RIGIDLY)


def _nearest(mixture, X, weight, S, M):
    """The components nearest to each shape, and how unlikely an image is under each: (B, n) both."""
    means = torch.stack([g.mean for g in mixture]).flatten(1)
    near = torch.cdist(S.flatten(1), means).topk(min(_NEAREST, len(mixture)), largest=False).indices
    value = torch.empty(near.shape, dtype=X.dtype)
    for k, gaussian in enumerate(mixture):
        i, column = (near == k).nonzero(as_tuple=True)
        if len(i):
            value[i, column] = of_each_frame(gaussian, X[i], weight[i], M[i]) - math.log(gaussian.share)
    return near, value


def _assign(mixture, X, weight, S, M):
    """The component of every frame: the one under which its image is likeliest, among those nearest to its shape."""
    near, value = _nearest(mixture, X, weight, S, M)
    return near.gather(1, value.argmin(1, keepdim=True))[:, 0]


def _fit_each(mixture, component, X, weight, M, steps):
    """Shapes and cameras, each frame in its component."""
    S, M = torch.empty(*X.shape[:2], 3, dtype=X.dtype), M.clone()
    for k, gaussian in enumerate(mixture):
        i = (component == k).nonzero()[:, 0]
        if len(i):
            S[i], M[i] = fit(gaussian, X[i], weight[i], M[i], steps)
    return S, M


def _unlikeliness(prior, frames):
    """−log p(image) per visible coordinate of frames that were kept back, cameras integrated out; mean over frames."""
    X, weight, S, M = frames
    mixture = _mixture(prior)
    component = _assign(mixture, X, weight, S, M)
    _, M = _fit_each(mixture, component, X, weight, M, 2)
    each = _unlikely(mixture, component, X, weight, M, negative_log_evidence)
    return float((each / (2 * (weight > 0).sum(1))).mean())


def _unlikely(mixture, component, X, weight, M, function=of_each_frame):
    """−log p(image) of each frame in its component, which is one of several."""
    share = torch.tensor([g.share for g in mixture], dtype=X.dtype)
    return _of_each_component(function, mixture, component, X, weight, M) - share.log()[component]


def _of_each_component(function, mixture, component, X, weight, M):
    """A function of each frame, in its component."""
    value = torch.empty(len(X), dtype=X.dtype)
    for k, gaussian in enumerate(mixture):
        i = (component == k).nonzero()[:, 0]
        if len(i):
            value[i] = function(gaussian, X[i], weight[i], M[i])
    return value
