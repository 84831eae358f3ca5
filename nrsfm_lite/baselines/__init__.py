"""Classical methods, in one signature: (W or Landmarks, visible=None, **own) -> Reconstruction."""

from ..completion import complete
from .bmm import bmm
from .cns import cns
from .ksta import ksta
from .nlo import nlo
from .pta import pta
from .rigid import tomasi_kanade
from .riks import riks
from .sfc import sfc
from .sps import sps

__all__ = ["bmm", "cns", "complete", "ksta", "nlo", "pta", "riks", "sfc", "sps", "tomasi_kanade"]
