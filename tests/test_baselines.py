"""Rigid factorisation is exact on rigid data, and says when it cannot."""

import numpy as np
import pytest

import nrsfm_lite as nl
from nrsfm_lite.baselines import tomasi_kanade


@pytest.fixture
def rigid(rng):
    S = np.repeat(rng.normal(size=(1, 9, 3)), 30, axis=0)
    return nl.datasets.make_views(nl.Landmarks(points3d=S, edges=[(0, 1)]))


def test_exact_on_a_rigid_object(rigid):
    rec = tomasi_kanade(rigid)
    np.testing.assert_allclose(nl.metrics.normalized_error(rec.shapes, rigid.points3d, scale=False), 0, atol=1e-9)
    np.testing.assert_allclose(nl.cameras.rotation_error(rec.cameras, rigid.cameras), 0, atol=1e-5)
    np.testing.assert_allclose(rec.projections, rigid.points2d, atol=1e-9)
    assert nl.metrics.handedness(rec.shapes, rigid.points3d) == 0
    assert rec.method == "tomasi_kanade" and rec.edges.tolist() == [[0, 1]]


def test_takes_an_array_with_any_translation(rigid):
    rec = tomasi_kanade(rigid.points2d + 100.0)
    np.testing.assert_allclose(rec.translations, 100, atol=1e-9)
    np.testing.assert_allclose(rec.projections, rigid.points2d + 100.0, atol=1e-9)


def test_what_it_cannot_do_is_said(rigid, rng):
    with pytest.raises(ValueError, match="1 are hidden"):
        tomasi_kanade(rigid.points2d, np.arange(270).reshape(30, 9) > 0)
    with pytest.raises(ValueError, match="at least 3 frames"):
        tomasi_kanade(rigid.points2d[:2])
    with pytest.raises(ValueError, match=r"expected \(F, P, 2\)"):
        tomasi_kanade(rigid.points3d)
    flat = nl.Landmarks(points3d=np.repeat(rng.normal(size=(1, 9, 3)) * (1, 1, 0), 30, axis=0))
    with pytest.raises(ValueError, match="rank below 3"):
        tomasi_kanade(nl.datasets.make_views(flat))
