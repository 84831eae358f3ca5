"""A user's own key points."""

from pathlib import Path

import numpy as np

from ..data import Landmarks, read_npz

_KEYS = ("points2d", "visible", "confidence", "points3d", "cameras", "translations", "sequence", "names", "edges")


def load_npz(path):
    """Landmarks from an .npz file: what `Landmarks.save` wrote, or a user's own arrays.

    Parameters
    ----------
    path : path
        Arrays by the names of `Landmarks`; ``W`` may stand for points2d and ``S`` for points3d.
        Arrays of other names are ignored.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    KeyError
        If it has neither points2d nor points3d.
    ValueError
        If it is empty, broken or truncated, or if its arrays do not fit together.
    """
    path = Path(path)
    arrays = read_npz(path, keys={*_KEYS, "W", "S", "name"})
    for short, key in [("W", "points2d"), ("S", "points3d")]:
        if short in arrays:
            arrays.setdefault(key, arrays[short])
    if not {"points2d", "points3d"} & arrays.keys():
        with np.load(path, allow_pickle=False) as archive:
            found = ", ".join(sorted(archive.files)) or "nothing"
        raise KeyError(f"{path}: needs an array points2d (or W) or points3d (or S); it has {found}.")
    chosen = {key: arrays[key] for key in _KEYS if key in arrays}
    try:
        return Landmarks(**chosen, name=str(arrays.get("name", path.stem)))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
