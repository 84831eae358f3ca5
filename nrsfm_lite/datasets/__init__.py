"""Data, generated and real; everything comes as `Landmarks`.

`load` finds a set by its name; the other loaders take a path, and the makers nothing but a seed.
"""

from .bvh import CMU_BODY, load_bvh
from .files import load_classic, load_npz
from .motion import ACTIONS, make_motion
from .named import PASCAL3D, data_folder, load
from .pascal3d import load_pascal3d
from .views import make_views

__all__ = [
    "ACTIONS", "CMU_BODY", "PASCAL3D", "data_folder", "load", "load_bvh", "load_classic", "load_npz", "load_pascal3d",
    "make_motion", "make_views",
]  # fmt: skip
