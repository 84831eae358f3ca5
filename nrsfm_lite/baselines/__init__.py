"""Classical methods, in one signature: (W or Landmarks, visible=None, **own) -> Reconstruction."""

from .pta import pta
from .rigid import tomasi_kanade

__all__ = ["pta", "tomasi_kanade"]
