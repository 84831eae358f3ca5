"""Consensus of non-rigid reconstructions: its steps one by one, then all of it on data from its own model."""

from math import comb

import numpy as np
import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite.baselines import _cns_groups, cns
from nrsfm_lite.baselines._cns import consensus, group_signs, sample_groups


def low_rank(rng, frames=100, points=14, amount=0.3, **views):
    """Shapes that are a mean and one mode of deformation, seen from anywhere."""
    mean, mode = rng.normal(size=(2, points, 3))
    S = mean + amount * rng.normal(size=(frames, 1, 1)) * mode
    return nl.datasets.make_views(nl.Landmarks(points3d=S, edges=[(0, 1)]), **views)


def error(rec, data):
    return nl.metrics.normalized_error(rec.shapes, data.points3d, scale=False)


def quick(data, *args, **options):
    return cns(data, *args, **{"groups_per_point": 5, "progress": False} | options)


def test_groups_are_different_and_cover_all_points(rng):
    X = rng.normal(size=(30, 20, 2))
    groups = sample_groups(X, 6, 12, 0.1, rng)
    assert len(np.unique(groups, axis=0)) == len(groups)
    assert (np.diff(groups) > 0).all()
    assert np.bincount(groups.ravel()).min() == 12


def test_groups_of_few_points_are_all_there_are(rng):
    X = rng.normal(size=(5000, 8, 2))
    assert len(np.unique(sample_groups(X, 6, 50, 10.0, rng), axis=0)) == comb(8, 6)
    np.testing.assert_array_equal(sample_groups(X, 8, 50, 0.1, rng), [np.arange(8)])


def test_groups_are_local(rng):
    """Four clusters of ten points: with locality a group stays in one of them, without it is nearly never in one."""
    corners = np.repeat([[0, 0], [4, 0], [0, 4], [4, 4]], 10, axis=0)
    X = corners + 0.3 * rng.normal(size=(50, 40, 2))
    X -= X.mean(1, keepdims=True)

    def in_one_cluster(locality):
        groups = sample_groups(X, 6, 5, locality, rng)
        return (groups // 10 == groups[:, :1] // 10).all(1).mean()

    assert in_one_cluster(1.0) == 1
    assert in_one_cluster(0.0) < 0.1


def test_nearest_factor(rng):
    Q = rng.normal(size=(4, 6, 6))
    Q = Q + Q.swapaxes(1, 2)
    factor = _cns_groups._nearest_factor(Q)
    near = factor @ factor.swapaxes(1, 2)
    np.testing.assert_allclose(np.trace(near, axis1=1, axis2=2), 1)
    np.testing.assert_allclose(np.linalg.eigvalsh(near)[:, :3], 0, atol=1e-12)
    for step in np.geomspace(1e-3, 1, 50):  # no other matrix of this kind is nearer
        other = factor + step * rng.normal(size=factor.shape)
        other = other @ other.swapaxes(1, 2)
        other /= np.trace(other, axis1=1, axis2=2)[:, None, None]
        assert (np.linalg.norm(Q - near, axis=(1, 2)) <= np.linalg.norm(Q - other, axis=(1, 2)) + 1e-12).all()


def test_constraints_keep_the_sum_of_squares(rng):
    U, Q = torch.tensor(rng.normal(size=(2, 30, 2, 6))), rng.normal(size=(6, 6))
    Q = Q + Q.T
    A, size = _cns_groups.constraints(U)
    gram = U.numpy() @ Q @ U.numpy().swapaxes(2, 3)
    squares = (gram[:, :, 0, 0] - gram[:, :, 1, 1]) ** 2 + 4 * gram[:, :, 0, 1] ** 2
    np.testing.assert_allclose(((A @ Q.ravel()) ** 2).sum(1) * size, squares.sum(1))
    np.testing.assert_allclose(np.linalg.norm(A, 2, axis=(1, 2)), 1)


def test_depths_of_one_group_with_true_cameras(rng):
    data = low_rank(rng, points=10)
    M, W = torch.tensor(data.cameras), torch.tensor(data.points2d - data.points2d.mean(1, keepdims=True))
    view = torch.linalg.cross(M[..., 0], M[..., 1])
    z = _cns_groups.lowest_rank_depths((W @ M.mT).permute(2, 1, 0)[None].contiguous(), view.T[None].contiguous())[
        0
    ].numpy()
    true = nl.cameras.nearness(data.points3d, data.cameras).T
    true -= true.mean(0)
    assert np.linalg.norm(z - z.mean(0) - true) < 1e-4 * np.linalg.norm(true)


@pytest.fixture
def overlapping(rng):
    z = rng.normal(size=(12, 40))
    z -= z.mean(0)
    groups = np.sort([rng.permutation(12)[:6] for _ in range(30)])
    depths = z[groups]
    return z, groups, depths - depths.mean(1, keepdims=True)


def test_signs(overlapping, rng):
    _, groups, depths = overlapping
    signs = rng.choice([-1.0, 1.0], len(groups))
    found = group_signs(depths * signs[:, None, None], groups)
    assert abs((found * signs).sum()) == len(groups)


def test_consensus_leaves_bad_groups_out(overlapping, rng):
    z, groups, depths = overlapping
    depths[:4] = rng.normal(size=depths[:4].shape)
    np.testing.assert_allclose(consensus(depths, groups), z, atol=1e-4)


@pytest.mark.parametrize("amount", [0.0, 0.3])
def test_exact_on_low_rank_shapes(rng, amount):
    data = low_rank(rng, amount=amount)
    data = nl.Landmarks(points3d=50 * data.points3d, points2d=50 * data.points2d + 100, edges=data.edges)
    rec = quick(data)
    assert error(rec, data).mean() < 1e-3
    assert nl.metrics.handedness(rec.shapes, data.points3d).mirrored == 0
    np.testing.assert_allclose(rec.projections, data.points2d, rtol=1e-12)
    np.testing.assert_allclose(rec.translations, data.points2d.mean(1))
    np.testing.assert_allclose(rec.cameras - np.eye(3, 2), 0, atol=1e-12)
    assert rec.method == "cns" and rec.converged and rec.edges.tolist() == [[0, 1]]


def test_scale_may_change(rng):
    data = low_rank(rng, amount=0.0, projection="weak_perspective")
    assert error(quick(data), data).mean() < 1e-3


def test_no_more_points_than_a_group(rng):
    data = low_rank(rng, points=8, amount=0.0)
    assert error(quick(data), data).mean() < 1e-3


def test_missing_points_are_filled_in(rng, monkeypatch):
    monkeypatch.setattr(_cns_groups, "_UPGRADE_STEPS", 3000)  # enough for completed points
    cosine = np.cos(np.linspace(0, 9, 60))[:, None, None]
    data = rng.normal(size=(12, 3)) + 0.2 * cosine * rng.normal(size=(12, 3))
    data = nl.datasets.make_views(nl.Landmarks(points3d=data))
    visible = rng.random(data.visible.shape) > 0.2
    W = np.where(visible[..., None], data.points2d, np.nan)
    rec = quick(W, visible)
    assert error(rec, data).mean() < 0.02
    np.testing.assert_allclose(rec.projections[visible], data.points2d[visible])
    np.testing.assert_array_equal(rec.visible, visible)


def test_when_time_is_over_enough_groups_have_been_made(rng):
    data = low_rank(rng, frames=40, points=24, amount=0.0)
    rec = quick(data, groups_per_point=30, max_seconds=1e-6)
    assert not rec.converged
    assert error(rec, data).mean() < 1e-3  # a rigid shape needs no more


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"group_size": 3}, "group_size=3"),
        ({"groups_per_point": 0}, "groups_per_point=0"),
        ({"locality": -1.0}, "locality=-1.0"),
        ({"max_seconds": 0}, "max_seconds=0"),
    ],
)
def test_refuses(rng, options, message):
    with pytest.raises(ValueError, match=message):
        quick(low_rank(rng), **options)


def test_refuses_too_little(rng):
    data = low_rank(rng)
    with pytest.raises(ValueError, match="at least 5 frames and 4 points"):
        quick(data.points2d[:4])
    with pytest.raises(ValueError, match="at least 5 frames and 4 points"):
        quick(data.points2d[:, :3])
    with pytest.raises(ValueError, match="point 2 is hidden in every frame"):
        quick(data.points2d, np.arange(1400).reshape(100, 14) % 14 != 2)


@pytest.mark.realdata
def test_yoga(real_data):
    """With a fifth of the groups, nearly what the authors' program reaches, and nearly its shapes."""
    folder = real_data / "classic"
    if not (folder / "yoga.npz").exists():
        pytest.skip("the classic sequences are not in NRSFM_DATA")
    S = np.load(folder / "yoga.npz")["S"]
    rec = quick(S[..., :2], groups_per_point=10)
    assert nl.metrics.normalized_error(rec.shapes, S, scale=False).mean() == pytest.approx(0.0349, rel=0.1)
    reference = folder / "reference_reconstructions" / "CNS_yoga.npz"
    if reference.exists():
        assert nl.metrics.normalized_error(rec.shapes, np.load(reference)["S"], scale=False).mean() < 0.015
