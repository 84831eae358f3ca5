"""The shape prior: what it learns, how it decides how much there is to learn, and what it does for a frame."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import nrsfm_lite as nl
from nrsfm_lite import gaussian, normalizer, shape_prior

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


def turned_by(M, vectors):
    return torch.as_tensor(Rotation.from_rotvec(vectors).as_matrix()) @ M


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
    given = rough.clone()
    prior = shape_prior.learn(X, visible, mean, rough)
    assert (rough == given).all()
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


@pytest.fixture(scope="module")
def collection():
    """Five rigid shapes of eight points, 1,200 noisy views, and rough shapes and cameras to start from."""
    rng = np.random.default_rng(5)
    models = rng.normal(size=(8, 3)) + 0.3 * rng.normal(size=(5, 8, 3))
    models = torch.as_tensor(models - models.mean(1, keepdims=True))
    S = models[torch.as_tensor(rng.integers(0, 5, 1200))]
    M = torch.as_tensor(nl.cameras.random_cameras(1200, seed=6))
    X = S @ M + 0.05 * torch.as_tensor(rng.normal(size=(1200, 8, 2)))
    rough = S + 0.1 * torch.as_tensor(rng.normal(size=S.shape))
    return S, X - X.mean(1, keepdim=True), rough, turned_by(M, 0.1 * rng.normal(size=(1200, 3)))


def test_a_collection_of_rigid_shapes_is_found_to_be_one(collection):
    S, X, rough, cameras = collection
    visible = torch.ones(X.shape[:2], dtype=torch.bool)
    prior = shape_prior.learn(X, visible, rough, cameras)
    components = prior[1:]
    assert len(components) == 5
    assert all(g.covariance.abs().max() == 0 for g in components)
    assert np.median([g.noise for g in components]) ** 0.5 == pytest.approx(0.05, rel=0.2)
    assert sum(g.share for g in components) == pytest.approx(1)
    found, _ = shape_prior.apply(prior, X, visible, cameras)
    assert error(found, S) < 0.015  # the noise alone, unlearned, would be .06


def test_mirrored_frames_are_repaired_before_components_are_made(truth):
    shapes, cameras, images = (x[:800] for x in truth)
    visible = torch.ones(images.shape[:2], dtype=torch.bool)
    rough, start = shapes.clone(), cameras.clone()
    depth = torch.linalg.cross(cameras[..., 0], cameras[..., 1])[:200]
    # A fifth of the frames: the shape mirrored in depth, turned back onto the mean.
    mirrored = shapes[:200] - 2 * (shapes[:200] @ depth[..., None]) @ depth[:, None]
    U, _, Vh = torch.linalg.svd(shapes.mean(0).T @ mirrored)
    sign = torch.linalg.det(U @ Vh)
    Q = torch.cat([U[..., :2], U[..., 2:] * sign[:, None, None]], 2) @ Vh
    rough[:200], start[:200] = mirrored @ Q.mT, Q @ cameras[:200]
    prior = shape_prior.learn(images, visible, rough, start)
    S, _ = shape_prior.apply(prior, images, visible, start)
    assert nl.metrics.handedness(rough, shapes).mirrored > 0.15
    assert nl.metrics.handedness(S, shapes).mirrored < 0.02
    assert nl.metrics.rotation_only_error(S, shapes).mean() < 1.1 * error(S, shapes)


@pytest.mark.parametrize("n", [30, 300])
def test_new_frames_get_a_prior_of_their_own_where_that_says_more(truth, n):
    shapes, cameras, images = truth
    visible = torch.ones(len(images), P, dtype=torch.bool)
    prior = shape_prior.learn(images, visible, shapes, cameras)
    i = slice(0, n)
    S, M = shape_prior.apply(prior, images[i], visible[i], cameras[i])
    if n == 30:
        assert shape_prior.adapt(prior, images[i], visible[i], S, M) is prior
    mean = shapes.mean(0)  # another body, which moves in another way
    other = mean + 0.3 * (mean[:, [1, 2, 0]] + (shapes[i] - mean)[:, :, [2, 0, 1]])
    X = other @ cameras[i]
    S, M = shape_prior.apply(prior, X, visible[i], cameras[i])
    own = shape_prior.adapt(prior, X, visible[i], S, M)
    assert own is not prior
    assert error(shape_prior.apply(own, X, visible[i], M)[0], other) < 0.5 * error(S, other)


def test_nothing_is_kept_back_of_points_that_are_needed():
    weight = torch.ones(3, 9)
    weight[0, 5:] = 0  # five, seven and nine points are visible
    weight[1, 7:] = 0
    hidden = shape_prior._points_kept_back(weight)
    assert hidden.sum(1).tolist() == [1, 1, 2] and not hidden[weight == 0].any()
    weight[0, 4] = 0
    assert shape_prior._points_kept_back(weight).sum(1).tolist() == [0, 1, 2]


def test_the_scale_of_every_frame_is_found(truth):
    shapes, cameras, images = truth
    true = torch.as_tensor(np.random.default_rng(6).normal(0, 0.15, len(images))).exp()
    X, visible = images * true[:, None, None], torch.ones(len(images), P, dtype=torch.bool)
    rough = turned_by(cameras, 0.1 * np.random.default_rng(4).normal(size=(len(X), 3)))
    start = shapes.mean(0).expand_as(shapes)
    found = {}
    for free in (False, True):
        prior = shape_prior.learn(X, visible, start, rough, free_scale=free)
        S, M = shape_prior.apply(prior, X, visible, rough)
        found[free] = S * gaussian.scales(M)[:, None, None], gaussian.scales(M)
    assert (found[False][1] - 1).abs().max() < 1e-9
    assert np.corrcoef(found[True][1].log(), true.log())[0, 1] > 0.9
    errors = [error(found[free][0], shapes * true[:, None, None]) for free in (True, False)]
    assert errors[0] < 0.8 * errors[1]


def test_the_noise_of_few_frames_is_measured_by_points_kept_back():
    motion = nl.datasets.make_motion(100)
    found = {}
    for noise in (0.0, 0.05):
        views = nl.datasets.make_views(motion, noise=noise)
        rec = nl.baselines.em_gaussian(views, start="bmm", progress=False)
        X = torch.as_tensor(views.points2d - views.points2d.mean(1, keepdims=True))
        M, weight = torch.as_tensor(rec.cameras), torch.ones(X.shape[:2], dtype=torch.double)
        (gaussian,) = shape_prior.learn(X, weight, torch.as_tensor(rec.shapes), M)
        found[noise] = gaussian.noise**0.5 / float(X.square().mean().sqrt())
    assert found[0.0] < 0.01 and 0.03 < found[0.05] < 0.1  # it was .01 when read off the eigenvalues alone
