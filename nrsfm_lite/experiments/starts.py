"""What the shape prior makes of the same images from different starts, a network's among them (chapter 10)."""

import time
from typing import Any

import numpy as np

from .. import baselines, cameras, datasets
from ..data import Landmarks, Reconstruction
from ..reconstruction import reconstruct
from ..training import fit
from .lab import scoring

QUESTION = "Would the shape prior do the same without the network? What each start reaches, before and after it."
_VIEWS: dict[str, dict[str, Any]] = {
    "complete": {},
    "30 % hidden": {"missing": 0.3},
    "10 % noise": {"noise": 0.1},
    "5 % noise": {"noise": 0.05},
}
_STARTS = ("network", "rigid", "bmm", "random")
_CHOSEN_ON = ("motion", "salsa", "motion-50")
_REPORTED = ("martial", "indian", "05", "drink", "pickup", "yoga", "stretch", "dance", "bicycle", "chair")
_HARDER = (*((d, v) for v in ("30 % hidden", "10 % noise") for d in ("motion", "martial")),)
_NOISY = (("bicycle", "5 % noise"), ("chair", "5 % noise"))
_SEEDS = 3
_VIEWS_OF_MODELS = 2000  # of a category's models, by turns


def cases(quick: bool) -> list[dict[str, object]]:
    """Data, views, start and seed; seeds outermost, so that a run that is cut short has all data sets."""
    if quick:
        return [{"data": "motion-small", "views": "complete", "start": s, "seed": 0} for s in ("network", "rigid")]
    sets = [*((d, "complete") for d in _CHOSEN_ON + _REPORTED), *_HARDER, *_NOISY]
    rows = [(d, v, start, seed) for seed in range(_SEEDS) for d, v in sets for start in _STARTS]
    rows += [(d, "complete", "network, original", 0) for d in ("motion", "martial")]
    return [{"data": d, "views": v, "start": start, "seed": seed} for d, v, start, seed in rows]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "start": "network: one pass after the default schedule; network, original: after that of the authors; rigid, "
        "bmm: the classical methods of that name; random: cameras and shapes that were drawn",
        "seed": "of the cameras, of the training, and of whatever else a start draws",
        "after": "em_gaussian from that start, its defaults: the same prior for all",
        "bicycle, chair": f"{_VIEWS_OF_MODELS} views of the CAD models of PASCAL3D+",
        "errors": f"before: of the start; after: of what the prior makes of it; {scoring.ERRORS}",
        "seconds": "start_seconds: of the start, a training included; after_seconds: of the prior; one thread",
        "steps": scoring.QUICK_STEPS if quick else "the schedule's",
    }


def measure(data: str, views: str, start: str, seed: int) -> dict[str, object]:
    """Errors before and after the prior."""
    frames = _frames(data, views, seed)
    begun = time.perf_counter()
    first = _start(frames, start, seed, scoring.quick_steps(data))
    between = time.perf_counter()
    rec = baselines.em_gaussian(frames, start=first, progress=False)
    seconds: dict[str, object] = {"start_seconds": between - begun, "after_seconds": time.perf_counter() - between}
    return scoring.errors("before", first, frames) | scoring.errors("after", rec, frames) | seconds


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds, a line per data set, views and start."""
    columns = ("before", "before_mirrored", "after", "after_turned", "after_mirrored", "after_seconds")
    return scoring.by_groups(("data", "views", "start"), columns, rows)


def _frames(data, views, seed):
    """The frames that are learned from: the first 80 % of the sequences, or all of a single one."""
    truth = datasets.load(data)
    if data in datasets.PASCAL3D:
        truth = truth[np.arange(_VIEWS_OF_MODELS) % len(truth)]
    if truth.points2d is not None and views == "complete":  # the classic sequences have a camera of their own
        return truth
    frames = datasets.make_views(truth, seed=seed, **_VIEWS[views])
    return frames.split()[0] if len(np.unique(frames.sequence)) > 1 else frames


def _start(frames: Landmarks, start: str, seed: int, steps: int | None) -> Reconstruction:
    if start in ("network", "network, original"):
        schedule = "default" if start == "network" else "original"
        net = fit(frames, schedule=schedule, steps=steps, seed=seed, progress=False)
        return reconstruct(frames, model=net, refine=False)
    if start == "rigid":
        return baselines.tomasi_kanade(frames)
    if start == "bmm":
        return baselines.bmm(frames, seed=seed, progress=False)
    rng = np.random.default_rng(seed)
    W = np.where(frames.visible[..., None], frames.points2d, 0.0)
    shapes = rng.normal(size=(*W.shape[:2], 3)) * np.std(W[frames.visible])
    return Reconstruction(shapes, cameras.random_cameras(len(W), rng), method="random")
