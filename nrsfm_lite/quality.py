"""How good a trained network is, judged without any 3D (chapter 10a).

Every score looks at a network and at images, never at a true shape. Lower is better for all but
`code_dimension`, where neither direction is better by itself. `coherence` of the last dictionary, the
paper's own measure, is a property of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import shape_prior
from .cameras import image_turns, random_cameras
from .images import parse
from .model import DeepNRSfM
from .normalizer import center, frame_size


@dataclass(frozen=True, eq=False)
class _Frames:
    """Some frames in the network's units and type, where it is, and what it makes of them in one pass."""

    image: Tensor  # (B, P, 2), what the encoder takes
    X: Tensor  # (B, P, 2), what its shape is compared with
    weight: Tensor  # (B, P)
    S: Tensor  # (B, P, 3), centred
    M: Tensor  # (B, 3, 2)
    psi: Tensor  # (B, K)


def scores(model: DeepNRSfM, W: Any, visible: Any = None, *, seed: int = 0) -> dict[str, float]:
    """Every score of this module for some frames, and the model's coherence.

    Parameters
    ----------
    model : DeepNRSfM
    W : Landmarks, or (F, P, 2) array or tensor
    visible : (F, P) bool, optional
    seed : int
        Decides the new cameras of `consistency` and the turns of `turn_consistency`.

    Returns
    -------
    dict of floats: coherence, image_error, consistency, turn_consistency, distortion, code_dimension,
    negative_log_likelihood.

    Raises
    ------
    ValueError
        As `images.parse`; also if the frames have another number of points than the network.

    Examples
    --------
    >>> W = np.random.default_rng(0).normal(size=(20, 6, 2))
    >>> sorted(nl.quality.scores(nl.DeepNRSfM(n_points=6), W))[:3]
    ['code_dimension', 'coherence', 'consistency']
    """
    frames = _frames(model, W, visible)
    return {
        "coherence": model.coherence,
        "image_error": _image_error(frames),
        "consistency": _consistency(model, frames, seed),
        "turn_consistency": _turn_consistency(model, frames, seed),
        "distortion": _distortion(model, frames),
        "code_dimension": _code_dimension(frames),
        "negative_log_likelihood": _negative_log_likelihood(model, frames),
    }


def best(models: Sequence[DeepNRSfM], W: Any, visible: Any = None) -> DeepNRSfM:
    """The one of several networks, such as restarts with other seeds, under whose prior the images are likeliest.

    The networks must have been trained on the same images, so that they share a unit of length.

    Parameters
    ----------
    models : sequence of DeepNRSfM, each with a prior, as `fit` returns them
    W, visible : as in `scores`

    Raises
    ------
    ValueError
        If there is no model, or one without a prior.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(60))
    >>> nets = [nl.fit(views, steps=2, seed=seed, progress=False) for seed in (0, 1)]
    >>> nl.quality.best(nets, views) in nets
    True
    """
    if not models:
        raise ValueError("models is empty; expected at least one network.")
    values = [negative_log_likelihood(model, W, visible) for model in models]
    if not np.isfinite(values).all():
        raise ValueError(f"model {int(np.argmax(~np.isfinite(values)))} has no prior; `fit` learns one.")
    return models[int(np.argmin(values))]


def image_error(model: DeepNRSfM, W: Any, visible: Any = None) -> float:
    """Mean over frames of ‖W − S M − 1tᵀ‖ / ‖W‖ over the visible points: the training loss of one forward pass.

    Examples
    --------
    >>> W = np.random.default_rng(0).normal(size=(20, 6, 2))
    >>> nl.quality.image_error(nl.DeepNRSfM(n_points=6), W) > 0
    True
    """
    return _image_error(_frames(model, W, visible))


def consistency(model: DeepNRSfM, W: Any, visible: Any = None, *, seed: int = 0) -> float:
    """Does a reconstruction survive a photograph from elsewhere?

    Each reconstructed shape is seen by a new random camera, and the network reconstructs that image. Mean
    over frames of ‖S' − S‖ / ‖S‖, in the network's own coordinates, so that a turned or mirrored answer
    counts as an error.

    Examples
    --------
    >>> W = np.random.default_rng(0).normal(size=(20, 6, 2))
    >>> nl.quality.consistency(nl.DeepNRSfM(n_points=6), W) > 0
    True
    """
    return _consistency(model, _frames(model, W, visible), seed)


def turn_consistency(model: DeepNRSfM, W: Any, visible: Any = None, *, seed: int = 0) -> float:
    """Is an image, turned in its plane by a random angle, given the same shape? Mean of ‖S' − S‖ / ‖S‖.

    Examples
    --------
    >>> W = np.random.default_rng(0).normal(size=(20, 6, 2))
    >>> nl.quality.turn_consistency(nl.DeepNRSfM(n_points=6), W) > 0
    True
    """
    return _turn_consistency(model, _frames(model, W, visible), seed)


def distortion(model: DeepNRSfM, W: Any, visible: Any = None) -> float:
    """How far the cameras are from orthonormal before the projection makes them so: mean (σ₁ − σ₂) / (σ₁ + σ₂).

    Examples
    --------
    >>> W = np.random.default_rng(0).normal(size=(20, 6, 2))
    >>> 0 <= nl.quality.distortion(nl.DeepNRSfM(n_points=6), W) <= 1
    True
    """
    return _distortion(model, _frames(model, W, visible))


def code_dimension(model: DeepNRSfM, W: Any, visible: Any = None) -> float:
    """In how many directions the codes spread: (Σλ)² / Σλ² of the eigenvalues of their covariance.

    Examples
    --------
    >>> W = np.random.default_rng(0).normal(size=(20, 6, 2))
    >>> 0 <= nl.quality.code_dimension(nl.DeepNRSfM(n_points=6), W) <= 10
    True
    """
    return _code_dimension(_frames(model, W, visible))


def negative_log_likelihood(model: DeepNRSfM, W: Any, visible: Any = None) -> float:
    """−log p(image) per visible coordinate under the model's shape prior, with refined cameras; NaN without a prior.

    The unit of length is the network's.

    Examples
    --------
    >>> W = np.random.default_rng(0).normal(size=(20, 6, 2))
    >>> nl.quality.negative_log_likelihood(nl.DeepNRSfM(n_points=6), W)
    nan
    """
    return _negative_log_likelihood(model, _frames(model, W, visible))


@torch.no_grad()
def _frames(model: DeepNRSfM, W: Any, visible: Any) -> _Frames:
    """The way in: frames read and checked once, seen by the network once."""
    images = parse(W, visible)
    if model.config.n_points != images.n_points:
        raise ValueError(f"model was trained for {model.config.n_points} points, but W has {images.n_points}.")
    X, mean, weight = images.tensors(device=model.device)
    image, X, _ = model.normalizer.normalize(X, mean, weight)
    return _Frames(image.to(model.dtype), X.to(model.dtype), weight.to(model.dtype), *_lift(model, image))


def _lift(model: DeepNRSfM, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centred shapes, cameras and codes."""
    psi, S, M = model.lift(image)
    return S - S.mean(1, keepdim=True), M, psi


def _image_error(frames: _Frames) -> float:
    missed, _ = center(frames.X - frames.S @ frames.M, frames.weight)
    return float((frame_size(missed, frames.weight) / frame_size(frames.X, frames.weight)).mean())


@torch.no_grad()
def _consistency(model: DeepNRSfM, frames: _Frames, seed: int) -> float:
    cameras = torch.as_tensor(random_cameras(len(frames.S), seed)).to(frames.S)
    return _relative(_lift(model, frames.S @ cameras)[0], frames.S)


@torch.no_grad()
def _turn_consistency(model: DeepNRSfM, frames: _Frames, seed: int) -> float:
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(frames.image))
    turns = image_turns(torch.as_tensor(angle).to(frames.image))
    return _relative(_lift(model, frames.image @ turns)[0], frames.S)


@torch.no_grad()
def _distortion(model: DeepNRSfM, frames: _Frames) -> float:
    A = (model.encode(frames.image) @ model.gamma)[:, :, :3].mT
    sigma = torch.linalg.svdvals(A)  # (B, 2)
    return float(((sigma[:, 0] - sigma[:, 1]) / sigma.sum(1).clamp(min=1e-12)).mean())


def _code_dimension(frames: _Frames) -> float:
    values = torch.linalg.eigvalsh(torch.cov(frames.psi.double().T)).clamp(min=0)
    return float(values.sum() ** 2 / values.square().sum().clamp(min=1e-300))


@torch.no_grad()
def _negative_log_likelihood(model: DeepNRSfM, frames: _Frames) -> float:
    if model.prior is None:
        return float("nan")
    X, weight = frames.X.cpu(), frames.weight.cpu()  # where the prior works
    _, M = shape_prior.apply(model.prior, X, weight, frames.M.cpu())
    return shape_prior.negative_log_likelihood(model.prior, X, weight, M)


def _relative(S: Tensor, reference: Tensor) -> float:
    size = reference.flatten(1).norm(dim=1).clamp(min=1e-12)
    return float(((S - reference).flatten(1).norm(dim=1) / size).mean())
