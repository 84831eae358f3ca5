"""Remakes the picture of the README and of the book's first page: `make picture`."""

import sys

import numpy as np

import nrsfm_lite as nl


def main(path: str) -> None:
    """Reconstruct generated motion, print the error, and draw five frames, neither the best nor the worst."""
    views = nl.datasets.make_views(nl.datasets.make_motion(4000, seed=0), seed=0)
    rec = nl.reconstruct(views, seed=0)
    error = nl.metrics.normalized_error(rec.shapes, views.points3d)
    moved, true = nl.metrics.align(rec.shapes, views.points3d)
    off = np.linalg.norm(moved - true, axis=2).mean()
    print(f"mean normalised 3D error {error.mean():.4f}, {100 * off:.1f} cm per point")
    # One frame from each fifth of the film: the one whose error is nearest to the film's median.
    parts = np.array_split(np.arange(len(error)), 5)
    frames = [part[np.abs(error[part] - np.median(error)).argmin()] for part in parts]
    nl.plotting.use_style()
    nl.plotting.compare(rec, views, frames).savefig(path, dpi=90)


if __name__ == "__main__":
    main(sys.argv[1])
