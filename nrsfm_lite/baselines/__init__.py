"""Classical methods, in one signature: (W or Landmarks, visible=None, **own) -> Reconstruction."""

from ..completion import complete
from .pta import pta
from .rigid import tomasi_kanade

__all__ = ["complete", "pta", "tomasi_kanade"]
