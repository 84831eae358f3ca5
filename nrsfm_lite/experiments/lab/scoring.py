"""How a network is trained and scored, and how the rows are summed up: the same in every experiment."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.stats import norm

from ... import cameras, datasets, metrics, quality
from ...data import Landmarks, Reconstruction
from ...model import Config, DeepNRSfM
from ...reconstruction import reconstruct
from ...training import SCHEDULES, Schedule, fit

QUICK_STEPS = 20
# To compare settings of the network itself: longer than the default schedule, and without its pull.
_LONG = replace(SCHEDULES["default"], steps=2700, pull=0.0)


@lru_cache
def describe(name: str) -> dict[str, int | str]:
    """Frames, points and a hash of the 3D points, so that a result can be traced to its data."""
    data = datasets.load(name)
    digest = hashlib.sha256(np.ascontiguousarray(data.points3d, dtype=np.float32).tobytes()).hexdigest()
    return {"frames": len(data), "points": data.n_points, "sha256": digest[:16]}


def score(net: DeepNRSfM, train: Landmarks, test: Landmarks) -> dict[str, float]:
    """Scores and errors of a trained network. The truth is used here, and nowhere else.

    Returns
    -------
    dict with all of `quality.scores` on the training frames and `image_unseen` (`image_error` of the other
    frames), then mean normalised 3D errors of the training frames: `seen` (one forward pass), `by_code`
    (refined by the code), `refined` (as `reconstruct` does); the same of the other frames, `unseen`,
    `by_code_unseen`, `refined_unseen`; `adapted_unseen` (the prior learned from them); and `other_hand`,
    the share of refined training frames that are mirrored against the others.
    """
    result = quality.scores(net, train) | {"image_unseen": quality.image_error(net, test)}

    def error(frames, **how):
        rec = reconstruct(frames, model=net, **how)
        return float(metrics.normalized_error(rec.shapes, frames.points3d).mean()), rec

    result["seen"], _ = error(train, refine=False)
    result["unseen"], _ = error(test, refine=False)
    result["by_code"], _ = error(train, refine="code")
    result["by_code_unseen"], _ = error(test, refine="code")
    result["refined"], rec = error(train)
    result["refined_unseen"], _ = error(test)
    result["adapted_unseen"], _ = error(test, adapt=True)
    result["other_hand"] = metrics.handedness(rec.shapes, train.points3d).mirrored
    return result


def quick_steps(data: str) -> int | None:
    """How many steps to train on the small data of quick runs; None, the schedule's own, on any other."""
    return QUICK_STEPS if data == "motion-small" else None


def default_schedule(rates: float = 1.0, **changes: Any) -> Schedule:
    """The default schedule with its learning rates times a factor, and other fields changed by name."""
    plan = SCHEDULES["default"]
    return replace(plan, rate=rates * plan.rate, muon_rate=rates * plan.muon_rate, **changes)


def views(data: str, seed: int = 0, **how: Any) -> tuple[Landmarks, Landmarks]:
    """Training frames (the first 80 % of the sequences) and unseen ones, each under its own random camera."""
    return datasets.make_views(datasets.load(data), seed=seed, **how).split()


def train_and_score(data: str, seed: int, how: dict[str, Any], **config: Any) -> tuple[DeepNRSfM, dict[str, Any]]:
    """The default network on views made as `how` says, and its errors; the truth is used for these only.

    Returns
    -------
    net, dict of mean normalised 3D errors: `seen` (training frames, one pass), `refined` (as `reconstruct`
    does), `unseen` and `refined_unseen` (the other frames), each of them again with `_hidden` for the hidden
    points alone (empty if there are none), and `shift`, the mean distance of the training frames' translations
    from the true ones, as a share of the object's largest extent.
    """
    train, test = views(data, **how)
    settings = Config(train.n_points, **config)
    net = fit(train, config=settings, steps=quick_steps(data), seed=seed, progress=False)
    result: dict[str, Any] = {}
    for key, frames, refine in [
        ("seen", train, False),
        ("unseen", test, False),
        ("refined", train, True),
        ("refined_unseen", test, True),
    ]:
        rec = reconstruct(frames, model=net, refine=refine)
        result |= hidden_errors(key, rec.shapes, frames)
        if key == "refined":
            missed = np.linalg.norm(rec.translations - frames.translations, axis=1)
            result["shift"] = float(missed.mean() / np.ptp(frames.points3d, axis=1).max())
    return net, result


def hidden_errors(key: str, S: np.ndarray, frames: Landmarks) -> dict[str, Any]:
    """Mean normalised error under `key`, and that of the hidden points alone under `key`_hidden."""
    whole = float(metrics.normalized_error(S, frames.points3d).mean())
    if frames.visible.all():
        return {key: whole, f"{key}_hidden": ""}
    hidden = metrics.normalized_error(S, frames.points3d, points=~frames.visible)
    return {key: whole, f"{key}_hidden": float(np.nanmean(hidden))}


ERRORS = (  # what the columns of `errors` are, for an experiment's conditions
    "mean normalised 3D error; _turned: with rotations only, after one mirror image for all frames; "
    "_mirrored: share of the frames of the other hand"
)


def errors(key: str, rec: Reconstruction, frames: Landmarks) -> dict[str, object]:
    """Mean normalised error under `key`, with rotations only under `key`_turned, and the share of mirrored frames."""
    return {
        key: float(metrics.normalized_error(rec.shapes, frames.points3d).mean()),
        f"{key}_turned": float(metrics.rotation_only_error(rec.shapes, frames.points3d).mean()),
        f"{key}_mirrored": metrics.handedness(rec.shapes, frames.points3d).mirrored,
    }


def coverage(
    rec: Reconstruction, frames: Landmarks, share: float = 0.9, points: np.ndarray | None = None
) -> tuple[float, float]:
    """Share of the points (all, or those of a mask) whose depth lies in its band, and the bands' median width.

    Seen by each frame's camera, so that nothing is aligned but the sign of all depths: a mirrored frame counts as
    missed. The width is that of the whole band, over the root mean square distance of the true points from their
    centroid.
    """
    truth = frames.points3d - frames.points3d.mean(1, keepdims=True)
    found, true = (cameras.camera_frame(*c)[..., 2] for c in ((rec.shapes, rec.cameras), (truth, frames.cameras)))
    half = norm.ppf((1 + share) / 2) * np.sqrt(rec.uncertainty[..., 2, 2])
    off = np.abs(np.sign((found * true).sum()) * found - true)
    size = np.sqrt(np.square(truth).sum(2).mean())
    chosen = np.ones_like(rec.visible) if points is None else points
    return float((off < half)[chosen].mean()), float(np.median(2 * half[chosen]) / size)


def variants(setting: str, values: Sequence[str], seeds: int, quick: bool) -> list[dict[str, object]]:
    """Cases of an experiment that compares the values of one setting of the network over seeds."""
    data, seeds = (["motion-small"], 1) if quick else (["motion", "martial"], seeds)
    return [{"data": d, setting: v, "seed": s} for d in data for v in values for s in range(seeds)]


def variant_conditions(setting: str, quick: bool) -> dict[str, object]:
    """What the cases of `variants` share."""
    return {"network": f"the default, but for {setting}", "steps": QUICK_STEPS if quick else _LONG.steps}


def score_variant(data: str, seed: int, **setting: Any) -> dict[str, float]:
    """`score` of the default network with one setting changed."""
    config = Config(datasets.load(data).n_points, **setting)
    train, test = views(data)
    net = fit(train, config=config, schedule=_LONG, steps=quick_steps(data), seed=seed, progress=False)
    return score(net, train, test)


def compare_variants(setting: str, rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds of the errors, for each data set and value of the setting, as text."""
    return by_groups(("data", setting), ("image_error", "by_code", "by_code_unseen"), rows)


def by_groups(keys: Sequence[str], columns: Sequence[str], rows: list[dict[str, str]]) -> str:
    """Mean ± standard deviation of some columns over the rows that agree in `keys`, a line for each group.

    >>> print(by_groups(["data"], ["seen"], [{"data": "motion", "seen": "0.1"}, {"data": "motion", "seen": "0.3"}]))
    data motion, 2 seeds: seen 0.2 ± 0.14
    """
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(tuple(f"{key} {row[key]}" for key in keys), []).append(row)
    return "\n".join(f"{', '.join(g)}, {len(r)} seeds: {mean_and_spread(r, columns)}" for g, r in groups.items())


def mean_and_spread(rows: list[dict[str, str]], keys: Sequence[str]) -> str:
    """Mean ± standard deviation of some columns, as text; empty cells are left out.

    >>> mean_and_spread([{"seen": "0.1", "shift": ""}, {"seen": "0.3", "shift": ""}], ["seen", "shift"])
    'seen 0.2 ± 0.14, shift not measured'
    """
    parts = []
    for key in keys:
        numbers = np.array([float(r[key]) for r in rows if r[key]])
        spread = numbers.std(ddof=1) if len(numbers) > 1 else 0
        parts.append(f"{key} {numbers.mean():.4g} ± {spread:.2g}" if len(numbers) else f"{key} not measured")
    return ", ".join(parts)
