"""Hidden points for methods that need every point: `image_prior` puts them at their likely places."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ... import image_prior, normalizer
from ...images import Images, read
from ...threads import one_thread


@one_thread
def complete(W: Any, visible: Any = None, *, confidence: Any = None) -> np.ndarray:
    """Image points with the hidden ones filled in, for methods that need every point.

    A point of the highest confidence in its frame stays as it is; one of less moves towards its likely place.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
    confidence : (F, P), optional
        From 0 to 1, how far to trust a visible point; 0 hides it. Default: that of the Landmarks, else 1.

    Returns
    -------
    (F, P, 2) array, in the units of W

    Raises
    ------
    ValueError
        As `images.read`: also if a point is hidden in every frame, or all visible points are at one place.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(60), missing=0.2)
    >>> bool(np.isfinite(nl.baselines.complete(views)).all())
    True
    """
    return completed(read(W, visible, confidence, method="complete")).points


def completed(images: Images) -> Images:
    """The same images with all points at hand; they are the same object if nothing is hidden or doubted."""
    if images.complete:
        return images
    X, weight = torch.as_tensor(images.X), torch.as_tensor(images.weight)
    filled = image_prior.fill(image_prior.learn(X, weight), X, weight) * images.scale
    # The fill centres every frame anew; what it left as it was tells how far each frame has moved.
    kept = weight == weight.amax(1, keepdim=True)
    W = torch.as_tensor(images.points)
    moved = normalizer.weighted_mean(W - filled, kept)
    return images.completed(torch.where(kept[..., None], W, filled + moved[:, None]).numpy())
