"""The one door: what it takes, what it refuses, and what it hands on."""

import numpy as np
import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite.images import parse, read


@pytest.fixture
def W(rng):
    return rng.normal(size=(12, 5, 2)) * 40 + 300


def test_every_form_of_the_same_points_is_the_same_images(W):
    visible = np.ones((12, 5), bool)
    visible[::2, 3] = False
    part = np.where(visible[..., None], W, np.nan)
    confidence = np.full((12, 5), 0.5)
    forms = [
        parse(part, visible, confidence),
        parse(torch.as_tensor(part), torch.as_tensor(visible), torch.as_tensor(confidence)),
        parse(nl.Landmarks(part, visible, confidence)),
        parse(W, confidence=0.5 * visible),
    ]
    for images in forms:
        np.testing.assert_array_equal(images.points, np.where(visible[..., None], W, 0))
        np.testing.assert_array_equal(images.weight, 0.5 * visible)
        np.testing.assert_array_equal(images.visible, visible)


def test_a_point_of_no_confidence_is_hidden(W):
    confidence = np.ones((12, 5))
    confidence[3, 1] = 0
    images = parse(W, confidence=confidence)
    assert not images.visible[3, 1] and images.visible.sum() == 59
    rec = nl.reconstruct(W, confidence=confidence, steps=2, progress=False)
    np.testing.assert_array_equal(rec.visible, confidence > 0)


def test_centred_points_have_unit_size_and_come_back(W, rng):
    images = parse(W)
    np.testing.assert_allclose(images.centred.mean(1), 0, atol=1e-12)
    assert np.square(images.X).mean() == pytest.approx(1)
    S = rng.normal(size=(12, 5, 3))
    M = nl.cameras.random_cameras(12)
    rec = images.reconstruction(S, M, rng.normal(size=(12, 2)), method="test")
    np.testing.assert_allclose(rec.shapes, images.scale * (S - S.mean(1, keepdims=True)))
    assert rec.method == "test" and rec.converged


def test_the_callers_array_is_not_changed(W):
    before = W.copy()
    images = parse(W, np.arange(60).reshape(12, 5) % 7 != 0)
    images.points[:] = 0
    np.testing.assert_array_equal(W, before)


@pytest.mark.parametrize("place", [0.0, 0.1, 0.7, 123.4, 1e6 / 3])
def test_points_at_one_place_are_refused(W, place):
    visible = np.ones((12, 5), bool)
    visible[3, 2] = False
    read(W, visible, method="test")
    W[3, visible[3]] = place  # its mean may differ from it by a rounding
    with pytest.raises(ValueError, match="frame 3 of W has all its visible points at one place"):
        read(W, visible, method="test")
    with pytest.raises(ValueError, match="no shape to see"):
        read(np.full((3, 4, 2), place), method="test")


def test_what_a_method_needs_is_said(W):
    with pytest.raises(ValueError, match="test needs at least 20 frames and 6 points; got 12 frames of 5 points"):
        read(W, method="test", frames=20, points=6)
    visible = np.ones((12, 5), bool)
    visible[:, 4] = False
    with pytest.raises(ValueError, match="point 4 is hidden in every frame of W"):
        read(W, visible, method="test")
    with pytest.raises(ValueError, match="d is hidden in every frame of W"):
        read(nl.Landmarks(W, np.roll(visible, -1, 1), names="abcde"), method="test")
    assert not read(W, visible, method="test", every_point=False).visible[:, 4].any()
