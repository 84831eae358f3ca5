"""What the default network and its shape prior make of each set, seen and unseen (chapter 10)."""

import time

from ..reconstruction import reconstruct
from ..training import fit
from .lab import scoring

QUESTION = "What do the defaults reach on each set: one pass, refined, and on unseen frames alone and adapted?"
_CHOSEN_ON = ("motion", "salsa")
_REPORTED = ("martial", "indian", "05")
_SEEDS = 3
_COLUMNS = ("one_pass", "refined", "unseen_one_pass", "unseen_alone", "unseen_adapted")


def cases(quick: bool) -> list[dict[str, object]]:
    """Data and seed; seeds outermost, so that a run that is cut short has all data sets."""
    if quick:
        return [{"data": "motion-small", "seed": 0}]
    return [{"data": d, "seed": seed} for seed in range(_SEEDS) for d in _CHOSEN_ON + _REPORTED]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "network": "the default, its default schedule",
        "seed": "of the cameras and of the training",
        "frames": "learned from: the first 80 % of the sequences; unseen: the others",
        "unseen": "alone: each frame on its own, under the prior that was learned from the others; adapted: with "
        "adapt=True, all unseen frames at once",
        "errors": scoring.ERRORS,
        "coverage": "share of points whose depth lies in its 90 % band, the sign of all depths free; width: the median "
        "of the whole band, over the root mean square distance of a shape's points from their centroid",
        "seconds": "fit_seconds: of the training, its prior included; refine_seconds: of the refinement; one thread",
        "steps": scoring.QUICK_STEPS if quick else "the schedule's",
    }


def measure(data: str, seed: int) -> dict[str, object]:
    """Errors of one network; the truth is used here only."""
    train, test = scoring.views(data, seed=seed)
    begun = time.perf_counter()
    net = fit(train, steps=scoring.quick_steps(data), seed=seed, progress=False)
    fitted = time.perf_counter()
    found = {"refined": reconstruct(train, model=net, progress=False)}
    refined = time.perf_counter()
    found |= {
        "one_pass": reconstruct(train, model=net, refine=False),
        "unseen_one_pass": reconstruct(test, model=net, refine=False),
        "unseen_alone": reconstruct(test, model=net, progress=False),
        "unseen_adapted": reconstruct(test, model=net, adapt=True, progress=False),
    }
    result: dict[str, object] = {}
    for key in _COLUMNS:
        frames = test if key.startswith("unseen") else train
        result |= scoring.errors(key, found[key], frames)
        if found[key].uncertainty is not None:
            result[f"{key}_coverage"], result[f"{key}_width"] = scoring.coverage(found[key], frames)
    return result | {"fit_seconds": fitted - begun, "refine_seconds": refined - fitted}


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds, a line for each set."""
    return scoring.by_groups(("data",), (*_COLUMNS, "refined_turned", "refined_mirrored"), rows)
