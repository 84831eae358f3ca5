"""Filling in hidden points: the conditional mean, by definition, and what it is worth."""

import numpy as np
import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite import image_prior, normalizer
from nrsfm_lite.threads import use_threads


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    with use_threads(1):
        yield


@pytest.fixture(scope="module")
def body():
    """Complete images of a body and the same with points hidden, in the network's units."""
    data = nl.datasets.make_motion(800, seed=5)
    full, part = (nl.datasets.make_views(data, missing=m) for m in (0, 0.2))
    seen = torch.as_tensor(part.visible)
    W = torch.as_tensor(full.points2d)
    X, _ = normalizer.center(torch.where(seen[..., None], W, 0.0), seen)
    return W / normalizer.set_scale(X, seen), X / normalizer.set_scale(X, seen), seen


@pytest.mark.parametrize("weight", [[1, 0, 1, 1, 0], [1, 0.5, 0, 0.1, 1], [0.2, 0.1, 0, 0.02, 0.2]])
def test_a_hidden_point_is_put_at_its_conditional_mean(weight):
    rng = np.random.default_rng(0)
    B = rng.normal(size=(5, 5))
    C = np.eye(5) - 1 / 5
    G = C @ B @ B.T @ C
    x, given = rng.normal(size=(1, 5, 2)), np.array(weight, float)
    w = given / given.max()
    seen = w > 0
    noise = 1e-4 + 1e-2 * (1 / w[seen] - 1)
    Sigma = G + 1
    likely = Sigma[:, seen] @ np.linalg.solve(Sigma[np.ix_(seen, seen)] + np.diag(noise), x[0, seen])
    expected = np.where((w == 1)[:, None], x[0], likely)
    expected -= expected.mean(0)
    filled = image_prior.fill(torch.as_tensor(G), torch.as_tensor(x), torch.as_tensor(given)[None])
    np.testing.assert_allclose(filled[0], expected, atol=1e-10)


def test_learning_from_complete_images_is_their_covariance_and_few_hidden_points_change_it_little(body):
    W, X, seen = body
    whole = image_prior.learn(W, torch.ones_like(seen))
    rows = W.mT.reshape(-1, 31)
    torch.testing.assert_close(whole, torch.cov(rows.T, correction=0) + torch.outer(rows.mean(0), rows.mean(0)))
    part = image_prior.learn(X, seen)
    assert (part - whole).norm() < 0.05 * whole.norm()
    torch.testing.assert_close(part.sum(0), torch.zeros(31, dtype=torch.double), atol=1e-6, rtol=0)


def test_it_foretells_hidden_points_far_better_than_the_mean_of_the_others(body):
    W, X, seen = body
    filled = image_prior.fill(image_prior.learn(X, seen), X, seen)
    truth = W - W.mean(1, keepdim=True)
    missed = (filled - truth)[~seen].norm() / truth[~seen].norm()
    assert missed < 0.15
    alone = image_prior.fill(image_prior.learn(X, seen), X[3:4], seen[3:4])  # a frame does not need the others
    torch.testing.assert_close(alone[0], filled[3])
