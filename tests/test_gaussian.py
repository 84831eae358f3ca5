"""One Gaussian over shapes: its likelihood, its cameras, and what images say about it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

import nrsfm_lite as nl
from nrsfm_lite import gaussian

P = 6


def by_hand(prior, X, weight, M):
    """Mean and covariance of one image's visible coordinates, straight from the definition."""
    seen = weight > 0
    A = np.kron(M.numpy().T, np.eye(P))[np.tile(seen, 2)]
    shifts = np.kron(np.eye(2), np.ones((P, 1)))[np.tile(seen, 2)]
    C = A @ prior.covariance.numpy() @ A.T + np.diag(prior.noise / np.tile(weight[seen], 2)) + shifts @ shifts.T
    return A, C, X.numpy().T.ravel()[np.tile(seen, 2)], A @ prior.mean.numpy().T.ravel()


def some_prior():
    B = torch.randn(3 * P, 3 * P, dtype=torch.double, generator=torch.Generator().manual_seed(2)) / 5
    mean = torch.randn(P, 3, dtype=torch.double, generator=torch.Generator().manual_seed(3))
    return gaussian.Gaussian(mean, B @ B.T, 1e-2)


def turned_by(M, vectors):
    return torch.as_tensor(Rotation.from_rotvec(vectors).as_matrix()) @ M


@pytest.mark.parametrize(
    "weight", [[1, 1, 1, 1, 1, 1], [1, 0, 1, 1, 1, 1], [0, 1, 1, 0.3, 1, 1], [1, 1, 0.7, 1, 0.1, 1]]
)
def test_a_shape_is_the_conditional_mean_and_newton_steps_end_at_the_most_likely_camera(weight):
    prior = some_prior()
    weight = np.array(weight, float)
    visible = weight > 0
    M = torch.as_tensor(nl.cameras.random_cameras(1))
    images = torch.randn(1, P, 2, dtype=torch.double, generator=torch.Generator().manual_seed(1))
    X = (images - images.mean(1, keepdim=True)) * torch.as_tensor(visible)[:, None]
    for _ in range(60):
        M = gaussian.turn(prior, X, torch.as_tensor(weight)[None], M, 1)
    np.testing.assert_allclose(M.mT @ M, np.eye(2)[None], atol=1e-12)
    A, C, w, expected = by_hand(prior, X[0], weight, M[0])
    mean = prior.mean.numpy().T.ravel() + prior.covariance.numpy() @ A.T @ np.linalg.solve(C, w - expected)
    S = gaussian.fit(prior, X, torch.as_tensor(weight)[None], M, 0)[0][0]
    np.testing.assert_allclose(S.numpy().T.ravel(), mean, atol=1e-8)

    def misfit(vector):
        _, C, w, expected = by_hand(prior, X[0], weight, turned_by(M, vector[None])[0])
        return -multivariate_normal(expected, C).logpdf(w)

    got = gaussian.negative_log_likelihood(prior, X, torch.as_tensor(weight)[None], M)
    assert float(got) == pytest.approx(misfit(np.zeros(3)), rel=1e-9)
    for axis in np.eye(3) * 1e-4:
        slope, bend = misfit(axis) - misfit(-axis), misfit(axis) + misfit(-axis) - 2 * misfit(0 * axis)
        assert abs(slope) < 0.1 * bend  # the minimum is within a hundred-thousandth of a turn


def test_a_frame_does_not_depend_on_its_batch():
    prior = some_prior()
    X = torch.randn(10, P, 2, dtype=torch.double, generator=torch.Generator().manual_seed(1))
    X = X - X.mean(1, keepdim=True)
    M, weight = torch.as_tensor(nl.cameras.random_cameras(10)), torch.ones(10, P)
    weight[5:, 0] = 0  # in the same chunk
    X[5:, 0] = 0
    alone = gaussian.negative_log_likelihood(prior, X[:1], weight[:1], M[:1])
    torch.testing.assert_close(gaussian.negative_log_likelihood(prior, X, weight, M)[:1], alone)
    torch.testing.assert_close(
        gaussian.fit(prior, X, weight, M, 3)[0][:1], gaussian.fit(prior, X[:1], weight[:1], M[:1], 3)[0]
    )


@pytest.fixture(scope="module")
def rigid():
    """A rigid shape of eight points in 600 views with noise of .05; no camera is known well."""
    rng = np.random.default_rng(0)
    shape = torch.as_tensor(rng.normal(size=(8, 3)))
    shape = shape - shape.mean(0)
    M = torch.as_tensor(nl.cameras.random_cameras(600, seed=1))
    X = shape @ M + 0.05 * torch.as_tensor(rng.normal(size=(600, 8, 2)))
    return shape, turned_by(M, 0.1 * rng.normal(size=(600, 3))), X - X.mean(1, keepdim=True)


@pytest.mark.parametrize("rank", [0, 2, None])
def test_the_noise_of_few_points_is_not_taken_for_shape(rigid, rank):
    shape, M, X = rigid
    start = gaussian.Gaussian(shape, 0.05 * gaussian._about_the_centroid(8), 1e-4)
    found, _ = gaussian.maximise(start, X, torch.ones(600, 8), M, iterations=40, strength=0.1, rank=rank)
    found = gaussian.without_noise(found, rank)
    # The camera's doubt and the centroid count, or three angles and two coordinates an image would explain noise away.
    assert found.noise**0.5 == pytest.approx(0.05, rel=0.12 if rank is not None else 0.3)
    assert nl.metrics.normalized_error(found.mean[None], shape[None]).mean() < 0.01


def test_evidence_is_the_likelihood_averaged_over_cameras(rigid):
    shape, M, X = rigid
    C = 0.02 * gaussian._about_the_centroid(8)
    wide = gaussian.Gaussian(shape, C, 0.2**2)  # so that random cameras come near enough
    X, weight, n = X[:3], torch.ones(3, 8), 100_000
    M = gaussian.turn(wide, X, weight, M[:3], 10)
    got = gaussian.negative_log_evidence(wide, X, weight, M)
    best = gaussian.negative_log_likelihood(wide, X, weight, M)
    anywhere = torch.as_tensor(nl.cameras.random_cameras(n, seed=2))
    for x, value, at_best in zip(X, got, best, strict=True):
        each = gaussian.negative_log_likelihood(wide, x.expand(n, 8, 2), torch.ones(n, 8), anywhere)
        average = float(-(torch.logsumexp(-each, 0) - np.log(n)))
        assert average - float(at_best) > 4  # what a fitted camera explains
        assert float(value) == pytest.approx(average, abs=1)


def test_frames_of_the_other_hand_are_found_and_repaired(rigid):
    shape, M, X = rigid
    prior, weight = gaussian.Gaussian(shape, torch.zeros(24, 24, dtype=torch.double), 0.05**2), torch.ones(600, 8)
    M = gaussian.turn(prior, X, weight, M, 5)
    other = gaussian.turn(gaussian.Gaussian(-shape, prior.covariance, prior.noise), X, weight, -M, 5)
    mixed = torch.where((torch.arange(600) < 200)[:, None, None], other, M)
    # Its image mirrored in depth is what the first shape shows from its other side.
    mixed = gaussian.turn(prior, X, weight, mixed, 5)
    before = gaussian.negative_log_likelihood(prior, X, weight, mixed)
    S, _ = gaussian.fit(prior, X, weight, mixed, 0)
    _, repaired, flipped, _ = gaussian.right_hand(prior, X, weight, S, mixed)
    wrong = before > gaussian.negative_log_likelihood(prior, X, weight, M) + 1
    assert wrong[:200].double().mean() > 0.5 and not wrong[200:].any()
    assert flipped[wrong].double().mean() > 0.9
    after = gaussian.negative_log_likelihood(prior, X, weight, repaired)
    assert (after <= before + 1e-9).all()


def test_newton_steps_end_at_the_most_likely_scale_too():
    prior = replace(some_prior(), spread=0.2)
    random = torch.Generator().manual_seed(1)
    drawn = torch.linalg.cholesky(prior.covariance) @ torch.randn(3 * P, generator=random).double()
    S = prior.mean + drawn.view(3, P).T
    M = 1.3 * torch.as_tensor(nl.cameras.random_cameras(1))
    X, weight = S[None] @ M, torch.ones(1, P)
    X = X - X.mean(1, keepdim=True)
    for _ in range(80):
        M = gaussian.turn(prior, X, weight, M, 1)
    scale = gaussian.scales(M)
    np.testing.assert_allclose(M.mT @ M, np.eye(2)[None] * float(scale) ** 2, atol=1e-9)

    def unlikely(factor):
        _, C, w, expected = by_hand(prior, X[0], np.ones(P), M[0] * factor)
        log_scale = np.log(float(scale) * factor)
        return -multivariate_normal(expected, C).logpdf(w) + log_scale**2 / (2 * 0.2**2)

    values = [unlikely(np.exp(step)) for step in (-2e-2, 0.0, 2e-2)]
    assert values[1] < min(values[0], values[2])
    here, more = (gaussian.negative_log_likelihood(prior, X, weight, M * f) for f in (1, 1.1))
    assert float(more - here) == pytest.approx(unlikely(1.1) - unlikely(1), abs=1e-6)


def test_a_camera_with_its_depth_is_a_rotation_times_its_scale():
    M = torch.as_tensor(nl.cameras.random_cameras(4)) * torch.tensor([0.5, 1, 2, 3])[:, None, None].double()
    R = gaussian.with_depth(M) / gaussian.scales(M)[:, None, None]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(4, 3, 3), rtol=0, atol=1e-12)
    assert (torch.linalg.det(R) > 0).all()


@pytest.mark.parametrize("size", [1, 2, 3])
def test_doubt_follows_the_size_of_a_frames_own_covariance(size):
    """Bands of nine in ten hold as many depths where shapes vary two or three times as much as the Gaussian says."""
    random = torch.Generator().manual_seed(0)
    n, F = 20, 300
    B = torch.randn(3 * n, 8, dtype=torch.double, generator=random) / 5
    mean = torch.randn(n, 3, dtype=torch.double, generator=random)
    prior = gaussian.Gaussian(mean - mean.mean(0), B @ B.T + 1e-2 * torch.eye(3 * n, dtype=torch.double), 1e-4)
    drawn = torch.linalg.cholesky(prior.covariance) @ torch.randn(3 * n, F, dtype=torch.double, generator=random)
    S = prior.mean + size * drawn.T.unflatten(1, (3, n)).mT
    true = torch.as_tensor(nl.cameras.random_cameras(F))
    X = S @ true
    X = X - X.mean(1, keepdim=True)
    weight = torch.ones(F, n, dtype=torch.bool)
    M = gaussian.turn(prior, X, weight, true, 12)
    found, covariances = gaussian.doubt(prior, X, weight, M)
    off = (found @ gaussian.with_depth(M) - S @ gaussian.with_depth(true))[..., 2]
    off = off - off.mean(1, keepdim=True)
    inside = (off.abs() < 1.645 * covariances[..., 2, 2].sqrt()).double().mean()
    assert 0.8 < inside < 0.98
