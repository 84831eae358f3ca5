"""The errors, against a brute-force search over rotations and against hand-made cases."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from nrsfm_lite import metrics
from nrsfm_lite.cameras import random_rotations


def brute_force(S, S_true, scale, reflections):
    """The same error by minimising over rotations directly, from many starts."""
    S, S_true = S - S.mean(0), S_true - S_true.mean(0)
    if scale:
        S = S * np.linalg.norm(S_true) / np.linalg.norm(S)
    best = np.inf
    for mirror in (1, -1) if reflections else (1,):
        T = S * (1, 1, mirror)
        for start in Rotation.random(12, rng=np.random.default_rng(0)).as_rotvec():
            found = minimize(lambda v, T=T: np.linalg.norm(Rotation.from_rotvec(v).apply(T) - S_true), start)
            best = min(best, found.fun)
    return best / np.linalg.norm(S_true)


@pytest.mark.parametrize("scale", [True, False])
@pytest.mark.parametrize("reflections", [True, False])
def test_normalized_error_against_brute_force(rng, scale, reflections):
    S, S_true = rng.normal(size=(2, 3, 7, 3))
    error = metrics.normalized_error(S, S_true, scale=scale, reflections=reflections)
    expected = [brute_force(a, b, scale, reflections) for a, b in zip(S, S_true, strict=True)]
    np.testing.assert_allclose(error, expected, rtol=1e-6)


def test_what_each_error_forgives(rng):
    S = rng.normal(size=(4, 9, 3))
    moved = 3 * S @ random_rotations(4) + rng.normal(size=(4, 1, 3))
    mirrored = moved * (1, 1, -1)
    np.testing.assert_allclose(metrics.normalized_error(moved, S), 0, atol=1e-12)
    np.testing.assert_allclose(metrics.normalized_error(mirrored, S), 0, atol=1e-12)
    assert (metrics.normalized_error(moved, S, scale=False) > 1).all()
    assert (metrics.normalized_error(mirrored, S, reflections=False) > 0.1).all()
    np.testing.assert_allclose(metrics.pa_mpjpe(moved, S), 0, atol=1e-12)
    assert (metrics.mpjpe(moved, S) > 0.1).all()
    np.testing.assert_allclose(metrics.mpjpe(S + 5, S), 0, atol=1e-12)


def test_mpjpe_by_hand():
    S_true = np.array([[[0.0, 0, 0], [2, 0, 0]]])
    S = np.array([[[0.0, 0, 0], [0, 0, 4]]])
    # Centred: (±1, 0, 0) against (0, 0, ±2): each point is off by √5.
    np.testing.assert_allclose(metrics.mpjpe(S, S_true), np.sqrt(5))


def test_pa_mpjpe_is_the_least_squares_similarity(rng):
    S, S_true = rng.normal(size=(2, 5, 8, 3))
    for a, b, value in zip(S, S_true, metrics.pa_mpjpe(S, S_true), strict=True):
        a, b = a - a.mean(0), b - b.mean(0)
        fits = [
            minimize(
                lambda v, a=a, b=b: np.square(np.exp(v[0]) * Rotation.from_rotvec(v[1:]).apply(a) - b).sum(), start
            )
            for start in np.column_stack([np.zeros(10), Rotation.random(10, rng=np.random.default_rng(1)).as_rotvec()])
        ]
        v = min(fits, key=lambda f: f.fun).x
        by_search = np.linalg.norm(np.exp(v[0]) * Rotation.from_rotvec(v[1:]).apply(a) - b, axis=1).mean()
        assert value == pytest.approx(by_search, rel=1e-3)


def test_handedness_counts_the_minority(rng):
    S = rng.normal(size=(10, 9, 3))
    flipped = S @ random_rotations(10)
    assert metrics.handedness(flipped, S) == 0
    assert metrics.handedness(-flipped, S) == 0  # all mirrored: a convention, not an error
    flipped[:3] *= (1, 1, -1)
    assert metrics.handedness(flipped, S) == pytest.approx(0.3)


def test_a_flat_prediction_has_a_finite_error(rng):
    assert np.isfinite(metrics.normalized_error(np.zeros((1, 5, 3)), rng.normal(size=(1, 5, 3)))).all()


@pytest.mark.parametrize(
    ("S", "S_true", "message"),
    [
        (np.zeros((1, 5, 3)), np.zeros((1, 4, 3)), "have shapes"),
        (np.zeros((1, 5, 2)), np.zeros((1, 5, 2)), r"expected \(F, P, 3\)"),
        (np.full((1, 5, 3), np.nan), np.ones((1, 5, 3)), "finite"),
        (np.zeros((1, 5, 3)), np.ones((1, 5, 3)), "all equal"),
    ],
)
def test_wrong_input_is_refused(S, S_true, message):
    with pytest.raises(ValueError, match=message):
        metrics.normalized_error(S, S_true)


@pytest.mark.realdata
def test_real_reconstructions_have_their_listed_errors(real_data):
    """The per-frame errors of reconstructions by the classical MATLAB codes, scale not fitted."""
    listed = {"CNS_pickup": 0.0482, "CNS_yoga": 0.0349, "CNS_stretch": 0.0323, "CNS_dance": 0.0685,
              "PND2_yoga": 0.0110, "BMM_yoga": 0.0258, "BMM_pickup": 0.0264, "BMM_stretch": 0.0226,
              "PTA_pickup": 0.0362, "PTA_yoga": 0.0319, "PTA_stretch": 0.0505}  # fmt: skip
    for name, value in listed.items():
        file = real_data / "classic" / "reference_reconstructions" / f"{name}.npz"
        truth = real_data / "classic" / f"{name.split('_')[1]}.npz"
        if not file.exists() or not truth.exists():
            pytest.skip(f"{file.name} or its sequence is not in NRSFM_DATA")
        S, S_true = np.load(file)["S"], np.load(truth)["S"]
        assert metrics.normalized_error(S, S_true, scale=False).mean() == pytest.approx(value, abs=6e-5), name
