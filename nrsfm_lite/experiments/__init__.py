"""The measurements of the book, as experiments that anyone can repeat: `nrsfm experiment NAME`."""

from .lab.results import read_results
from .lab.runner import NAMES, run

__all__ = ["NAMES", "read_results", "run"]
