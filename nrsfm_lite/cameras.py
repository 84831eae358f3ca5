"""Cameras: random ones, projection, and the nearest camera to a 3×2 matrix.

A camera is a (3, 2) matrix M with orthonormal columns, MᵀM = I₂. A shape S (P, 3) is seen as
W = S M + t (paper, eq. 9).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from . import checks

# A 3×2 block with σ₁ σ₂ below this share of ‖A‖² has no direction to offer for the second column:
# the nearest camera is not unique there, and close by its gradient has no bound.
_DEGENERATE = 1e-6


def random_rotations(n: int, seed: int | np.random.Generator = 0) -> np.ndarray:
    """(n, 3, 3) rotation matrices, uniform over SO(3). `seed` is a whole number or a NumPy Generator.

    >>> nl.cameras.random_rotations(4).shape
    (4, 3, 3)
    """
    n = checks.whole("n", n, 0)
    if not isinstance(seed, np.random.Generator):
        seed = np.random.default_rng(checks.whole("seed", seed, 0))
    return Rotation.random(n, rng=seed).as_matrix()


def random_cameras(n: int, seed: int | np.random.Generator = 0) -> np.ndarray:
    """(n, 3, 2) orthographic cameras from uniformly random directions, orthonormal columns; `seed` as above.

    >>> M = nl.cameras.random_cameras(4)
    >>> np.allclose(M.swapaxes(1, 2) @ M, np.eye(2))
    True
    """
    return random_rotations(n, seed)[:, :, :2]


def image_turns(angle: Tensor) -> Tensor:
    """(n, 2, 2) rotations of the image plane, for points as rows, by angles (n,) in radians (a tensor).

    >>> (torch.eye(2) @ nl.cameras.image_turns(torch.tensor([torch.pi / 2]))).round()[0] + 0
    tensor([[ 0., -1.],
            [ 1.,  0.]])
    """
    if angle.ndim != 1:
        raise ValueError(f"angle has shape {tuple(angle.shape)}; expected (n,).")
    c, s = angle.cos(), angle.sin()
    return torch.stack([c, -s, s, c], 1).view(-1, 2, 2)


def project(S: Any, M: Any, t: Any = None) -> Any:
    """Image points of shapes: W = S M + t (paper, eq. 9).

    Parameters
    ----------
    S : (..., P, 3) array or tensor
    M : (..., 3, 2)
    t : (..., 2), optional

    Returns
    -------
    (..., P, 2), an array or a tensor as S is

    Raises
    ------
    ValueError
        If a shape does not fit.

    Examples
    --------
    >>> nl.cameras.project(np.ones((1, 4, 3)), np.eye(3, 2), t=[[1, 2]])[0, 0]
    array([2., 3.])
    """
    S, M, t = (x if x is None or torch.is_tensor(x) else np.asarray(x) for x in (S, M, t))
    if S.shape[-1:] != (3,) or M.shape[-2:] != (3, 2) or (t is not None and t.shape[-1:] != (2,)):
        shapes = f"S has shape {tuple(S.shape)}, M {tuple(M.shape)}" + (
            f", t {tuple(t.shape)}" if t is not None else ""
        )
        raise ValueError(f"{shapes}; expected (..., P, 3), (..., 3, 2) and (..., 2).")
    W = S @ M
    return W if t is None else W + t[..., None, :]


def nearness(S: Any, M: Any) -> np.ndarray:
    """How far each point is from the plane through the origin towards the viewer; x right, y up, z to the viewer.

    S (F, P, 3) and M (F, 3, 2); returns (F, P), in the units of S. Raises ValueError as `camera_frame`.

    >>> nl.cameras.nearness(np.array([[[1, 2, 3], [4, 5, 6]]]), np.eye(3, 2)[None])
    array([[3., 6.]])
    """
    return camera_frame(S, M)[:, :, 2]


def camera_frame(S: Any, M: Any) -> np.ndarray:
    """Shapes as their cameras see them: x right, y up, z towards the viewer.

    Methods that find no camera return their shapes like this, so a comparison turns all others and the truth.
    S (F, P, 3) and M (F, 3, 2); returns (F, P, 3), in the units of S. Raises ValueError if a shape does not fit.

    >>> nl.cameras.camera_frame(np.array([[[1, 2, 3]]]), np.eye(3)[None, :, 1:])
    array([[[2., 3., 1.]]])
    """
    S, M = checks.as_array("S", S, float), checks.as_array("M", M, float)
    if S.ndim != 3 or S.shape[2] != 3 or M.shape != (len(S), 3, 2):
        raise ValueError(f"S and M have shapes {S.shape} and {M.shape}; expected (F, P, 3) and (F, 3, 2).")
    return S @ rotations(M)


def rotations(M: Any) -> np.ndarray:
    """Cameras (..., 3, 2) completed by the direction to the viewer, m₁ × m₂: array (..., 3, 3).

    >>> nl.cameras.rotations(np.eye(3, 2)[None])[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    M = checks.as_array("M", M, float)
    if M.shape[-2:] != (3, 2):
        raise ValueError(f"M has shape {M.shape}; expected (..., 3, 2).")
    return np.concatenate([M, np.cross(M[..., 0], M[..., 1])[..., None]], -1)


def nearest_orthonormal(A: Tensor) -> Tensor:
    """The camera nearest to each 3×2 matrix: its polar factor A (AᵀA)^(-1/2) = U Vᵀ, in closed form.

    That the polar factor is the nearest matrix with orthonormal columns: Higham (1986, doi:10.1137/0907079).

    With n the unit normal of the two columns a₁, a₂, and σ₁, σ₂ the singular values,

        M = ( A + [a₂ × n, n × a₁] ) / (σ₁ + σ₂),   σ₁ + σ₂ = sqrt(‖A‖² + 2 ‖a₁ × a₂‖).

    The bracket is A with its two singular values swapped, so the sum has both equal. No singular
    vectors are formed, which is why the gradient stays exact when σ₁ = σ₂ (chapter 07).

    Parameters
    ----------
    A : (..., 3, 2) tensor

    Returns
    -------
    (..., 3, 2) tensor, orthonormal columns
        Where A is zero or has rank one, a fixed camera and a gradient of zero: there the nearest
        camera is not unique, and the true gradient grows as 1/σ₂.

    Raises
    ------
    ValueError
        If the last two axes are not (3, 2).

    Examples
    --------
    >>> nl.cameras.nearest_orthonormal(torch.tensor([[3.0, 0.0], [0.0, 0.5], [0.0, 0.0]])).round() + 0
    tensor([[1., 0.],
            [0., 1.],
            [0., 0.]])
    """
    if A.shape[-2:] != (3, 2):
        raise ValueError(f"A has shape {tuple(A.shape)}; expected (..., 3, 2).")
    return _Polar.apply(A) if A.requires_grad and torch.is_grad_enabled() else polar(A)[0]


def polar(A: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`nearest_orthonormal` and what its gradient needs: M, (AᵀA)^(-1/2) and 1 / (σ₁ + σ₂), both 0 if degenerate.

    A is a (..., 3, 2) tensor.

    >>> M, inverse, per_total = nl.cameras.polar(2 * torch.eye(3, 2))
    >>> inverse, per_total.squeeze()
    (tensor([[0.5000, 0.0000],
            [0.0000, 0.5000]]), tensor(0.2500))
    """
    size = A.square().sum((-2, -1), keepdim=True)  # ‖A‖²
    size = torch.where(size > 0, size, torch.ones_like(size)).sqrt()
    A = A / size  # no under- or overflow below
    a1, a2 = A.unbind(-1)  # each (..., 3)
    normal = torch.linalg.cross(a1, a2)
    area = normal.norm(dim=-1, keepdim=True)  # σ₁ σ₂ / ‖A‖²
    good = area[..., None] > _DEGENERATE  # False for NaN, too
    area = torch.where(good[..., 0], area, torch.ones_like(area))
    n = normal / area
    swapped = torch.stack([torch.linalg.cross(a2, n), torch.linalg.cross(n, a1)], -1)
    total = (1 + 2 * area).sqrt()[..., None]  # (σ₁ + σ₂) / ‖A‖
    M = torch.where(good, (A + swapped) / total, torch.eye(3, 2, dtype=A.dtype, device=A.device))
    inverse = (total * torch.eye(2, dtype=A.dtype, device=A.device) - M.mT @ A) / (area[..., None] * size)
    return M, torch.where(good, inverse, 0.0), torch.where(good, 1 / (total * size), 0.0)


def polar_gradient(g: Tensor, found: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Gradient before the polar factor, of g (..., 3, 2) after it; `found` is what `polar` returned.

    What moves the columns out of their plane is divided by the singular values, what turns them inside
    it by their sum. No difference of singular values appears (chapter 07).

    >>> nl.cameras.polar_gradient(torch.ones(3, 2), nl.cameras.polar(2 * torch.eye(3, 2)))[2]
    tensor([0.5000, 0.5000])
    """
    M, inverse, per_total = found
    inner = M.mT @ g
    angle = (inner[..., 0, 1] - inner[..., 1, 0])[..., None, None] * per_total
    turned = torch.stack([-M[..., 1], M[..., 0]], -1)
    return (g - M @ inner) @ inverse + angle * turned


class _Polar(torch.autograd.Function):
    """`polar` with `polar_gradient` behind it: a third of the operations autograd would need."""

    @staticmethod
    def forward(ctx, A):
        M, *rest = polar(A)
        ctx.save_for_backward(M, *rest)
        return M

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g):
        return polar_gradient(g, ctx.saved_tensors)


def rotation_error(M: Any, M_true: Any, *, degrees: bool = True) -> np.ndarray:
    """Angle between estimated and true cameras after the best common rotation or reflection.

    The world frame of a reconstruction is arbitrary, and so is its mirror image. One orthogonal Q
    for all frames takes that freedom out: Q = argmin Σ‖Q M_f − M_f*‖².

    Parameters
    ----------
    M, M_true : (F, 3, 2) arrays or tensors, orthonormal columns
    degrees : bool

    Returns
    -------
    (F,) angles between the completed rotations, in degrees (radians with ``degrees=False``).

    Raises
    ------
    ValueError
        If the shapes differ or a value is not finite.

    Examples
    --------
    >>> M = nl.cameras.random_cameras(5)
    >>> nl.cameras.rotation_error(M[:, ::-1], M).max().round(3) + 0  # the world turned over
    np.float64(0.0)
    """
    M, M_true = checks.as_array("M", M, float), checks.as_array("M_true", M_true, float)
    if M.shape != M_true.shape or M.shape[1:] != (3, 2):
        raise ValueError(f"M and M_true have shapes {M.shape} and {M_true.shape}; expected (F, 3, 2) twice.")
    checks.check_finite("M", M)
    checks.check_finite("M_true", M_true)
    U, _, Vh = np.linalg.svd(np.einsum("fij,fkj->ik", M_true, M))
    relative = rotations((U @ Vh) @ M).swapaxes(1, 2) @ rotations(M_true)
    angle = Rotation.from_matrix(relative).magnitude()
    return np.degrees(angle) if checks.truth("degrees", degrees) else angle
