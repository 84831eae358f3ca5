"""nrsfm_lite: deep non-rigid structure from motion, from 2D landmarks to 3D shapes and cameras.

import nrsfm_lite as nl
data = nl.datasets.make_motion()
views = nl.datasets.make_views(data)
rec = nl.reconstruct(views)
nl.metrics.normalized_error(rec.shapes, data.points3d).mean()
"""

from . import baselines, cameras, datasets, experiments, metrics, plotting, quality, sparse_coding
from .data import Landmarks, Reconstruction
from .model import Config, DeepNRSfM
from .reconstruction import reconstruct
from .training import Schedule, fit

__version__ = "0.1.0"

__all__ = [
    "Config", "DeepNRSfM", "Landmarks", "Reconstruction", "Schedule", "baselines", "cameras", "datasets",
    "experiments", "fit", "metrics", "plotting", "quality", "reconstruct",
    "sparse_coding",
]  # fmt: skip
