"""The measurements of the book, as experiments that anyone can repeat: `nrsfm experiment NAME`."""

from .results import read_results
from .runner import NAMES, run

__all__ = ["NAMES", "read_results", "run"]
