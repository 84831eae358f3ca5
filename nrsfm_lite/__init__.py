"""nrsfm_lite: deep non-rigid structure from motion, from 2D landmarks to 3D shapes and cameras.

import nrsfm_lite as nl
data = nl.datasets.make_motion()
views = nl.datasets.make_views(data)
rec = nl.reconstruct(views)
nl.metrics.normalized_error(rec.shapes, data.points3d).mean()
"""

from importlib import import_module
from typing import TYPE_CHECKING

from . import data
from .data import Landmarks, Reconstruction

if TYPE_CHECKING:  # for editors and type checkers; at run time, see `__getattr__`
    from . import baselines, cameras, datasets, experiments, metrics, plotting, quality, sparse_coding
    from .model import Config, DeepNRSfM
    from .reconstruction import reconstruct
    from .training import Schedule, fit

__version__ = "0.1.0"

__all__ = [
    "Config", "DeepNRSfM", "Landmarks", "Reconstruction", "Schedule", "baselines", "cameras", "datasets",
    "experiments", "fit", "metrics", "plotting", "quality", "reconstruct",
    "sparse_coding",
]  # fmt: skip

# Where the names live that are not modules themselves.
_HOMES = {
    "Config": "model",
    "DeepNRSfM": "model",
    "Schedule": "training",
    "fit": "training",
    "reconstruct": "reconstruction",
}


def __getattr__(name: str) -> object:
    """Load a name or module on first use: PyTorch, SciPy and matplotlib take seconds, and few programs need all."""
    path = f"{__name__}.{_HOMES.get(name, name)}"
    try:
        home = import_module(path) if not name.startswith("_") else None
    except ModuleNotFoundError as error:
        if error.name != path:  # something that the module needs is missing
            raise
        home = None
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(home, name) if name in _HOMES else home
    globals()[name] = value  # the next time, Python finds it itself
    return value


def _network_from_arrays(config: dict, arrays: dict) -> object:
    return import_module(f"{__name__}.model").DeepNRSfM.from_arrays(config, arrays)


# `data` reads networks back without knowing how one is built.
data.network_from_arrays = _network_from_arrays


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
