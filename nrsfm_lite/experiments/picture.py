"""Remakes the picture of the README and of the book's first page: `make picture`."""

import sys

import numpy as np

from .. import datasets, metrics, plotting
from ..reconstruction import reconstruct


def main(path):
    """Reconstruct generated motion, print the error, and draw five frames, neither the best nor the worst."""
    views = datasets.make_views(datasets.make_motion(4000, seed=0), seed=0)
    rec = reconstruct(views, seed=0)
    error = metrics.normalized_error(rec.shapes, views.points3d)
    moved, true = metrics.align(rec.shapes, views.points3d)
    off = np.linalg.norm(moved - true, axis=2).mean()
    print(f"mean normalised 3D error {error.mean():.4f}, {100 * off:.1f} cm per point")
    # One frame from each fifth of the film: the one whose error is nearest to the film's median.
    parts = np.array_split(np.arange(len(error)), 5)
    frames = [part[np.abs(error[part] - np.median(error)).argmin()] for part in parts]
    plotting.use_style()
    plotting.compare(rec, views, frames).savefig(path, dpi=90)


if __name__ == "__main__":
    main(sys.argv[1])
