"""The Gaussian shape prior: its likelihood, what it learns, and what it does for a frame."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

import nrsfm_lite as nl
from nrsfm_lite import normalizer, shape_prior

P = 6


@pytest.fixture(scope="module")
def truth():
    """Shapes drawn from a Gaussian of rank 4, and their images from all sides."""
    rng = np.random.default_rng(0)
    basis = rng.normal(size=(4, P, 3)) * np.array([0.5, 0.3, 0.2, 0.1])[:, None, None]
    mean = rng.normal(size=(P, 3))
    S = mean + np.tensordot(rng.normal(size=(1500, 4)), basis, 1)
    S = torch.as_tensor(S - S.mean(1, keepdims=True))
    M = torch.as_tensor(nl.cameras.random_cameras(1500, seed=1))
    return S, M, S @ M


def by_hand(prior, X, weight, M, shift):
    """Mean and covariance of one image's visible coordinates, straight from the definition."""
    seen = weight > 0
    A = np.kron(M.numpy().T, np.eye(P))[np.tile(seen, 2)]
    shifts = np.kron(np.eye(2), np.ones((P, 1)))[np.tile(seen, 2)]
    C = (
        A @ prior.covariance.numpy() @ A.T
        + np.diag(prior.noise / np.tile(weight[seen], 2))
        + shift**2 * shifts @ shifts.T
    )
    return A, C, X.numpy().T.ravel()[np.tile(seen, 2)], A @ prior.mean.numpy().T.ravel()


def some_prior():
    B = torch.randn(3 * P, 3 * P, dtype=torch.double, generator=torch.Generator().manual_seed(2)) / 5
    mean = torch.randn(P, 3, dtype=torch.double, generator=torch.Generator().manual_seed(3))
    return shape_prior.Gaussian(mean, B @ B.T, 1e-2)


def turned_by(M, vectors):
    return torch.as_tensor(Rotation.from_rotvec(vectors).as_matrix()) @ M


@pytest.mark.parametrize(
    "weight", [[1, 1, 1, 1, 1, 1], [1, 0, 1, 1, 1, 1], [0, 1, 1, 0.3, 1, 1], [1, 1, 0.7, 1, 0.1, 1]]
)
def test_a_shape_is_the_conditional_mean_and_newton_steps_end_at_the_most_likely_camera(truth, weight):
    prior, (_, cameras, images) = some_prior(), truth
    weight = np.array(weight, float)
    visible = weight > 0
    shift = 0.0 if (weight == 1).all() else 1.0
    X, M = images[:1] * torch.as_tensor(visible)[:, None], cameras[:1]
    root_weight = torch.as_tensor(np.tile(weight, 2))[None].sqrt()
    for _ in range(60):
        M = shape_prior._newton_step(prior, shape_prior._posterior(prior, X, root_weight, M), M)
    np.testing.assert_allclose(M.mT @ M, np.eye(2)[None], atol=1e-12)
    A, C, w, expected = by_hand(prior, X[0], weight, M[0], shift)
    mean = prior.mean.numpy().T.ravel() + prior.covariance.numpy() @ A.T @ np.linalg.solve(C, w - expected)
    S = shape_prior._posterior(prior, X, root_weight, M).shapes[0]
    np.testing.assert_allclose(S.numpy().T.ravel(), mean, atol=1e-8)

    def misfit(vector):
        _, C, w, expected = by_hand(prior, X[0], weight, turned_by(M, vector[None])[0], shift)
        return -multivariate_normal(expected, C).logpdf(w)

    got = shape_prior.negative_log_likelihood((prior,), X, torch.as_tensor(weight)[None], M)
    assert got == pytest.approx(misfit(np.zeros(3)) / (2 * visible.sum()), rel=1e-9)
    for axis in np.eye(3) * 1e-4:
        slope, bend = misfit(axis) - misfit(-axis), misfit(axis) + misfit(-axis) - 2 * misfit(0 * axis)
        assert abs(slope) < 0.1 * bend  # the minimum is within a hundred-thousandth of a turn


def error(S, truth):
    return nl.metrics.normalized_error(S, truth).mean()


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_learning_finds_shapes_cameras_and_noise(truth, noise):
    shapes, cameras, images = truth
    rng = np.random.default_rng(4)
    visible = torch.ones(len(images), P, dtype=torch.bool)
    X = images + noise * torch.as_tensor(rng.normal(size=images.shape))
    X = X - X.mean(1, keepdim=True)
    rough = turned_by(cameras, 0.15 * rng.normal(size=(len(X), 3)))
    mean = shapes.mean(0).expand_as(shapes)
    prior = shape_prior.learn(X, visible, mean, rough)
    S, M = shape_prior.apply(prior, X, visible, rough)
    assert error(S, shapes) < (0.6 if noise else 0.35) * error(mean, shapes)
    before, after = (nl.cameras.rotation_error(m, cameras).mean() for m in (rough, M))
    assert after < (0.6 if noise else 0.5) * before
    assert prior[0].noise ** 0.5 < noise + 0.02
    alone = shape_prior.apply(prior, X[7:8], visible[7:8], rough[7:8])
    torch.testing.assert_close(alone[0][0], S[7], rtol=0, atol=1e-8)


def test_the_noise_of_a_body_is_measured():
    rng = np.random.default_rng(0)
    views = nl.datasets.make_views(nl.datasets.make_motion(1000, seed=3), seed=3)
    W = views.points2d + 0.05 * views.points2d.std() * rng.normal(size=views.points2d.shape)
    net = nl.fit(W, steps=300, progress=False)
    assert net.prior[0].noise ** 0.5 == pytest.approx(0.05 * views.points2d.std() / net.normalizer.scale, rel=0.3)


def test_hidden_points_are_filled_in(truth):
    shapes, cameras, images = truth
    visible = torch.rand(len(images), P, generator=torch.Generator().manual_seed(0)) > 0.2
    visible[:, :2] = True
    X, _ = normalizer.center(images, visible)
    prior = shape_prior.learn(X, visible, shapes.mean(0).expand_as(shapes), cameras)
    S, _ = shape_prior.apply(prior, X, visible, cameras)
    S = S - S.mean(1, keepdim=True)
    off = (S - shapes).norm(dim=2)[~visible].mean()
    assert off < 0.5 * (shapes.mean(0) - shapes).norm(dim=2)[~visible].mean()


@pytest.mark.parametrize("frames", [10, 40])
def test_few_frames_give_a_finite_answer(truth, frames):
    shapes, cameras, images = (x[:frames] for x in truth)
    visible = torch.ones(frames, P, dtype=torch.bool)
    prior = shape_prior.learn(images, visible, shapes.mean(0).expand_as(shapes), cameras)
    S, M = shape_prior.apply(prior, images, visible, cameras)
    assert torch.isfinite(S).all() and error(S, shapes) < error(shapes.mean(0).expand_as(shapes), shapes)
    torch.testing.assert_close(M.mT @ M, torch.eye(2, dtype=torch.double).expand(frames, 2, 2))


def test_a_network_that_has_diverged_does_not_break_it(truth):
    _, cameras, images = (x[:600] for x in truth)
    visible = torch.ones(600, P, dtype=torch.bool)
    wild = 1e9 * torch.randn(600, P, 3, dtype=torch.double, generator=torch.Generator().manual_seed(0))
    wild[:5] = torch.nan
    S, M = shape_prior.apply(shape_prior.learn(images, visible, wild, cameras), images, visible, cameras)
    assert torch.isfinite(S).all() and torch.isfinite(M).all()
