"""From a user's image coordinates to what the network sees, and the numbers to come back.

The normalisation is isotropic: x and y are moved and scaled alike, never each on its own, because
a camera with orthonormal columns could not explain a stretched image.
"""

import torch


def visible_mean(W, visible):
    """Mean of the visible points of each frame, weighted if `visible` holds weights: (B, P, 2), (B, P) -> (B, 2)."""
    weight = visible.to(W.dtype)[..., None]
    return torch.where(weight > 0, W * weight, 0.0).sum(1) / weight.sum(1).clamp(min=1e-12)


def center(W, visible):
    """Subtract each frame's visible mean and set hidden points to zero.

    Parameters
    ----------
    W : (B, P, 2) tensor; hidden points may be NaN
    visible : (B, P) tensor, bool or weights from 0 to 1

    Returns
    -------
    X : (B, P, 2), mean : (B, 2)
    """
    mean = visible_mean(W, visible)
    return torch.where((visible > 0)[..., None], W - mean[:, None], 0.0), mean


def frame_scale(X, visible):
    """Root mean square coordinate of each frame's visible points: (B, P, 2), (B, P) -> (B,)."""
    return (_weighted_squares(X, visible) / (2 * visible.sum(1)).clamp(min=1e-12)).sqrt()


def set_scale(X, visible):
    """One scale for a whole set of centred frames: the root mean square over all visible coordinates."""
    return (_weighted_squares(X, visible).sum() / (2 * visible.sum())).sqrt()


def frame_size(X, visible):
    """‖X‖_F of each frame, points weighted as in the loss: (B, P, 2), (B, P) -> (B,)."""
    return _weighted_squares(X, visible).sqrt()


def _weighted_squares(X, visible):
    return (X.square().sum(2) * visible).sum(1)


def check_points(visible, names=()):
    """Raise ValueError, naming it, where a point is hidden in every frame; `visible` (F, P) is bool or weights."""
    hidden = (visible == 0).all(0)
    if hidden.any():
        point = int(hidden.nonzero()[0])
        raise ValueError(f"{names[point] if names else f'point {point}'} is hidden in every frame of W; leave it out.")


def check_extent(W, visible):
    """Raise ValueError, naming the frame, where all visible points of a frame are at one place.

    Up to the rounding of the coordinates, which grows with their distance from the origin.
    """
    X, _ = center(W, visible)
    extent = X.abs().amax((1, 2))
    point = extent <= 1e-9 * torch.where((visible > 0)[..., None], W, 0.0).abs().amax((1, 2))
    if point.all():
        raise ValueError("W has all its visible points at one place in every frame; there is no shape to see.")
    if point.any():
        frame = int(point.nonzero()[0])
        raise ValueError(f"frame {frame} of W has all its visible points at one place; leave it out.")
