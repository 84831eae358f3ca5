"""Training the network on 2D landmarks alone."""

import hashlib
import json
import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tqdm import tqdm

from . import completion, preprocessing, shape_prior
from .cameras import image_turns
from .data import as_points, as_weights
from .gradient import backpropagate
from .model import Config, DeepNRSfM
from .threads import use_threads

MIN_FRAMES = 10
MIN_POINTS = 4
_CHECKPOINT_EVERY = 500  # steps
PRIOR_FRAMES = 4000  # more add little


@dataclass(frozen=True)
class Schedule:
    """How long to train and how.

    `steps` of `batch` frames each. Optimiser "muon": Muon for the inner dictionaries, Adam for the
    rest, warm-up and cosine; "adam": Adam for all, slowly decaying. `rate` is Adam's peak learning
    rate. For the first `turn` of the steps every image is turned in its plane by a random angle: an
    orthographic camera may be held at any tilt, so these are new and valid views. `pull` draws shapes to
    their mean with this weight at first and none from the middle on, so that frames and their mirror
    images, which explain the same pictures, do not both find a place. `clip`: the longest gradient.
    """

    steps: int
    batch: int
    optimizer: str  # "muon": Muon for the inner dictionaries, Adam for the rest; "adam": Adam for all
    rate: float  # Adam's peak learning rate
    muon_rate: float = 0.0
    muon_decay: float = 0.0
    turn: float = 0.0
    pull: float = 0.0
    clip: float = math.inf


SCHEDULES = {
    # Found on salsa and on motions of other seeds than those that any figure is reported on.
    "default": Schedule(800, 256, "muon", rate=8e-3, muon_rate=2.4e-2, muon_decay=0.1, turn=0.4, pull=0.3, clip=1.0),
    # The authors' code: Adam at 1e-3, times 0.95 every 10,000 steps.
    "original": Schedule(200_000, 32, "adam", rate=1e-3),
}


def fit(
    W,
    visible=None,
    config=None,
    schedule="default",
    *,
    confidence=None,
    steps=None,
    seed=0,
    device=None,
    progress=True,
    checkpoint=None,
    threads=1,
    callback=None,
):
    """Train a network and its shape prior on 2D landmarks. No 3D is seen, not even that of Landmarks with 3D.

    The loss is the paper's: the reprojection error ‖W − S M‖_F of each frame over its visible points (with
    hidden ones, after the translation that fits best), divided by ‖W‖_F as in the authors' code. A step
    whose gradient is not finite is left out. In the end the network's cameras give a Gaussian prior over
    shapes (`shape_prior`), which `reconstruct` refines with.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array or tensor
        Image points; hidden ones may be NaN.
    visible : (F, P) bool, optional
        Default: all visible.
    config : Config, optional
        Default: ``Config(n_points=P)``.
    schedule : "default", "original" or a `Schedule`
        The package's schedule, the authors' (200,000 steps of Adam on 32 frames), or one of your own.
    confidence : (F, P), optional
        From 0 to 1, weights of the visible points in the first layer, the loss and the prior. Default: that
        of the Landmarks, else 1.
    steps : int, optional
        Another number of steps; the default schedule stretches its learning rates to it.
    seed : int
        Decides the weights at the start and the order of the frames. No global state is touched.
    device : str or torch.device, optional
        Default: the GPU if there is one.
    progress : bool
        Show a bar with the running loss.
    checkpoint : path, optional
        Written every 500 steps. If it exists, training goes on from it and ends at the same result
        as if it had never stopped.
    threads : int or None
        CPU threads while training, set back afterwards. One is fastest for batches of this size
        unless the machine is idle, and makes results repeatable; None leaves PyTorch's setting.
    callback : function, optional
        Called after every step as ``callback(step, net)``, step from 1; to look, not to change anything.

    Returns
    -------
    DeepNRSfM on the CPU, in evaluation mode.

    Raises
    ------
    ValueError
        For arrays of wrong shape, visible points that are not finite, too few frames or points, a
        frame with no visible point or all of them at one place, a point that no frame shows, an unknown
        schedule, or a checkpoint that belongs to other data or settings.
    FileNotFoundError
        If the folder of the checkpoint does not exist.
    FloatingPointError
        If 100 steps in a row have no finite gradient.
    """
    if not isinstance(schedule, Schedule) and schedule not in SCHEDULES:
        raise ValueError(f"schedule={schedule!r}; expected one of {', '.join(SCHEDULES)}, or a Schedule.")
    plan = schedule if isinstance(schedule, Schedule) else SCHEDULES[schedule]
    steps = plan.steps if steps is None else int(steps)
    if steps < 1:
        raise ValueError(f"steps={steps}; expected at least 1.")
    if checkpoint is not None and not Path(checkpoint).parent.is_dir():
        raise FileNotFoundError(f"{Path(checkpoint).parent}: no such folder for the checkpoint.")
    weight = torch.as_tensor(as_weights(W, visible, confidence))
    W, _, names, _ = as_points(W, visible)
    W = torch.as_tensor(W)
    F, P, _ = W.shape
    if F < MIN_FRAMES or P < MIN_POINTS:
        raise ValueError(
            f"training needs at least {MIN_FRAMES} frames and {MIN_POINTS} points; got {F} frames of {P} points."
        )
    config = Config(n_points=P) if config is None else config
    if config.n_points != P:
        raise ValueError(f"config.n_points is {config.n_points}, but W has {P} points.")
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"

    preprocessing.check_points(weight, names)
    preprocessing.check_extent(W, weight)
    seed = int(seed)
    random = torch.Generator().manual_seed(seed)
    net = DeepNRSfM(config, generator=random).float()
    X, mean = preprocessing.center(W, weight)
    net.scale.fill_(preprocessing.set_scale(X, weight))
    net.origin.copy_(mean.mean(0))
    with use_threads(threads):
        net.image_covariance.copy_(completion.learn(net.scaled(W, weight)[0], weight))
        image, X, _ = net.normalize(W, weight)
    size = preprocessing.frame_size(X, weight).float().to(device)
    complete = bool((weight == 1).all())
    image, X, weight = image.float().to(device), X.float().to(device), weight.float().to(device)
    net.to(device)
    optimizers = make_optimizers(net, plan)
    decay = warmup_cosine(steps) if plan.optimizer == "muon" else _exponential
    rates = [torch.optim.lr_scheduler.LambdaLR(o, decay) for o in optimizers]
    key = _fingerprint(config, plan, steps, seed, image, weight) if checkpoint else None
    first = _resume(checkpoint, key, net, optimizers, rates, random)

    running, skipped = None, 0
    bar = tqdm(range(first, steps), initial=first, total=steps, desc="training", disable=not progress, mininterval=0.5)
    with use_threads(threads):
        for step in bar:
            pick = torch.randint(F, (min(plan.batch, F),), generator=random).to(device)
            seen, compared = image[pick], X[pick]
            if step < plan.turn * steps:
                turns = image_turns(2 * math.pi * torch.rand(len(pick), generator=random)).to(seen)
                seen, compared = seen @ turns, compared @ turns
            pull = plan.pull * max(0.0, 1 - 2 * step / steps)
            loss = backpropagate(net, seen, None if complete else weight[pick], size[pick], pull, compared)
            norm = torch.nn.utils.clip_grad_norm_(net.parameters(), plan.clip)
            if torch.isfinite(norm):  # a camera one step from degenerate can ask for an infinite step
                for optimizer in optimizers:
                    optimizer.step()
                if config.threshold == "soft":
                    for b in (*net.encoder_threshold, *net.decoder_threshold):
                        b.data.clamp_(min=0)
                running = loss.item() if running is None else 0.98 * running + 0.02 * loss.item()
                bar.set_postfix(loss=f"{running:.4f}", refresh=False)
                skipped = 0
            else:
                skipped += 1
            if skipped == 100:
                raise FloatingPointError(f"training has diverged: no finite gradient since step {step - 99}.")
            for rate in rates:
                rate.step()
            if checkpoint and ((step + 1) % _CHECKPOINT_EVERY == 0 or step + 1 == steps):
                _save(checkpoint, key, step + 1, net, optimizers, rates, random)
            if callback:
                callback(step + 1, net)
        for p in net.parameters():
            p.data = p.data.clone()  # no longer a piece of the optimiser's vector
        net.cpu().eval()
        net.prior = learn_prior(net, image.cpu(), X.cpu(), weight.cpu(), random)
    return net


@torch.no_grad()
def learn_prior(net, image, X, visible, random=None):
    """The shape prior of some frames, from a trained network's shapes and cameras of at most 4,000 of them.

    Parameters
    ----------
    net : DeepNRSfM
    image, X : (F, P, 2) tensors
        As `net.normalize` makes them.
    visible : (F, P) tensor, bool or weights from 0 to 1
    random : torch.Generator, optional
        Draws the frames.
    """
    pick = torch.randperm(len(X), generator=random)[:PRIOR_FRAMES]
    psi, M = net.bottleneck(net.encode(image[pick].to(net.scale)))
    return shape_prior.learn(X[pick], visible[pick], net.decode(psi).cpu(), M.cpu())


class FlatAdam(torch.optim.Adam):
    """Fused Adam on one long vector of which the parameters are pieces: one update instead of forty."""

    def __init__(self, parameters, rate):
        self.pieces = [p for p in parameters if p.requires_grad]
        flat = torch.nn.Parameter(torch.cat([p.detach().flatten() for p in self.pieces]))
        for p, piece in zip(self.pieces, flat.detach().split([p.numel() for p in self.pieces]), strict=True):
            p.data = piece.view_as(p)
        super().__init__([flat], rate, fused=True)

    def step(self):
        self.param_groups[0]["params"][0].grad = torch.cat([p.grad.flatten() for p in self.pieces])
        super().step()


def make_optimizers(net, plan):
    """The optimisers of a `Schedule` for a network; the network must already be where it is trained."""
    if plan.optimizer == "adam":
        return [FlatAdam(net.parameters(), plan.rate)]
    inner = list(net.D)[1:]
    chosen = {id(p) for p in inner}
    adam = FlatAdam([p for p in net.parameters() if id(p) not in chosen], plan.rate)
    return [torch.optim.Muon(inner, plan.muon_rate, weight_decay=plan.muon_decay), adam] if inner else [adam]


def warmup_cosine(steps):
    """Rises over the first 5 % of the steps, then half a cosine down to a thousandth."""
    warm = max(1, steps // 20)

    def factor(step):
        if step < warm:
            return (step + 1) / warm
        return 1e-3 + (1 - 1e-3) * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, steps - warm)))

    return factor


def _exponential(step):
    return 0.95 ** (step / 10_000)


def _fingerprint(config, plan, steps, seed, X, weight):
    digest = hashlib.sha256(X.cpu().numpy().tobytes() + weight.cpu().numpy().tobytes())
    settings = json.dumps([asdict(config), asdict(plan), steps, seed], sort_keys=True)
    digest.update(settings.encode())
    return digest.hexdigest()


def _save(path, key, step, net, optimizers, rates, random):
    """Write a checkpoint so that a crash while writing leaves the last one whole."""
    path = Path(path)
    part = path.with_name(path.name + ".part")
    torch.save(
        {
            "key": key,
            "step": step,
            "net": net.state_dict(),
            "optimizers": [o.state_dict() for o in optimizers],
            "rates": [r.state_dict() for r in rates],
            "random": random.get_state(),
        },
        part,
    )
    os.replace(part, path)


def _resume(path, key, net, optimizers, rates, random):
    """Load a checkpoint if there is one; returns the step to go on from."""
    if path is None or not Path(path).exists():
        return 0
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises many kinds for a broken file
        raise ValueError(f"{path}: not a checkpoint, or a broken one ({type(error).__name__}).") from None
    if not isinstance(state, dict) or state.get("key") != key:
        raise ValueError(f"{path}: this checkpoint belongs to other data or settings; remove it or name another.")
    net.load_state_dict(state["net"])
    for part, saved in zip(optimizers + rates, state["optimizers"] + state["rates"], strict=True):
        part.load_state_dict(saved)
    random.set_state(state["random"])
    return state["step"]
