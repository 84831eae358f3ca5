"""The methods that factor the images over cameras found first: bmm, ksta, riks."""

import numpy as np
import pytest
from scipy.fft import idct
from scipy.optimize import check_grad

import nrsfm_lite as nl
from nrsfm_lite.baselines import _bmm, bmm, ksta, riks
from nrsfm_lite.baselines.shared import limits, upgrade, variable_projection

METHODS = (bmm, ksta, riks)


def low_rank(rng, coefficients, cameras):
    """Exact views of shapes of low rank: the first coefficient is 1, the others are given (F, K − 1)."""
    C = np.column_stack([np.ones(len(coefficients)), coefficients])
    S = np.einsum("fk,kpi->fpi", C, rng.normal(size=(C.shape[1], 30, 3)))
    return nl.Landmarks(points3d=S, points2d=S @ cameras, cameras=cameras)


def circling(frames):
    angle = np.linspace(0, 7, frames)
    M = np.zeros((frames, 3, 2))
    M[:, 0, 0], M[:, 2, 0], M[:, 1, 1] = np.cos(angle), np.sin(angle), 1
    tilt = 0.4 * np.sin(np.linspace(0, 5, frames))
    turn = np.zeros((frames, 3, 3))
    turn[:, 0, 0], turn[:, 1, 1], turn[:, 2, 2] = 1, np.cos(tilt), np.cos(tilt)
    turn[:, 1, 2], turn[:, 2, 1] = -np.sin(tilt), np.sin(tilt)
    return turn @ M


@pytest.fixture
def video(rng):
    """90 frames of rank 2; the coefficient is a smooth curve."""
    t = np.linspace(0, 1, 90)
    return low_rank(rng, 0.5 * np.sin(5 * t)[:, None], circling(90))


def error(rec, data):
    return nl.metrics.normalized_error(rec.shapes, data.points3d, scale=False).mean()


def test_bmm_is_exact_on_low_rank_in_any_order(rng):
    data = low_rank(rng, 0.4 * rng.normal(size=(120, 1)), nl.cameras.random_cameras(120, seed=1))
    rec = bmm(data, rank=2, progress=False)
    assert error(rec, data) < 1e-3 and rec.converged
    assert nl.metrics.handedness(rec.shapes, data.points3d).mirrored == 0
    np.testing.assert_allclose(rec.projections, data.points2d, atol=1e-2)
    order = rng.permutation(120)
    assert error(bmm(data[order], rank=2, progress=False), data[order]) < 1e-3


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5])
def test_ksta_is_exact_on_its_own_model(seed):
    """The curve stays on a circle around one of the centres, so the shape has a rigid part: the cameras need it."""
    angle = 2 * np.sin(np.linspace(0, 3, 90))
    y = np.column_stack([np.cos(angle), np.sin(angle)])
    C = np.exp(-((y[:, None] - np.array([[0, 0], [1, 0], [0, 1]])) ** 2).sum(2) / 2)
    S = np.einsum("fk,kpi->fpi", C, np.random.default_rng(seed).normal(size=(3, 30, 3)))
    data = nl.Landmarks(points3d=S, points2d=S @ circling(90))
    rec = ksta(data, rank=3, smoothness=1.0, dimensions=2, progress=False)
    assert error(rec, data) < 1e-3
    assert nl.cameras.rotation_error(rec.cameras, circling(90)).max() < 0.15


@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("kernel", ["asfm", "rik"])
def test_riks_is_exact_on_its_own_model(seed, kernel):
    """Atoms found one after the other are the true ones if their images are independent over the frames."""
    M, c = circling(90), np.sin(np.linspace(0, 12, 90))
    directions = np.linalg.svd((M @ M.swapaxes(1, 2)).reshape(90, 9), full_matrices=False)[0][:, :6]
    c = c - directions @ (directions.T @ c)
    data = low_rank(np.random.default_rng(seed), 0.2 * c[:, None] / c.std(), M)
    assert error(riks(data, rank=2, basis=1.0, kernel=kernel, progress=False), data) < 1e-3
    assert error(riks(data, rank=1, basis=1.0, kernel=kernel, progress=False), data) > 0.01  # not for any reason


@pytest.mark.parametrize(
    ("method", "own"),
    [
        (nl.baselines.pta, {"rank": 4}),
        (bmm, {"rank": 2, "progress": False}),
        (ksta, {"rank": 2, "dimensions": 1, "progress": False}),
        (riks, {"rank": 2, "progress": False}),
    ],
)
def test_a_fifth_missing_on_a_smooth_sequence(video, rng, method, own):
    visible = rng.random((90, 30)) > 0.2
    W = np.where(visible[..., None], 7 * video.points2d + (100, -40), np.nan)
    rec = method(W, visible, **own)
    complete = nl.metrics.normalized_error(method(video, **own).shapes, video.points3d).mean()
    assert nl.metrics.normalized_error(rec.shapes, video.points3d).mean() - complete < 0.05
    centroids = (7 * video.points2d + (100, -40)).mean(1)  # in the user's units
    np.testing.assert_allclose(rec.translations, centroids, atol=0.5)
    np.testing.assert_array_equal(rec.visible, visible)


@pytest.mark.parametrize("method", METHODS)
def test_time_limit_and_refusals(video, method):
    rec = method(video, rank=4, max_seconds=1e-3, progress=False)
    assert not rec.converged and np.isfinite(rec.shapes).all() and rec.method == method.__name__
    with pytest.raises(ValueError, match=r"rank=11; expected a whole number, \d … 10 for 90 frames and 30 points"):
        method(video, rank=11)
    with pytest.raises(ValueError, match="max_seconds=0; expected a number above 0"):
        method(video, max_seconds=0)
    with pytest.raises(ValueError, match=r"needs at least \d frames and 6 points; got 90 frames of 5 points"):
        method(video.points2d[:, :5])
    with pytest.raises(ValueError, match="hidden in every frame"):
        method(video.points2d, np.arange(2700).reshape(90, 30) % 30 > 0)


def test_own_parameters_out_of_range(video):
    for method, wrong in [
        (bmm, {"restarts": 0}),
        (ksta, {"dimensions": 9}),
        (bmm, {"rank": 2.5}),
        (riks, {"rank": 2.5}),
        (ksta, {"smoothness": 0}),
        (riks, {"basis": 1.5}),
        (riks, {"kernel": "gauss"}),
    ]:
        ((name, value),) = wrong.items()
        with pytest.raises(ValueError, match=f"{name}={value!r}; expected"):
            method(video, **wrong, progress=False)
    for method in METHODS:
        with pytest.raises(ValueError, match="progress='no'; expected True or False"):
            method(video, rank=2, progress="no")


@pytest.mark.parametrize(
    ("method", "wrong"),
    [
        (nl.baselines.nlo, {"rank": True}),
        (nl.baselines.nlo, {"prior": "little"}),
        (nl.baselines.sps, {"active": True}),
        (nl.baselines.sfc, {"upgrade": "no"}),
        (nl.baselines.sfc, {"penalty": np.nan}),
        (nl.baselines.cns, {"locality": "here"}),
        (nl.baselines.bmm, {"max_seconds": "a minute"}),
        (nl.baselines.pta, {"rank": 2.5}),
    ],
)
def test_nothing_is_taken_for_a_number_that_is_none(video, method, wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(ValueError, match=f"{name}={value!r}; expected"):
        method(video, **wrong, progress=False)


def test_a_float_that_is_whole_will_do(video):
    own = {"smoothness": np.float32(0.1), "dimensions": np.int64(1), "progress": np.False_}
    np.testing.assert_array_equal(ksta(video, rank=2.0, **own).shapes, ksta(video, rank=2, **own).shapes)


def test_fewer_points_take_a_smaller_rank(rng):
    video = low_rank(rng, 0.3 * np.sin(np.linspace(0, 5, 40))[:, None], circling(40))
    for method in METHODS:
        assert np.isfinite(method(video.points2d[:, :7], progress=False).shapes).all()


def test_a_rigid_video_is_referred_to_the_rigid_method(rng):
    S = np.repeat(rng.normal(size=(1, 9, 3)), 20, axis=0)
    for method in (nl.baselines.pta, ksta, riks):
        with pytest.raises(ValueError, match="W has rank 3, as a rigid object's images have: tomasi_kanade"):
            method(S @ circling(20), rank=2)


def test_singular_steps_are_no_crash():
    """Directions that change nothing, and little damping left: 30 frames of a motion, all components."""
    clip = nl.datasets.make_motion(30, seed=0)
    assert np.isfinite(riks(clip.points3d @ circling(30), rank=3, progress=False).shapes).all()


def test_one_frame_on_a_line_does_not_spoil_the_cameras(rng):
    data = low_rank(rng, 0.4 * rng.normal(size=(120, 1)), nl.cameras.random_cameras(120, seed=1))
    for axis in (0, 1):
        W = data.points2d.copy()
        W[3, :, axis] = 0
        rec = bmm(W, rank=2, progress=False)
        others = np.arange(120) != 3
        found = nl.metrics.normalized_error(rec.shapes[others], data.points3d[others], scale=False)
        assert found.mean() < 0.1


def test_bmm_says_when_its_steps_did_not_settle(rng, monkeypatch):
    data = low_rank(rng, 0.4 * rng.normal(size=(40, 1)), nl.cameras.random_cameras(40, seed=1))
    monkeypatch.setattr(_bmm, "_ITERATIONS", 1)
    assert not bmm(data, rank=2, progress=False).converged


def test_too_large_is_refused_beforehand():
    with pytest.raises(ValueError, match=r"bmm would need about 9\d{5}.\d GB of memory for 9 frames"):
        limits.check_cost("bmm", 9, 950_000)
    with pytest.raises(ValueError, match=r"bmm would take up to about 2.0 hours for 9 frames; give max_seconds"):
        limits.check_cost("bmm", 9, 0, 7200)
    limits.check_cost("bmm", 9, 0, 7200, max_seconds=60)
    with pytest.raises(ValueError, match=r"riks would (need|take up to) about"):
        riks(np.random.default_rng(0).normal(size=(20_000, 40, 2)), basis=1.0)


@pytest.mark.parametrize(
    ("folder", "limit", "usage"),
    [(".", "memory.max", "memory.current"), ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes")],
)
def test_inside_a_container_only_what_it_has_left_is_free(tmp_path, monkeypatch, folder, limit, usage):
    monkeypatch.setattr(limits, "_CGROUP", tmp_path, raising=False)
    outside = limits._free_bytes()  # no such files
    assert outside > 2**27
    folder = tmp_path / folder
    folder.mkdir(exist_ok=True)
    (folder / limit).write_text(f"{2**27}\n")
    (folder / usage).write_text(f"{2**27 - 3000}\n")
    (folder / "memory.stat").write_text("anon 5\ninactive_file 1000\n")
    assert limits._free_bytes() == 4000
    with pytest.raises(ValueError, match=r"bmm would need about 1.0 GB of memory for 9 frames, and 0.0 GB are free"):
        limits.check_cost("bmm", 9, 1)
    (folder / limit).write_text("max\n")
    assert limits._free_bytes() > 2**27


def test_signs_of_frames_in_no_order(rng):
    S = np.repeat(rng.normal(size=(1, 20, 3)), 50, axis=0) + 0.1 * rng.normal(size=(50, 20, 3))
    M = nl.cameras.random_cameras(50, seed=2)
    flipped = M * np.where(rng.random(50) < 0.5, -1, 1)[:, None, None]
    mended = upgrade.consistent(flipped, S @ M)
    same = np.einsum("fij,fij->f", mended, M) / 2
    np.testing.assert_allclose(same, same[0], atol=1e-9)


def test_gradients_of_the_upgrade(rng):
    motion, g = rng.normal(size=(20, 2, 6)), rng.normal(size=18)
    for misfit in (upgrade._misfit, upgrade._ratio_misfit):
        assert check_grad(lambda g, f=misfit: f(g, motion)[0], lambda g, f=misfit: f(g, motion)[1], g) < 5e-3


@pytest.mark.parametrize("solve", [variable_projection._together, variable_projection._one_by_one])
def test_normal_equations_are_those_of_the_jacobian(rng, solve):
    """Against the Jacobian formed in full, parameter by parameter."""
    F, P, K, d = 12, 7, 2, 4
    X, M = rng.normal(size=(F, P, 2)), nl.cameras.random_cameras(F)
    basis = idct(np.eye(F, d), axis=0, norm="ortho")
    local, free, Z = rng.normal(size=(F, K, 2)), rng.normal(size=(F, K, 3)), rng.normal(size=(F, K))
    now = variable_projection.Coefficients(Z, basis, local, free)
    images = X.transpose(0, 2, 1).reshape(2 * F, P)
    B, Q, projectors, residual = solve(images, now.C, M)
    gradient, hessian = variable_projection._normal_equations(now, M, B, Q, projectors, residual)
    steps = [np.einsum("f,fk->fk", basis[:, i], local[:, :, q]) for i in range(d) for q in range(2)]
    steps += [free[:, :, m] for m in range(3)]
    J = []
    for dC in steps:
        v = [np.einsum("fij,f,ip->fjp", M, dC[:, k], B[k]).reshape(2 * F, P) for k in range(K)]
        J.append(sum(v[k] - Q @ (projectors[k] @ v[k]) for k in range(K)).ravel() / np.sqrt(residual.size))
    J = np.array(J)
    np.testing.assert_allclose(hessian, J @ J.T, atol=1e-12)
    np.testing.assert_allclose(gradient, J @ residual.ravel() / np.sqrt(residual.size), atol=1e-12)


CLASSIC = [  # the published e3D (Dai et al.), and what a port of the sheet reaches with riks
    ("bmm", "drink", {"rank": 12}, 0.0266),
    ("bmm", "pickup", {"rank": 12}, 0.1731),
    ("bmm", "stretch", {"rank": 11}, 0.1034),
    ("bmm", "dance", {"rank": 10}, 0.1864),
    ("riks", "pickup", {"rank": 3, "kernel": "rik"}, 0.229),
    ("riks", "yoga", {"rank": 7, "kernel": "rik"}, 0.1485),
]


@pytest.mark.realdata
@pytest.mark.parametrize(("method", "name", "own", "expected"), CLASSIC)
def test_classic_sequences(real_data, method, name, own, expected):
    """Within a tenth of the listed error."""
    file = real_data / "classic" / f"{name}.npz"
    if not file.exists():
        pytest.skip("the classic sequences are not in NRSFM_DATA")
    truth = np.load(file)
    rec = getattr(nl.baselines, method)(truth["S"][..., :2], **own, progress=False)
    if "S_world" in truth:
        found = nl.metrics.e3d(rec.shapes, truth["S_world"]).mean()
    else:
        found = nl.metrics.e3d(nl.cameras.camera_frame(rec.shapes, rec.cameras), truth["S"]).mean()
    assert found == pytest.approx(expected, rel=0.1)
