"""Progress, the time a user grants, and a refusal before a machine is brought down."""

import time

import psutil
from tqdm.auto import tqdm

_SHARE = 0.8  # of the free memory that a method may take
LONG = 3600  # seconds that nobody is made to wait unasked


class Watch:
    """Shows the progress of a method's loops, and ends them when its time is over.

    Parameters
    ----------
    method : str
    max_seconds : float or None, for all loops of the method together
    progress : bool
    """

    def __init__(self, method, max_seconds=None, progress=True):
        if max_seconds is not None and not max_seconds > 0:
            raise ValueError(f"max_seconds={max_seconds}; expected a positive number of seconds, or None.")
        self.method, self.progress = method, progress
        self.end = None if max_seconds is None else time.monotonic() + max_seconds

    @property
    def over(self):
        """True once the time is up."""
        return self.end is not None and time.monotonic() > self.end

    def steps(self, things, what):
        """The items of `things` (or of range(things)) until they or the time are over; the first one always."""
        things = range(things) if isinstance(things, int) else things
        bar = tqdm(things, desc=f"{self.method}: {what}", disable=not self.progress, leave=False)
        for thing in bar:
            yield thing
            if self.over:
                bar.close()
                return


def check_cost(method, frames, gigabytes, seconds=0, max_seconds=None, advice=""):
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
    ValueError
    """
    free = psutil.virtual_memory().available / 2**30
    if gigabytes > _SHARE * free:
        raise ValueError(
            f"{method} would need about {gigabytes:.1f} GB of memory for {frames} frames, and {free:.1f} GB are free."
            f" {advice}".rstrip()
        )
    if max_seconds is None and seconds > LONG:
        raise ValueError(
            f"{method} would take up to about {seconds / 3600:.1f} hours for {frames} frames; give max_seconds to have "
            f"the best result of that time. {advice}".rstrip()
        )
