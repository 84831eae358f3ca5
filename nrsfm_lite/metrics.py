"""How far a reconstruction is from the truth, and up to what.

A reconstruction from orthographic images is known only up to a rotation and a mirror image, so
every error first aligns the two shapes of a frame. Each function says which freedom it grants;
numbers of different functions are never compared.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from . import checks

# A frame has a handedness if its normalised distance from its own mirror image, best turned, is above this.
_ONE_HANDED = 0.1


class Handedness(NamedTuple):
    """What `handedness` finds.

    Attributes
    ----------
    mirrored : float in [0, 0.5], NaN if no frame counts
        Share of the frames that count whose handedness disagrees with the majority's.
    left_out : float in [0, 1]
        Share of all frames that do not count: their truth is nearly its own mirror image.
    """

    mirrored: float
    left_out: float


def align(S: Any, S_true: Any, *, scale: bool = True, reflections: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Move each predicted shape onto its true one.

    Both are centred over their points; then the best orthogonal matrix per frame is applied: orthogonal
    Procrustes, by SVD (Schönemann, 1966, doi:10.1007/BF02289451).

    Parameters
    ----------
    S, S_true : (F, P, 3) arrays or tensors
    scale : bool
        First scale the prediction to the norm of the truth, as the paper's authors do.
    reflections : bool
        Allow a mirror image in each frame, O(3). With False only rotations, SO(3).

    Returns
    -------
    aligned, centred : (F, P, 3) float64
        The moved prediction and the truth with its centroid at zero.

    Raises
    ------
    ValueError
        If the shapes differ or a value is not finite, or if a true shape has all points equal.

    Examples
    --------
    >>> S_true = np.eye(4, 3)[None]
    >>> moved, centred = nl.metrics.align(7 - 2 * S_true, S_true)
    >>> np.allclose(moved, centred)
    True
    """
    S, S_true = _centred(*_pair(S, S_true))
    if checks.truth("scale", scale):
        size = np.linalg.norm(S, axis=(1, 2))
        S = S * (np.linalg.norm(S_true, axis=(1, 2)) / np.where(size > 0, size, 1))[:, None, None]
    U, _, Vh = np.linalg.svd(S.swapaxes(1, 2) @ S_true)  # (F, 3, 3)
    if not checks.truth("reflections", reflections):
        U[:, :, -1] *= np.sign(np.linalg.det(U @ Vh))[:, None]  # the weakest direction pays
    return S @ (U @ Vh), S_true


def normalized_error(
    S: Any, S_true: Any, *, scale: bool = True, reflections: bool = True, points: Any = None
) -> np.ndarray:
    """Normalised 3D error per frame, ‖S − S*‖_F / ‖S*‖_F after `align` (paper, experiments).

    Parameters as in `align`. ``scale=True`` is the evaluation of the paper's authors;
    ``scale=False`` is the common per-frame error of the classical literature. Both forgive a mirror image in
    each frame; `rotation_only_error` forgives one for the whole result, and ``reflections=False`` none at all,
    which fits only data whose handedness the images decide.

    points : (F, P) bool, optional
        Count only these points, for instance the hidden ones; the alignment still takes all. Their root mean
        square distance is divided by the root mean square of the whole true shape, so that the squared
        error of all points is the mean of the squared errors of two halves, weighted by their sizes.

    Returns
    -------
    (F,) array; the number that papers print is its mean. NaN for a frame with none of `points`.

    Raises
    ------
    ValueError
        As `align`; also if `points` is not an (F, P) mask.

    Examples
    --------
    >>> S_true = np.eye(4, 3)[None]
    >>> nl.metrics.normalized_error(S_true * (1, 1, 0), S_true).round(2)
    array([0.49])
    """
    S, S_true = align(S, S_true, scale=scale, reflections=reflections)
    if points is None:
        return np.linalg.norm(S - S_true, axis=(1, 2)) / np.linalg.norm(S_true, axis=(1, 2))
    points = checks.as_array("points", points, bool)
    checks.check_shape("points", points, S.shape[:2])
    count = np.where(points.any(1), points.sum(1), np.nan)
    square = (((S - S_true) ** 2).sum(2) * points).sum(1) / count
    return np.sqrt(square / (S_true**2).sum(2).mean(1))


def rotation_only_error(S: Any, S_true: Any, *, scale: bool = True, points: Any = None) -> np.ndarray:
    """`normalized_error` with rotations only: a frame that is mirrored against the others pays for it.

    The whole result is first mirrored or not, whichever has the smaller mean error over frames and points, for
    orthographic images always leave that one choice. Then each frame is aligned by a rotation, SO(3). It is
    at least as large as `normalized_error`, which mirrors frame by frame, and equal to it where no frame is
    of the wrong hand.

    Parameters
    ----------
    S, S_true, scale, points : as in `normalized_error`

    Returns
    -------
    (F,) array

    Raises
    ------
    ValueError
        As `normalized_error`.

    Examples
    --------
    >>> S_true = np.tile(np.eye(4, 3) * (1, 2, 3), (3, 1, 1))
    >>> nl.metrics.rotation_only_error(S_true * (1, 1, -1), S_true).round(2) + 0
    array([0., 0., 0.])
    >>> one_flipped = S_true * np.array([1, 1, -1])[:, None, None]
    >>> nl.metrics.rotation_only_error(one_flipped, S_true).round(2) + 0
    array([0.  , 0.  , 0.41])
    """
    S, S_true = _pair(S, S_true)
    hands = (S, -S)
    whole = [normalized_error(hand, S_true, scale=scale, reflections=False) for hand in hands]
    best = int(whole[1].mean() < whole[0].mean())
    if points is None:
        return whole[best]
    return normalized_error(hands[best], S_true, scale=scale, reflections=False, points=points)


def camera_frame_error(S: Any, S_true: Any) -> np.ndarray:
    """Normalised error per frame of shapes in their camera's frame, turned not at all.

    Only the sign of all depths (the third coordinate) may change, per frame. For methods that return shapes in the
    camera's frame and keep the image points as they are, this is what their authors report (Lee et al., 2016).

    Parameters
    ----------
    S, S_true : (F, P, 3) arrays or tensors, as `cameras.camera_frame` makes them

    Returns
    -------
    (F,) array

    Raises
    ------
    ValueError
        As `align`.

    Examples
    --------
    >>> S_true = np.eye(4, 3)[None]
    >>> nl.metrics.camera_frame_error(S_true * (1, 1, -1), S_true).round(2) + 0
    array([0.])
    """
    S, S_true = _centred(*_pair(S, S_true))
    missed = [np.linalg.norm(S * (1, 1, sign) - S_true, axis=(1, 2)) for sign in (1, -1)]
    return np.minimum(*missed) / np.linalg.norm(S_true, axis=(1, 2))


def e3d(S: Any, S_true: Any, *, per_frame: bool = False) -> np.ndarray:
    """The classical normalised mean 3D error per frame, with one alignment for all frames.

    Both sets are centred per frame. One orthogonal matrix, the polar factor of the least-squares map
    from all predicted points to all true ones, is applied to every frame; a mirror image is allowed.
    Distances per point are then divided by σ, the mean standard deviation of the true coordinates
    over frames and axes. No scale is fitted. Unlike `normalized_error` this punishes frames that are
    turned against each other; the two are never comparable (Akhter et al., 2009; Dai et al., 2014).

    Parameters
    ----------
    S, S_true : (F, P, 3) arrays or tensors
    per_frame : bool
        Align each frame on its own instead, as `align` does, without scale.

    Returns
    -------
    (F,) array; papers print its mean.

    Raises
    ------
    ValueError
        If the shapes differ or a value is not finite, or if a true shape has all points equal.

    Examples
    --------
    >>> S_true = np.eye(4, 3)[None]
    >>> nl.metrics.e3d(1.1 * S_true, S_true).round(3)
    array([0.169])
    """
    if checks.truth("per_frame", per_frame):
        moved, S_true = align(S, S_true, scale=False)
    else:
        S, S_true = _centred(*_pair(S, S_true))
        linear = np.linalg.lstsq(S.reshape(-1, 3), S_true.reshape(-1, 3), rcond=None)[0]
        U, _, Vh = np.linalg.svd(linear)
        moved = S @ (U @ Vh)
    return np.linalg.norm(moved - S_true, axis=2).mean(1) / S_true.std(axis=1).mean()


def cumulative_error(errors: Any, at: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Share of frames whose error is at most a value: the curve that says more than a mean.

    Parameters
    ----------
    errors : (F,) array
        Frames of NaN, which have no error (`normalized_error` with `points`), are left out.
    at : (n,) array, optional
        Values at which to count. Default: 200 values from 0 to the largest error.

    Returns
    -------
    at, share : two (n,) arrays; `share` rises from 0 to 1.

    Raises
    ------
    ValueError
        If no frame has an error.

    Examples
    --------
    >>> nl.metrics.cumulative_error([0.1, 0.3, np.nan, 0.2, 0.4], at=[0.25])
    (array([0.25]), array([0.5]))
    """
    errors = checks.as_array("errors", errors, float)
    if errors.ndim != 1:
        raise ValueError(f"errors has shape {errors.shape}; expected (F,).")
    errors = np.sort(errors[~np.isnan(errors)])
    if not len(errors):
        raise ValueError("errors holds no number; there is nothing to count.")
    at = np.linspace(0, errors[-1], 200) if at is None else checks.as_array("at", at, float)
    return at, np.searchsorted(errors, at, side="right") / len(errors)


def handedness(S: Any, S_true: Any) -> Handedness:
    """Share of frames whose handedness disagrees with the majority's.

    One mirror image for all frames is a convention; frames that flip one by one are an error that
    `normalized_error` with its reflections hides and a video shows at once. A frame counts as
    mirrored if its best orthogonal alignment has a negative determinant. A flat shape is its own mirror image,
    and then noise decides that sign, so a frame counts only if its truth differs from its mirror image:
    by a normalised error of more than 0.1 with rotations only.

    Parameters
    ----------
    S, S_true : (F, P, 3) arrays or tensors

    Returns
    -------
    Handedness, a named tuple: `mirrored`, the share of the frames that count, in [0, 0.5] and 0 if all agree (NaN
    if none counts); and `left_out`, the share of all frames that do not count.

    Raises
    ------
    ValueError
        As `align`.

    Examples
    --------
    >>> S_true = np.tile(np.eye(4, 3) * (1, 2, 3), (4, 1, 1))
    >>> S = S_true * np.array([1, 1, 1, -1])[:, None, None]
    >>> nl.metrics.handedness(S, S_true)
    Handedness(mirrored=0.25, left_out=0.0)
    """
    S, S_true = _centred(*_pair(S, S_true))
    counts = normalized_error(-S_true, S_true, reflections=False) > _ONE_HANDED
    if not counts.any():
        return Handedness(float("nan"), 1.0)
    # det of the best orthogonal matrix has the sign of det(Sᵀ S*)
    mirrored = np.mean(np.linalg.det(S[counts].swapaxes(1, 2) @ S_true[counts]) < 0)
    return Handedness(float(min(mirrored, 1 - mirrored)), float(np.mean(~counts)))


def mpjpe(S: Any, S_true: Any) -> np.ndarray:
    """Mean distance per point after centring only, in the units of the truth: (F,).

    S and S_true are (F, P, 3) arrays or tensors. Raises ValueError as `align`.

    >>> S_true = np.eye(4, 3)[None]
    >>> nl.metrics.mpjpe(S_true + 5, S_true).round(6) + 0
    array([0.])
    """
    S, S_true = _centred(*_pair(S, S_true))
    return np.linalg.norm(S - S_true, axis=2).mean(1)


def pa_mpjpe(S: Any, S_true: Any) -> np.ndarray:
    """Mean distance per point after the best similarity without mirroring, in the truth's units: (F,).

    Scale, rotation and translation per frame are the least-squares optimum. S and S_true are (F, P, 3) arrays or
    tensors. Raises ValueError as `align`.

    >>> S_true = np.eye(4, 3)[None]
    >>> nl.metrics.pa_mpjpe(3 * S_true + 5, S_true).round(6) + 0
    array([0.])
    """
    S, S_true = align(S, S_true, reflections=False)
    best = (S * S_true).sum((1, 2)) / np.maximum((S * S).sum((1, 2)), np.finfo(float).tiny)
    return np.linalg.norm(best[:, None, None] * S - S_true, axis=2).mean(1)


def _centred(*shapes: np.ndarray) -> list[np.ndarray]:
    return [S - S.mean(1, keepdims=True) for S in shapes]


def _pair(S: Any, S_true: Any) -> tuple[np.ndarray, np.ndarray]:
    S, S_true = checks.as_array("S", S, float), checks.as_array("S_true", S_true, float)
    if S.shape != S_true.shape or S.ndim != 3 or S.shape[2] != 3:
        raise ValueError(f"S and S_true have shapes {S.shape} and {S_true.shape}; expected (F, P, 3) twice.")
    checks.check_finite("S", S)
    checks.check_finite("S_true", S_true)
    if (np.ptp(S_true, axis=1) == 0).all(-1).any():
        raise ValueError("S_true has a frame whose points are all equal; a relative error has no meaning there.")
    return S, S_true
