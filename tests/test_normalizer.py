"""The normalisation, and that it forgets hidden points."""

import pytest
import torch

from nrsfm_lite import normalizer


@pytest.fixture
def points():
    g = torch.Generator().manual_seed(0)
    W = torch.randn(5, 7, 2, generator=g, dtype=torch.double) * 40 + 300
    visible = torch.rand(5, 7, generator=g) > 0.3
    visible[:, 0] = True
    return W, visible


def test_center_by_hand():
    W = torch.tensor([[[0.0, 0], [2, 4], [100, 100]]])
    X, mean = normalizer.center(W, torch.tensor([[True, True, False]]))
    assert mean.tolist() == [[1, 2]]
    assert X.tolist() == [[[-1, -2], [1, 2], [0, 0]]]


def test_hidden_points_do_not_matter(points):
    W, visible = points
    X, mean = normalizer.center(W, visible)
    other = torch.where(visible[..., None], W, torch.nan)
    torch.testing.assert_close(normalizer.center(other, visible), (X, mean))


def test_scale_is_isotropic_and_makes_unit_rms(points):
    W, visible = points
    X, _ = normalizer.center(W, visible)
    unit = X / normalizer.set_scale(X, visible)
    assert unit[visible].square().mean() == pytest.approx(1)
    torch.testing.assert_close(unit[..., 0] / X[..., 0], unit[..., 1] / X[..., 1], equal_nan=True)
    per_frame = X / normalizer.frame_scale(X, visible)[:, None, None]
    for x, v in zip(per_frame, visible, strict=True):
        assert x[v].square().mean() == pytest.approx(1)
