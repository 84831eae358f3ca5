"""The package's schedule beside the authors': time, errors and their spread over seeds (chapter 10)."""

import time

from ..reconstruction import reconstruct
from ..training import fit
from .lab import scoring

QUESTION = "How fast and how well does the default schedule train, beside the original one, and over seeds?"
_SEEDS = {  # (schedule, data): how many seeds
    ("default", "martial"): 5,
    ("default", "salsa"): 5,
    ("default", "motion"): 5,
    ("default", "indian"): 3,
    ("original", "martial"): 3,
    ("original", "salsa"): 1,
    ("original", "indian"): 1,
    ("original", "motion"): 1,
}


def cases(quick: bool) -> list[dict[str, object]]:
    """Schedule, data and seed."""
    seeds = {("default", "motion-small"): 1, ("original", "motion-small"): 1} if quick else _SEEDS
    return [{"schedule": s, "data": d, "seed": i} for (s, d), n in seeds.items() for i in range(n)]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "network": "the default",
        "steps": scoring.QUICK_STEPS if quick else "the schedule's",
        "threads": 1,
        "frames": "training: the first 80 % of the sequences; unseen: the rest",
        "time": "train_seconds: fit; refine_seconds: reconstruct of the training frames with the trained network",
    }


def measure(schedule: str, data: str, seed: int) -> dict[str, object]:
    """One training, its scores and errors, and the time of both halves of `reconstruct`."""
    train, test = scoring.views(data)
    start = time.perf_counter()
    net = fit(train, schedule=schedule, seed=seed, steps=scoring.quick_steps(data), progress=False)
    train_seconds = time.perf_counter() - start
    start = time.perf_counter()
    reconstruct(train, model=net)
    seconds: dict[str, object] = {"train_seconds": train_seconds, "refine_seconds": time.perf_counter() - start}
    return seconds | scoring.score(net, train, test)


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds, a line per schedule and data set."""
    return scoring.by_groups(
        ("schedule", "data"), ("train_seconds", "seen", "refined", "unseen", "refined_unseen"), rows
    )
