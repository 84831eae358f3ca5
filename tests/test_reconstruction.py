"""The front door: from points to a Reconstruction, and back to the points."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

import nrsfm_lite as nl


@pytest.fixture(scope="module")
def views():
    return nl.datasets.make_views(nl.datasets.make_motion(600, seed=7), seed=7)


@pytest.fixture(scope="module")
def rec(views):
    return nl.reconstruct(views, steps=400, progress=False)


def test_beats_rigid_factorisation_even_when_trained_briefly(views, rec):
    ours = nl.metrics.normalized_error(rec.shapes, views.points3d).mean()
    rigid = nl.metrics.normalized_error(nl.baselines.tomasi_kanade(views).shapes, views.points3d).mean()
    assert ours < rigid


def test_keeps_its_promises(views, rec):
    np.testing.assert_allclose(
        rec.cameras.swapaxes(1, 2) @ rec.cameras, np.broadcast_to(np.eye(2), (600, 2, 2)), atol=1e-9
    )
    np.testing.assert_allclose(rec.shapes.mean(1), 0, atol=1e-9)
    np.testing.assert_allclose(rec.projections.mean(1), views.points2d.mean(1), atol=1e-9)
    assert rec.names == views.names and rec.method == "deep_nrsfm" and rec.converged
    assert 0 <= rec.coherence <= 1 and not rec.model.training


def test_units_of_the_user(views):
    pixels = 200 * views.points2d + (640, 360)
    few, other = (nl.reconstruct(W, steps=5, refine=False, progress=False) for W in (views, pixels))
    np.testing.assert_allclose(other.shapes, 200 * few.shapes, rtol=0, atol=0.02)
    np.testing.assert_allclose(other.translations, [[640, 360]] * 600, atol=1e-6)


def test_refinement_explains_the_images_better(views, rec):
    def residual(r):
        return np.linalg.norm(r.projections - views.points2d)

    plain = nl.reconstruct(views, model=rec.model, refine=False)
    assert residual(rec) < residual(plain)
    S, M, _ = rec.model(torch.as_tensor(views.points2d).float())
    np.testing.assert_allclose(plain.shapes, S.detach(), atol=1e-4)
    np.testing.assert_allclose(plain.cameras, M.detach(), atol=1e-4)


def test_each_refinement_is_better_than_none_and_the_prior_is_best(views, rec):
    def error(**how):
        again = nl.reconstruct(views, model=rec.model, **how)
        return nl.metrics.normalized_error(again.shapes, views.points3d).mean()

    with_prior, by_code, plain = error(), error(refine="code"), error(refine=False)
    assert with_prior < by_code < plain
    np.testing.assert_allclose(nl.reconstruct(views, model=rec.model).shapes, rec.shapes, atol=1e-3)


def test_the_prior_can_be_learned_from_the_new_frames(rec):
    other = nl.datasets.make_views(nl.datasets.make_motion(400, seed=8), seed=8)
    errors = {}
    for adapt in (False, True):
        again = nl.reconstruct(other, model=rec.model, adapt=adapt)
        errors[adapt] = nl.metrics.normalized_error(again.shapes, other.points3d).mean()
    assert errors[True] < errors[False]
    film = other[:20]
    alone, adapted = (nl.reconstruct(film, model=rec.model, adapt=a).shapes for a in (False, True))
    errors = [nl.metrics.normalized_error(S, film.points3d).mean() for S in (alone, adapted)]
    assert errors[1] < 0.6 * errors[0]
    bare = nl.DeepNRSfM(n_points=31, generator=torch.Generator().manual_seed(0)).eval()
    assert bare.prior is None and np.isfinite(nl.reconstruct(other, model=bare).shapes).all()


def test_a_trained_network_takes_new_frames_of_any_number(rec):
    other = nl.datasets.make_views(nl.datasets.make_motion(50, seed=99))
    again = nl.reconstruct(other, model=rec.model)
    one = nl.reconstruct(other.points2d[:1], model=rec.model)
    np.testing.assert_allclose(one.shapes[0], again.shapes[0], atol=1e-4)


def test_one_bad_frame_does_not_touch_the_others(views, rec):
    W = views.points2d[:50].copy()
    W[7] *= 1e4
    other = nl.reconstruct(W, model=rec.model)
    np.testing.assert_allclose(np.delete(other.shapes, 7, 0), np.delete(rec.shapes[:50], 7, 0), atol=1e-4)


def test_reversed_and_read_only_input(views, rec):
    backwards = nl.reconstruct(views[::-1], model=rec.model)
    np.testing.assert_allclose(backwards.shapes, rec.shapes[::-1], atol=1e-4)
    frozen = views.points2d[::2].copy()
    frozen.setflags(write=False)
    with torch.no_grad():
        nl.reconstruct(frozen, model=rec.model)


def test_tensors_and_hidden_points(views, rec):
    visible = np.ones((600, 31), bool)
    visible[:, 3] = False
    W = torch.as_tensor(np.where(visible[..., None], views.points2d, np.nan))
    other = nl.reconstruct(W, visible=torch.as_tensor(visible), model=rec.model, refine=False)
    assert np.isfinite(other.shapes).all() and not other.visible[:, 3].any()


def test_weak_perspective_scale_goes_into_the_shape(views):
    views = views[::4]
    rec = nl.reconstruct(views, projection="weak_perspective", steps=50, progress=False)
    scale = np.random.default_rng(0).uniform(0.1, 9, (150, 1, 1))
    other = nl.reconstruct(views.points2d * scale, model=rec.model)  # the model knows its projection
    np.testing.assert_allclose(other.cameras, rec.cameras, atol=1e-3)
    np.testing.assert_allclose(other.shapes / scale, rec.shapes, atol=1e-3)


@pytest.mark.parametrize("projection", ["orthographic", "weak_perspective"])
@pytest.mark.parametrize("seed", range(3))
def test_projections_come_back_in_the_users_image_whatever_its_size_and_offset(views, projection, seed):
    rng = np.random.default_rng(seed)
    size, offset = 10 ** rng.uniform(-3, 4), 10 ** rng.uniform(0, 4) * rng.normal(size=2)
    views = views[::4]
    visible = rng.random((150, 31)) > 0.2
    unit = nl.reconstruct(views.points2d, visible, projection=projection, steps=20, progress=False)
    W = size * views.points2d + offset
    model = copy.deepcopy(unit.model)
    if projection == "orthographic":
        model.normalizer = replace(model.normalizer, scale=size * model.normalizer.scale)  # as training on W leaves it
    rec = nl.reconstruct(W, visible, model=model)
    misses = [np.linalg.norm((r.projections - w)[visible]) for r, w in ((unit, views.points2d), (rec, W))]
    assert misses[1] / size == pytest.approx(misses[0], rel=1e-3)
    residual = np.where(visible[..., None], rec.projections - W, 0.0)
    np.testing.assert_allclose(residual.sum(1), 0, atol=1e-6 * (size + np.abs(offset).max()))  # the best translation


def test_translations_are_found_and_their_model_is_kept(views, tmp_path):
    moved = nl.datasets.make_views(nl.datasets.make_motion(600, seed=7), seed=7, translation_range=1.0)
    rec = nl.reconstruct(moved, translation=True, steps=100, progress=False)
    assert rec.model.config.translation
    np.testing.assert_allclose(rec.translations, moved.translations, atol=1e-9)  # complete: the mean of the points
    again = nl.Reconstruction.load(rec.save(tmp_path / "moved.npz"))
    other = nl.reconstruct(moved, model=again.model)
    np.testing.assert_allclose(other.shapes, rec.shapes, atol=1e-4)


def test_a_wrong_point_without_confidence_does_not_matter(views, rec):
    W, confidence = views.points2d.copy(), np.ones((600, 31))
    W[::2, 5] += 1.0  # far off
    trusted = nl.reconstruct(W, model=rec.model)
    confidence[::2, 5] = 1e-5  # the prior's noise, a few thousandths of a body, is then as large as the body
    doubted = nl.reconstruct(W, model=rec.model, confidence=confidence)
    confidence[::2, 5] = 0
    hidden = nl.reconstruct(W, model=rec.model, confidence=confidence)
    errors = [nl.metrics.normalized_error(r.shapes, views.points3d).mean() for r in (trusted, doubted, hidden, rec)]
    assert errors[0] > 2 * errors[1] and errors[1] < 1.3 * errors[3] and errors[2] < 1.3 * errors[3]
    alike = nl.reconstruct(views, model=rec.model, confidence=np.full((600, 31), 0.01), refine=False)
    np.testing.assert_allclose(alike.shapes, nl.reconstruct(views, model=rec.model, refine=False).shapes, atol=1e-6)
    same = nl.reconstruct(views, visible=confidence > 0, model=rec.model)
    np.testing.assert_allclose(same.shapes, hidden.shapes, atol=1e-9)


def test_frames_with_few_points(views, rec):
    visible = np.ones((20, 31), bool)
    visible[3, 2:] = False
    few = nl.reconstruct(views.points2d[:20], visible, model=rec.model)
    assert np.isfinite(few.shapes).all()
    size = np.linalg.norm(views.points3d[:20], axis=(1, 2))
    assert np.linalg.norm(few.shapes[3]) < 2 * size.max()  # two points: a likely shape, seen from somewhere
    visible[3, 1:] = False
    with pytest.raises(ValueError, match="frame 3 of W has all its visible points at one place; leave it out"):
        nl.reconstruct(views.points2d[:20], visible, model=rec.model)
    visible[3] = False
    with pytest.raises(ValueError, match="frame 3 of W has no visible point"):
        nl.reconstruct(views.points2d[:20], visible, model=rec.model)


def test_wrong_input_is_refused(views, rec):
    with pytest.raises(ValueError, match=r"confidence is 2\.0 at frame 0, point 0; expected 0 to 1"):
        nl.reconstruct(views, model=rec.model, confidence=np.full((600, 31), 2))
    with pytest.raises(ValueError, match=r"confidence has shape \(600, 30\); expected \(600, 31\)"):
        nl.reconstruct(views, model=rec.model, confidence=np.ones((600, 30)))
    with pytest.raises(ValueError, match="no visible point with confidence"):
        nl.reconstruct(views, model=rec.model, confidence=np.zeros((600, 31)))
    with pytest.raises(ValueError, match="refine='codes'; expected one of True, False, code"):
        nl.reconstruct(views, model=rec.model, refine="codes")
    with pytest.raises(ValueError, match="no points2d"):
        nl.reconstruct(nl.datasets.make_motion(20))
    with pytest.raises(ValueError, match="at least 10 frames"):
        nl.reconstruct(views.points2d[:2], progress=False)
    with pytest.raises(ValueError, match="at least one frame"):
        nl.reconstruct(views.points2d[:0], model=rec.model)
    with pytest.raises(ValueError, match="visible cannot be read"):
        nl.reconstruct(views.points2d, visible=np.full((600, 31), np.nan), model=rec.model)
    with pytest.raises(ValueError, match="model was trained for 31 points, but W has 30"):
        nl.reconstruct(views.points2d[:, :30], model=rec.model)
    with pytest.raises(ValueError, match="projection='orthographic', not 'weak_perspective'"):
        nl.reconstruct(views, model=rec.model, projection="weak_perspective")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"steps": -5}, "steps=-5 with a trained model"),
        ({"checkpoint": "nowhere/state.pt"}, "checkpoint=.* with a trained model"),
        ({"device": "nonsense"}, "device='nonsense' with a trained model"),
        ({"translation": True}, "trained for translation=False, not True"),
        ({"adapt": True, "refine": False}, "adapt=True with refine=False"),
        ({"adapt": True, "refine": "code"}, "adapt=True with refine='code'"),
        ({"adapt": "yes"}, "adapt='yes'; expected True or False"),
        ({"refine": 1}, "refine=1"),
        ({"occlusion": 1}, "occlusion=1"),
        ({"occlusion": True}, "every point is visible"),
        ({"seed": -1}, "seed=-1"),
        ({"seed": 0.5}, "seed=0.5"),
    ],
)
def test_what_contradicts_or_cannot_act_is_refused(views, rec, wrong, message):
    with pytest.raises(ValueError, match=message):
        nl.reconstruct(views, model=rec.model, **wrong)


def test_the_same_is_refused_where_a_network_is_trained(views):
    for wrong, error, message in [
        ({"steps": -5}, ValueError, "steps=-5"),
        ({"steps": 2.9}, ValueError, "steps=2.9"),
        ({"device": "nonsense"}, ValueError, "no such device here"),
        ({"checkpoint": "nowhere/state.pt"}, FileNotFoundError, "no such folder"),
        ({"projection": "fisheye"}, ValueError, "projection='fisheye'"),
        ({"translation": "no"}, ValueError, "translation='no'"),
    ]:
        with pytest.raises(error, match=message):
            nl.reconstruct(views, progress=False, **wrong)
    with pytest.raises(ValueError, match="every point is visible"):
        nl.reconstruct(views, occlusion=True, progress=False)
    with pytest.raises(ValueError, match="model is a str; expected a DeepNRSfM"):
        nl.reconstruct(views, model="walk.npz")


def test_a_numpy_seed_is_a_seed(views, rec):
    one, other = (nl.reconstruct(views[:50], model=rec.model, adapt=True, seed=s) for s in (3, np.int64(3)))
    np.testing.assert_array_equal(one.shapes, other.shapes)


def test_refining_shows_its_progress(views, rec, capsys):
    nl.reconstruct(views, model=rec.model, progress=True)
    assert "refining" in capsys.readouterr().err
    nl.reconstruct(views, model=rec.model, progress=False)
    assert not capsys.readouterr().err


def test_uncertainty_covers_the_depths_and_moves_with_the_unit(views):
    views = views[::4]
    rec = nl.reconstruct(views, steps=30, progress=False)
    z, true = (
        nl.cameras.camera_frame(S - S.mean(1, keepdims=True), M)[..., 2]
        for S, M in ((rec.shapes, rec.cameras), (views.points3d, views.cameras))
    )
    off = np.abs(np.sign((z * true).sum()) * z - true)
    half = 1.645 * np.sqrt(rec.uncertainty[..., 2, 2])
    assert 0.7 < (off < half).mean() < 0.995 and 2 * np.median(half) < 0.3 * np.std(true)
    assert nl.reconstruct(views, model=rec.model, refine=False).uncertainty is None
    larger = nl.reconstruct(64 * views.points2d, steps=30, progress=False)
    np.testing.assert_allclose(larger.uncertainty, 64**2 * rec.uncertainty, rtol=1e-6)


def test_a_network_that_knows_nothing_does_not_spoil_the_refinement(views, rec):
    bare = nl.DeepNRSfM(n_points=31, generator=torch.Generator().manual_seed(0)).eval()
    bare.normalizer, bare.prior = rec.model.normalizer, rec.model.prior
    lost = nl.reconstruct(views, model=bare, refine=False)
    found = nl.reconstruct(views, model=bare)
    errors = [nl.metrics.normalized_error(r.shapes, views.points3d).mean() for r in (lost, found, rec)]
    assert errors[0] > 10 * errors[1] and errors[1] < 1.5 * errors[2]


def test_what_is_hidden_lies_behind(views, rec):
    depth = nl.cameras.nearness(views.points3d, views.cameras)

    def hand(visible):
        found = nl.reconstruct(views, visible, model=rec.model, occlusion=True)
        return found, np.sign((nl.cameras.nearness(found.shapes, found.cameras) * depth).sum())

    behind = nl.datasets.make_views(nl.datasets.make_motion(600, seed=7), seed=7, missing="self").visible
    in_front = np.ones_like(behind)  # what would be behind in the mirror image
    in_front[np.arange(600), depth.argmax(1)] = False
    right, sign = hand(behind)
    wrong, other = hand(in_front)
    assert (sign, other) == (1, -1)
    plain = nl.reconstruct(views, in_front, model=rec.model)
    turned = wrong if np.abs(wrong.shapes - plain.shapes).max() > 1e-6 else right
    plain = plain if turned is wrong else nl.reconstruct(views, behind, model=rec.model)
    np.testing.assert_allclose(turned.projections, plain.projections, atol=1e-9)
    signs = np.outer((1, 1, -1), (1, 1, -1))
    np.testing.assert_allclose(turned.uncertainty, plain.uncertainty * signs, atol=1e-12)


def test_points_hidden_by_chance_say_nothing_about_the_hand(views, rec):
    by_chance = nl.datasets.make_views(views, seed=1, missing=1)
    with pytest.warns(UserWarning, match="which mirror image is right remains open"):
        nl.reconstruct(by_chance, model=rec.model, occlusion=True)


def test_agreement_is_small_where_two_starts_lead_to_the_same(tmp_path):
    easy = nl.datasets.make_views(nl.datasets.make_motion(50, seed=4), seed=4)
    rec = nl.reconstruct(easy, steps=5, progress=False)
    assert 0 <= rec.agreement < 0.02 and nl.Reconstruction.load(rec.save(tmp_path / "r")).agreement == rec.agreement
    assert nl.reconstruct(easy, model=rec.model).agreement is None  # nothing was learned
    assert nl.reconstruct(easy, model=rec.model, adapt=True).agreement is not None
    noisy = np.random.default_rng(0).normal(size=(60, 31, 2))  # nothing to agree on
    assert nl.reconstruct(noisy, steps=5, progress=False).agreement > 0.1
