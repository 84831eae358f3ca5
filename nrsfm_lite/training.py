"""Training the network on 2D landmarks alone."""

from __future__ import annotations

import hashlib
import json
import math
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor
from tqdm import tqdm

from . import image_prior, normalizer, shape_prior
from .cameras import image_turns
from .checks import at_least, one_of, whole
from .gradient import backpropagate
from .images import Images, read
from .model import Config, DeepNRSfM
from .shape_prior import Prior
from .threads import use_threads

Learned = TypeVar("Learned")

MIN_FRAMES = 10
MIN_POINTS = 4
_CHECKPOINT_EVERY = 500  # steps


@dataclass(frozen=True)
class Schedule:
    """How long to train and how.

    Parameters
    ----------
    steps, batch : int
        So many steps of so many frames each.
    optimizer : "muon" or "adam"
        "muon": Muon for the inner dictionaries, Adam for the rest, warm-up and cosine; "adam": Adam for all, slowly
        decaying.
    rate : float
        Adam's peak learning rate.
    muon_rate, muon_decay : float
        Peak learning rate and weight decay of Muon; of no use with "adam", and refused there.
    turn : float
        For this first share of the steps every image is turned in its plane by a random angle: an orthographic
        camera may be held at any tilt, so these are new and valid views.
    pull : float
        Draws shapes to their mean with this weight at first and none from the middle on, so that frames and their
        mirror images, which explain the same pictures, do not both find a place.
    clip : float
        The longest gradient; may be infinite.

    Raises
    ------
    ValueError
        If a value is outside its range, or cannot act.

    Examples
    --------
    >>> nl.fit(np.random.default_rng(0).normal(size=(20, 5, 2)), progress=False,
    ...        schedule=nl.Schedule(steps=3, batch=8, optimizer="adam", rate=1e-3)).config.n_points
    5
    """

    steps: int
    batch: int
    optimizer: str
    rate: float
    muon_rate: float = 0.0
    muon_decay: float = 0.0
    turn: float = 0.0
    pull: float = 0.0
    clip: float = math.inf

    def __post_init__(self) -> None:
        for key in ("steps", "batch"):
            object.__setattr__(self, key, whole(key, getattr(self, key), 1))
        one_of("optimizer", self.optimizer, ("muon", "adam"))
        for key in ("muon_rate", "muon_decay", "turn", "pull"):
            at_least(key, getattr(self, key))
        at_least("rate", self.rate, above=True)
        if not self.clip > 0:
            raise ValueError(f"clip={self.clip!r}; expected a number above 0.")
        if self.turn > 1:
            raise ValueError(f"turn={self.turn!r}; expected a share of the steps, 0 to 1.")
        if self.optimizer == "muon" and self.muon_rate == 0:
            raise ValueError("optimizer='muon' needs a muon_rate above 0; without one, nothing would move.")
        if self.optimizer == "adam" and (self.muon_rate or self.muon_decay):
            raise ValueError("optimizer='adam' has no use for muon_rate and muon_decay; leave them 0.")


SCHEDULES = {
    # Found on salsa and on motions of other seeds than those that any figure is reported on.
    "default": Schedule(800, 256, "muon", rate=8e-3, muon_rate=2.4e-2, muon_decay=0.1, turn=0.4, pull=0.3, clip=1.0),
    # The authors' code: Adam at 1e-3, times 0.95 every 10,000 steps.
    "original": Schedule(200_000, 32, "adam", rate=1e-3),
}


def fit(
    W: Any,
    visible: Any = None,
    config: Config | None = None,
    *,
    schedule: str | Schedule = "default",
    confidence: Any = None,
    steps: int | None = None,
    seed: int = 0,
    device: str | torch.device | None = None,
    progress: bool = True,
    checkpoint: str | Path | None = None,
    threads: int | None = 1,
    callback: Callable[[int, DeepNRSfM], None] | None = None,
) -> DeepNRSfM:
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
        From 0 to 1, weights of the visible points in the first layer, the loss and the prior; 0 hides a point.
        Default: that of the Landmarks, else 1.
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
    DeepNRSfM on the CPU, in evaluation mode. If no shape prior can be learned, a warning says why, and the network
    comes without one.

    Raises
    ------
    ValueError
        For arrays of wrong shape, visible points that are not finite, too few frames or points, a
        frame with no visible point or all of them at one place, a point that no frame shows, an unknown
        schedule or device, or a checkpoint that belongs to other data or settings.
    FileNotFoundError
        If the folder of the checkpoint does not exist.
    FloatingPointError
        If 100 steps in a row have no finite gradient.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(60))
    >>> nl.fit(views, steps=3, progress=False).config.n_points
    31
    """
    if not isinstance(schedule, Schedule):
        one_of("schedule", schedule, (*SCHEDULES, "a Schedule"))
        schedule = SCHEDULES[schedule]
    if steps is not None:
        schedule = replace(schedule, steps=steps)
    device = check_training(seed, device, checkpoint)
    images = read_to_train(W, visible, confidence)
    config = Config(n_points=images.n_points) if config is None else config
    if config.n_points != images.n_points:
        raise ValueError(f"config.n_points is {config.n_points}, but W has {images.n_points} points.")
    return train(
        images,
        config,
        schedule,
        seed=int(seed),
        device=device,
        progress=progress,
        checkpoint=checkpoint,
        threads=threads,
        callback=callback,
    )


def read_to_train(W: Any, visible: Any = None, confidence: Any = None) -> Images:
    """The images that a training needs, read and checked."""
    return read(W, visible, confidence, method="training", frames=MIN_FRAMES, points=MIN_POINTS)


def check_training(seed: Any, device: Any, checkpoint: Any) -> torch.device:
    """Refuse a seed, a device or a checkpoint's folder that cannot be; the device, chosen if it is None."""
    whole("seed", seed, 0)
    if checkpoint is not None and not Path(checkpoint).parent.is_dir():
        raise FileNotFoundError(f"{Path(checkpoint).parent}: no such folder for the checkpoint.")
    if device is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError):
        raise ValueError(f"device={device!r}: there is no such device here; 'cpu' is always there.") from None


def train(
    images: Images,
    config: Config,
    plan: Schedule,
    *,
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: bool = False,
    checkpoint: str | Path | None = None,
    threads: int | None = 1,
    callback: Callable[[int, DeepNRSfM], None] | None = None,
    with_prior: bool = True,
) -> DeepNRSfM:
    """`fit` of images that have been read; nothing is checked. `with_prior=False` leaves the prior to the caller."""
    random = torch.Generator().manual_seed(seed)
    net = DeepNRSfM(config, generator=random).float()
    W, mean, weight = images.tensors()
    with use_threads(threads):
        net.normalizer = learn_normalizer(net.normalizer, W, mean, weight)
        image, X, _ = net.normalizer.normalize(W, mean, weight)
    size = normalizer.frame_size(X, weight).float().to(device)
    image, X, weight = image.float().to(device), X.float().to(device), weight.float().to(device)
    net.to(device)
    descent = Descent(net, plan, random)
    key = _fingerprint(config, plan, seed, image, weight) if checkpoint else None
    first = _resume(checkpoint, key, descent) if checkpoint else 0

    def gradient(pick: Tensor, turns: Tensor | None, pull: float) -> Tensor:
        pick = pick.to(device)
        shown, compared = image[pick], X[pick]
        if turns is not None:
            turns = turns.to(shown)
            shown, compared = shown @ turns, compared @ turns
        share = None if images.complete else weight[pick]
        return backpropagate(net, shown, share, size=size[pick], pull=pull, X=compared)

    def after(step: int) -> None:
        if checkpoint and (step % _CHECKPOINT_EVERY == 0 or step == plan.steps):
            _save(checkpoint, key, step, descent)
        if callback:
            callback(step, net)

    with use_threads(threads):
        descent.run(len(images), gradient, first=first, after=after, progress=progress)
        for p in net.parameters():
            p.data = p.data.clone()  # no longer a piece of the optimiser's vector
        net.cpu().eval()
        if with_prior:
            net.prior = or_warn(lambda: learn_prior(net, image.cpu(), X.cpu(), weight.cpu(), random))
    return net


def or_warn(learn: Callable[[], Learned]) -> Learned | None:
    """What `learn` returns; if it fails, a warning and None: a finished training must not be lost by it."""
    try:
        return learn()
    except Exception as error:
        warnings.warn(f"no shape prior could be learned, so nothing will be refined ({error}).", stacklevel=4)
        return None


def learn_normalizer(
    untrained: normalizer.Normalizer, W: Tensor, mean: Tensor, weight: Tensor
) -> normalizer.Normalizer:
    """The way into a network's units for training frames W, centred, in double precision."""
    found = replace(untrained, scale=float(normalizer.set_scale(W, weight)), origin=mean.mean(0))
    X = W / found.unit(W, weight)[:, None, None]
    return replace(found, covariance=image_prior.learn(X, weight))


@torch.no_grad()
def learn_prior(
    net: DeepNRSfM, image: Tensor, X: Tensor, weight: Tensor, random: torch.Generator | None = None
) -> Prior:
    """The shape prior of some frames, from a trained network's shapes and cameras of at most 20,000 of them.

    Parameters
    ----------
    net : DeepNRSfM
    image, X : (F, P, 2) tensors
        As `net.normalize` makes them.
    weight : (F, P) tensor, bool or from 0 to 1
    random : torch.Generator, optional
        Draws the frames.
    """
    pick = torch.randperm(len(X), generator=random)[: shape_prior.MOST_FRAMES]
    _, S, M = net.lift(image[pick].to(net.device))
    return shape_prior.learn(X[pick], weight[pick], S.cpu(), M.cpu(), free_scale=free_scale(net))


def free_scale(net: DeepNRSfM) -> bool:
    """Whether the shape prior finds a scale for every frame: images of weak perspective come in units of their own."""
    return net.config.projection == "weak_perspective"


class Descent:
    """The loop of a training: which frames, which turns, and what becomes of their gradient.

    The network must already be where it is trained. `random` draws the frames and the turns.
    """

    def __init__(self, net: DeepNRSfM, plan: Schedule, random: torch.Generator) -> None:
        self.net, self.plan, self.random = net, plan, random
        self.optimizers = make_optimizers(net, plan)
        decay = _warmup_cosine(plan.steps) if plan.optimizer == "muon" else _exponential
        self.rates = [torch.optim.lr_scheduler.LambdaLR(o, decay) for o in self.optimizers]

    def run(
        self,
        n_frames: int,
        gradient: Callable[[Tensor, Tensor | None, float], Tensor],
        *,
        first: int = 0,
        after: Callable[[int], None] | None = None,
        progress: bool = False,
    ) -> None:
        """All steps from `first` on.

        Parameters
        ----------
        n_frames : int, to draw from
        gradient : function
            Takes the frames of a batch (B,), rotations of their images (B, 2, 2) or None, and the weight of the pull
            to the mean shape; leaves the gradient in the network and returns the loss.
        after : function, optional, called with the number of steps done

        Raises
        ------
        FloatingPointError
            If 100 steps in a row have no finite gradient.
        """
        plan, net = self.plan, self.net
        running, skipped = None, 0
        bar = tqdm(
            range(first, plan.steps), initial=first, total=plan.steps, desc="training", disable=not progress,
            mininterval=0.5,
        )  # fmt: skip
        for step in bar:
            pick = torch.randint(n_frames, (min(plan.batch, n_frames),), generator=self.random)
            turns = None
            if step < plan.turn * plan.steps:
                turns = image_turns(2 * math.pi * torch.rand(len(pick), generator=self.random))
            loss = gradient(pick, turns, plan.pull * max(0.0, 1 - 2 * step / plan.steps))
            norm = torch.nn.utils.clip_grad_norm_(net.parameters(), plan.clip)
            if torch.isfinite(norm):  # a camera one step from degenerate can ask for an infinite step
                for optimizer in self.optimizers:
                    optimizer.step()
                if net.config.threshold == "soft":
                    for b in (*net.encoder_threshold, *net.decoder_threshold):
                        b.data.clamp_(min=0)
                running = loss.item() if running is None else 0.98 * running + 0.02 * loss.item()
                bar.set_postfix(loss=f"{running:.4f}", refresh=False)
                skipped = 0
            else:
                skipped += 1
            if skipped == 100:
                raise FloatingPointError(f"training has diverged: no finite gradient since step {step - 99}.")
            for rate in self.rates:
                rate.step()
            if after:
                after(step + 1)

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        return {
            "net": self.net.state_dict(),
            "optimizers": [o.state_dict() for o in self.optimizers],
            "rates": [r.state_dict() for r in self.rates],
            "random": self.random.get_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        self.net.load_state_dict(state["net"])
        parts: list[Any] = [*self.optimizers, *self.rates]
        for part, saved in zip(parts, [*state["optimizers"], *state["rates"]], strict=True):
            part.load_state_dict(saved)
        self.random.set_state(state["random"])


class FlatAdam(torch.optim.Adam):
    """Fused Adam on one long vector of which the parameters are pieces: one update instead of forty."""

    def __init__(self, parameters: Sequence[torch.nn.Parameter], rate: float) -> None:
        self.pieces = [p for p in parameters if p.requires_grad]
        flat = torch.nn.Parameter(torch.cat([p.detach().flatten() for p in self.pieces]))
        for p, piece in zip(self.pieces, flat.detach().split([p.numel() for p in self.pieces]), strict=True):
            p.data = piece.view_as(p)
        super().__init__([flat], rate, fused=True)

    def step(self) -> None:  # type: ignore[override]
        self.param_groups[0]["params"][0].grad = torch.cat([p.grad.flatten() for p in self.pieces])
        super().step()


def make_optimizers(net: DeepNRSfM, plan: Schedule) -> list[torch.optim.Optimizer]:
    """The optimisers of a `Schedule` for a network; the network must already be where it is trained."""
    if plan.optimizer == "adam":
        return [FlatAdam(list(net.parameters()), plan.rate)]
    inner = list(net.D)[1:]
    chosen = {id(p) for p in inner}
    adam = FlatAdam([p for p in net.parameters() if id(p) not in chosen], plan.rate)
    return [torch.optim.Muon(inner, plan.muon_rate, weight_decay=plan.muon_decay), adam] if inner else [adam]


def _warmup_cosine(steps: int) -> Callable[[int], float]:
    """Rises over the first 5 % of the steps, then half a cosine down to a thousandth."""
    warm = max(1, steps // 20)

    def factor(step: int) -> float:
        if step < warm:
            return (step + 1) / warm
        return 1e-3 + (1 - 1e-3) * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, steps - warm)))

    return factor


def _exponential(step: int) -> float:
    return 0.95 ** (step / 10_000)


def _fingerprint(config: Config, plan: Schedule, seed: int, X: Tensor, weight: Tensor) -> str:
    digest = hashlib.sha256(X.cpu().numpy().tobytes() + weight.cpu().numpy().tobytes())
    digest.update(json.dumps([asdict(config), asdict(plan), seed], sort_keys=True).encode())
    return digest.hexdigest()


def _save(path: str | Path, key: str | None, step: int, descent: Descent) -> None:
    """Write a checkpoint so that a crash while writing leaves the last one whole."""
    path = Path(path)
    part = path.with_name(path.name + ".part")
    torch.save({"key": key, "step": step, **descent.state()}, part)
    os.replace(part, path)


def _resume(path: str | Path, key: str | None, descent: Descent) -> int:
    """Load a checkpoint if there is one; returns the step to go on from."""
    if not Path(path).exists():
        return 0
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises many kinds for a broken file
        raise ValueError(f"{path}: not a checkpoint, or a broken one ({type(error).__name__}).") from None
    if not isinstance(state, dict) or state.get("key") != key:
        raise ValueError(f"{path}: this checkpoint belongs to other data or settings; remove it or name another.")
    descent.restore(state)
    return state["step"]
