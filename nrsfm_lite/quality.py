"""How good a trained network is, judged without any 3D (chapter 10).

Every score looks at a network and at images, never at a true shape. Lower is better for all but
`code_dimension`, where neither direction is better by itself. `coherence` of the last dictionary, the
paper's own measure, is a property of the model.
"""

import numpy as np
import torch

from . import shape_prior
from .cameras import image_turns, random_cameras
from .data import as_points, as_weights
from .preprocessing import center, frame_size


def scores(model, W, visible=None, seed=0):
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
    dict of floats: coherence, image_error, consistency, turn_consistency, distortion, code_dimension, surprise.
    """
    return {
        "coherence": model.coherence,
        "image_error": image_error(model, W, visible),
        "consistency": consistency(model, W, visible, seed),
        "turn_consistency": turn_consistency(model, W, visible, seed),
        "distortion": distortion(model, W, visible),
        "code_dimension": code_dimension(model, W, visible),
        "surprise": surprise(model, W, visible),
    }


def best(models, W, visible=None):
    """The one of several networks, such as restarts with other seeds, whose prior the images surprise least.

    The networks must have been trained on the same images, so that they share a unit of length.

    Parameters
    ----------
    models : sequence of DeepNRSfM, each with a prior, as `fit` returns them
    W, visible : as in `scores`

    Raises
    ------
    ValueError
        If there is no model, or one without a prior.
    """
    if not models:
        raise ValueError("models is empty; expected at least one network.")
    values = [surprise(model, W, visible) for model in models]
    if not np.isfinite(values).all():
        raise ValueError(f"model {int(np.argmax(~np.isfinite(values)))} has no prior; `fit` learns one.")
    return models[int(np.argmin(values))]


@torch.no_grad()
def image_error(model, W, visible=None):
    """Mean over frames of ‖W − S M − 1tᵀ‖ / ‖W‖ over the visible points: the training loss of one forward pass."""
    image, X, weight = _normalized(model, W, visible)
    S, M, _ = _forward(model, image)
    missed, _ = center(X - S @ M, weight)
    return float((frame_size(missed, weight) / frame_size(X, weight)).mean())


@torch.no_grad()
def consistency(model, W, visible=None, seed=0):
    """Does a reconstruction survive a photograph from elsewhere?

    Each reconstructed shape is seen by a new random camera, and the network reconstructs that image. Mean
    over frames of ‖S' − S‖ / ‖S‖, in the network's own coordinates, so that a turned or mirrored answer
    counts as an error.
    """
    S, _, _ = _forward(model, _normalized(model, W, visible)[0])
    cameras = torch.as_tensor(random_cameras(len(S), seed)).to(S)
    again, _, _ = _forward(model, S @ cameras)
    return _relative(again, S)


@torch.no_grad()
def turn_consistency(model, W, visible=None, seed=0):
    """Is an image, turned in its plane by a random angle, given the same shape? Mean of ‖S' − S‖ / ‖S‖."""
    image, _, _ = _normalized(model, W, visible)
    angle = torch.as_tensor(np.random.default_rng(seed).uniform(0, 2 * np.pi, len(image))).to(image)
    S, _, _ = _forward(model, image)
    again, _, _ = _forward(model, image @ image_turns(angle))
    return _relative(again, S)


@torch.no_grad()
def distortion(model, W, visible=None):
    """How far the cameras are from orthonormal before the projection makes them so: mean (σ₁ − σ₂) / (σ₁ + σ₂)."""
    A = (model.encode(_normalized(model, W, visible)[0]) @ model.gamma)[:, :, :3].mT
    sigma = torch.linalg.svdvals(A)  # (B, 2)
    return float(((sigma[:, 0] - sigma[:, 1]) / sigma.sum(1).clamp(min=1e-12)).mean())


@torch.no_grad()
def code_dimension(model, W, visible=None):
    """In how many directions the codes spread: (Σλ)² / Σλ² of the eigenvalues of their covariance."""
    _, _, psi = _forward(model, _normalized(model, W, visible)[0])
    values = torch.linalg.eigvalsh(torch.cov(psi.double().T)).clamp(min=0)
    return float(values.sum() ** 2 / values.square().sum().clamp(min=1e-300))


@torch.no_grad()
def surprise(model, W, visible=None):
    """−log p(image) per visible coordinate under the model's shape prior, with refined cameras; NaN without a prior.

    The unit of length is the network's.
    """
    prior = model.prior
    if prior is None:
        return float("nan")
    image, X, weight = _normalized(model, W, visible)
    _, M, _ = _forward(model, image)
    X, weight = X.cpu(), weight.cpu()  # where the prior works
    _, M = shape_prior.apply(prior, X, weight, M.cpu())
    return shape_prior.surprise(prior, X, weight, M)


def _normalized(model, W, visible):
    """`normalize` of the points, and their weights, where the network is."""
    weight = torch.as_tensor(as_weights(W, visible)).to(model.scale.device)
    W = torch.as_tensor(as_points(W, visible)[0]).to(model.scale.device)
    image, X, _ = model.normalize(W, weight)
    return image.to(model.gamma.dtype), X.to(model.gamma.dtype), weight.to(model.gamma.dtype)


def _forward(model, image):
    """Centred shapes, cameras and codes in the network's units."""
    psi, M = model.bottleneck(model.encode(image))
    S = model.decode(psi)
    return S - S.mean(1, keepdim=True), M, psi


def _relative(S, reference):
    size = reference.flatten(1).norm(dim=1).clamp(min=1e-12)
    return float(((S - reference).flatten(1).norm(dim=1) / size).mean())
