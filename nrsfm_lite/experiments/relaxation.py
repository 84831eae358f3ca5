"""One weight per entry of a block, or one per entry of all blocks: the paper's β and the authors'."""

from ..model import Config
from . import material

QUESTION = "Is the code better read off the last blocks by the paper's six shared weights, or by a full linear map?"


def cases(quick):
    """Data, beta and seed."""
    data, seeds = (["motion-small"], 1) if quick else (["motion", "martial"], 3)
    return [{"data": d, "beta": t, "seed": s} for d in data for t in ("full", "shared") for s in range(seeds)]


def conditions(quick):
    """What all cases share."""
    return {"network": "the default, but for the beta", "steps": _steps(quick) or "those of the default schedule"}


def measure(data, beta, seed):
    """Errors of one network."""
    config = Config(material.load(data).n_points, beta=beta)
    return material.score(data, config, seed, _steps(data == "motion-small"))


def report(rows):
    """Mean and spread of each."""
    return material.compare(rows, "beta")


def _steps(quick):
    return 60 if quick else None
