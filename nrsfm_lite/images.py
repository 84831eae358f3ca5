"""The one door: image points in any form are parsed and checked here, once, and every result is made here.

`parse` takes what users have; `read` also asks what a method needs. Everything behind the door takes an
`Images` and checks nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import normalizer
from .cameras import nearest_orthonormal
from .checks import as_array, check_shape, check_visible_finite
from .data import Landmarks, Reconstruction


@dataclass(frozen=True, eq=False)
class Images:
    """Image points of F frames with P points, checked. Arrays are float64, and nobody changes them.

    Attributes
    ----------
    points : (F, P, 2), in the user's units, zero where hidden
    weight : (F, P), how much a point counts: its confidence where it is visible, zero where it is hidden
    visible : (F, P) bool, what the method is shown: the points with a weight, also after `completed`
    names, edges : as in `Landmarks`
    """

    points: np.ndarray
    weight: np.ndarray
    visible: np.ndarray
    names: tuple[str, ...]
    edges: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def n_points(self) -> int:
        """P, the number of points."""
        return self.points.shape[1]

    @cached_property
    def complete(self) -> bool:
        """Whether every point counts fully."""
        return bool((self.weight == 1).all())

    @cached_property
    def _centred(self) -> tuple[np.ndarray, np.ndarray]:
        X, mean = normalizer.center(torch.as_tensor(self.points), torch.as_tensor(self.weight))
        return X.numpy(), mean.numpy()

    @property
    def centred(self) -> np.ndarray:
        """(F, P, 2), each frame less its weighted mean, zero where hidden; in the user's units."""
        return self._centred[0]

    @property
    def mean(self) -> np.ndarray:
        """(F, 2), what `centred` lacks."""
        return self._centred[1]

    @cached_property
    def scale(self) -> float:
        """Root mean square of all visible coordinates of `centred`, in the user's units."""
        return float(normalizer.set_scale(torch.as_tensor(self.centred), torch.as_tensor(self.weight)))

    @cached_property
    def X(self) -> np.ndarray:
        """(F, P, 2), `centred` in units of `scale`: what the classical methods work on."""
        return self.centred / self.scale

    def tensors(self, part: slice = slice(None), device: torch.device | str = "cpu") -> tuple[Tensor, Tensor, Tensor]:
        """`centred`, `mean` and `weight` of some frames as tensors on a device: what `Normalizer.normalize` takes."""
        X, mean, weight = (torch.as_tensor(a[part]).to(device) for a in (self.centred, self.mean, self.weight))
        return X, mean, weight

    def completed(self, points: np.ndarray) -> Images:
        """The same images with all points at hand, (F, P, 2) in the user's units; `visible` stays what it was."""
        return replace(self, points=points, weight=np.ones_like(self.weight))

    def reconstruction(
        self,
        S: np.ndarray,
        M: np.ndarray,
        t: np.ndarray | None = None,
        *,
        method: str,
        scale: float | None = None,
        converged: bool = True,
        **more: Any,
    ) -> Reconstruction:
        """The one maker of a `Reconstruction`, in the user's units.

        Parameters
        ----------
        S : (F, P, 3), in units of `scale`
        M : (F, 3, 2), of which the nearest orthonormal ones are returned
        t : (F, 2), optional
            Image translation beyond `mean`, in units of `scale`.
        method, converged, more : fields of the `Reconstruction`
        scale : float, optional
            Default: that of these images, so that S is in the units of `X`.
        """
        unit = self.scale if scale is None else scale
        M = nearest_orthonormal(torch.as_tensor(M)).numpy()
        centre = S.mean(1, keepdims=True)
        moved = (0 if t is None else t) + (centre @ M)[:, 0]  # the image of the centroid
        return Reconstruction(
            shapes=(S - centre) * unit,
            cameras=M,
            translations=self.mean + moved * unit,
            visible=self.visible,
            names=self.names,
            edges=self.edges,
            method=method,
            converged=converged,
            **more,
        )


def parse(W: Any, visible: Any = None, confidence: Any = None) -> Images:
    """What a user has, as `Images`.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array or tensor
        Image points; hidden ones may be NaN.
    visible : (F, P) bool, optional
        Default: that of the Landmarks, else everything.
    confidence : (F, P), optional
        From 0 to 1, how far to trust a visible point; 0 hides it. Default: that of the Landmarks, else 1.

    Raises
    ------
    ValueError
        For Landmarks without points2d, wrong shapes, no frames, visible points that are not finite, a confidence
        outside 0 … 1, or a frame with no visible point.
    """
    names: tuple[str, ...] = ()
    edges = np.zeros((0, 2), int)
    if isinstance(W, Landmarks):
        if W.points2d is None:
            raise ValueError("these Landmarks have no points2d; photograph them with datasets.make_views first.")
        names, edges = W.names, W.edges
        visible = W.visible if visible is None else visible
        confidence = W.confidence if confidence is None else confidence
        W = W.points2d
    W = as_array("W", W, float)
    if W.ndim != 3 or W.shape[2] != 2 or not len(W):
        raise ValueError(f"W has shape {W.shape}; expected (F, P, 2) with at least one frame.")
    visible = np.ones(W.shape[:2], bool) if visible is None else as_array("visible", visible, bool)
    check_shape("visible", visible, W.shape[:2])
    check_visible_finite("W", W, visible)
    _check_every_frame(visible, "no visible point")
    weight = visible.astype(float)
    if confidence is not None:
        confidence = as_array("confidence", confidence, float)
        check_shape("confidence", confidence, W.shape[:2])
        bad = visible & ~((confidence >= 0) & (confidence <= 1))
        if bad.any():
            frame, point = np.argwhere(bad)[0]
            value = confidence[frame, point]
            raise ValueError(f"confidence is {value} at frame {frame}, point {point}; expected 0 to 1.")
        weight = np.where(visible, confidence, 0.0)
        _check_every_frame(weight > 0, "no visible point with confidence")
    shown = weight > 0
    return Images(np.where(shown[..., None], W, 0.0), weight, shown, names, edges)


def read(
    W: Any,
    visible: Any = None,
    confidence: Any = None,
    *,
    method: str,
    frames: int = 1,
    points: int = 1,
    every_point: bool = True,
) -> Images:
    """`parse`, and what a method needs.

    Parameters
    ----------
    W, visible, confidence : as in `parse`
    method : str, for the message
    frames, points : int
        The least that the method needs.
    every_point : bool
        Whether each point must be visible somewhere.

    Raises
    ------
    ValueError
        As `parse`; also with too few frames or points, a point hidden in every frame, or a frame whose visible
        points are all at one place.
    """
    images = parse(W, visible, confidence)
    F, P = images.weight.shape
    if frames > F or points > P:
        raise ValueError(f"{method} needs at least {frames} frames and {points} points; got {F} frames of {P} points.")
    hidden = ~images.visible.any(0)
    if every_point and hidden.any():
        point = int(hidden.argmax())
        name = images.names[point] if images.names else f"point {point}"
        raise ValueError(f"{name} is hidden in every frame of W; leave it out.")
    # All at one place up to the rounding of the coordinates, which grows with their distance from the origin.
    at_one_place = np.abs(images.centred).max((1, 2)) <= 1e-9 * np.abs(images.points).max((1, 2))
    if at_one_place.all():
        raise ValueError("W has all its visible points at one place in every frame; there is no shape to see.")
    if at_one_place.any():
        frame = int(at_one_place.argmax())
        raise ValueError(f"frame {frame} of W has all its visible points at one place; leave it out.")
    return images


def _check_every_frame(shown: np.ndarray, what: str) -> None:
    if not shown.any(1).all():
        raise ValueError(f"frame {shown.any(1).argmin()} of W has {what}; leave it out.")
