"""Missing points: how much of the shape is left when 1 to 7 of 31 points, a third, or half are hidden (chapter 11)."""

from .. import baselines
from ..data import Landmarks
from ..reconstruction import reconstruct
from ..training import fit
from .lab import scoring

QUESTION = "How does the error grow with the number of hidden points, and what should the encoder see in their place?"
_HIDDEN = ("0", "1", "2", "3", "4", "5", "6", "7", "0.3", "0.5", "self")
_BETWEEN = ("1", "2", "4", "5", "6", "self")
_METHODS = ("zero", "scaled", "completed")
_CLASSICAL = ("rigid", "em_gaussian")


def cases(quick: bool) -> list[dict[str, object]]:
    """Data, what is hidden, method and seed."""
    if quick:
        methods = ("likely", *_METHODS, *_CLASSICAL)
        return [{"data": "motion-small", "hidden": "7", "method": m, "seed": 0} for m in methods]
    rows = [(h, "likely", seed) for seed in range(3) for h in _HIDDEN]
    rows += [("7", m, seed) for seed in range(3) for m in _METHODS]
    rows += [(h, m, 0) for m in _CLASSICAL for h in _HIDDEN]
    rows.sort(key=lambda row: row[0] in _BETWEEN)  # the levels between the others come last
    return [{"data": "martial", "hidden": h, "method": m, "seed": s} for h, m, s in rows]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "hidden": "a whole number m: 1 to m points per frame, uniformly; a share: so many in every frame; self: "
        "points that the body's own rods are in front of",
        "method": "likely, zero, scaled: the network, and what its encoder gets for a hidden point (Config.fill); "
        "completed: all hidden points completed first, then taken for visible; rigid: one rigid shape after "
        "completion; em_gaussian: the shape prior from that start, no network",
        "errors": "normalised 3D error over all points; _hidden: over the hidden ones, in the same unit",
        "steps": scoring.QUICK_STEPS if quick else "the default schedule's",
    }


def measure(data: str, hidden: str, method: str, seed: int) -> dict[str, object]:
    """Errors of one training, or of the rigid baseline."""
    missing = hidden if hidden == "self" else float(hidden) if "." in hidden else int(hidden)
    if method in ("likely", "zero", "scaled"):
        return scoring.train_and_score(data, seed, {"missing": missing}, fill=method)[1]
    train, test = scoring.views(data, missing=missing)
    keys = ("seen", "unseen", "refined", "refined_unseen")
    names = [*(k for key in keys for k in (key, f"{key}_hidden")), "shift"]
    result: dict[str, object] = {name: "" for name in names}
    if method in _CLASSICAL:
        baseline = baselines.tomasi_kanade if method == "rigid" else baselines.em_gaussian
        return result | scoring.hidden_errors("seen", baseline(train, progress=False).shapes, train)
    net = fit(_complete(train), steps=scoring.quick_steps(data), seed=seed, progress=False)
    for key, frames in (("refined", train), ("refined_unseen", test)):
        S = reconstruct(_complete(frames), model=net).shapes
        result |= scoring.hidden_errors(key, S, frames)
    return result


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds, a line per number of hidden points and method."""
    return scoring.by_groups(("hidden", "method"), ("seen", "refined", "refined_hidden", "refined_unseen"), rows)


def _complete(frames):
    return Landmarks(baselines.complete(frames))
