"""How often the costly first steps are taken within one public call: `python -m tests.count_calls` prints a table.

Image points are parsed, checked and centred once, behind one door (`images.parse`), and everything after it works
on what came out. Before there was that door, the same calls parsed up to twelve times:

    function                     reconstruct  bmm  tomasi_kanade  nlo  scores
    as_points                              4    2              2    3      12
    check_visible_finite                   5    2              2    3      12
    center                                 5    4              4    6       7
    normalize                              2    -              -    -       6
    fill                                   2    1              -    1       6
"""

import sys
import threading
from collections import Counter
from collections.abc import Callable
from inspect import unwrap
from types import CodeType, FrameType
from typing import Any

import nrsfm_lite as nl
from nrsfm_lite import checks, image_prior, images, normalizer

COUNTED = {
    "parse": images.parse,
    "check_visible_finite": checks.check_visible_finite,
    "center": normalizer.center,
    "normalize": normalizer.Normalizer.normalize,
    "fill": image_prior.fill,
}
_FRAMES = 60
_STEPS = 5


def count(function: Callable[..., Any], *arguments: Any, **named: Any) -> Counter[str]:
    """How often each of `COUNTED` runs while function(*arguments, **named) does.

    The interpreter reports every function that starts, so it does not matter by which name a caller imported it.
    """
    names: dict[CodeType, str] = {unwrap(f).__code__: name for name, f in COUNTED.items()}
    counts: Counter[str] = Counter()

    def notice(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code in names:
            counts[names[frame.f_code]] += 1

    before = sys.getprofile()
    threading.setprofile(notice)  # for threads that start meanwhile
    sys.setprofile(notice)
    try:
        function(*arguments, **named)
    finally:
        sys.setprofile(before)
        threading.setprofile(None)
    return counts


def table() -> dict[str, Counter[str]]:
    """The counts for one call each of some public functions, of frames with hidden points."""
    motion = nl.datasets.make_motion(_FRAMES, actions=["walk"], seed=0)
    views = nl.datasets.make_views(motion, seed=0, missing=3)
    calls = {"reconstruct": count(nl.reconstruct, views, steps=_STEPS, seed=0, progress=False)}
    for name, how in {"bmm": {"progress": False}, "tomasi_kanade": {}, "nlo": {"progress": False}}.items():
        calls[name] = count(getattr(nl.baselines, name), views, **how)
    calls["scores"] = count(nl.quality.scores, nl.fit(views, steps=_STEPS, seed=0, progress=False), views)
    return calls


def main() -> None:
    """Print the table."""
    calls = table()
    print(" " * 22 + "".join(f"{name:>15s}" for name in calls))
    for name in COUNTED:
        print(f"{name:22s}" + "".join(f"{counts[name]:15d}" for counts in calls.values()))


if __name__ == "__main__":
    main()
