"""Filling in missing image points by low rank, for methods that need every point (chapter 11)."""

import numpy as np

from ..data import as_points

_HELD_OUT = 0.05  # of the visible points, on which the shrinkage is chosen
_HALVINGS = 14
_ITERATIONS, _TOLERANCE = 100, 1e-4


def complete(W, visible=None):
    """Image points with the hidden ones filled in: the same as `W` where visible.

    Soft-impute (Mazumder, Hastie & Tibshirani, 2010): the matrix of all frames (2F × P) is replaced in turn by
    one of small nuclear norm, singular values shrunk by λ, and by what is known of it. λ is halved from the
    largest singular value on, and the one is taken that foretells 5 % of the visible points best,
    which are held back meanwhile. Each frame's translation is the mean of its completed points. Cost O(F P²)
    per iteration.

    It assumes that all shapes are sums of few: far fewer than the points of the frames that see most. Where
    shapes vary in more ways than a frame has points to show, no low rank can know the rest.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional

    Returns
    -------
    (F, P, 2) array

    Raises
    ------
    ValueError
        As `as_points`; also if a point is hidden in every frame.
    """
    W, visible, names, _ = as_points(W, visible)
    if visible.all():
        return W
    if not visible.any(0).all():
        point = int(np.argmin(visible.any(0)))
        raise ValueError(f"point {names[point] if names else point} is hidden in every frame of W; leave it out.")
    F, P, _ = W.shape
    held = visible & (np.random.default_rng(0).random((F, P)) < _HELD_OUT)
    held &= (visible & ~held).any(1, keepdims=True)  # never all of a frame
    best, shrinkage = np.inf, 0.0
    for shrink, filled in _path(W, visible & ~held):
        missed = np.linalg.norm((filled - W)[held])
        if missed < best:
            best, shrinkage = missed, shrink
        elif missed > 1.5 * best:
            break
    for shrink, filled in _path(W, visible):  # noqa: B007
        if shrink <= shrinkage:
            break
    return np.where(visible[..., None], W, filled)


def _path(W, visible):
    """(λ, completed points) for ever smaller λ, as shares of the largest singular value; each starts from the last."""
    F, P, _ = W.shape
    seen = np.repeat(visible, 2, axis=0)  # rows: x and y of each frame
    known = W.transpose(0, 2, 1).reshape(2 * F, P)
    t = (known * seen).sum(1, keepdims=True) / seen.sum(1, keepdims=True)
    Z = np.zeros_like(known)
    largest = np.linalg.norm(np.where(seen, known - t, 0.0), 2)
    for halving in range(1, _HALVINGS + 1):
        shrink = 0.5**halving
        for _ in range(_ITERATIONS):
            before = Z
            filled = np.where(seen, known - t, Z)
            t = t + filled.mean(1, keepdims=True)
            filled = filled - filled.mean(1, keepdims=True)
            U, s, Vh = np.linalg.svd(filled, full_matrices=False)
            Z = (U * np.maximum(s - shrink * largest, 0)) @ Vh
            if np.linalg.norm(Z - before) <= _TOLERANCE * np.linalg.norm(Z):
                break
        yield shrink, (Z + t).reshape(F, 2, P).transpose(0, 2, 1)
