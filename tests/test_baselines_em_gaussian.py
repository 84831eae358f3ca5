"""Gaussians over shapes as a classical method: exact on their own model, from different starts."""

import numpy as np
import pytest

import nrsfm_lite as nl
from nrsfm_lite.baselines import bmm, em_gaussian, starts, tomasi_kanade


def error(rec, truth):
    return nl.metrics.rotation_only_error(rec.shapes, truth.points3d).mean()


@pytest.fixture(scope="module")
def own():
    """Shapes of one Gaussian with two directions, a random camera each, in no order."""
    rng = np.random.default_rng(0)
    S = 1.5 * rng.normal(size=(15, 3)) + np.tensordot(0.4 * rng.normal(size=(100, 2)), rng.normal(size=(2, 15, 3)), 1)
    return nl.datasets.make_views(nl.Landmarks(points3d=S))


def test_exact_on_its_own_model(own):
    rec = em_gaussian(own, start="bmm", progress=False)
    assert error(rec, own) < 1e-3
    np.testing.assert_allclose(rec.projections, own.points2d, atol=1e-2 * np.abs(own.points2d).max())
    assert rec.method == "em_gaussian"


def test_from_one_rigid_shape_it_gets_far(own):
    assert error(em_gaussian(own), own) < error(tomasi_kanade(own), own) / 10


def test_units_and_translations_come_back(own):
    rec = em_gaussian(1000 * own.points2d + 500)
    np.testing.assert_allclose(rec.translations, 500, atol=1)
    assert np.linalg.norm(rec.shapes) == pytest.approx(1000 * np.linalg.norm(em_gaussian(own).shapes), rel=1e-3)


def test_another_methods_result_is_a_start():
    views = nl.datasets.make_views(nl.datasets.make_motion(60, seed=2), seed=2)
    first = bmm(views, rank=3, restarts=1, progress=False)
    rec = em_gaussian(views, start=first)
    assert error(rec, views) < error(first, views) / 2
    hidden = nl.datasets.make_views(nl.datasets.make_motion(60, seed=2), seed=2, missing=0.1)
    assert error(em_gaussian(hidden, start=first), hidden) < error(first, views)


def test_random_cameras_are_no_start_for_few_frames(own):
    """They are for thousands; here this keeps the option honest about what it is."""
    rec = em_gaussian(own, start="random", seed=1)
    assert np.isfinite(rec.shapes).all() and rec.shapes.shape == own.points3d.shape


def test_starts_leave_out_what_cannot_run(own):
    X = own.points2d - own.points2d.mean(1, keepdims=True)
    assert len(starts(X)) == 2
    assert len(starts(X[:, :5] - X[:, :5].mean(1, keepdims=True))) == 1  # too few points for bmm
    flat = own.points3d * (1, 1, 0) @ own.cameras
    flat = np.repeat(flat[:1], 100, axis=0)  # one view of a flat thing, again and again
    assert starts(flat - flat.mean(1, keepdims=True)) == []


def test_what_it_refuses(own):
    with pytest.raises(ValueError, match="start='flat'; expected one of rigid, bmm, random, a Reconstruction"):
        em_gaussian(own, start="flat")
    with pytest.raises(ValueError, match=r"start has shapes \(50, 15, 3\), but W has 100 frames of 15 points"):
        em_gaussian(own, start=tomasi_kanade(own.points2d[:50]))
    with pytest.raises(ValueError, match="at least 3 frames"):
        em_gaussian(own.points2d[:2])
