"""Point trajectory approach: every point moves along few cosines in time (Akhter et al., 2008)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.fft import idct

from ..checks import whole
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from .shared.completion import completed
from .shared.limits import Watch
from .shared.upgrade import stacked, trajectory_cameras


@one_thread
def pta(
    W: Any, visible: Any = None, *, confidence: Any = None, rank: int = 12, progress: bool = True
) -> Reconstruction:
    """Smooth trajectories: the shape's change over time is a sum of `rank` discrete cosines.

    Objective: ``min_B Σ_f ‖W_f − S_f M_f‖²`` with ``S_f = Σ_k θ_fk B_k``, θ the first `rank` functions
    of the discrete cosine transform over the frames. The cameras come first, from `trajectory_cameras`;
    then the coefficients B are linear least squares. Cost O(F (3·rank)²), memory O(F · rank).

    Assumes orthographic views in *temporal order* from a slowly moving camera; on shuffled frames it
    fails, since shuffled trajectories are not smooth.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points, in temporal order
    visible : (F, P) bool, optional
        Hidden points are filled in by `complete` first.
    confidence : (F, P), optional
        From 0 to 1; `complete` moves a doubtful point towards its likely place. Default: that of the Landmarks,
        else 1.
    rank : int
        Number of cosines; 3·rank is at most 2F. Akhter et al. choose it per sequence, 5 to 13.
    progress : bool

    Returns
    -------
    Reconstruction in one world frame for all frames, in the units of W.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 3 frames or 6 points; as `trajectory_cameras`; or for a rank out of range.

    References
    ----------
    Akhter, Sheikh, Khan, Kanade (2008). Nonrigid structure from motion in trajectory space. Advances in Neural
    Information Processing Systems 21, 41–48.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(30))
    >>> nl.baselines.pta(views, rank=4, progress=False).shapes.shape == views.points3d.shape
    True
    """
    images = completed(read(W, visible, confidence, method="pta", frames=3, points=6))
    F, P, _ = images.X.shape
    rank = whole("rank", rank, 1, 2 * F // 3, f" for {F} frames")
    M = trajectory_cameras(images.X, Watch("pta", progress=progress))  # (F, 3, 2)
    cosines = idct(np.eye(F, rank), axis=0, norm="ortho")  # (F, rank)
    # Row (f, j) of the system: x_fj = Σ_k θ_fk m_fjᵀ B_k, for all points at once.
    system = np.einsum("fij,fk->fjki", M, cosines).reshape(2 * F, 3 * rank)
    B = np.linalg.lstsq(system, stacked(images.X), rcond=None)[0].reshape(rank, 3, P)
    return images.reconstruction(np.einsum("fk,kip->fpi", cosines, B), M, method="pta")
