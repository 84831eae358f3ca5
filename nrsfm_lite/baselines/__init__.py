"""Classical methods, in one signature: (W or Landmarks, visible=None, *, confidence=None, **own) -> Reconstruction.

Each method has a private module of its own; what several of them use is in `shared`.
"""

from ._bmm import bmm
from ._cns import cns
from ._em_gaussian import em_gaussian
from ._em_gaussian import starts as starts
from ._ksta import ksta
from ._nlo import nlo
from ._pta import pta
from ._riks import riks
from ._sfc import sfc
from ._sps import sps
from ._tomasi_kanade import tomasi_kanade
from .shared.completion import complete

__all__ = [
    "bmm", "cns", "complete", "em_gaussian", "ksta", "nlo", "pta", "riks", "sfc", "sps", "tomasi_kanade",
]  # fmt: skip
