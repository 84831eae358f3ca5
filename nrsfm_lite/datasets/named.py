"""Data by name, generated or real, and the one place that knows where real data is."""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path

from ..data import Landmarks
from .bvh import CMU_BODY, load_bvh
from .files import load_classic, load_npz
from .motion import make_motion
from .pascal3d import load_pascal3d

GENERATED = {"motion": 4000, "motion-small": 600}  # frames
CMU = ("martial", "salsa", "indian", "05")
CLASSIC = ("drink", "pickup", "yoga", "stretch", "dance")
PASCAL3D = ("aeroplane", "bicycle", "bus", "chair", "diningtable", "sofa")
KNOWN = (*GENERATED, "motion-N", *CMU, *CLASSIC, "monkey", *PASCAL3D)


def load(name: str) -> Landmarks:
    """Landmarks with points3d, by name; a copy each time, that may be changed.

    Parameters
    ----------
    name : str
        - ``"motion"``, ``"motion-small"``, or ``"motion-N"`` with N frames: generated, nothing is needed.
        - ``"martial"``, ``"salsa"``, ``"indian"``, ``"05"``: a folder of ``cmu_bvh``, motions of the CMU database as
          .bvh files, of which the 31 points of `CMU_BODY` are taken.
        - ``"drink"``, ``"pickup"``, ``"yoga"``, ``"stretch"``, ``"dance"``: ``classic/NAME.npz``, see `load_classic`.
        - ``"aeroplane"``, ``"bicycle"``, ``"bus"``, ``"chair"``, ``"diningtable"``, ``"sofa"``: the CAD models of
          ``pascal3d/NAME.mat``, see `load_pascal3d`.
        - ``"monkey"``: ``animals/monkey.npz``, a macaque filmed by one camera (pixels, y down) and its 3D truth.

    Returns
    -------
    Landmarks

    Raises
    ------
    KeyError
        If the name is unknown.
    FileNotFoundError
        If real data is asked for and `data_folder` does not hold it.

    Examples
    --------
    >>> nl.datasets.load("motion-100")
    Landmarks('motion': 100 frames × 31 points; 3D truth)
    """
    generated = isinstance(name, str) and re.fullmatch(r"motion-([0-9]+)", name)
    if not generated and name not in KNOWN[:2] + KNOWN[3:]:
        raise KeyError(f"unknown data {name!r}; there are {', '.join(KNOWN)}.")
    if generated or name in GENERATED:
        return _loaded(None, int(generated[1]) if generated else GENERATED[name])[:]
    if name in CMU:
        return _loaded(_real(f"cmu_bvh/{name}"), "bvh")[:]
    if name in CLASSIC:
        return _loaded(_real(f"classic/{name}.npz"), "classic")[:]
    if name in PASCAL3D:
        return _loaded(_real(f"pascal3d/{name}.mat"), "pascal3d")[:]
    return _loaded(_real(f"animals/{name}.npz"), "npz")[:]


def data_folder() -> Path:
    """Where real data is: the environment variable NRSFM_DATA, or ``~/.cache/nrsfm_lite``.

    The folder need not exist.

    >>> nl.datasets.data_folder().is_absolute()
    True
    """
    return Path(os.environ.get("NRSFM_DATA") or "~/.cache/nrsfm_lite").expanduser().absolute()


@lru_cache(maxsize=4)
def _loaded(path: Path | None, kind: int | str) -> Landmarks:
    """What stands behind a name: a motion of so many frames, or a file or folder of some format."""
    if path is None:
        return make_motion(int(kind), seed=0)
    if kind == "bvh":
        return load_bvh(path, joints=CMU_BODY)
    return {"classic": load_classic, "pascal3d": load_pascal3d, "npz": load_npz}[str(kind)](path)


def _real(name: str) -> Path:
    """Where a file or folder of real data is."""
    path = data_folder() / name
    if not path.exists():
        raise FileNotFoundError(f"{path}: not there; set NRSFM_DATA to a folder that holds {name}.")
    return path
