"""Generated motion, views of it, and a user's own files."""

import contextlib

import numpy as np
import pytest

import nrsfm_lite as nl
from nrsfm_lite import datasets
from nrsfm_lite.datasets import views as views_module


@pytest.fixture(scope="module")
def motion():
    return datasets.make_motion(400, seed=1)


def test_motion_is_a_body_of_31_points(motion):
    assert motion.points3d.shape == (400, 31, 3) and len(motion.edges) == 30
    assert len(datasets.ACTIONS) >= 8 and set(motion.sequence) == {0, 1}


def test_bones_keep_their_lengths_within_a_subject_and_differ_between(motion):
    bones = motion.points3d[:, motion.edges[:, 1]] - motion.points3d[:, motion.edges[:, 0]]
    lengths = np.linalg.norm(bones, axis=2)
    first, second = lengths[motion.sequence == 0], lengths[motion.sequence == 1]
    np.testing.assert_allclose(first.std(0), 0, atol=1e-12)
    assert np.abs(first[0] / second[0] - 1).max() > 0.02


@pytest.mark.parametrize("action", datasets.ACTIONS)
def test_every_action_looks_like_a_person(action):
    data = datasets.make_motion(200, seed=0, actions=[action])
    S, at = data.points3d, {name: i for i, name in enumerate(data.names)}
    assert S[..., 1].min() >= -1e-9, "nothing goes through the floor"
    assert np.linalg.norm(np.diff(S, axis=0), axis=2).max() < 0.6, "nothing jumps more than 0.6 m in 1/30 s"
    # A knee is a hinge: it folds the shin backwards, about the axis that points to the body's left.
    left = S[:, at["left_thigh"]] - S[:, at["right_thigh"]]
    for side in ("left_", "right_"):
        thigh = S[:, at[side + "knee"]] - S[:, at[side + "thigh"]]
        shin = S[:, at[side + "ankle"]] - S[:, at[side + "knee"]]
        sine = np.cross(thigh, shin) / (np.linalg.norm(thigh, axis=1) * np.linalg.norm(shin, axis=1))[:, None]
        folded = (sine * left).sum(1) / np.linalg.norm(left, axis=1)
        assert folded.mean() > 0.05, "the knee bends the wrong way"
    assert (S[:, at["head"], 1] > S[:, at["left_ankle"], 1] + 0.2).mean() > 0.9


def test_left_and_right_are_mirror_images_in_the_rest_pose():
    from nrsfm_lite.datasets import motion

    lefts = [i for i, n in enumerate(motion.NAMES) if n.startswith("left_")]
    for i in lefts:
        other = motion._MIRROR[i]
        assert motion.NAMES[other] == motion.NAMES[i].replace("left_", "right_")
        np.testing.assert_allclose(motion._OFFSETS[other], motion._OFFSETS[i] * (-1, 1, 1))
        np.testing.assert_allclose(motion._REST[other], motion._REST[i] * (1, -1, -1))


def test_motion_is_repeatable_and_seeds_differ(motion):
    np.testing.assert_array_equal(datasets.make_motion(400, seed=1).points3d, motion.points3d)
    assert not np.array_equal(datasets.make_motion(400, seed=2).points3d, motion.points3d)


def rank99(S):
    """How many principal components hold 99 % of the variance, each shape turned onto the mean one."""
    mean = S[0]
    for _ in range(5):
        A, _ = nl.metrics.align(S, np.broadcast_to(mean, S.shape), scale=False, reflections=False)
        mean = A.mean(0)
    energy = np.linalg.svd((A - mean).reshape(len(A), -1), compute_uv=False) ** 2
    return int(np.searchsorted(np.cumsum(energy) / energy.sum(), 0.99) + 1)


def rigid_error(data):
    views = datasets.make_views(data, seed=0)
    return nl.metrics.normalized_error(nl.baselines.tomasi_kanade(views).shapes, data.points3d).mean()


@pytest.mark.realdata
def test_generated_motion_is_no_easier_than_motion_capture(real_data):
    """At least 80 % of the rank and of the rigid error of the CMU martial-arts files."""
    folder = real_data / "cmu_bvh" / "martial"
    if not folder.exists():
        pytest.skip("the CMU motions are not in NRSFM_DATA")
    real = datasets.load_bvh(folder, joints=datasets.CMU_BODY, every=4)
    made = datasets.make_motion(4000, seed=0)
    assert rank99(made.points3d) >= 0.8 * rank99(real.points3d)
    assert rigid_error(made) >= 0.8 * rigid_error(real)


def test_motion_refuses(motion):
    for n_frames in (0, 10.5, "10", np.nan):
        with pytest.raises(ValueError, match="n_frames="):
            datasets.make_motion(n_frames)
    with pytest.raises(ValueError, match=r"seed=0\.5"):
        datasets.make_motion(10, seed=0.5)
    with pytest.raises(ValueError, match="expected a sequence"):
        datasets.make_motion(10, actions="walk")
    with pytest.raises(KeyError, match="unknown action 'swim'"):
        datasets.make_motion(10, actions=["walk", "swim"])


def test_time_runs_at_thirty_frames_per_second_in_each_sequence(motion):
    for i in (0, 1):
        np.testing.assert_allclose(motion.time[motion.sequence == i], np.arange(200) / 30)
    assert datasets.make_views(motion).time.tolist() == motion.time.tolist()


def test_seeds_may_be_numpys(motion):
    np.testing.assert_array_equal(datasets.make_motion(np.int64(400), seed=np.uint8(1)).points3d, motion.points3d)
    views = datasets.make_views(motion, seed=np.int32(4))
    np.testing.assert_array_equal(views.points2d, datasets.make_views(motion, seed=4).points2d)


def test_views_are_projections_of_the_truth(motion):
    views = datasets.make_views(motion, seed=4)
    np.testing.assert_allclose(nl.cameras.project(views.points3d, views.cameras, views.translations), views.points2d)
    np.testing.assert_allclose(views.points2d.mean(1), 0, atol=1e-12)
    np.testing.assert_array_equal(views.points2d, datasets.make_views(motion, seed=4).points2d)
    assert motion.points2d is None, "the motion itself is untouched"


def test_weak_perspective_views_have_scale_and_translation(motion):
    views = datasets.make_views(motion, projection="weak_perspective", scale_range=(1, 3), translation_range=2.0)
    np.testing.assert_allclose(nl.cameras.project(views.points3d, views.cameras, views.translations), views.points2d)
    S = motion.points3d - motion.points3d.mean(1, keepdims=True)
    scale = np.linalg.norm(views.points3d, axis=(1, 2)) / np.linalg.norm(S, axis=(1, 2))
    assert scale.min() < 1.1 and scale.max() > 2.9 and np.ptp(views.translations) > 1


def test_noise_has_the_ratio_asked_for_and_leaves_the_cameras(motion):
    clean, noisy = datasets.make_views(motion), datasets.make_views(motion, noise=0.2)
    np.testing.assert_array_equal(clean.cameras, noisy.cameras)
    ratio = np.linalg.norm(noisy.points2d - clean.points2d, axis=(1, 2)) / np.linalg.norm(clean.points2d, axis=(1, 2))
    np.testing.assert_allclose(ratio, 0.2)


def test_missing_by_number_and_by_share(motion):
    few = datasets.make_views(motion, missing=7)
    hidden = (~few.visible).sum(1)
    assert set(hidden) == set(range(1, 8)), "an int m hides 1 … m"
    assert np.isnan(few.points2d[~few.visible]).all()
    assert set((~datasets.make_views(motion, missing=0.3).visible).sum(1)) == {round(0.3 * 31)}


def test_a_point_behind_a_rod_is_hidden_and_one_beside_or_before_it_is_not():
    rod = [(-1, 0, 0), (1, 0, 0)]
    points = [(0, 0, -0.8), (0, 0, 0.8), (0, 0.5, -0.8), (0.99, 0, -0.01)]  # behind, before, beside, too close
    S = np.array([rod + points], float)
    data = nl.Landmarks(points3d=S - S.mean(1, keepdims=True), edges=[(0, 1)])
    front = np.eye(3)[None, :, :2]  # x right, y up: the viewer is at positive z
    size = np.ptp(S, axis=1).max()
    visible = views_module._in_sight(data.points3d, front, data.edges, 0.05 * size)
    assert visible[0].tolist() == [True, True, False, True, True, True]
    behind = views_module._in_sight(data.points3d, front * (-1, 1), data.edges, 0.05 * size)
    assert behind[0].tolist() == [True, True, True, False, True, True]


def test_a_body_hides_a_part_of_itself(motion):
    views = datasets.make_views(motion, missing="self")
    share = 1 - views.visible.mean(0)
    assert 0.1 < share.mean() < 0.4 and views.visible.sum(1).min() >= 5
    trunk, toe = motion.names.index("abdomen"), motion.names.index("left_toe")
    assert share[trunk] > 2 * share[toe]
    with pytest.raises(ValueError, match="landmarks with edges"):
        datasets.make_views(nl.Landmarks(points3d=motion.points3d), missing="self")


def test_perspective_is_a_pinhole_and_far_away_orthographic(motion):
    far, near = (datasets.make_views(motion, projection="perspective", distance=d) for d in (1e6, 2.0))
    np.testing.assert_allclose(far.points2d, far.points3d @ far.cameras, atol=1e-4)
    third = np.cross(near.cameras[:, :, 0], near.cameras[:, :, 1])
    centre = third * 2.0 * np.ptp(near.points3d, axis=1).max()  # (F, 3)
    ray = near.points3d - centre[:, None]
    image = near.cameras @ near.points2d.swapaxes(1, 2)  # the image lies in the plane through the centroid
    to_image = image.swapaxes(1, 2) - centre[:, None]
    np.testing.assert_allclose(np.cross(ray, to_image), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"projection": "fisheye"}, "projection='fisheye'"),
        ({"scale_range": (1, 2)}, "no meaning for orthographic"),
        ({"projection": "weak_perspective", "scale_range": (2, 1)}, "0 < low <= high"),
        ({"noise": -1}, "noise=-1"),
        ({"projection": "perspective", "distance": 1.0}, "distance=1.0"),
        ({"missing": 31}, "at most 30 of 31"),
        ({"missing": -1}, "at least 0"),
        ({"translation_range": -1}, "translation_range=-1"),
        ({"noise": np.nan}, "noise=nan"),
        ({"missing": "many"}, "missing='many'"),
        ({"missing": np.nan}, "missing=nan"),
        ({"seed": 1.5}, "seed=1.5"),
        ({"translation_range": np.inf}, "translation_range=inf"),
        ({"translation_range": (1, 2)}, r"translation_range=\(1, 2\)"),
        ({"noise": "some"}, "noise='some'"),
        ({"projection": "weak_perspective", "scale_range": 2}, "scale_range=2"),
        ({"projection": "weak_perspective", "scale_range": (1, np.inf)}, "0 < low <= high"),
        ({"projection": "weak_perspective", "scale_range": (1, 2, 3)}, "expected a pair"),
    ],
)
def test_views_refuse(motion, more, message):
    with pytest.raises(ValueError, match=message):
        datasets.make_views(motion, **more)


def test_views_need_3d(rng):
    with pytest.raises(ValueError, match="needs Landmarks with points3d"):
        datasets.make_views(nl.Landmarks(points2d=rng.normal(size=(3, 4, 2))))
    with pytest.raises(ValueError, match="at least one frame"):
        datasets.make_views(nl.Landmarks(points3d=np.zeros((0, 4, 3))))


def test_npz_of_a_user(rng, tmp_path):
    W = rng.normal(size=(3, 4, 2))
    np.savez(tmp_path / "mine.npz", W=W, other=np.array([{"not": "read"}], dtype=object))
    data = datasets.load_npz(tmp_path / "mine.npz")
    np.testing.assert_array_equal(data.points2d, W)
    assert data.name == "mine" and data.names[0] == "point_0"
    np.savez(tmp_path / "shape.npz", S=rng.normal(size=(3, 4, 3)))
    assert datasets.load_npz(tmp_path / "shape.npz").points3d.shape == (3, 4, 3)


def test_npz_with_any_bytes_broken_is_refused_in_words(rng, tmp_path):
    file = tmp_path / "f.npz"
    nl.Landmarks(points2d=rng.normal(size=(30, 40, 2))).save(file)
    whole = bytearray(file.read_bytes())
    for position in rng.integers(0, len(whole), 300):
        broken = whole.copy()
        broken[position] ^= 0xFF
        file.write_bytes(broken)
        with contextlib.suppress(ValueError, KeyError):  # anything else fails the test
            datasets.load_npz(file)


def test_npz_refuses(rng, tmp_path):
    file = tmp_path / "f.npz"
    with pytest.raises(FileNotFoundError, match="no such file"):
        datasets.load_npz(file)
    file.write_bytes(b"")
    with pytest.raises(ValueError, match="the file is empty"):
        datasets.load_npz(file)
    file.write_text("hello")
    with pytest.raises(ValueError, match=r"not an \.npz file"):
        datasets.load_npz(file)
    np.savez(file, points2d=rng.normal(size=(30, 40, 2)))
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"truncated|could not be read"):
        datasets.load_npz(file)
    np.savez(file, x=np.zeros(3))
    with pytest.raises(KeyError, match="it has x"):
        datasets.load_npz(file)
    np.savez(file, points2d=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="could not be read"):
        datasets.load_npz(file)
    np.savez(file, points2d=np.full((3, 4, 2), np.nan))
    with pytest.raises(ValueError, match=r"f\.npz: points2d has 12 visible points"):
        datasets.load_npz(file)


def test_classic_sequences_come_with_their_world_or_in_the_camera_frame(tmp_path, rng):
    S_world, R = rng.normal(size=(5, 7, 3)), nl.cameras.random_rotations(5)
    S = S_world @ R.swapaxes(1, 2)
    np.savez(tmp_path / "walk.npz", S=S, S_world=S_world, R=R)
    data = nl.datasets.load_classic(tmp_path / "walk.npz")
    np.testing.assert_allclose(data.points3d @ data.cameras, data.points2d, atol=1e-12)
    np.testing.assert_allclose(nl.cameras.camera_frame(data.points3d, data.cameras), S - S.mean(1, keepdims=True))
    assert data.name == "walk" and len(np.unique(data.sequence)) == 1
    np.savez(tmp_path / "bare.npz", S=S)
    bare = nl.datasets.load_classic(tmp_path / "bare.npz")
    np.testing.assert_allclose(bare.points3d @ bare.cameras, bare.points2d)
    np.savez(tmp_path / "wrong.npz", S=S, S_world=S_world, R=R[::-1])
    with pytest.raises(ValueError, match="S is not S_world turned by R"):
        nl.datasets.load_classic(tmp_path / "wrong.npz")
    np.savez(tmp_path / "short.npz", S=S, S_world=S_world[:3], R=R)
    with pytest.raises(ValueError, match="do not fit together"):
        nl.datasets.load_classic(tmp_path / "short.npz")
    np.savez(tmp_path / "none.npz", W=S)
    with pytest.raises(KeyError, match="needs an array S"):
        nl.datasets.load_classic(tmp_path / "none.npz")
