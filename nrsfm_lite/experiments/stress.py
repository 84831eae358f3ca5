"""Does training survive what no one should ask of it?"""

from collections import Counter

import numpy as np

from .. import datasets, metrics
from ..data import Landmarks
from ..model import Config
from ..reconstruction import reconstruct
from ..training import fit
from .lab import scoring

QUESTION = "Does any learning rate, batch, depth or degenerate data lead to a number that is not one?"
_STEPS = 60


def cases(quick: bool) -> list[dict[str, object]]:
    """Kind of data, factor on the learning rates, batch and depth."""
    kinds = ("fifty frames", "flat") if quick else ("body", "fifty frames", "flat", "repeated points")
    rates, batches, depths = ((10.0,), (8,), (2, 16)) if quick else ((0.1, 1.0, 10.0), (8, 256, 2048), (2, 6, 16))
    return [
        {"kind": k, "rates": r, "batch": b, "depth": d} for k in kinds for r in rates for b in batches for d in depths
    ]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "data": "600 frames of a generated body; fifty of them; the body pressed flat; ten points at one place",
        "steps": f"{_STEPS}; at batch 2048 there are no more than 600 frames in a batch",
    }


def measure(kind: str, rates: float, batch: int, depth: int) -> dict[str, object]:
    """Whether everything is finite, or the sentence that says why not; and the error, for the curious."""
    data = _data(kind)
    views = datasets.make_views(data, seed=0)
    plan = scoring.default_schedule(rates, steps=_STEPS, batch=batch)
    try:
        net = fit(views, config=Config(31, depth), schedule=plan, progress=False)
        rec = reconstruct(views, model=net)
    except (ValueError, FloatingPointError) as refused:
        return {"outcome": str(refused), "refined": float("nan")}
    finite = all(np.isfinite(a).all() for a in (rec.shapes, rec.cameras, rec.translations))
    finite = finite and all(np.isfinite(a).all() for a in net.to_arrays()[1].values())
    error = float(metrics.normalized_error(rec.shapes, data.points3d).mean()) if finite else float("nan")
    return {"outcome": "finite" if finite else "not finite", "refined": error}


def report(rows: list[dict[str, str]]) -> str:
    """How often each outcome came."""
    return "\n".join(f"{n:4d} {outcome}" for outcome, n in Counter(r["outcome"] for r in rows).most_common())


def _data(kind):
    data = datasets.make_motion(50 if kind == "fifty frames" else 600, seed=0)
    S = data.points3d.copy()
    if kind == "flat":
        S[..., 2] = 0
    if kind == "repeated points":
        S[:, 1:10] = S[:, :1]
    return Landmarks(points3d=S, sequence=data.sequence, names=data.names, edges=data.edges, name=kind)
