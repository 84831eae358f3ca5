"""Classical methods, in one signature: (W or Landmarks, visible=None, **own) -> Reconstruction."""

from ..completion import complete
from .bmm import bmm
from .ksta import ksta
from .pta import pta
from .rigid import tomasi_kanade
from .riks import riks
from .sps import sps

__all__ = ["bmm", "complete", "ksta", "pta", "riks", "sps", "tomasi_kanade"]
