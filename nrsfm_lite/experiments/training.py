"""The package's schedule beside the authors': time, errors and their spread over seeds (chapter 10)."""

import numpy as np

from . import material

QUESTION = "How fast and how well does the default schedule train, beside the original one, and over seeds?"
_SEEDS = {  # (schedule, data): how many seeds
    ("original", "martial"): 3,
    ("original", "salsa"): 1,
    ("original", "indian"): 1,
    ("original", "motion"): 1,
    ("default", "martial"): 5,
    ("default", "salsa"): 5,
    ("default", "indian"): 3,
    ("default", "motion"): 5,
}


def cases(quick):
    """Schedule, data and seed."""
    seeds = {("original", "motion-small"): 1, ("default", "motion-small"): 1} if quick else _SEEDS
    return [{"schedule": s, "data": d, "seed": i} for (s, d), n in seeds.items() for i in range(n)]


def conditions(quick):
    """What all cases share."""
    return {
        "network": "the default",
        "steps": "60" if quick else "the schedule's",
        "threads": 1,
        "frames": "training: the first 80 % of the sequences; unseen: the rest",
    }


def measure(schedule, data, seed):
    """One training, its scores and errors."""
    return material.score(data, seed, schedule=schedule, steps=60 if data == "motion-small" else None)


def report(rows):
    """Mean and spread over seeds, a line per schedule and data set."""
    lines = []
    for schedule, data in dict.fromkeys((r["schedule"], r["data"]) for r in rows):
        chosen = [r for r in rows if (r["schedule"], r["data"]) == (schedule, data)]
        parts = []
        for key in ("train_seconds", "seen", "refined", "unseen", "refined_unseen"):
            numbers = np.array([float(r[key]) for r in chosen])
            parts.append(f"{key} {numbers.mean():.4g} ± {numbers.std(ddof=1) if len(numbers) > 1 else 0:.2g}")
        worst = max(float(r["refined"]) for r in chosen) / min(float(r["refined"]) for r in chosen)
        lines.append(f"{schedule:8s} {data:7s} {len(chosen)} seeds: {', '.join(parts)}; worst / best {worst:.2f}")
    return "\n".join(lines)
