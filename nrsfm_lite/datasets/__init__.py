"""Data, generated and real; everything comes as `Landmarks`."""

from .bvh import CMU_BODY, load_bvh
from .files import load_classic, load_npz
from .motion import ACTIONS, make_motion
from .views import make_views

__all__ = ["ACTIONS", "CMU_BODY", "load_bvh", "load_classic", "load_npz", "make_motion", "make_views"]
