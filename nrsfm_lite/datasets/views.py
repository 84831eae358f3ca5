"""Photographing a motion: 2D views of 3D landmarks from random cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import checks
from ..cameras import nearness, project, random_cameras
from ..data import Landmarks


def make_views(
    data: Landmarks,
    seed: int = 0,
    *,
    projection: str = "orthographic",
    missing: int | float | str = 0,
    noise: float = 0.0,
    scale_range: Sequence[float] | None = None,
    translation_range: float | None = None,
    distance: float = 4.0,
) -> Landmarks:
    """One random view of each frame of a motion, whose shapes are first centred over their points.

    Parameters
    ----------
    data : Landmarks with points3d
    seed : int
    projection : "orthographic", "weak_perspective" or "perspective"
        Weak perspective draws a scale per frame from `scale_range` (default 0.5 … 1.5) and moves
        the true shape's size with it: ``points2d = points3d @ cameras + translations`` still holds.
        Perspective is a pinhole at `distance` from the centroid that looks at it, with the focal length that
        shows the plane through the centroid at its own size: there the equation holds only nearly.
    missing : int, float or "self"
        An int m hides 1 … m points of each frame, uniformly (the paper's protocol); a float p hides
        round(p·P) points; "self" hides what the body itself is in front of, taking every edge for a rod
        of 5 % of the object's size in radius. Hidden coordinates are NaN.
    noise : float
        ‖noise‖_F / ‖centred W‖_F, Gaussian.
    scale_range : (low, high), optional
        Weak perspective and perspective; with the latter a scale is drawn only if this is given.
    translation_range : float, optional
        Largest shift of the image per axis, in sizes of the object (the largest extent over all frames).
    distance : float
        Of a perspective camera, in sizes of the object; more than 1.

    Returns
    -------
    Landmarks with points2d, visible, cameras, translations, and as points3d the centred (for weak
    perspective also scaled) shapes of `data`, so that ``points3d @ cameras + translations`` is the image,
    exactly or, for perspective, nearly.

    Raises
    ------
    ValueError
        If `data` has no points3d or no frames, or if an argument is out of range.

    Examples
    --------
    >>> nl.datasets.make_views(nl.datasets.make_motion(50), missing=0.1, noise=0.05)
    Landmarks('motion': 50 frames × 31 points; images, 90.3% visible, 3D truth, true cameras)
    """
    if not isinstance(data, Landmarks) or data.points3d is None:
        raise ValueError("make_views needs Landmarks with points3d; got none.")
    if not len(data):
        raise ValueError("make_views needs at least one frame; these landmarks have none.")
    seed = checks.whole("seed", seed, 0)
    checks.one_of("projection", projection, ("orthographic", "weak_perspective", "perspective"))
    distance = checks.at_least("distance", distance, 1, above=True)
    if isinstance(missing, str) and (missing != "self" or not len(data.edges)):
        expected = "a number or 'self'" if missing != "self" else "landmarks with edges, which are what hides points"
        raise ValueError(f"missing={missing!r}; expected {expected}.")
    if scale_range is not None and projection == "orthographic":
        raise ValueError("scale_range has no meaning for orthographic views; use projection='weak_perspective'.")
    noise = checks.at_least("noise", noise)
    if translation_range is not None:
        translation_range = checks.at_least("translation_range", translation_range)
    n_frames, n_points = data.visible.shape
    # One stream per purpose: asking for noise does not change the cameras.
    cameras_rng, scale_rng, shift_rng, noise_rng, hide_rng = (
        np.random.default_rng([seed, purpose]) for purpose in range(5)
    )
    cameras = random_cameras(n_frames, cameras_rng)
    S = data.points3d - data.points3d.mean(1, keepdims=True)
    if projection == "weak_perspective" or scale_range is not None:
        low, high = _range("scale_range", (0.5, 1.5) if scale_range is None else scale_range)
        S = S * scale_rng.uniform(low, high, (n_frames, 1, 1))
    translations = np.zeros((n_frames, 2))
    size = np.ptp(S, axis=1).max()
    if translation_range:
        translations = shift_rng.uniform(-1, 1, (n_frames, 2)) * translation_range * size
    W = project(S, cameras)
    if projection == "perspective":
        far = distance * size
        W = W * (far / (far - nearness(S, cameras)))[..., None]
    perturbation = noise_rng.standard_normal(W.shape)
    perturbation *= (
        noise * np.linalg.norm(W, axis=(1, 2), keepdims=True) / np.linalg.norm(perturbation, axis=(1, 2), keepdims=True)
    )
    if missing == "self":
        visible = _in_sight(S, cameras, data.edges, 0.05 * size)
    else:
        visible = _hide(hide_rng, missing, n_frames, n_points)
    W = np.where(visible[..., None], W + perturbation + translations[:, None], np.nan)
    return replace(
        data, points2d=W, visible=visible, confidence=None, points3d=S, cameras=cameras, translations=translations
    )


def _range(name, value):
    """A pair 0 < low <= high of finite numbers."""
    pair = checks.as_array(name, value, float)
    if pair.shape != (2,) or not 0 < pair[0] <= pair[1] < np.inf:
        raise ValueError(f"{name}={value}; expected a pair of numbers, 0 < low <= high.")
    return pair


def _in_sight(S, cameras, edges, radius):
    """(F, P) bool: False where a rod of this radius around some edge is in front of a point."""
    Q = np.concatenate([project(S, cameras), nearness(S, cameras)[..., None]], 2)  # x, y, nearness
    visible = np.ones(S.shape[:2], bool)
    for a, b in edges:
        start, along = Q[:, None, a], (Q[:, b] - Q[:, a])[:, None]  # (F, 1, 3)
        length = (along[..., :2] ** 2).sum(-1)
        share = ((Q - start)[..., :2] * along[..., :2]).sum(-1) / np.where(length > 0, length, 1)
        nearest = start + np.clip(share, 0, 1)[..., None] * along  # (F, P, 3): of the rod's axis, in the image
        beside = np.linalg.norm((nearest - Q)[..., :2], axis=-1)
        hidden = (beside < radius) & (nearest[..., 2] - Q[..., 2] > radius)
        hidden[:, [a, b]] = False  # a joint is part of its own rods
        visible &= ~hidden
    return visible


def _hide(rng, missing, n_frames, n_points):
    """Visibility (F, P) with random points missing."""
    if isinstance(missing, (bool, np.bool_)) or not isinstance(missing, (int, float, np.number)):
        raise ValueError(f"missing={missing!r}; expected a whole number of points or a share of them.")
    whole = isinstance(missing, (int, np.integer))
    most = int(missing) if whole else round(checks.at_least("missing", missing) * n_points)
    if not 0 <= most < n_points:
        raise ValueError(
            f"missing={missing}; expected to hide at least 0 and at most {n_points - 1} of {n_points} points."
        )
    counts = rng.integers(1, most + 1, n_frames) if whole and most else np.full(n_frames, most)
    rank = rng.random((n_frames, n_points)).argsort(1).argsort(1)  # a random order of the points per frame
    return rank >= counts[:, None]
