"""What each classical method costs as the frames grow, up to where it refuses (chapter 02)."""

import time

from .. import baselines, datasets, metrics
from ..baselines.shared import limits
from .lab.process import apart, peak_mb

QUESTION = "How do time and memory of the classical methods grow with the number of frames?"
_FRAMES = (100, 300, 1000, 3000, 10_500)
_METHODS = ("tomasi_kanade", "pta", "bmm", "sfc", "em_gaussian", "ksta", "riks", "cns", "nlo", "sps")
_LONG = 600  # seconds by a method's own estimate, above which it refuses here; users are granted an hour


def cases(quick: bool) -> list[dict[str, object]]:
    """Frames and method; the small sizes first."""
    frames = (60,) if quick else _FRAMES
    methods = _METHODS[:2] if quick else _METHODS
    return [{"data": f"motion-{n}", "method": m} for n in frames for m in methods]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "views": "31 points, a random camera per frame; own parameters at their defaults",
        "outcome": "done; not converged, by the method's own rule; or refused beforehand, with the method's words",
        "refusal": f"by memory, or if the method expects to take more than {_LONG} s (by default an hour)",
        "work_mb": "growth of the peak memory during the call; a fresh process per case, one thread",
        "per_frame": "normalised error per frame, no scale fitted",
    }


def measure(data: str, method: str) -> dict[str, object]:
    """Seconds, megabytes and error."""
    return apart(_reconstruct, data, method, one_thread=True)


def report(rows: list[dict[str, str]]) -> str:
    """One line per case."""
    return "\n".join(
        f"{r['data']:13s} {r['method']:14s} {r['method_seconds'] or '-':>8s} s {r['work_mb'] or '-':>8s} MB, "
        f"error {r['per_frame'] or '-':8s} {r['outcome']}"
        for r in rows
    )


def _reconstruct(data, method):
    views = datasets.make_views(datasets.load(data))
    baselines.tomasi_kanade(views[:20], progress=False)  # libraries load on first use
    limits.LONG = _LONG  # in this process only
    before, start = peak_mb(), time.perf_counter()
    try:
        rec = getattr(baselines, method)(views, progress=False)
    except limits.TooLarge as refusal:
        return {"method_seconds": "", "work_mb": "", "per_frame": "", "outcome": f"refused: {refusal}"}
    seconds = time.perf_counter() - start
    return {
        "method_seconds": seconds,
        "work_mb": peak_mb() - before,
        "per_frame": float(metrics.normalized_error(rec.shapes, views.points3d, scale=False).mean()),
        "outcome": "done" if rec.converged else "not converged",
    }
