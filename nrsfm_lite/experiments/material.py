"""What the experiments measure on, and how a network is scored: the same everywhere."""

import hashlib
import os
import time
from functools import lru_cache
from pathlib import Path

import numpy as np

from .. import datasets, metrics, quality
from ..model import Config
from ..reconstruction import reconstruct
from ..training import fit

_CMU = ("salsa", "indian", "martial")
_QUICK_STEPS = 60


@lru_cache(maxsize=4)
def load(name):
    """Landmarks with points3d: "motion", "motion-small", or a folder of `cmu_bvh`, "martial", "salsa" or "indian".

    Raises FileNotFoundError, with a sentence, if real data is asked for and NRSFM_DATA does not lead to it.
    """
    if name == "motion":
        return datasets.make_motion(4000, seed=0)
    if name == "motion-small":
        return datasets.make_motion(600, seed=0)
    if name not in _CMU:
        raise KeyError(f"unknown data {name!r}; there are motion, motion-small, {', '.join(_CMU)}.")
    folder = Path(os.environ.get("NRSFM_DATA", Path.home() / ".cache/nrsfm_lite")) / "cmu_bvh" / name
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; set NRSFM_DATA to a folder that holds cmu_bvh/{name}.")
    return datasets.load_bvh(folder, joints=datasets.CMU_BODY)


@lru_cache
def describe(name):
    """Frames, points and a hash of the 3D points, so that a result can be traced to its data."""
    data = load(name)
    digest = hashlib.sha256(np.ascontiguousarray(data.points3d, dtype=np.float32).tobytes()).hexdigest()
    return {"frames": len(data), "points": data.n_points, "sha256": digest[:16]}


def score(data, seed, config=None, schedule="default", steps=None, threads=1, checkpoint=None):
    """Train on the first 80 % of the sequences and measure on those and on the rest.

    One random orthographic camera per frame, the same for every seed of the training. The truth is
    used to measure, and nowhere else.

    Returns
    -------
    dict with `train_seconds`, all of `quality.scores` on the training frames, `image_unseen` (`image_error` of
    the other frames), `seen` and `unseen` (mean normalised 3D error of training and other frames, one forward
    pass), `refined` and `refined_unseen` (after the per-frame refinement), and `other_hand` (share of training
    frames of the other handedness).
    """
    train, test = views(data)
    start = time.perf_counter()
    options = {"schedule": schedule, "steps": steps, "threads": threads, "checkpoint": checkpoint}
    net = fit(train, config=config, seed=seed, progress=False, **options)
    result = {"train_seconds": time.perf_counter() - start}
    result |= quality.scores(net, train) | {"image_unseen": quality.image_error(net, test)}
    for label, frames in (("", train), ("_unseen", test)):
        plain = reconstruct(frames, model=net, refine=False)
        result[label[1:] or "seen"] = metrics.normalized_error(plain.shapes, frames.points3d).mean()
        refined = reconstruct(frames, model=net)
        result["refined" + label] = metrics.normalized_error(refined.shapes, frames.points3d).mean()
        if not label:
            result["other_hand"] = metrics.handedness(refined.shapes, frames.points3d)
    return {k: float(v) for k, v in result.items()}


def views(data):
    """Training and unseen frames, each under its own random camera."""
    return datasets.make_views(load(data), seed=0).split()


def variants(setting, values, seeds, quick):
    """Cases of an experiment that compares the values of one setting of the network over seeds."""
    data, seeds = (["motion-small"], 1) if quick else (["motion", "martial"], seeds)
    return [{"data": d, setting: v, "seed": s} for d in data for v in values for s in range(seeds)]


def variant_conditions(setting, quick):
    """What the cases of `variants` share."""
    return {"network": f"the default, but for {setting}", "steps": _QUICK_STEPS if quick else "the default schedule's"}


def score_variant(data, seed, **setting):
    """`score` of the default network with one setting changed."""
    config = Config(load(data).n_points, **setting)
    return score(data, seed, config, steps=_QUICK_STEPS if data == "motion-small" else None)


def compare_variants(setting, rows):
    """Mean and spread over seeds of the errors, for each data set and value of the setting, as text."""
    lines = []
    groups = dict.fromkeys((r["data"], r[setting]) for r in rows)
    for data, value in groups:
        chosen = [r for r in rows if (r["data"], r[setting]) == (data, value)]
        parts = []
        for key in ("image_error", "refined", "refined_unseen"):
            numbers = np.array([float(r[key]) for r in chosen])
            parts.append(f"{key} {numbers.mean():.4f} ± {numbers.std(ddof=1) if len(numbers) > 1 else 0:.4f}")
        lines.append(f"{data}, {setting} {value}, {len(chosen)} seeds: " + ", ".join(parts))
    return "\n".join(lines)
