"""Each method is exact on data made from its own model, and says when it cannot."""

import inspect
from collections import Counter

import numpy as np
import pytest

import nrsfm_lite as nl
from nrsfm_lite import image_prior, images, normalizer
from nrsfm_lite.baselines import complete, tomasi_kanade

METHODS = [name for name in nl.baselines.__all__ if name != "complete"]
QUICK = {  # as little as a method can do
    "bmm": {"rank": 2, "restarts": 1},
    "cns": {"groups_per_point": 1},
    "ksta": {"rank": 2},
    "nlo": {"rank": 2},
    "pta": {"rank": 2},
    "riks": {"rank": 2},
    "sfc": {"rank": 1},
    "sps": {"atoms": 4, "restarts": 1},
}


@pytest.fixture
def rigid(rng):
    S = np.repeat(rng.normal(size=(1, 9, 3)), 30, axis=0)
    return nl.datasets.make_views(nl.Landmarks(points3d=S, edges=[(0, 1)]))


@pytest.mark.parametrize("name", nl.baselines.__all__)
def test_every_method_has_the_same_signature(name):
    parameters = inspect.signature(getattr(nl.baselines, name)).parameters
    assert list(parameters)[:3] == ["W", "visible", "confidence"]
    assert all(p.kind is p.KEYWORD_ONLY for p in list(parameters.values())[2:])
    assert parameters["visible"].default is None and parameters["confidence"].default is None
    if name != "complete":
        assert parameters["progress"].default is True
        assert name in ("tomasi_kanade", "pta", "em_gaussian") or parameters["max_seconds"].default is None


@pytest.mark.parametrize("name", METHODS)
def test_points_are_read_centred_and_filled_in_no_more_often_than_needed(name, rng, monkeypatch):
    views = nl.datasets.make_views(nl.datasets.make_motion(40, seed=0), missing=0.1, seed=0)
    calls = Counter()
    for module, function in [(images, "parse"), (normalizer, "center"), (image_prior, "fill")]:
        original = getattr(module, function)

        def counted(*args, original=original, function=function):
            calls[function] += 1
            return original(*args)

        monkeypatch.setattr(module, function, counted)
    rec = getattr(nl.baselines, name)(views, **QUICK.get(name, {}), progress=False)
    assert rec.method == name and rec.names == views.names
    assert calls["parse"] == 1 and calls["center"] <= 2 and calls["fill"] <= 1
    assert calls["fill"] == (name != "sfc")


def test_exact_on_a_rigid_object(rigid):
    rec = tomasi_kanade(rigid)
    np.testing.assert_allclose(nl.metrics.normalized_error(rec.shapes, rigid.points3d, scale=False), 0, atol=1e-9)
    np.testing.assert_allclose(nl.cameras.rotation_error(rec.cameras, rigid.cameras), 0, atol=1e-5)
    np.testing.assert_allclose(rec.projections, rigid.points2d, atol=1e-9)
    assert nl.metrics.handedness(rec.shapes, rigid.points3d).mirrored == 0
    assert rec.method == "tomasi_kanade" and rec.edges.tolist() == [[0, 1]]


def test_takes_an_array_with_any_translation(rigid):
    rec = tomasi_kanade(rigid.points2d + 100.0)
    np.testing.assert_allclose(rec.translations, 100, atol=1e-9)
    np.testing.assert_allclose(rec.projections, rigid.points2d + 100.0, atol=1e-9)


def test_what_it_cannot_do_is_said(rigid, rng):
    with pytest.raises(ValueError, match="point_4 is hidden in every frame"):
        tomasi_kanade(rigid, np.arange(270).reshape(30, 9) % 9 != 4)
    with pytest.raises(ValueError, match="at least 3 frames"):
        tomasi_kanade(rigid.points2d[:2])
    with pytest.raises(ValueError, match=r"expected \(F, P, 2\)"):
        tomasi_kanade(rigid.points3d)
    flat = nl.Landmarks(points3d=np.repeat(rng.normal(size=(1, 9, 3)) * (1, 1, 0), 30, axis=0))
    with pytest.raises(ValueError, match="rank below 3"):
        tomasi_kanade(nl.datasets.make_views(flat))


def test_few_missing_points_of_low_rank_are_completed(rigid, rng):
    visible = rng.random((30, 9)) > 0.15
    visible[:, :3] = True
    W = np.where(visible[..., None], rigid.points2d + 50.0, np.nan)
    filled = complete(W, visible)
    np.testing.assert_array_equal(filled[visible], W[visible])
    assert np.abs(filled - 50 - rigid.points2d).max() < 0.05 * np.abs(rigid.points2d).max()
    np.testing.assert_array_equal(complete(rigid), rigid.points2d)
    rec = tomasi_kanade(W, visible)
    assert nl.metrics.normalized_error(rec.shapes, rigid.points3d).mean() < 0.02
    np.testing.assert_array_equal(rec.visible, visible)


def smooth_motion(rng, rank=2, frames=120, points=40):
    """Trajectories of few cosines, seen by a camera that walks around them."""
    cosines = np.cos(np.pi * np.outer(np.arange(frames) + 0.5, np.arange(rank)) / frames)
    S = np.einsum("fk,kpi->fpi", cosines, rng.normal(size=(rank, points, 3)) / (1 + np.arange(rank))[:, None, None])
    angle = np.linspace(0, 5, frames)
    M = np.zeros((frames, 3, 2))
    M[:, 0, 0], M[:, 2, 0], M[:, 1, 1] = np.cos(angle), np.sin(angle), 1
    return nl.Landmarks(points3d=S, points2d=S @ M, cameras=M)


def test_pta_is_exact_on_smooth_trajectories_and_fails_on_shuffled_ones(rng):
    data = smooth_motion(rng)
    rec = nl.baselines.pta(data, rank=2)
    error = nl.metrics.normalized_error(rec.shapes, data.points3d, scale=False).mean()
    assert error < 1e-3
    assert nl.metrics.e3d(rec.shapes, data.points3d).mean() < 1e-2
    np.testing.assert_allclose(rec.projections, data.points2d, atol=1e-3)
    order = rng.permutation(len(data))
    shuffled = nl.baselines.pta(data[order], rank=2)
    assert nl.metrics.normalized_error(shuffled.shapes, data.points3d[order]).mean() > 50 * error


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "rank", "classical", "per_frame"),
    [
        ("drink", 13, 0.0250, 0.0141),
        ("pickup", 12, 0.2374, 0.0362),
        ("yoga", 11, 0.1547, 0.0332),
        ("stretch", 12, 0.1034, 0.0504),
    ],
)
def test_pta_on_the_classic_sequences(real_data, name, rank, classical, per_frame):
    """What an independent port of the same description reached, to about its printed digits."""
    file = real_data / "classic" / f"{name}.npz"
    if not file.exists():
        pytest.skip("the classic sequences are not in NRSFM_DATA")
    truth = np.load(file)
    rec = nl.baselines.pta(truth["S"][..., :2], rank=rank)
    assert nl.metrics.e3d(rec.shapes, truth["S_world"]).mean() == pytest.approx(classical, abs=2e-4)
    assert nl.metrics.normalized_error(rec.shapes, truth["S"], scale=False).mean() == pytest.approx(per_frame, abs=2e-4)


DOUBT = {  # what the methods are told for a mild deformation
    "bmm": {"rank": 2, "restarts": 2},
    "cns": {"groups_per_point": 2},
    "ksta": {"rank": 2},
    "nlo": {"rank": 2},
    "pta": {"rank": 4},
    "riks": {"rank": 2},
    "sfc": {"rank": 1, "upgrade": True},
    "sps": {"atoms": 1, "active": 1, "restarts": 1},
}


@pytest.mark.parametrize("name", METHODS)
def test_points_of_low_confidence_hardly_count(name, rng):
    """A tenth of the points are wrong: doubting them is nearly as good as hiding them."""
    frames, points = 60, 20
    deformation = 0.15 * np.sin(np.linspace(0, 5, frames))[:, None, None]
    S = rng.normal(size=(points, 3)) + deformation * rng.normal(size=(points, 3))
    data = nl.Landmarks(points3d=S, points2d=S @ smooth_motion(rng, frames=frames).cameras)
    wrong = rng.random((frames, points)) < 0.1
    W = data.points2d + wrong[..., None] * rng.normal(size=(frames, points, 2))

    def error(**given):
        method = getattr(nl.baselines, name)
        rec = method(nl.Landmarks(W, **given), **DOUBT.get(name, {}), progress=False)
        return nl.metrics.normalized_error(rec.shapes, S).mean()

    doubted, trusted = error(confidence=np.where(wrong, 1e-3, 1.0)), error()
    hidden = error(visible=~wrong)
    assert abs(doubted - hidden) < 0.1 * (trusted - hidden)


def test_completion_moves_doubtful_points_towards_their_likely_places(rigid, rng):
    wrong = rng.random((30, 9)) < 0.2
    wrong[:, :4] = False
    W = rigid.points2d + 100 + wrong[..., None] * rng.normal(size=(30, 9, 2))

    def off(confidence):
        filled = complete(W, confidence=np.where(wrong, confidence, 0.8))
        np.testing.assert_array_equal(filled[~wrong], W[~wrong])  # the most trusted of a frame stay
        return np.linalg.norm((filled - 100 - rigid.points2d)[wrong])

    assert off(0.8) > off(0.1) > 100 * off(1e-3)


def test_pta_refuses(rng):
    data = smooth_motion(rng, frames=30)
    with pytest.raises(ValueError, match="rank=30"):
        nl.baselines.pta(data, rank=30)
    with pytest.raises(ValueError, match="point 0 is hidden in every frame"):
        nl.baselines.pta(data.points2d, np.arange(1200).reshape(30, 40) % 40 > 0)
