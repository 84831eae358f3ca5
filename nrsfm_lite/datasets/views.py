"""Photographing a motion: 2D views of 3D landmarks from random cameras."""

from dataclasses import replace

import numpy as np

from ..cameras import project, random_cameras
from ..data import Landmarks


def make_views(data, seed=0, projection="orthographic", missing=0, noise=0.0, scale_range=None, translation_range=None):
    """One random view of each frame of a motion, whose shapes are first centred over their points.

    Parameters
    ----------
    data : Landmarks with points3d
    seed : int
    projection : "orthographic" or "weak_perspective"
        Weak perspective draws a scale per frame from `scale_range` (default 0.5 … 1.5) and moves
        the true shape's size with it: ``points2d = points3d @ cameras + translations`` still holds.
    missing : int or float
        An int m hides 1 … m points of each frame, uniformly (the paper's protocol); a float p hides
        round(p·P) points. Hidden coordinates are NaN.
    noise : float
        ‖noise‖_F / ‖centred W‖_F, Gaussian.
    scale_range : (low, high), optional
    translation_range : float, optional
        Largest shift of the image per axis, in sizes of the object (the largest extent over all frames).

    Returns
    -------
    Landmarks with points2d, visible, cameras, translations, and as points3d the centred (for weak
    perspective also scaled) shapes of `data`, so that ``points3d @ cameras + translations`` is the image.

    Raises
    ------
    ValueError
        If `data` has no points3d, or if an argument is out of range.
    """
    if not isinstance(data, Landmarks) or data.points3d is None:
        raise ValueError("make_views needs Landmarks with points3d; got none.")
    if projection not in ("orthographic", "weak_perspective"):
        raise ValueError(f"projection={projection!r}; expected 'orthographic' or 'weak_perspective'.")
    if scale_range is not None and projection == "orthographic":
        raise ValueError("scale_range has no meaning for orthographic views; use projection='weak_perspective'.")
    if not 0 <= noise < np.inf:
        raise ValueError(f"noise={noise}; expected a number of at least 0.")
    if translation_range is not None and not (np.isscalar(translation_range) and translation_range >= 0):
        raise ValueError(f"translation_range={translation_range}; expected a number of at least 0.")
    n_frames, n_points = data.visible.shape
    # One stream per purpose: asking for noise does not change the cameras.
    cameras_rng, scale_rng, shift_rng, noise_rng, hide_rng = (
        np.random.default_rng([seed, purpose]) for purpose in range(5)
    )
    cameras = random_cameras(n_frames, cameras_rng)
    S = data.points3d - data.points3d.mean(1, keepdims=True)
    if projection == "weak_perspective":
        low, high = (0.5, 1.5) if scale_range is None else scale_range
        if not 0 < low <= high:
            raise ValueError(f"scale_range={scale_range}; expected 0 < low <= high.")
        S = S * scale_rng.uniform(low, high, (n_frames, 1, 1))
    translations = np.zeros((n_frames, 2))
    if translation_range:
        size = np.ptp(S, axis=1).max()
        translations = shift_rng.uniform(-1, 1, (n_frames, 2)) * translation_range * size
    W = project(S, cameras)
    perturbation = noise_rng.standard_normal(W.shape)
    perturbation *= (
        noise * np.linalg.norm(W, axis=(1, 2), keepdims=True) / np.linalg.norm(perturbation, axis=(1, 2), keepdims=True)
    )
    visible = _hide(hide_rng, missing, n_frames, n_points)
    W = np.where(visible[..., None], W + perturbation + translations[:, None], np.nan)
    return replace(
        data, points2d=W, visible=visible, confidence=None, points3d=S, cameras=cameras, translations=translations
    )


def _hide(rng, missing, n_frames, n_points):
    """Visibility (F, P) with random points missing."""
    if isinstance(missing, (bool, np.bool_)) or not isinstance(missing, (int, float, np.number)):
        raise ValueError(f"missing={missing!r}; expected a whole number of points or a share of them.")
    whole = isinstance(missing, (int, np.integer))
    most = int(missing) if whole else round(missing * n_points)
    if not 0 <= most < n_points:
        raise ValueError(
            f"missing={missing}; expected to hide at least 0 and at most {n_points - 1} of {n_points} points."
        )
    counts = rng.integers(1, most + 1, n_frames) if whole and most else np.full(n_frames, most)
    rank = rng.random((n_frames, n_points)).argsort(1).argsort(1)  # a random order of the points per frame
    return rank >= counts[:, None]
