"""What every classical method starts from, and how its result goes back to the user's units."""

from dataclasses import dataclass

import numpy as np
import torch

from .. import preprocessing
from ..cameras import nearest_orthonormal
from ..completion import complete
from ..data import Reconstruction, as_points


@dataclass(eq=False)
class Images:
    """Centred image points of unit scale.

    Attributes
    ----------
    X : (F, P, 2), each frame centred over its visible points, zero where hidden; root mean square coordinate 1
    t : (F, 2), what was subtracted
    scale : float, what the points were divided by
    visible : (F, P) bool, what the user gave
    names, edges : as in `Landmarks`
    """

    X: np.ndarray
    t: np.ndarray
    scale: float
    visible: np.ndarray
    names: tuple
    edges: np.ndarray

    def reconstruction(self, S, M, method, converged=True, t=None):
        """The result in the user's units.

        S (F, P, 3) and t (F, 2), an image translation, are in the units of X, and M (F, 3, 2) are the cameras, of
        which the nearest orthonormal ones are returned.
        """
        M = nearest_orthonormal(torch.as_tensor(M)).numpy()
        centre = S.mean(1, keepdims=True)
        t = (0 if t is None else t) + (centre @ M)[:, 0]  # the image of the centroid
        return Reconstruction(
            shapes=(S - centre) * self.scale, cameras=M, translations=self.t + t * self.scale,
            visible=self.visible, names=self.names, edges=self.edges, method=method, converged=converged,
        )  # fmt: skip


def stacked(X):
    """(F, P, 2) to (2F, P): two rows per frame, x and y."""
    return X.transpose(0, 2, 1).reshape(-1, X.shape[1])


def read(W, visible=None, *, fill=True, frames=3, points=4, method="this method"):
    """The input of a method, checked.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
    fill : bool
        Fill hidden points in by `complete`; without it they stay zero, for methods that leave them out.
    frames, points : int
        The least that the method needs.
    method : str, for the messages

    Raises
    ------
    ValueError
        As `as_points`; also with too few frames or points, a point hidden in every frame, or a frame whose
        points are all at one place.
    """
    W, visible, names, edges = as_points(W, visible)
    if len(W) < frames or W.shape[1] < points:
        raise ValueError(f"{method} needs at least {frames} frames and {points} points; got {len(W)} and {W.shape[1]}.")
    shown = torch.as_tensor(visible)
    preprocessing.check_points(shown, names)
    preprocessing.check_extent(torch.as_tensor(W), shown)
    if fill:
        W, shown = complete(W, visible), torch.ones_like(shown)
    X, t = preprocessing.center(torch.as_tensor(W), shown)
    scale = preprocessing.set_scale(X, shown)
    return Images((X / scale).numpy(), t.numpy(), float(scale), visible, names, edges)
