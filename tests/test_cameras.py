"""Random cameras, projection, and the nearest orthonormal matrix with its gradient."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from nrsfm_lite import cameras


def test_random_rotations_are_rotations_and_repeatable():
    R = cameras.random_rotations(100, seed=3)
    np.testing.assert_allclose(R.swapaxes(1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    np.testing.assert_array_equal(R, cameras.random_rotations(100, seed=3))


def test_random_cameras_look_from_everywhere():
    M = cameras.random_cameras(20000)
    np.testing.assert_allclose(M.swapaxes(1, 2) @ M, np.broadcast_to(np.eye(2), (20000, 2, 2)), atol=1e-12)
    # Uniform directions: mean 0, and E[m mᵀ] = I/3.
    np.testing.assert_allclose(M.mean(0), 0, atol=0.02)
    np.testing.assert_allclose(np.einsum("fij,fkj->ik", M, M) / 40000, np.eye(3) / 3, atol=0.01)


def test_projection_point_by_point(rng):
    S, M, t = rng.normal(size=(2, 4, 3)), cameras.random_cameras(2), rng.normal(size=(2, 2))
    W = cameras.project(S, M, t)
    for f in range(2):
        for p in range(4):
            np.testing.assert_allclose(W[f, p], M[f].T @ S[f, p] + t[f])


def test_polar_equals_svd():
    A = torch.randn(2000, 3, 2, dtype=torch.double, generator=torch.Generator().manual_seed(0))
    U, _, Vh = torch.linalg.svd(A, full_matrices=False)
    torch.testing.assert_close(cameras.nearest_orthonormal(A), U @ Vh)


def test_polar_in_float32_stays_orthonormal_near_rank_one():
    g = torch.Generator().manual_seed(0)
    A = torch.randn(1000, 3, 2, generator=g)
    A[:, :, 1] = 3 * A[:, :, 0] + 1e-3 * A[:, :, 1]
    M = cameras.nearest_orthonormal(A)
    torch.testing.assert_close(M.mT @ M, torch.eye(2).expand(1000, 2, 2), atol=1e-4, rtol=0)


@pytest.mark.parametrize("size", [1e-18, 1.0, 1e18])
def test_polar_does_not_depend_on_the_size_of_its_input(size):
    A = torch.randn(50, 3, 2, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(cameras.nearest_orthonormal(size * A), cameras.nearest_orthonormal(A))


def test_polar_gradient():
    g = torch.Generator().manual_seed(0)
    A = torch.randn(5, 3, 2, dtype=torch.double, generator=g, requires_grad=True)
    assert gradcheck(cameras.nearest_orthonormal, (A,))


@pytest.mark.parametrize("size", [0.1, 1.0, 20.0])
def test_polar_gradient_at_equal_singular_values(size):
    M = torch.as_tensor(cameras.random_cameras(5))
    A = (size * M).requires_grad_()
    assert gradcheck(cameras.nearest_orthonormal, (A,))
    # The road that is not taken: there the SVD's gradient is not finite.
    B = torch.eye(3, 2, dtype=torch.double, requires_grad=True)
    U, _, Vh = torch.linalg.svd(B, full_matrices=False)
    (U @ Vh)[0, 1].backward()
    assert not torch.isfinite(B.grad).all()


def test_polar_gradient_equals_the_svds_where_that_is_good():
    g = torch.Generator().manual_seed(0)
    A = torch.randn(200, 3, 2, dtype=torch.double, generator=g, requires_grad=True)
    weights = torch.randn(200, 3, 2, dtype=torch.double, generator=g)
    U, _, Vh = torch.linalg.svd(A, full_matrices=False)
    (by_svd,) = torch.autograd.grad(((U @ Vh) * weights).sum(), A)
    (by_polar,) = torch.autograd.grad((cameras.nearest_orthonormal(A) * weights).sum(), A)
    torch.testing.assert_close(by_polar, by_svd, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("A", [torch.zeros(3, 2), torch.ones(3, 2), torch.tensor([[1.0, 0], [0, 0], [0, 0]])])
def test_degenerate_input_gives_a_camera_and_a_finite_gradient(A):
    A = A.clone().requires_grad_()
    M = cameras.nearest_orthonormal(A)
    torch.testing.assert_close(M.mT @ M, torch.eye(2))
    M.sum().backward()
    assert torch.isfinite(A.grad).all()


def test_polar_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"\(\.\.\., 3, 2\)"):
        cameras.nearest_orthonormal(torch.zeros(2, 3))


def test_rotation_error_ignores_the_world_frame_and_its_mirror():
    M = cameras.random_cameras(50)
    Q = cameras.random_rotations(1, seed=9)[0]
    np.testing.assert_allclose(cameras.rotation_error(Q @ M, M), 0, atol=1e-5)
    np.testing.assert_allclose(cameras.rotation_error(np.diag([1, 1, -1]) @ M, M), 0, atol=1e-5)


def test_rotation_error_measures_one_wrong_camera():
    M = np.repeat(cameras.random_cameras(1), 1000, axis=0)
    M = cameras.random_rotations(1000, seed=1) @ M
    wrong = M.copy()
    angle = np.radians(30)
    spin = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    wrong[0] = M[0] @ spin
    assert cameras.rotation_error(wrong, M)[0] == pytest.approx(30, abs=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cameras.random_rotations(2.5), "n=2.5"),
        (lambda: cameras.random_cameras(3, seed=0.5), "seed=0.5"),
        (lambda: cameras.random_cameras(3, seed=-1), "seed=-1"),
        (lambda: cameras.image_turns(torch.zeros(2, 2)), r"angle has shape \(2, 2\)"),
        (lambda: cameras.project(np.zeros((4, 2)), np.zeros((3, 2))), r"S has shape \(4, 2\)"),
        (lambda: cameras.project(np.zeros((4, 3)), np.zeros((3, 2)), np.zeros(3)), r"t \(3,\)"),
        (lambda: cameras.camera_frame(np.zeros((5, 4, 3)), np.zeros((1, 3, 2))), r"expected \(F, P, 3\)"),
        (lambda: cameras.nearness(np.zeros((4, 3)), np.zeros((3, 2))), r"expected \(F, P, 3\)"),
        (lambda: cameras.rotations(np.zeros((5, 2, 3))), r"expected \(\.\.\., 3, 2\)"),
        (lambda: cameras.rotation_error(np.zeros((5, 3, 2)), np.zeros((4, 3, 2))), "twice"),
        (
            lambda: cameras.rotation_error(np.full((5, 3, 2), np.nan), np.zeros((5, 3, 2))),
            "M has 30 values that are not",
        ),
    ],
)
def test_wrong_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_seeds_may_be_numpys_and_shapes_tensors():
    M = cameras.random_cameras(np.int64(3), seed=np.int32(4))
    np.testing.assert_array_equal(M, cameras.random_cameras(3.0, seed=4))
    S = torch.ones(3, 5, 3)
    np.testing.assert_allclose(cameras.camera_frame(S, torch.as_tensor(M))[..., :2], S.numpy() @ M)
    np.testing.assert_allclose(cameras.rotation_error(torch.as_tensor(M), M, degrees=False), 0, atol=1e-7)
