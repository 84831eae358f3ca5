"""Files of landmarks: a user's own key points, and the classic sequences."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..data import Landmarks, find_npz, read_npz

_KEYS = (
    "points2d", "visible", "confidence", "points3d", "cameras", "translations", "sequence", "time", "names", "edges",
)  # fmt: skip


def load_npz(path: str | Path) -> Landmarks:
    """Landmarks from an .npz file: what `Landmarks.save` wrote, or a user's own arrays.

    Parameters
    ----------
    path : path
        Arrays by the names of `Landmarks`; ``W`` may stand for points2d and ``S`` for points3d.
        Arrays of other names are ignored. The ending .npz may be left out.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    KeyError
        If it has neither points2d nor points3d.
    ValueError
        If it is empty, broken or truncated, or if its arrays do not fit together.

    Examples
    --------
    >>> import tempfile
    >>> file = nl.Landmarks(points2d=np.zeros((5, 3, 2)), name="mine").save(tempfile.mkdtemp() + "/mine")
    >>> nl.datasets.load_npz(file)
    Landmarks('mine': 5 frames × 3 points; images, all visible)
    """
    path = find_npz(path)
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


def load_classic(path: str | Path) -> Landmarks:
    """One of the classic sequences (drink, pickup, yoga, stretch, dance …) as an .npz of arrays.

    Parameters
    ----------
    path : path
        ``S`` (F, P, 3), the shapes as the camera sees them: x and y are the image. Where the shapes in the world
        are known, ``S_world`` (F, P, 3) and rotations ``R`` (F, 3, 3) with S = S_world Rᵀ.

    Returns
    -------
    Landmarks of one video: points3d in the world if known, else in the camera's frame; centred points2d.

    Raises
    ------
    FileNotFoundError, KeyError, ValueError
        As `load_npz`; also if S, S_world and R do not fit together.

    Examples
    --------
    >>> import tempfile
    >>> folder = tempfile.mkdtemp()
    >>> np.savez(folder + "/drink.npz", S=np.eye(4, 3)[None])
    >>> nl.datasets.load_classic(folder + "/drink")
    Landmarks('drink': 1 frame × 4 points; images, all visible, 3D truth, true cameras)
    """
    path = find_npz(path)
    arrays = read_npz(path, keys={"S", "S_world", "R"})
    if "S" not in arrays:
        raise KeyError(f"{path}: needs an array S (F, P, 3); it is not there.")
    try:
        S = Landmarks(points3d=arrays["S"]).points3d
    except ValueError as error:
        raise ValueError(f"{path}: S as {error}") from None
    S = S - S.mean(1, keepdims=True)
    if not {"S_world", "R"} <= arrays.keys():
        return Landmarks(S[..., :2], points3d=S, cameras=np.tile(np.eye(3, 2), (len(S), 1, 1)), name=path.stem)
    world, R = arrays["S_world"], arrays["R"]
    if world.shape != S.shape or R.shape != (len(S), 3, 3):
        raise ValueError(f"{path}: S {S.shape}, S_world {world.shape} and R {R.shape} do not fit together.")
    world = world - world.mean(1, keepdims=True)
    if not np.allclose(world @ R.swapaxes(1, 2), S, atol=1e-6 * np.abs(S).max()):
        raise ValueError(f"{path}: S is not S_world turned by R.")
    return Landmarks(S[..., :2], points3d=world, cameras=R.swapaxes(1, 2)[:, :, :2], name=path.stem)
