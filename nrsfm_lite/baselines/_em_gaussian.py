"""Gaussians over shapes by expectation maximisation (after Torresani, Hertzmann and Bregler, 2008)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from .. import shape_prior
from ..cameras import random_cameras
from ..checks import one_of, truth, whole
from ..data import Reconstruction
from ..images import Images, read
from ..normalizer import weighted_mean
from ..threads import one_thread
from ._bmm import shapes_and_cameras
from ._tomasi_kanade import factorise
from .shared.completion import completed
from .shared.limits import Watch, check_cost, choose_rank

_STARTS = ("rigid", "bmm", "random")


@one_thread
def em_gaussian(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    start: str | Reconstruction = "rigid",
    progress: bool = True,
    seed: int = 0,
) -> Reconstruction:
    """Shapes are draws of one Gaussian, or of a mixture; the images tell which, and the cameras, by turns.

    Objective: the likelihood of the images, ``w = Mᵀ s + t + noise`` with ``s ~ N(mean, C)``, in which the shapes
    have been integrated out. Expectation maximisation learns mean, C and the noise; between its iterations every
    camera takes a Newton step on the likelihood of its image, and frames that are likelier mirrored are mirrored. With
    200 frames or more, a part of them is kept back, and decides in how many directions the shapes vary, and whether
    they are several Gaussians: kinds of motion, or models of a collection. This is `shape_prior`, with which
    `reconstruct` refines what a network finds; here it starts from a classical method, or from nothing.

    Cost O(F P³) for an iteration, some thirty of them; memory O(F P + P²).

    Assumes orthographic views from many sides; frames may be in any order.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Hidden points are left out of the likelihood; only a start fills them in.
    confidence : (F, P), optional
        From 0 to 1; a point's noise is divided by it. Default: that of the Landmarks, else 1.
    start : "rigid", "bmm", "random" or a Reconstruction of the same frames
        Where cameras and shapes come from: one rigid shape by factorisation (`tomasi_kanade`), the block matrix method
        (`bmm`), random cameras and shapes, or another method's result.
    progress : bool
        As everywhere; of the start "bmm".
    seed : int
        Of the starts "bmm" and "random".

    Returns
    -------
    Reconstruction in one world frame for all frames, in the units of W, with each point's uncertainty.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 3 frames or 4 points (4 and 6 for "bmm"); for another `start`, or one of
        other frames; or if memory would not suffice.

    Notes
    -----
    Torresani et al. have a basis of few shapes whose weights are Gaussian, temporal dynamics as an option, and cameras
    by one Gauss–Newton step in each iteration. Ours: a covariance in all directions or in few, as the likelihood
    decides, the cameras' own doubt in the expectation, repair of mirrored frames, and mixtures.

    References
    ----------
    Torresani, Hertzmann, Bregler (2008). Nonrigid structure-from-motion: estimating shape and motion with hierarchical
    priors. IEEE Transactions on Pattern Analysis and Machine Intelligence 30(5), 878–892. doi:10.1109/TPAMI.2007.70752

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(60))
    >>> nl.baselines.em_gaussian(views, progress=False).shapes.shape == views.points3d.shape
    True
    """
    if not isinstance(start, Reconstruction):
        one_of("start", start, (*_STARTS, "a Reconstruction"))
    truth("progress", progress)
    seed = whole("seed", seed, 0)
    frames, points = (4, 6) if start == "bmm" else (3, 4)
    images = read(W, visible, confidence, method="em_gaussian", frames=frames, points=points)
    F, P, _ = images.X.shape
    if isinstance(start, Reconstruction) and start.shapes.shape != (F, P, 3):
        raise ValueError(f"start has shapes {start.shapes.shape}, but W has {F} frames of {P} points.")
    check_cost("em_gaussian", F, 8 * (30 * F * P + 200 * P**2 * 9) / 2**30)
    S, M = _start(images, start, seed, progress)
    X, weight = torch.as_tensor(images.X), torch.as_tensor(images.weight)
    cameras = torch.as_tensor(M)
    prior = shape_prior.learn(X, weight, torch.as_tensor(S), cameras)
    found, cameras = shape_prior.apply(prior, X, weight, cameras)
    t = weighted_mean(X - found @ cameras, weight)
    doubt = shape_prior.uncertainty(prior, X, weight, found, cameras) * images.scale**2
    return images.reconstruction(
        found.numpy(), cameras.numpy(), t.numpy(), uncertainty=doubt.numpy(), method="em_gaussian"
    )


@one_thread
def starts(X: np.ndarray, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the fast methods make of centred images, all points at hand, for a shape prior to start from.

    One rigid shape, and the block matrix method; one that cannot run on these images is left out.

    Parameters
    ----------
    X : (F, P, 2) array of unit scale, not checked
    seed : int, of the block matrix method

    Returns
    -------
    list of pairs: shapes (F, P, 3) and cameras (F, 3, 2), in X's units

    Examples
    --------
    >>> X = nl.datasets.make_views(nl.datasets.make_motion(60)).points2d
    >>> len(nl.baselines.starts(X - X.mean(1, keepdims=True)))
    2
    """
    F, P, _ = X.shape
    found = []
    try:
        S, M = factorise(X)
        found.append((np.repeat(S[None], F, axis=0), M))
        if F >= 4 and P >= 6:
            watch = Watch("em_gaussian", None, progress=False)
            found.append(shapes_and_cameras(X, choose_rank(None, 10, 2, F, P), 10, watch, seed)[:2])
    except (ValueError, np.linalg.LinAlgError):  # flat images
        pass
    return found


def _start(images: Images, start: str | Reconstruction, seed: int, progress: bool) -> tuple[np.ndarray, np.ndarray]:
    """Shapes (F, P, 3) and cameras (F, 3, 2), in units of the images' scale."""
    if isinstance(start, Reconstruction):
        return start.shapes / images.scale, start.cameras
    F, P, _ = images.X.shape
    if start == "random":
        rng = np.random.default_rng(seed)
        return rng.normal(size=(F, P, 3)), random_cameras(F, rng)
    whole_images = completed(images)
    if start == "bmm":
        watch = Watch("em_gaussian", None, progress)
        S, M, _ = shapes_and_cameras(whole_images.X, choose_rank(None, 10, 2, F, P), 10, watch, seed)
    else:
        rigid, M = factorise(whole_images.X)
        S = np.repeat(rigid[None], F, axis=0)
    return S * (whole_images.scale / images.scale), M
