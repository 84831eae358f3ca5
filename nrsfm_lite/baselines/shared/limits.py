"""Progress, the time a user grants, and a refusal before a machine is brought down."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import psutil
from tqdm import tqdm

from ... import checks

Thing = TypeVar("Thing")

_CGROUP = Path("/sys/fs/cgroup")
_CONTAINER = (  # per version of Linux' control groups: folder, limit, usage
    ("", "memory.max", "memory.current"),
    ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
)
_SHARE = 0.8  # of the free memory that a method may take
LONG = 3600  # seconds that nobody is made to wait unasked


class TooLarge(ValueError):
    """A method's refusal beforehand."""


class Watch:
    """Shows the progress of a method's loops, and ends them when its time is over.

    Parameters
    ----------
    method : str
    max_seconds : float or None, for all loops of the method together
    progress : bool
    """

    def __init__(self, method: str, max_seconds: float | None = None, progress: bool = True) -> None:
        if max_seconds is not None:
            max_seconds = checks.at_least("max_seconds", max_seconds, above=True)
        self.method, self.progress = method, checks.truth("progress", progress)
        self.end = None if max_seconds is None else time.monotonic() + max_seconds

    @property
    def over(self) -> bool:
        """True once the time is up."""
        return self.end is not None and time.monotonic() > self.end

    def steps(self, things: Iterable[Thing] | int, what: str) -> Iterator[Thing | int]:
        """The items of `things` (or of range(things)) until they or the time are over; the first one always."""
        items: Iterable[Thing | int] = range(things) if isinstance(things, int) else things
        bar = tqdm(items, desc=f"{self.method}: {what}", disable=not self.progress, leave=False)
        for thing in bar:
            yield thing
            if self.over:
                bar.close()
                return


def check_cost(
    method: str,
    frames: int,
    gigabytes: float,
    seconds: float = 0,
    max_seconds: float | None = None,
    advice: str = "",
) -> None:
    """Refuse what this machine cannot do, or not within an hour unless a limit is given.

    Parameters
    ----------
    method, frames : for the message
    gigabytes, seconds : float
        Estimates. Memory counts the large arrays; times were measured on one core of a common processor.
    max_seconds : float or None
        What the user gave; with a limit, the time is no reason to refuse.
    advice : str, a sentence on what to do instead

    Raises
    ------
    TooLarge, a ValueError
    """
    free = _free_bytes() / 2**30
    if gigabytes > _SHARE * free:
        raise TooLarge(
            f"{method} would need about {gigabytes:.1f} GB of memory for {frames} frames, and {free:.1f} GB are free."
            f" {advice}".rstrip()
        )
    if max_seconds is None and seconds > LONG:
        raise TooLarge(
            f"{method} would take up to about {seconds / 3600:.1f} hours for {frames} frames; give max_seconds to have "
            f"the best result of that time. {advice}".rstrip()
        )


def choose_rank(rank: Any, usual: int, least: int, frames: int, points: int) -> int:
    """The user's rank, checked, or the usual one; three components per atom fit into `points` and 2 · `frames`."""
    most = min(points, 2 * frames) // 3
    rank = min(usual, most) if rank is None else rank
    return checks.whole("rank", rank, least, most, f" for {frames} frames and {points} points")


def choose_components(name: str, share: Any, rank: int, frames: int) -> int:
    """How many basis functions of the frames a share of them is; at least the rank."""
    number = checks.at_least(name, share, above=True)
    if number > 1:
        raise ValueError(f"{name}={share!r}; expected a share of the frames, above 0 and at most 1.")
    return max(rank, round(number * frames))


def _free_bytes() -> float:
    """Memory that is free, inside a container also of its own share."""
    return min(psutil.virtual_memory().available, *(_free_in(*files) for files in _CONTAINER))


def _free_in(folder: str, limit: str, usage: str) -> float:
    group = _CGROUP / folder
    try:
        free = int((group / limit).read_text()) - int((group / usage).read_text())
        statistics = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        # Copies of files in memory count as used, but are given up as soon as somebody needs the room.
        return max(free + int(statistics.get("inactive_file", 0)), 0)
    except (OSError, ValueError):  # no container, or one without a limit
        return math.inf
