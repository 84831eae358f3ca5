"""Soft threshold or ReLU: the paper's appendix finds no discernible difference."""

from ..model import Config
from . import material

QUESTION = "Does the soft threshold, which the paper derives, do better or worse than the ReLU that it runs?"


def cases(quick):
    """Data, threshold and seed."""
    data, seeds = (["motion-small"], 1) if quick else (["motion", "martial"], 5)
    return [{"data": d, "threshold": t, "seed": s} for d in data for t in ("relu", "soft") for s in range(seeds)]


def conditions(quick):
    """What all cases share."""
    return {"network": "the default, but for the threshold", "steps": _steps(quick) or "those of the default schedule"}


def measure(data, threshold, seed):
    """Errors of one network."""
    config = Config(material.load(data).n_points, threshold=threshold)
    return material.score(data, config, seed, _steps(data == "motion-small"))


def report(rows):
    """Mean and spread of each."""
    return material.compare(rows, "threshold")


def _steps(quick):
    return 60 if quick else None
