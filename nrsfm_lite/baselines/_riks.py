"""Rotation invariant kernels: frames that look alike have alike shapes (Hamsici, Gotardo and Martinez, 2012)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..checks import one_of
from ..data import Reconstruction
from ..images import read
from ..threads import one_thread
from .shared.completion import completed
from .shared.limits import Watch, check_cost, choose_components, choose_rank
from .shared.upgrade import stacked, trajectory_cameras
from .shared.variable_projection import fit, linear

KERNELS = ("asfm", "rik")
_ENERGY = 0.99  # of the kernel's spectrum, that the basis keeps


@one_thread
def riks(
    W: Any,
    visible: Any = None,
    *,
    confidence: Any = None,
    rank: int | None = None,
    basis: float = 0.2,
    kernel: str = "asfm",
    max_seconds: float | None = None,
    progress: bool = True,
) -> Reconstruction:
    """As column space fitting, but coefficients are smooth over *likeness of images* instead of time.

    Objective: ``min Σ_f ‖X_f − Σ_k c_fk B_k M_f‖²`` with C = Φ Z, where Φ (F, d) are the main components of a
    kernel between the images, exp(−E / 2σ²). E compares two images up to a rotation: ``"rik"`` in the plane,
    2 − 2 |z_fᴴ z_g| for images as unit vectors of complex numbers; ``"asfm"`` in space, the energy of the two
    images together that no rigid body can explain. σ is set so that d components hold 99 % of the spectrum.
    The atoms follow one after the other, each from what the ones before left, which is exact only where their images
    are independent of each other over the frames; `variable_projection` does the rest.

    Cost O(F³) for each of log₂F trials of σ, then O(F d² rank² + (d · rank)³) for a step, up to 300 of them; memory
    O(F² + (d · rank)²). With d a share of F this ends at some thousand frames.

    Coefficients need no order of the frames. The cameras do: they are those of `trajectory_cameras`, as in the
    authors' code, made for video, and they stay as they are.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array of image points
    visible : (F, P) bool, optional
        Hidden points are filled in by `complete` first.
    confidence : (F, P), optional
        From 0 to 1; `complete` moves a doubtful point towards its likely place. Default: that of the Landmarks,
        else 1.
    rank : int, optional
        Number of atoms K, with 3K at most P and 2F. The authors take 5 to 8, others 3 for `pickup`. Default: 7, or
        the largest possible.
    basis : float
        Number of components over the number of frames: .1 to .3 in the authors' demonstration.
    kernel : "asfm" or "rik"
    max_seconds : float, optional
        Then the result so far is returned, with ``converged=False``.
    progress : bool

    Returns
    -------
    Reconstruction in one world frame for all frames, in the units of W.

    Raises
    ------
    ValueError
        As `images.read`, with fewer than 6 frames or points; as `trajectory_cameras`; for a parameter out of range;
        or if memory or time would not suffice.

    Notes
    -----
    Certain: all of it, from the authors' code (their first algorithm). Their second one, which fits rank by rank
    with weights on the points, is left out.

    References
    ----------
    Hamsici, Gotardo, Martinez (2012). Learning spatially-smooth mappings in non-rigid structure from motion. ECCV,
    260–273.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(30))
    >>> nl.baselines.riks(views, rank=3, progress=False).shapes.shape == views.points3d.shape
    True
    """
    images = completed(read(W, visible, confidence, method="riks", frames=6, points=6))
    F, P, _ = images.X.shape
    rank = choose_rank(rank, 7, 1, F, P)
    d = choose_components("basis", basis, rank, F)
    one_of("kernel", kernel, KERNELS)
    check_cost("riks", F, *_cost(F, P, d, rank), max_seconds, "A smaller basis takes fewer components.")
    watch = Watch("riks", max_seconds, progress)
    M = trajectory_cameras(images.X, watch)
    distances = _unlike_in_space(images.X) if kernel == "asfm" else _unlike_in_the_plane(images.X)
    components = _components(distances, d, watch)
    coefficients, start = linear(components, rank)
    S, done = fit(images.X, M, coefficients, start, watch, sequential=True, iterations=300, tolerance=1e-9)
    return images.reconstruction(S, M, method="riks", converged=done)


def _unlike_in_the_plane(X: np.ndarray) -> np.ndarray:
    """(F, F): how far two images are from a rotation of each other in the plane, 0 to 2."""
    z = X[..., 0] + 1j * X[..., 1]
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.maximum(2 - 2 * np.abs(z @ z.conj().T), 0)


def _unlike_in_space(X: np.ndarray) -> np.ndarray:
    """(F, F): the energy of two images, stacked to four rows, outside their best rank 3, which a rigid body has."""
    F = len(X)
    rows = stacked(X)
    products = torch.as_tensor(rows @ rows.T).view(F, 2, F, 2).transpose(1, 2)  # (F, F, 2, 2)
    own = products.diagonal().permute(2, 0, 1)  # (F, 2, 2), each image with itself
    E = torch.empty(F, F, dtype=torch.float64)
    for f in range(F):  # row by row: F² matrices of 4×4 would not fit
        mine, cross = own[f].expand(F, 2, 2), products[f]
        gram = torch.cat([torch.cat([mine, cross], 2), torch.cat([cross.mT, own], 2)], 1)
        E[f] = torch.linalg.eigvalsh(gram)[:, 0].clamp(min=0)
    return ((E + E.T) / 2).numpy()


def _components(E: np.ndarray, d: int, watch: Watch) -> np.ndarray:
    """(F, d): main components of the kernel, its width chosen so that d of them hold most of the spectrum."""
    ordered = np.sort(E, axis=1)
    low, high = 1, len(E) - 1
    while low < high and not watch.over:  # a wider kernel needs fewer components
        middle = (low + high) // 2
        spectrum = np.sort(np.abs(np.linalg.eigvalsh(_kernel(E, ordered, middle))))[::-1]
        needed = 1 + int((np.cumsum(spectrum) < _ENERGY * spectrum.sum()).sum())
        low, high = (middle + 1, high) if needed > d else (low, middle)
    values, V = np.linalg.eigh(_kernel(E, ordered, low))
    main = np.argsort(-np.abs(values))[:d]
    # K v / sqrt(|λ|) = v · λ / sqrt(|λ|): the scale of a component is that of its singular value.
    return V[:, main] * np.sqrt(np.abs(values[main]))


def _kernel(E: np.ndarray, ordered: np.ndarray, neighbour: int) -> np.ndarray:
    """exp(−E / 2σ²), with σ² the mean distance to the neighbour of that rank."""
    return np.exp(-E / (2 * max(ordered[:, neighbour].mean(), 1e-300)))


def _cost(F: int, P: int, d: int, rank: int) -> tuple[float, float]:
    """Gigabytes and seconds, roughly."""
    n = d * rank
    gigabytes = 8 * (6 * F**2 + 6 * F * rank**2 * P + 7 * n**2) / 2**30
    return gigabytes, (4e-11 * F**3 * np.log2(F)) + 150 * (2 * F * n**2 + n**3 + 12 * F * rank * n * P) / 1e10
