"""What helps frames that no network has seen: changes of the default training, each alone (chapter 10)."""

from dataclasses import replace

import torch

from .. import metrics, shape_prior
from ..cameras import nearest_orthonormal, nearness, random_cameras
from ..images import parse
from ..model import Config, DeepNRSfM
from ..threads import use_threads
from ..training import SCHEDULES, Descent, learn_normalizer
from .lab import scoring

QUESTION = "Which changes of the training, or of the network, help on unseen frames? Would 3D supervision?"
_DEPTH = "3D supervision"
_ENSEMBLE = "ensemble of 3"
_ITERATIONS = {"unit dictionaries": 1, "2 iterations": 2, "3 iterations": 3}
_CHANGES = ("none", _DEPTH, "mirrored images", "hidden points", "noise", "new views", *_ITERATIONS, _ENSEMBLE)
_NOISE = 0.05  # of a frame's norm
_HIDDEN = 0.2  # of the points, at most


def cases(quick: bool) -> list[dict[str, object]]:
    """Data, change and seed: all changes where settings may be chosen, the comparison with 3D also elsewhere."""
    if quick:
        each_kind = [c for c in _CHANGES if c not in ("unit dictionaries", "3 iterations")]  # as "2 iterations"
        return [{"data": "motion-small", "change": c, "seed": 0} for c in each_kind]
    chosen = [(d, c) for d in ("motion", "salsa") for c in _CHANGES] + [("martial", "none"), ("martial", _DEPTH)]
    return [{"data": d, "change": c, "seed": s} for s in range(3) for d, c in chosen]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "network": "the default",
        "steps": scoring.QUICK_STEPS if quick else SCHEDULES["default"].steps,
        "schedule": "the default; with 3D supervision without its pull",
        "errors": "mean normalised 3D error; seen, unseen: one pass; refined: with a shape prior learned as in `fit`",
        _DEPTH: "the loss takes the depth of every point, beside its image, from the truth; shown for comparison only",
        "new views": "a second term, halved: the network's own shapes from new cameras, asked for the same shapes",
        "unit dictionaries": "spectral norm 1 in the encoder; two or three iterations of block ISTA also have it",
    }


def measure(data: str, change: str, seed: int) -> dict[str, object]:
    """Errors of one network, or of an ensemble, trained with one change."""
    train, test = scoring.views(data)
    seeds = (3 * seed, 3 * seed + 1, 3 * seed + 2) if change == _ENSEMBLE else (seed,)
    steps = scoring.quick_steps(data) or SCHEDULES["default"].steps
    with use_threads(1):
        nets = [_train(train, change, steps, s) for s in seeds]
        return _errors(nets, change, train, test)


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds, a line per data set and change."""
    return scoring.by_groups(("data", "change"), ("seen", "unseen", "refined", "refined_unseen"), rows)


def _train(views, change, steps, seed):
    """`training.train` with one change and a gradient by autograd."""
    plan = replace(SCHEDULES["default"], steps=steps)
    plan = replace(plan, pull=0.0) if change == _DEPTH else plan
    random = torch.Generator().manual_seed(seed)
    net = DeepNRSfM(Config(views.n_points), generator=random)
    images = parse(views.points2d)
    W, mean, weight = images.tensors()
    net.normalizer = learn_normalizer(net.normalizer, W, mean, weight)
    X = net.normalizer.normalize(W, mean, weight)[1].float()
    depth = (torch.as_tensor(nearness(views.points3d, views.cameras)) / net.normalizer.scale).float()

    def gradient(pick, turns, pull):
        shown = X[pick] if turns is None else X[pick] @ turns
        loss = _loss(net, shown, depth[pick], change, pull, random)
        net.zero_grad()
        loss.backward()
        return loss.detach()

    Descent(net, plan, random).run(len(X), gradient)
    return net.eval()


def _loss(net, images, depth, change, pull, random):
    """The loss of `gradient.backpropagate`, changed."""
    if change == "mirrored images":
        flip = torch.where(torch.rand(len(images), generator=random) < 0.5, 1.0, -1.0)
        images = torch.stack([images[..., 0] * flip[:, None], images[..., 1]], -1)
    shown = images
    size = images.flatten(1).norm(dim=1)
    if change == "hidden points":  # the network does not see them; the loss does
        share = _HIDDEN * torch.rand(len(images), 1, generator=random)
        shown = images * (torch.rand(images.shape[:2], generator=random) >= share)[..., None]
    if change == "noise":
        noise = torch.randn(images.shape, generator=random)
        shown = images + noise * (_NOISE * size / noise.flatten(1).norm(dim=1))[:, None, None]
    _, S, M = _lift(net, shown, change)
    missed = images - S @ M
    if change == _DEPTH:
        third = torch.linalg.cross(M[..., 0], M[..., 1])
        missed = torch.cat([missed, depth[..., None] - S @ third[..., None]], 2)
    loss = (missed.flatten(1).norm(dim=1) / size).mean()
    if change == "new views":
        turned = torch.as_tensor(random_cameras(len(S), int(torch.randint(2**31, (), generator=random)))).float()
        target = S.detach()
        again = (_lift(net, target @ turned, change)[1] - target).flatten(1).norm(dim=1) / target.flatten(1).norm(dim=1)
        loss = loss + again.mean() / 2
    if pull:
        loss = loss + pull * ((S - net.output_bias).flatten(1).norm(dim=1) / size).mean()
    return loss


def _lift(net, X, change):
    """`DeepNRSfM.lift`; with unit dictionaries and further iterations of block ISTA per layer, if asked for."""
    if change not in _ITERATIONS:
        return net.lift(X)
    B, P, _ = X.shape
    first, *rest = net.D
    Z = X.mT.reshape(2 * B, P)
    for D, b in zip([first.permute(1, 2, 0).reshape(P, -1), *rest], net.encoder_threshold, strict=True):
        D = D / torch.linalg.matrix_norm(D, 2)
        code = torch.relu((Z @ D).view(-1, len(b)) - b)
        for _ in range(_ITERATIONS[change] - 1):
            missed = Z - code.view(len(Z), -1) @ D.mT
            code = torch.relu(code + (missed @ D).view(-1, len(b)) - b)
        Z = code
    psi, M = net.bottleneck(Z.view(B, 2, 3, -1))
    return psi, net.decode(psi), M


@torch.no_grad()
def _errors(nets, change, train, test):
    X, S, M = _guess(nets, change, train)
    visible = torch.ones(X.shape[:2], dtype=torch.bool)
    pick = torch.randperm(len(X), generator=torch.Generator().manual_seed(0))[: shape_prior.MOST_FRAMES]
    prior = shape_prior.learn(X[pick], visible[pick], S[pick], M[pick])
    result = {"seen": _error(S, train), "refined": _error(shape_prior.apply(prior, X, visible, M)[0], train)}
    X, S, M = _guess(nets, change, test)
    visible = torch.ones(X.shape[:2], dtype=torch.bool)
    result["unseen"] = _error(S, test)
    result["refined_unseen"] = _error(shape_prior.apply(prior, X, visible, M)[0], test)
    return result


def _guess(nets, change, views):
    """Normalised points, shapes and cameras; those of an ensemble turned onto the first network's and averaged."""
    W = torch.as_tensor(views.points2d)
    _, X, _ = nets[0].normalize(W, torch.ones(W.shape[:2], dtype=torch.bool))
    X = X.float()
    S_sum = M_sum = torch.tensor(0.0)
    for net in nets:
        _, S, M = _lift(net, X, change)
        S = S - S.mean(1, keepdim=True)
        if net is nets[0]:
            M_first = M
        U, _, Vh = torch.linalg.svd(torch.einsum("fij,fkj->ik", M_first, M))
        S_sum, M_sum = S_sum + S @ (U @ Vh).T, M_sum + U @ Vh @ M
    return X, S_sum / len(nets), nearest_orthonormal(M_sum / len(nets))


def _error(S, views):
    return float(metrics.normalized_error(S, views.points3d).mean())
