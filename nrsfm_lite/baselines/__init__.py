"""Classical methods, in one signature: (W or Landmarks, visible=None, **own) -> Reconstruction."""

from .rigid import tomasi_kanade

__all__ = ["tomasi_kanade"]
