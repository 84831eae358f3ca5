"""Which number, taken without ground truth, tells a good network from a bad one (chapter 10a)?"""

import numpy as np
from scipy.stats import spearmanr

from .. import metrics, quality
from ..reconstruction import reconstruct
from ..training import fit
from .lab import scoring

QUESTION = "Does the coherence of the last dictionary, or any other score without ground truth, rank networks?"
SCORES: tuple[str, ...] = ("coherence", "image_error", "consistency", "turn_consistency", "distortion")
SCORES += ("code_dimension", "negative_log_likelihood", "image_unseen")
_LOOKS = 12  # at a network while it trains
_FRAMES = 1000  # of each look
_SETTINGS: dict[str, dict[str, float]] = {
    "default": {},
    "half rates": {"rates": 0.5},
    "double rates": {"rates": 2},
    "no pull": {"pull": 0.0},
}


def cases(quick: bool) -> list[dict[str, object]]:
    """Data, setting of the schedule, and seed: 16 networks for each data set."""
    data, settings, seeds = (
        (["motion-small"], ["default"], 2) if quick else (["motion", "salsa", "martial"], _SETTINGS, 4)
    )
    return [{"data": d, "setting": s, "seed": i} for d in data for s in settings for i in range(seeds)]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "network": "the default",
        "settings": "the default schedule, its learning rates halved or doubled, and without the pull to the mean",
        "steps": scoring.QUICK_STEPS if quick else "the default schedule's",
        "looks": f"{_LOOKS} in each training, on {_FRAMES} frames drawn once; negative_log_likelihood and refined at "
        "the end only",
        "errors": "normalised 3D error; seen, unseen: one forward pass; refined: as `reconstruct` does",
    }


def measure(data: str, setting: str, seed: int) -> list[dict[str, object]]:
    """A row for each look at the network while it trains, and one for the end."""
    train, test = scoring.views(data)
    some, others = _draw(train), _draw(test)
    plan = scoring.default_schedule(**_SETTINGS[setting])
    steps = scoring.quick_steps(data) or plan.steps
    looks = {round(steps * (i + 1) / _LOOKS) for i in range(_LOOKS - 1)}
    rows = []

    def look(step, net):
        if step in looks:
            rows.append({"step": step, **_look(net, some, others)})

    net = fit(train, schedule=plan, steps=steps, seed=seed, progress=False, callback=look)
    refined = reconstruct(some, model=net)
    last = {"refined": metrics.normalized_error(refined.shapes, some.points3d).mean()}
    last["other_hand"] = metrics.handedness(refined.shapes, some.points3d).mirrored
    return [*rows, {"step": steps, **_look(net, some, others), **{k: float(v) for k, v in last.items()}}]


def rank(rows: list[dict[str, str]], score: str, error: str) -> dict[str, float]:
    """Spearman's correlation of a score and an error over the final networks of each data set: {data: rho}."""
    result = {}
    for data in dict.fromkeys(r["data"] for r in rows):
        final = [r for r in rows if r["data"] == data and r["refined"] != "nan"]
        result[data] = float(spearmanr([float(r[score]) for r in final], [float(r[error]) for r in final])[0])
    return result


def rank_within(rows: list[dict[str, str]], score: str) -> dict[str, float]:
    """The same over the looks at one network, mean over the networks of a data set: {data: rho}."""
    result = {}
    for data in dict.fromkeys(r["data"] for r in rows):
        runs: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for r in rows:
            if r["data"] == data and r[score] != "nan":
                runs.setdefault((r["setting"], r["seed"]), []).append((float(r[score]), float(r["seen"])))
        rhos = [spearmanr(*np.transpose(run))[0] for run in runs.values() if len(run) > 2]
        result[data] = float(np.mean(rhos)) if rhos else float("nan")
    return result


def report(rows: list[dict[str, str]]) -> str:
    """Rank correlation of each score with the errors of the final networks, and within trainings."""
    lines = []
    for score in SCORES:
        parts = [f"{e} {_words(rank(rows, score, e))}" for e in ("seen", "refined")]
        lines.append(f"{score:23s} " + "; ".join([*parts, f"within trainings {_words(rank_within(rows, score))}"]))
    return "\n".join(lines)


def _words(rhos):
    return ", ".join(f"{data} {rho:+.2f}" for data, rho in rhos.items())


def _draw(views):
    pick = np.random.default_rng(0).permutation(len(views))[:_FRAMES]
    return views[np.sort(pick)]


def _look(net, some, others):
    plain = reconstruct(some, model=net, refine=False)
    new = reconstruct(others, model=net, refine=False)
    return {
        **quality.scores(net, some),
        "image_unseen": quality.image_error(net, others),
        "seen": float(metrics.normalized_error(plain.shapes, some.points3d).mean()),
        "unseen": float(metrics.normalized_error(new.shapes, others.points3d).mean()),
        "refined": float("nan"),
        "other_hand": metrics.handedness(plain.shapes, some.points3d).mirrored,
    }
