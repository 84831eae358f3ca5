"""Short films, hidden points, noise: ten of each kind, and what tells a good result from a bad one (chapter 10a)."""

from typing import Any

import numpy as np
from scipy.stats import spearmanr

from .. import baselines, cameras, datasets, quality
from ..data import Landmarks, Reconstruction
from ..reconstruction import reconstruct
from .lab import scoring

QUESTION = "How good are films of few frames, of hidden points, and of noise, and what tells so without the truth?"
_VIEWS: dict[str, dict[str, Any]] = {
    "complete": {},
    "5 % noise": {"noise": 0.05},
    "3 hidden": {"missing": 3},
    "30 % hidden": {"missing": 0.3},
    "50 % hidden": {"missing": 0.5},
    "self-occluded": {"missing": "self"},
    "weak perspective": {"projection": "weak_perspective"},
}
_SHORT = (20, 50, 150)
_CLASSICAL = ("em_gaussian bmm", "em_gaussian", "bmm", "cns")
_DEFAULT = "reconstruct"
_SEEDS = 10
SCORES = ("doubt", "agreement", "negative_log_likelihood", "coherence")


def cases(quick: bool) -> list[dict[str, object]]:
    """Data, views, method and seed; seeds outermost, so that a run that is cut short has all kinds."""
    if quick:
        return [{"data": "motion-40", "views": v, "method": _DEFAULT, "seed": 0} for v in ("complete", "self-occluded")]
    rows = [(f"motion-{n}", "complete", m) for n in _SHORT for m in (_DEFAULT, *_CLASSICAL)]
    rows += [("motion-100", v, _DEFAULT) for v in _VIEWS if "hidden" in v or "noise" in v]
    rows += [("motion-600", v, _DEFAULT) for v in ("complete", "self-occluded", "weak perspective")]
    rows += [("martial", v, _DEFAULT) for v in _VIEWS if v.endswith(" hidden")]
    return [{"data": d, "views": v, "method": m, "seed": s} for s in range(_SEEDS) for d, v, m in rows]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "seed": "of the motion, where it is generated (the hash below is that of seed 0), of the cameras, of what is "
        "hidden, and of the training",
        "method": "reconstruct: its defaults, with occlusion=True where the views are self-occluded, and told of weak "
        "perspective; em_gaussian, from one rigid shape or from bmm, bmm and cns at their defaults",
        "errors": scoring.ERRORS,
        "doubt": "how far points may be off by their own covariances, in the mean, as a share of the shapes' size",
        "coverage": "share of points whose depth lies in its 90 % band, the sign of all depths free; hidden_coverage: "
        "of the hidden points",
        "own_hand": "whether the depths have the right sign as they are; what occlusion=True is for",
        "steps": scoring.QUICK_STEPS if quick else "the schedule's",
    }


def measure(data: str, views: str, method: str, seed: int) -> dict[str, object]:
    """Errors of one film, and what the result says of itself."""
    frames = _frames(data, views, seed)
    empty: dict[str, object] = dict.fromkeys((*SCORES, "coverage", "hidden_coverage", "own_hand"), "")
    if method != _DEFAULT:
        name, *start = method.split()
        rec = getattr(baselines, name)(frames, progress=False, **({"start": start[0]} if start else {}))
        return scoring.errors("error", rec, frames) | empty
    occlusion, projection = views == "self-occluded", _VIEWS[views].get("projection")
    steps = scoring.QUICK_STEPS if data == "motion-40" else None
    rec = reconstruct(frames, seed=seed, steps=steps, projection=projection, occlusion=occlusion, progress=False)
    result: dict[str, object] = scoring.errors("error", rec, frames)
    result |= {
        "doubt": rec.doubt,
        "agreement": "" if rec.agreement is None else rec.agreement,
        "negative_log_likelihood": quality.negative_log_likelihood(rec.model, frames),
        "coherence": rec.coherence,
        "coverage": scoring.coverage(rec, frames)[0],
        "hidden_coverage": "" if frames.visible.all() else scoring.coverage(rec, frames, points=~frames.visible)[0],
        "own_hand": _own_hand(rec, frames) if occlusion else "",
    }
    return result


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds for each kind, films that failed, and how each score ranks the films."""
    text = scoring.by_groups(("data", "views", "method"), ("error", "error_turned", "error_mirrored", "coverage"), rows)
    ours = [r for r in rows if r["method"] == _DEFAULT]
    for data, views in dict.fromkeys((r["data"], r["views"]) for r in ours):
        errors = np.array([float(r["error"]) for r in ours if (r["data"], r["views"]) == (data, views)])
        failed = int((errors > 2 * np.median(errors)).sum())
        text += f"\n{data}, {views}: {failed} of {len(errors)} above twice the median, {np.median(errors):.4f}"
    for score in SCORES:
        n, rho = rank(ours, score)
        if n > 2:
            text += f"\nrank correlation of {score} with the error, {n} films: {rho:.2f}"
            text += f"; within a kind {rank_within(ours, score):.2f}"
    hands = [r["own_hand"] == "True" for r in ours if r["own_hand"]]
    return text + (f"\nhand right by occlusion: {sum(hands)} of {len(hands)}" if hands else "")


def rank(rows: list[dict[str, str]], score: str) -> tuple[int, float]:
    """How many films have a score, and Spearman's correlation of it and the error over them; nan for fewer than 3."""
    pairs = np.array([(float(r[score]), float(r["error"])) for r in rows if r[score]])
    return len(pairs), float(spearmanr(*pairs.T).statistic) if len(pairs) > 2 else float("nan")


def rank_within(rows: list[dict[str, str]], score: str) -> float:
    """The same among films of one kind, data and views: the mean over all kinds that have at least 3 such films."""
    kinds = dict.fromkeys((r["data"], r["views"]) for r in rows)
    each = [rank([r for r in rows if (r["data"], r["views"]) == kind], score) for kind in kinds]
    return float(np.mean([rho for n, rho in each if n > 2] or float("nan")))


def _frames(data: str, views: str, seed: int) -> Landmarks:
    how = _VIEWS[views]
    if data.startswith("motion-"):
        motion = datasets.make_motion(int(data.removeprefix("motion-")), seed=seed)
        return datasets.make_views(motion, seed=seed, **how)
    return scoring.views(data, seed=seed, **how)[0]


def _own_hand(rec: Reconstruction, frames: Landmarks) -> bool:
    """Whether the depths have the right sign as they are."""
    return bool(
        (cameras.nearness(rec.shapes, rec.cameras) * cameras.nearness(frames.points3d, frames.cameras)).sum() > 0
    )
