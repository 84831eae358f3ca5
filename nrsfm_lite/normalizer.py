"""From a user's image coordinates to what the network sees, and the numbers to come back.

The normalisation is isotropic: x and y are moved and scaled alike, never each on its own, because
a camera with orthonormal columns could not explain a stretched image.

Shapes in comments: B frames, P points. `weight` (B, P) is bool or holds numbers from 0 to 1; 0 hides a point.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from . import image_prior


def weighted_mean(W: Tensor, weight: Tensor) -> Tensor:
    """Mean of the visible points of each frame, by their weights: (B, P, 2), (B, P) -> (B, 2)."""
    share = weight.to(W.dtype)[..., None]
    return torch.where(share > 0, W * share, 0.0).sum(1) / share.sum(1).clamp(min=1e-12)


def center(W: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Subtract each frame's weighted mean and set hidden points to zero.

    Parameters
    ----------
    W : (B, P, 2) tensor; hidden points may be NaN
    weight : (B, P) tensor

    Returns
    -------
    X : (B, P, 2), mean : (B, 2)
    """
    mean = weighted_mean(W, weight)
    return torch.where((weight > 0)[..., None], W - mean[:, None], 0.0), mean


def frame_scale(X: Tensor, weight: Tensor) -> Tensor:
    """Root mean square coordinate of each frame's visible points: (B, P, 2), (B, P) -> (B,)."""
    return (_weighted_squares(X, weight) / (2 * weight.sum(1)).clamp(min=1e-12)).sqrt()


def set_scale(X: Tensor, weight: Tensor) -> Tensor:
    """One scale for a whole set of centred frames: the root mean square over all visible coordinates."""
    return (_weighted_squares(X, weight).sum() / (2 * weight.sum())).sqrt()


def frame_size(X: Tensor, weight: Tensor) -> Tensor:
    """‖X‖_F of each frame, points weighted as in the loss: (B, P, 2), (B, P) -> (B,)."""
    return _weighted_squares(X, weight).sqrt()


def _weighted_squares(X: Tensor, weight: Tensor) -> Tensor:
    return (X.square().sum(2) * weight).sum(1)


@dataclass(frozen=True, eq=False)
class Normalizer:
    """What lies between image coordinates and a network's: found once on the training frames, and then fixed.

    Attributes
    ----------
    projection, fill, translation : as in `model.Config`
    scale : float
        The unit of length of the training frames; of use with orthographic projection.
    origin : (2,) double tensor
        Where a model of translations has its zero.
    covariance : (P, P) double tensor
        `image_prior.learn` of the training frames, to fill in hidden points.
    """

    projection: str
    fill: str
    translation: bool
    scale: float
    origin: Tensor
    covariance: Tensor

    def unit(self, X: Tensor, weight: Tensor) -> Tensor:
        """The length of one network unit in each of some centred frames (B,)."""
        if self.projection == "weak_perspective":
            return frame_scale(X, weight)
        return X.new_full((), self.scale).expand(X.shape[0])  # not len(X), which `torch.export` would fix

    def normalize(self, X: Tensor, mean: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """From centred image points to the network's.

        Parameters
        ----------
        X, mean : what `center` returns, in double precision
        weight : (B, P)

        Returns
        -------
        image : (B, P, 2)
            What the encoder takes: hidden points filled in, centred but for a model of translations.
        X : (B, P, 2)
            Points centred over the visible ones, zero where hidden: what the loss and the prior compare with.
        unit : (B,)
        """
        unit = self.unit(X, weight)
        X = X / unit[:, None, None]
        if not torch.compiler.is_exporting() and (weight == 1).all():
            image = X  # the shortcut is the same, but an exported graph has no branches
        elif self.fill == "likely":
            image = image_prior.fill(self.covariance.to(X), X, weight)
        else:
            share = weight.to(X.dtype)
            total = share.mean(1, keepdim=True) if self.fill == "scaled" else 1.0
            image = X * (share / total)[..., None]
        if self.translation:
            moved = weighted_mean(X - image, weight)  # back to where the visible points are
            image = image + (moved + (mean - self.origin.to(mean)) / unit[:, None])[:, None]
            if self.fill != "likely":
                image = image * (weight > 0)[..., None]
        return image, X, unit
