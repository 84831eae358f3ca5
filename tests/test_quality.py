"""Scores of a network that need no truth."""

import numpy as np
import pytest
import torch

import nrsfm_lite as nl


@pytest.fixture(scope="module")
def views():
    return nl.datasets.make_views(nl.datasets.make_motion(600, seed=7), seed=7)


@pytest.fixture(scope="module")
def nets(views):
    """Looks at one training: a bad network, a better one, and the end."""
    kept = {}

    def keep(step, net):
        if step in (10, 120):
            kept[step] = nl.DeepNRSfM.from_arrays(*net.to_arrays())

    end = nl.fit(views, steps=400, progress=False, callback=keep)
    return [kept[10], kept[120], end]


def test_scores_are_finite_and_the_image_error_falls(nets, views):
    first, middle, last = (nl.quality.scores(net, views) for net in nets)
    assert all(np.isfinite(v) for v in last.values())
    assert np.isnan(first["negative_log_likelihood"])  # no prior yet
    assert last["image_error"] < middle["image_error"] < first["image_error"]
    assert 0 <= last["coherence"] <= 1 and 0 <= last["distortion"] <= 1
    assert 1 <= last["code_dimension"] <= nets[-1].config.last_atoms


def test_image_error_is_that_of_the_forward_pass(nets, views):
    plain = nl.reconstruct(views, model=nets[-1], refine=False)
    W = views.points2d - views.points2d.mean(1, keepdims=True)
    expected = np.linalg.norm(plain.projections - views.points2d, axis=(1, 2)) / np.linalg.norm(W, axis=(1, 2))
    assert nl.quality.image_error(nets[-1], views) == pytest.approx(expected.mean(), rel=1e-4)


def test_consistency_needs_a_network_that_answers_alike(nets, views):
    net = nl.DeepNRSfM.from_arrays(*nets[-1].to_arrays())
    with torch.no_grad():
        net.D[0].zero_()  # always S̄: consistent, and wrong
        net.output_bias.copy_(torch.randn(31, 3, generator=torch.Generator().manual_seed(0)))
    assert nl.quality.consistency(net, views) < 1e-6 and nl.quality.turn_consistency(net, views) < 1e-6
    assert nl.quality.consistency(nets[-1], views) > 0.01
    assert nl.quality.consistency(nets[-1], views, seed=0) == nl.quality.consistency(nets[-1], views, seed=0)


def test_images_like_its_own_are_likelier_under_a_prior(nets, views):
    strange = views.points2d[:, ::-1].copy()  # the points in another order
    assert nl.quality.negative_log_likelihood(nets[-1], views) < nl.quality.negative_log_likelihood(nets[-1], strange)
    hidden = np.ones(strange.shape[:2], bool)
    hidden[:, 5] = False
    assert np.isfinite(nl.quality.negative_log_likelihood(nets[-1], views.points2d, hidden))


def test_the_best_of_several_networks(nets, views):
    short = nl.fit(views, steps=20, progress=False)
    assert nl.quality.best([short, nets[-1]], views) is nets[-1]
    with pytest.raises(ValueError, match="model 1 has no prior"):
        nl.quality.best([nets[-1], nets[0]], views)
    with pytest.raises(ValueError, match="models is empty"):
        nl.quality.best([], views)
