"""How fast a trained network takes in many frames, and whether its memory stays flat."""

import time

import numpy as np
import torch

from ..model import DeepNRSfM
from ..reconstruction import reconstruct
from ..training import learn_prior
from .lab.process import apart, peak_mb

QUESTION = "How many frames per second does `reconstruct` take in with a trained network, and how much memory?"
_POINTS = 31
_PRIOR_FRAMES = 4000


def cases(quick: bool) -> list[dict[str, object]]:
    """Number of frames, with and without the refinement of each frame."""
    return [{"frames": n, "refine": r} for r in (False, True) for n in ((300,) if quick else (10_000, 100_000))]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "network": "the default, 31 points, float32, a prior of eight kinds; its weights do not matter",
        "work_mb": "growth of the peak memory during the call, less the arrays it returns; a fresh process per case",
    }


def measure(frames: int, refine: bool) -> dict[str, object]:
    """Seconds and megabytes, measured in a process of its own, since a peak never goes down again."""
    return apart(_infer, frames, refine)


def report(rows: list[dict[str, str]]) -> str:
    """One line per case."""
    return "\n".join(
        f"{int(r['frames']):7d} frames, refine={r['refine']}: {float(r['frames_per_s']):8.0f} frames/s, "
        f"{float(r['work_mb']):.0f} MB to work with, {float(r['peak_mb']):.0f} MB in all"
        for r in rows
    )


def _infer(frames, refine):
    W = np.random.default_rng(0).normal(size=(frames, _POINTS, 2))
    net = DeepNRSfM(n_points=_POINTS).eval()
    some = torch.as_tensor(W[:_PRIOR_FRAMES])
    visible = torch.ones(some.shape[:2], dtype=torch.bool)
    net.prior = learn_prior(net, *net.normalize(some, visible)[:2], visible)  # as `fit` leaves it, all kinds in use
    reconstruct(W[:100], model=net, refine=refine)  # libraries load on first use
    before = peak_mb()
    start = time.perf_counter()
    rec = reconstruct(W, model=net, refine=refine)
    seconds = time.perf_counter() - start
    returned = sum(a.nbytes for a in (rec.shapes, rec.cameras, rec.translations, rec.visible)) / 1e6
    peak = peak_mb()
    return {"frames_per_s": frames / seconds, "work_mb": peak - before - returned, "peak_mb": peak}
