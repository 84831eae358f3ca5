"""Key points of the CAD models of PASCAL3D+."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..data import Landmarks


def load_pascal3d(path: str | Path) -> Landmarks:
    """The models of one category of PASCAL3D+, from the .mat file of its CAD key points; a frame for each model.

    Not every model has every point. Kept are the points that most models have, and of the models those that have all
    of these: 8 of 10 chairs with 10 points, 5 of 6 dining tables with 8 of 12.

    Parameters
    ----------
    path : path
        A structure array, with the field ``pnames`` and a field for each point, empty where a model lacks it.

    Returns
    -------
    Landmarks of points3d, in the units of the file; z is up.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a MATLAB file, or holds no such structure.

    Examples
    --------
    >>> import tempfile
    >>> from scipy.io import savemat
    >>> points = {"seat": [0.0, 0, 1], "wheel": [1.0, 0, 0]}
    >>> file = tempfile.mkdtemp() + "/bicycle.mat"
    >>> savemat(file, {"bicycle": [{"pnames": list(points), **points}]})
    >>> nl.datasets.load_pascal3d(file)
    Landmarks('bicycle': 1 frame × 2 points; 3D truth)

    References
    ----------
    Xiang, Mottaghi, Savarese (2014). Beyond PASCAL: a benchmark for 3D object detection in the wild. IEEE Winter
    Conference on Applications of Computer Vision, 75–82. doi:10.1109/WACV.2014.6836101
    """
    path = Path(path)
    models = _models(path)
    names = [str(name).strip() for name in np.atleast_1d(models[0].pnames)]
    points = np.full((len(models), len(names), 3), np.nan)
    for i, model in enumerate(models):
        for j, name in enumerate(names):
            point = np.asarray(getattr(model, name, ()), float).ravel()
            if len(point) == 3:
                points[i, j] = point
    there = np.isfinite(points).all(2)
    chosen = 2 * there.sum(0) > len(models)
    if not chosen.any():
        raise ValueError(f"{path}: no point is there in more than half of its {len(models)} models.")
    whole = there[:, chosen].all(1)
    names = [name for name, kept in zip(names, chosen, strict=True) if kept]
    return Landmarks(points3d=points[whole][:, chosen], names=tuple(names), name=path.stem)


def _models(path: Path) -> list[Any]:
    """The structures of the file's only variable."""
    # Imported here: few need it, and it takes a while.
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file.")
    try:
        held = loadmat(path, squeeze_me=True, struct_as_record=False)
    except (ValueError, TypeError, NotImplementedError, MatReadError) as error:
        raise ValueError(f"{path}: not a MATLAB file that can be read ({type(error).__name__}).") from None
    for value in (v for key, v in held.items() if not key.startswith("_")):
        models = list(np.atleast_1d(value))
        if all(hasattr(model, "pnames") for model in models):
            return models
    raise ValueError(f"{path}: holds no structure with the field pnames; expected CAD models of PASCAL3D+.")
