"""SPS is exact on block-sparse shapes, and says so when shapes are not."""

import numpy as np
import pytest

import nrsfm_lite as nl
from nrsfm_lite.baselines import sps
from nrsfm_lite.baselines._sps import _best, _rotation
from nrsfm_lite.baselines._sps_dictionary import block_omp
from nrsfm_lite.baselines.shared.limits import Watch
from nrsfm_lite.images import read


def block_sparse(seed, frames=300, points=30, atoms=5, active=2, positive=True):
    """Shapes that are sums of `active` out of `atoms`, from random views."""
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(atoms, points, 3))
    support = rng.permuted(np.tile(np.arange(atoms), (frames, 1)), axis=1)[:, :active]
    c = rng.uniform(0.5, 1.5, (frames, active)) * (1 if positive else rng.choice([-1, 1], (frames, active)))
    S = np.einsum("fk,fkpi->fpi", c, B[support])
    S -= S.mean(1, keepdims=True)
    M = nl.cameras.random_cameras(frames, rng)
    return nl.Landmarks(points3d=S, points2d=S @ M, cameras=M)


def error(rec, data):
    return nl.metrics.normalized_error(rec.shapes, data.points3d, scale=False)


@pytest.mark.parametrize("seed", range(3))
def test_exact_on_block_sparse_shapes(seed):
    data = block_sparse(seed)
    rec = sps(data, atoms=5, progress=False)
    assert rec.converged and rec.method == "sps"
    assert error(rec, data).max() < 1e-4
    np.testing.assert_allclose(rec.projections, data.points2d, atol=1e-3)


def test_cameras_too_where_coefficients_are_positive():
    data = block_sparse(3)
    rec = sps(data, atoms=5, progress=False)
    assert nl.cameras.rotation_error(rec.cameras, data.cameras).max() < 0.1  # degrees
    assert nl.metrics.e3d(rec.shapes, data.points3d).max() < 1e-3
    assert nl.metrics.handedness(rec.shapes, data.points3d).mirrored == 0


def test_exact_with_free_signs_and_more_dimensions_than_points():
    data = block_sparse(0, frames=400, points=20, atoms=8, positive=False)
    rec = sps(data, atoms=8, progress=False)
    assert rec.converged and error(rec, data).max() < 1e-4


def test_one_atom_is_a_rigid_object():
    data = block_sparse(0, frames=30, points=9, atoms=1, active=1)
    rec = sps(data, atoms=1, active=1, progress=False)
    assert rec.converged and error(rec, data).max() < 1e-7


def test_units_and_translations_come_back():
    data = block_sparse(0, frames=150)
    rec = sps(data, atoms=5, progress=False)
    moved = sps(50 * data.points2d + [1000.0, -300.0], atoms=5, progress=False)
    np.testing.assert_allclose(moved.projections, 50 * data.points2d + [1000.0, -300.0], atol=0.05)
    np.testing.assert_allclose(moved.translations, np.tile([1000.0, -300.0], (150, 1)), atol=1e-6)
    np.testing.assert_allclose(nl.metrics.normalized_error(moved.shapes / 50, rec.shapes, scale=False), 0, atol=1e-4)


def test_noise_is_not_amplified(rng):
    data = block_sparse(0)
    W = data.points2d + 0.01 * data.points2d.std() * rng.normal(size=data.points2d.shape)
    assert error(sps(W, atoms=5, progress=False), data).mean() < 0.01


def test_missing_points_are_completed_first(rng):
    data = block_sparse(0)
    visible = rng.random((300, 30)) > 0.2
    rec = sps(np.where(visible[..., None], data.points2d, np.nan), visible, atoms=5, progress=False)
    assert error(rec, data).mean() < 5e-3
    np.testing.assert_array_equal(rec.visible, visible)


def test_the_same_seed_gives_the_same_result():
    data = block_sparse(0, frames=60, points=15)
    a, b = (sps(data, atoms=5, restarts=2, seed=4, progress=False) for _ in range(2))
    np.testing.assert_array_equal(a.shapes, b.shapes)


@pytest.mark.parametrize("seconds", [1e-9, 0.2])
def test_time_limit(seconds):
    data = block_sparse(0, frames=1000, points=31, atoms=20)
    rec = sps(data, atoms=20, max_seconds=seconds, progress=False)
    assert not rec.converged and np.isfinite(rec.shapes).all()


def test_shapes_without_structure_come_back_finite_and_not_converged(rng):
    rec = sps(rng.normal(size=(60, 15, 2)), atoms=4, restarts=1, progress=False)
    assert not rec.converged and np.isfinite(rec.shapes).all() and np.isfinite(rec.cameras).all()


def test_atoms_that_never_meet_are_right_by_themselves_and_not_converged():
    data = block_sparse(0, frames=60, points=15, atoms=3, active=1)
    rec = sps(data, atoms=3, active=1, progress=False)
    assert not rec.converged and error(rec, data).max() < 1e-6


def test_starts_are_chosen_by_the_reprojection_error():
    data = block_sparse(1, frames=60, points=15, atoms=3)  # so few frames that most starts fail
    X = read(data, method="sps").X
    watch = Watch("sps", progress=False)
    misfits = []
    for restarts in (1, 4, 16):
        S, M, _, used = _best(X, 3, 2, restarts, np.random.default_rng(0), watch)
        misfits.append(np.linalg.norm(X - S @ M))
        assert 1 <= used <= restarts
    assert misfits[0] >= misfits[1] >= misfits[2]


def test_block_omp_finds_orthogonal_atoms_and_leaves_an_orthogonal_residual(rng):
    U = np.linalg.qr(rng.normal(size=(15, 15)))[0].T.reshape(5, 3, 15).transpose(0, 2, 1)
    support = rng.permuted(np.tile(np.arange(5), (40, 1)), axis=1)[:, :2]
    rows = np.einsum("fkij,fkpj->fip", rng.normal(size=(40, 2, 2, 3)), U[support])
    found, codes, rest = block_omp(U, rows, 2)
    np.testing.assert_array_equal(np.sort(found), np.sort(support))
    np.testing.assert_allclose(rest, 0, atol=1e-8)
    U = np.linalg.qr(rng.normal(size=(5, 15, 3)))[0]  # not orthogonal to each other
    found, codes, rest = block_omp(U, rows, 2)
    np.testing.assert_allclose(rest[:, None] @ U[found], 0, atol=1e-7)
    np.testing.assert_allclose(rows - np.einsum("fkij,fkpj->fip", codes, U[found]), rest, atol=1e-12)


def test_gluing_survives_wrong_cameras(rng):
    T = nl.cameras.random_rotations(1, rng)[0]
    own = nl.cameras.random_cameras(60, rng)
    M = rng.choice([-1, 1], 60)[:, None, None] * (T @ own)
    M[:25] = nl.cameras.random_cameras(25, rng)
    found, distance = _rotation(own, M, rng)
    assert distance < 1e-6
    np.testing.assert_allclose(found * np.sign((found * T).sum()), T, atol=1e-6)


def test_refusals():
    W = block_sparse(0, frames=20, points=12).points2d
    for message, options in [
        (r"needs at least 7 frames and 14 points; got 20 frames of 12 points", {"active": 4}),
        (r"active=0", {"active": 0}),
        (r"atoms=2; expected a whole number, 3 … 8 for 20 frames", {"atoms": 2}),
        (r"atoms=9; expected a whole number, 3 … 8", {"atoms": 9}),
        (r"restarts=0; expected a whole number", {"restarts": 0, "atoms": 5}),
        (r"max_seconds=0", {"max_seconds": 0, "atoms": 5}),
    ]:
        with pytest.raises(ValueError, match=message):
            sps(W, progress=False, **options)
    with pytest.raises(ValueError, match="sps needs at least 8 frames"):
        sps(W[:4])
    with pytest.raises(ValueError, match="point 2 is hidden in every frame"):
        sps(W, np.arange(240).reshape(20, 12) % 12 != 2, atoms=5)


@pytest.mark.realdata
def test_real_shapes_are_not_block_sparse(real_data):
    """Compressible is not enough: finite, worse by far than on exact data, and said to be so."""
    file = real_data / "classic" / "yoga.npz"
    if not file.exists():
        pytest.skip("the classic sequences are not in NRSFM_DATA")
    truth = np.load(file)["S"]
    rec = sps(truth[..., :2], progress=False)
    assert not rec.converged and np.isfinite(rec.shapes).all()
    assert 0.02 < nl.metrics.normalized_error(rec.shapes, truth, scale=False).mean() < 1
