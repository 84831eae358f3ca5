"""Bundle adjustment of a low-rank shape: its derivatives, exact on its own model, bounded on what is not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import nrsfm_lite as nl
from nrsfm_lite.baselines import _nlo, nlo, tomasi_kanade
from nrsfm_lite.baselines.shared.limits import Watch
from nrsfm_lite.images import read


def mild_motion(rng, frames=80, points=15, rank=2, amplitude=0.3):
    """A mean shape and a few atoms with random weights, one random view per frame."""
    atoms, weights = rng.normal(size=(rank, points, 3)), rng.normal(size=(frames, rank)) * amplitude
    weights[:, 0] = 1
    data = nl.Landmarks(points3d=np.tensordot(weights, atoms, 1))
    return nl.datasets.make_views(data, translation_range=1.0)


def error(rec, data):
    return nl.metrics.normalized_error(rec.shapes, data.points3d, scale=False).mean()


def random_problem(rng, F=6, P=5, K=3, hidden=0.2):
    weight = rng.random((F, P)) * (rng.random((F, P)) >= hidden)
    weight[:, 0] = 1
    state = _nlo._State(
        Q=Rotation.random(F, rng=rng).as_matrix(),
        coefficients=np.column_stack([np.ones(F), rng.normal(size=(F, K - 1))]),
        atoms=rng.normal(size=(K, P, 3)),
        t=rng.normal(size=(F, 2)),
    )
    X = rng.normal(size=(F, P, 2))
    return state, _nlo._Problem(X, weight, prior=0.02, mean_prior=0.05, mean=rng.normal(size=(P, 3)))


def test_jacobian_against_finite_differences(rng):
    s, problem = random_problem(rng)
    J = _nlo._jacobian(s)
    step = 1e-6
    for i in range(J.shape[3]):
        own = np.zeros((len(s.t), J.shape[3]))
        own[:, i] = step
        ahead, behind = (_nlo._residual(s.moved(sign * own, 0), problem) for sign in (1, -1))
        np.testing.assert_allclose(J[..., i], (behind - ahead) / (2 * step), atol=1e-8)


def test_a_step_is_the_damped_solution_of_the_whole_system(rng):
    """Elimination gives what all unknowns at once give, with derivatives by finite differences."""
    s, problem = random_problem(rng)
    F, n, damping = len(s.t), len(s.atoms) + 4, 0.3
    size = F * n + s.atoms.size

    def residuals(change):
        new = s.moved(change[: F * n].reshape(F, n), change[F * n :].reshape(s.atoms.shape))
        strength, away = problem.on_atoms(new.atoms)
        priors = np.sqrt(problem.on_coefficients) * new.coefficients[:, 1:], np.sqrt(strength) * away
        seen = _nlo._residual(new, problem) * np.sqrt(problem.weight)[..., None]
        return np.concatenate([seen.ravel(), *(p.ravel() for p in priors)])

    assert (residuals(np.zeros(size)) ** 2).sum() / 2 == pytest.approx(_nlo._objective(s, problem))
    J = np.stack([(residuals(e) - residuals(-e)) / 2e-6 for e in 1e-6 * np.eye(size)], 1)
    H = J.T @ J
    extra = damping * (
        np.diag(H) + _nlo._FLOOR * np.r_[np.full(F * n, len(problem.weight[0])), np.full(s.atoms.size, F)]
    )
    extra[: F * n].reshape(F, n)[:, -2:] = 0  # translations are not damped
    change = -np.linalg.solve(H + np.diag(extra), J.T @ residuals(np.zeros(size)))
    expected = s.moved(change[: F * n].reshape(F, n), change[F * n :].reshape(s.atoms.shape))
    found = _nlo._step(s, problem, damping)
    for name in ("Q", "coefficients", "atoms", "t"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-6)


def test_exact_on_a_mild_deformation_without_priors(rng):
    data = mild_motion(rng)
    rec = nlo(data, rank=2, prior=0, mean_prior=0, progress=False)
    assert rec.converged and rec.method == "nlo"
    assert error(rec, data) < 1e-6
    np.testing.assert_allclose(rec.projections, data.points2d, atol=1e-5)
    np.testing.assert_allclose(rec.translations, data.translations, atol=1e-5)
    np.testing.assert_allclose(nl.cameras.rotation_error(rec.cameras, data.cameras), 0, atol=1e-2)


def test_priors_cost_the_less_the_smaller_they_are(rng):
    data = mild_motion(rng)
    priors = [1e-6, 1e-4, 1e-2]
    errors = [error(nlo(data, rank=2, prior=p, mean_prior=min(p, 1e-3), progress=False), data) for p in priors]
    assert errors[0] < 1e-3
    assert 3 * errors[0] < errors[1] and 3 * errors[1] < errors[2]
    assert 5 * errors[2] < error(tomasi_kanade(data), data)  # with the default priors


def test_missing_points_are_left_out(rng):
    data = mild_motion(rng)
    visible = rng.random(data.visible.shape) > 0.2
    W = np.where(visible[..., None], data.points2d, np.nan)
    rec = nlo(W, visible, rank=2, prior=1e-6, mean_prior=1e-6, progress=False)
    assert error(rec, data) < 1e-3
    assert np.abs(rec.projections - data.points2d).max() < 0.02 * np.ptp(data.points2d)  # hidden ones, too
    np.testing.assert_array_equal(rec.visible, visible)


def test_units_do_not_matter_and_come_back(rng):
    data = mild_motion(rng, frames=40)
    rec = nlo(data, rank=2, progress=False)
    changed = nlo(data.points2d * 1000 + 5, rank=2, progress=False)
    np.testing.assert_allclose(changed.shapes, rec.shapes * 1000, atol=0.1)
    np.testing.assert_allclose(changed.projections, rec.projections * 1000 + 5, atol=0.1)


def test_each_descent_lowers_the_objective_and_adding_an_atom_raises_it_little(rng):
    data = mild_motion(rng, rank=3)
    images = read(data, method="nlo")
    rigid = _nlo._rigid(images)
    problem = _nlo._Problem(images.X, images.weight, 1e-3, 1e-3, rigid.atoms[0])
    better, _ = _nlo._descend(rigid, problem, Watch("nlo", progress=False))
    assert _nlo._objective(better, problem) < _nlo._objective(rigid, problem)
    wider = _nlo._add_atom(better, replace(problem, prior=0.0))
    assert _nlo._objective(wider, replace(problem, prior=0.0)) < _nlo._objective(better, problem)


def test_a_rigid_object_needs_no_atoms(rng):
    data = mild_motion(rng, rank=1)
    for rank in (1, 2):
        assert error(nlo(data, rank=rank, progress=False), data) < 1e-3
        assert error(nlo(data, rank=rank, prior=1e-6, mean_prior=1e-6, progress=False), data) < 1e-6


def test_time_limit_returns_what_there_is(rng):
    data = mild_motion(rng, rank=3)
    for seconds in (1e-9, 0.05):
        rec = nlo(data, rank=3, prior=1e-8, mean_prior=1e-8, max_seconds=seconds, progress=False)
        assert not rec.converged and np.isfinite(rec.shapes).all()
        misfit, rigid = (np.linalg.norm(r.projections - data.points2d) for r in (rec, tomasi_kanade(data)))
        assert misfit < rigid * (1 + 1e-9)  # every step lowers the objective, which is all but this


def test_what_it_cannot_do_is_said(rng):
    data = mild_motion(rng)
    for wrong, message in [
        ({"rank": 0}, "rank=0; expected a whole number"),
        ({"prior": -1}, "prior=-1; expected a number of at least 0"),
        ({"mean_prior": np.inf}, "mean_prior=inf"),
        ({"max_seconds": -1}, "max_seconds=-1"),
    ]:
        with pytest.raises(ValueError, match=message):
            nlo(data, progress=False, **wrong)
    with pytest.raises(ValueError, match="at least 3 frames"):
        nlo(data.points2d[:2], progress=False)


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "share"), [("pickup", 0.7), ("stretch", np.inf)])
def test_depth_stays_bounded_on_the_classic_sequences(real_data, name, share):
    """And the error falls to that share of the rigid one's; on stretch the minimum is a wrong one."""
    file = real_data / "classic" / f"{name}.npz"
    if not file.exists():
        pytest.skip("the classic sequences are not in NRSFM_DATA")
    data = nl.datasets.load_classic(file)
    rec, rigid = nlo(data, progress=False), tomasi_kanade(data)
    assert error(rec, data) < share * error(rigid, data)
    assert np.linalg.norm(rec.shapes, axis=(1, 2)).max() < 1.3 * np.linalg.norm(data.points3d, axis=(1, 2)).max()
