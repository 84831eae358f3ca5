"""Point trajectory approach: every point moves along few cosines in time (Akhter et al., 2009)."""

import numpy as np
from scipy.fft import idct

from ..threads import one_thread
from .images import read, stacked
from .limits import check_whole
from .upgrade import trajectory_cameras


@one_thread
def pta(W, visible=None, rank=12):
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
    rank : int
        Number of cosines; 3·rank is at most 2F. Akhter et al. choose it per sequence, 5 to 13.

    Returns
    -------
    Reconstruction in one world frame for all frames.

    Raises
    ------
    ValueError
        As `images.read` and `trajectory_cameras`; or for a rank out of range.
    """
    images = read(W, visible, points=6, method="pta")
    F, P, _ = images.X.shape
    check_whole("rank", rank, 1, 2 * F // 3, f" for {F} frames")
    M = trajectory_cameras(images.X)  # (F, 3, 2)
    cosines = idct(np.eye(F, rank), axis=0, norm="ortho")  # (F, rank)
    # Row (f, j) of the system: x_fj = Σ_k θ_fk m_fjᵀ B_k, for all points at once.
    system = np.einsum("fij,fk->fjki", M, cosines).reshape(2 * F, 3 * rank)
    B = np.linalg.lstsq(system, stacked(images.X), rcond=None)[0].reshape(rank, 3, P)
    return images.reconstruction(np.einsum("fk,kip->fpi", cosines, B), M, "pta")
