"""From a user's image coordinates to what the network sees, and the numbers to come back.

The normalisation is isotropic: x and y are moved and scaled alike, never each on its own, because
a camera with orthonormal columns could not explain a stretched image.
"""

import torch


def visible_mean(W, visible):
    """Mean of the visible points of each frame: (B, P, 2), (B, P) bool -> (B, 2)."""
    return torch.where(visible[..., None], W, 0.0).sum(1) / visible.sum(1, keepdim=True).clamp(min=1)


def center(W, visible):
    """Subtract each frame's visible mean and set hidden points to zero.

    Parameters
    ----------
    W : (B, P, 2) tensor; hidden points may be NaN
    visible : (B, P) bool tensor

    Returns
    -------
    X : (B, P, 2), mean : (B, 2)
    """
    mean = visible_mean(W, visible)
    return torch.where(visible[..., None], W - mean[:, None], 0.0), mean


def frame_scale(X, visible):
    """Root mean square coordinate of each frame's visible points: (B, P, 2), (B, P) -> (B,)."""
    count = 2 * visible.sum(1).clamp(min=1)
    return (X.square().sum((1, 2)) / count).sqrt()


def set_scale(X, visible):
    """One scale for a whole set of centred frames: the root mean square over all visible coordinates."""
    return (X.square().sum() / (2 * visible.sum())).sqrt()


def check_extent(W, visible):
    """Raise ValueError, naming the frame, where all visible points of a frame are at one place.

    Up to the rounding of the coordinates, which grows with their distance from the origin.
    """
    X, _ = center(W, visible)
    extent = X.abs().amax((1, 2))
    point = extent <= 1e-9 * torch.where(visible[..., None], W, 0.0).abs().amax((1, 2))
    if point.all():
        raise ValueError("W has all its visible points at one place in every frame; there is no shape to see.")
    if point.any():
        frame = int(point.nonzero()[0])
        raise ValueError(f"frame {frame} of W has all its visible points at one place; leave it out.")
