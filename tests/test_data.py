"""Landmarks and Reconstruction: their checks, their frames, their files."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite import data


@pytest.fixture
def landmarks(rng):
    return nl.Landmarks(
        points2d=rng.normal(size=(6, 4, 2)), sequence=[0, 0, 1, 1, 2, 2], names="abcd", edges=[(0, 1), (1, 2)]
    )


def test_defaults(landmarks):
    assert len(landmarks) == 6 and landmarks.n_points == 4
    assert landmarks.visible.all() and landmarks.names == ("a", "b", "c", "d")


def test_frames_by_slice_mask_and_number(landmarks):
    assert len(landmarks[1:3]) == 2
    assert len(landmarks[landmarks.sequence == 1]) == 2
    np.testing.assert_array_equal(landmarks[5].points2d[0], landmarks.points2d[5])
    assert landmarks[::2].names == landmarks.names


def test_split_is_by_whole_sequences_and_takes_the_last(landmarks):
    train, test = landmarks.split()
    assert set(train.sequence) == {0, 1} and set(test.sequence) == {2}


def test_split_of_one_sequence_is_refused(landmarks):
    with pytest.raises(ValueError, match="sequences on both sides"):
        landmarks[:2].split()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({}, "needs points2d"),
        ({"points2d": np.zeros((3, 2))}, "three axes"),
        ({"points2d": np.zeros((3, 4, 3))}, r"expected \(3, 4, 2\)"),
        ({"points2d": np.zeros((3, 4, 2)), "visible": np.ones((3, 5))}, r"expected \(3, 4\)"),
        ({"points2d": np.full((3, 4, 2), np.nan)}, "12 visible points"),
        ({"points3d": np.full((3, 4, 3), np.inf)}, "not finite"),
        ({"points2d": np.zeros((3, 4, 2)), "names": "abc"}, "3 entries for 4 points"),
        ({"points2d": np.zeros((3, 4, 2)), "edges": [(0, 4)]}, "outside"),
        ({"points2d": np.zeros((3, 4, 2)), "edges": [0, 1, 2]}, r"edges has shape \(3,\)"),
        ({"points2d": np.zeros((3, 4, 2)), "visible": np.full((3, 4), 0.5)}, "visible cannot be read"),
        ({"points2d": [[["a", "b"]]]}, "cannot be read as an array"),
    ],
)
def test_wrong_landmarks_are_refused_by_name(wrong, message):
    with pytest.raises(ValueError, match=message):
        nl.Landmarks(**wrong)


def test_a_hidden_point_may_be_nan():
    W = np.zeros((2, 4, 2))
    W[0, 1] = np.nan
    visible = np.isfinite(W).all(-1)
    assert not nl.Landmarks(points2d=W, visible=visible).visible[0, 1]


def test_landmarks_round_trip(landmarks, tmp_path):
    landmarks.save(tmp_path / "walk.npz")
    again = nl.datasets.load_npz(tmp_path / "walk.npz")
    np.testing.assert_array_equal(again.points2d, landmarks.points2d)
    np.testing.assert_array_equal(again.edges, landmarks.edges)
    assert again.names == landmarks.names and again.name == landmarks.name and again.points3d is None


def test_reconstruction_reprojects_as_promised(rng):
    S, M, t = rng.normal(size=(3, 5, 3)), nl.cameras.random_cameras(3), rng.normal(size=(3, 2))
    W = nl.Reconstruction(S, M, t).projections
    for f, p in [(0, 0), (1, 4), (2, 2)]:
        np.testing.assert_allclose(W[f, p], S[f, p] @ M[f] + t[f])


def test_reconstruction_round_trip_with_its_network(rng, tmp_path):
    net = nl.DeepNRSfM(nl.Config(5, n_dictionaries=3, first_atoms=8, last_atoms=3))
    W = rng.normal(size=(4, 5, 2))
    rec = nl.reconstruct(W, model=net)
    assert rec.save(tmp_path / "walk") == tmp_path / "walk.npz"  # the ending is added
    state = torch.get_rng_state()
    again = nl.Reconstruction.load(tmp_path / "walk")
    assert torch.equal(torch.get_rng_state(), state)
    np.testing.assert_array_equal(again.shapes, rec.shapes)
    assert (again.coherence, again.method, again.converged) == (rec.coherence, rec.method, rec.converged)
    np.testing.assert_array_equal(nl.reconstruct(W, model=again.model).shapes, rec.shapes)


def test_reconstruction_without_a_network(rng, tmp_path):
    rec = nl.Reconstruction(rng.normal(size=(3, 5, 3)), nl.cameras.random_cameras(3), names="abcde")
    rec.save(tmp_path / "r.npz")
    again = nl.Reconstruction.load(tmp_path / "r.npz")
    assert again.model is None and again.coherence is None and again.names == rec.names


def test_wrong_reconstructions_are_refused(rng, landmarks, tmp_path):
    with pytest.raises(ValueError, match="shapes has shape"):
        nl.Reconstruction(np.zeros((3, 5, 2)), np.zeros((3, 3, 2)))
    with pytest.raises(ValueError, match="cameras has shape"):
        nl.Reconstruction(np.zeros((3, 5, 3)), np.zeros((2, 3, 2)))
    with pytest.raises(ValueError, match="cameras"):
        nl.Reconstruction(np.zeros((3, 5, 3)), None)
    with pytest.raises(ValueError, match="outside 0 … 4"):
        nl.Reconstruction(np.zeros((3, 5, 3)), np.zeros((3, 3, 2)), edges=[(0, 5)])
    landmarks.save(tmp_path / "l.npz")
    with pytest.raises(ValueError, match="not a saved reconstruction"):
        nl.Reconstruction.load(tmp_path / "l.npz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        nl.Reconstruction.load(tmp_path / "none.npz")


def test_a_reconstruction_with_half_a_network_is_refused(rng, tmp_path):
    net = nl.DeepNRSfM(nl.Config(5, n_dictionaries=3, first_atoms=8, last_atoms=3))
    file = nl.reconstruct(rng.normal(size=(4, 5, 2)), model=net).save(tmp_path / "r")
    arrays = dict(np.load(file))
    del arrays["model/gamma"]
    np.savez(file, **arrays)
    with pytest.raises(ValueError, match="the network in it is incomplete"):
        nl.Reconstruction.load(file)


@pytest.mark.parametrize("part", ["normalizer/scale", "gamma", "D.0", "*"])
def test_a_network_without_a_part_is_refused_in_words(rng, tmp_path, part):
    net = nl.DeepNRSfM(nl.Config(5, n_dictionaries=3, first_atoms=8, last_atoms=3))
    file = nl.reconstruct(rng.normal(size=(4, 5, 2)), model=net).save(tmp_path / "r")
    arrays = dict(np.load(file))
    for key in [k for k in arrays if k == f"model/{part}" or (part == "*" and k.startswith("model/"))]:
        del arrays[key]
    np.savez(file, **arrays)
    with pytest.raises(ValueError, match=r"r\.npz: the network in it is incomplete or of another version"):
        nl.Reconstruction.load(file)


def test_data_knows_no_network(rng, tmp_path, monkeypatch):
    """The module is the bottom of the package: who knows how a network is built tells it so."""
    net = nl.DeepNRSfM(nl.Config(5, n_dictionaries=3, first_atoms=8, last_atoms=3))
    file = nl.reconstruct(rng.normal(size=(4, 5, 2)), model=net).save(tmp_path / "r")
    monkeypatch.setattr(data, "network_from_arrays", lambda config, weights: (config["n_points"], len(weights)))
    assert nl.Reconstruction.load(file).model == (5, len(net.to_arrays()[1]))
    monkeypatch.setattr(data, "network_from_arrays", None)
    with pytest.raises(ValueError, match="the network in it"):
        nl.Reconstruction.load(file)


def test_the_bottom_of_the_package_imports_only_checks():
    for name in ("data", "sparse_coding", "cameras", "metrics"):
        source = Path(data.__file__).with_name(f"{name}.py").read_text()
        own = set(re.findall(r"from \.(\w+) import", source)) | set(re.findall(r"from \. import (.+)", source))
        assert own <= {"checks"}, name


def test_broken_fields_of_a_file_are_refused_with_its_name(rng, tmp_path):
    file = nl.Reconstruction(rng.normal(size=(3, 5, 3)), nl.cameras.random_cameras(3)).save(tmp_path / "r")
    arrays = dict(np.load(file))
    for key, wrong in [("coherence", np.zeros(2)), ("translations", np.zeros((2, 2)))]:
        np.savez(file, **arrays | {key: wrong})
        with pytest.raises(ValueError, match=r"r\.npz"):
            nl.Reconstruction.load(file)


def test_the_ending_may_be_left_out_of_every_npz(landmarks, rng, tmp_path):
    landmarks.save(tmp_path / "walk")
    assert nl.datasets.load_npz(tmp_path / "walk").name == landmarks.name
    np.savez(tmp_path / "classic.npz", S=rng.normal(size=(3, 5, 3)))
    assert nl.datasets.load_classic(tmp_path / "classic").name == "classic"
    with pytest.raises(FileNotFoundError, match=r"none\.npz: no such file"):
        nl.datasets.load_npz(tmp_path / "none")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"edges": [(0.9, 1)]}, "edges cannot be read as an array of whole numbers"),
        ({"sequence": [0, 0.5, 1]}, "sequence cannot be read as an array of whole numbers"),
        ({"sequence": [0, np.nan, 1]}, "sequence cannot be read as an array of whole numbers"),
        ({"time": [0, 1, np.inf]}, r"time has 1 values that are not finite numbers \(the first in frame 2\)"),
        ({"time": [0, 1]}, r"time has shape \(2,\); expected \(3,\)"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_numbers_are_not_cut_to_whole_ones(wrong, message):
    with pytest.raises(ValueError, match=message):
        nl.Landmarks(points2d=np.zeros((3, 4, 2)), **wrong)
    assert nl.Landmarks(points2d=np.zeros((3, 4, 2)), edges=[(0.0, 1.0)]).edges.tolist() == [[0, 1]]


def test_split_takes_a_share(landmarks):
    with pytest.raises(ValueError, match="test=nan"):
        landmarks.split(np.nan)


def test_time_travels_with_the_frames(landmarks, tmp_path):
    timed = nl.Landmarks(points2d=landmarks.points2d, time=[0, 0.1, 0.5, 0.6, 0.7, 2])
    assert timed[[1, 5]].time.tolist() == [0.1, 2] and landmarks[:2].time is None
    timed.save(tmp_path / "timed")
    assert nl.datasets.load_npz(tmp_path / "timed").time.tolist() == timed.time.tolist()


def test_what_landmarks_and_reconstructions_say_of_themselves(landmarks, rng):
    assert repr(landmarks) == "Landmarks('landmarks': 6 frames × 4 points; images, all visible, 3 sequences)"
    visible = np.ones((6, 4), bool)
    visible[0, 0] = False
    views = nl.Landmarks(landmarks.points2d, visible, confidence=np.ones((6, 4)), points3d=np.zeros((6, 4, 3)))
    assert repr(views[:2]) == "Landmarks('landmarks': 2 frames × 4 points; images, 87.5% visible, confidence, 3D truth)"
    rec = nl.Reconstruction(
        rng.normal(size=(1, 4, 3)),
        nl.cameras.random_cameras(1),
        method="bmm",
        coherence=0.25,
        agreement=0.5,
        converged=False,
    )
    assert repr(rec) == (
        "Reconstruction('bmm': 1 frame × 4 points; shown all points, stopped before it converged, agreement 0.500, "
        "coherence 0.250)"
    )


def test_doubt_is_a_share_of_the_size(rng):
    S, M = rng.normal(size=(5, 4, 3)), nl.cameras.random_cameras(5)
    each = np.broadcast_to(np.eye(3) / 3, (5, 4, 3, 3))  # every point may be off by one
    rec = nl.Reconstruction(S, M, uncertainty=each)
    assert np.isclose(rec.doubt, 1 / np.sqrt((S**2).sum(2).mean()))
    assert np.isclose(nl.Reconstruction(7 * S, M, uncertainty=49 * each).doubt, rec.doubt)
    assert nl.Reconstruction(S, M).doubt is None


def test_small_pictures_of_landmarks_and_reconstructions(rng):
    motion = nl.datasets.make_motion(60)
    views = nl.datasets.make_views(motion, missing=0.2)
    rec = nl.Reconstruction(views.points3d, views.cameras, edges=views.edges)
    many = nl.Landmarks(points2d=rng.normal(size=(9, 3000, 2)), edges=rng.integers(0, 3000, (4000, 2)))
    for source in (motion, views, rec, many):
        page = source._repr_html_()
        ElementTree.fromstring(f"<p>{page}</p>")  # well formed
        assert len(page) < 10_000 and page.count("<path") == 2 and "M" in page
        assert not re.search(r"nan|inf|href|src|script", page)
    assert views._repr_html_().count("h0") == views.visible[[0, 15, 30, 44, 59]].sum(), "a dot for each visible point"
    named = nl.Landmarks(points2d=np.zeros((1, 1, 2)), name="<script>")._repr_html_()
    assert "<script>" not in named and "&lt;script&gt;" in named


def test_pictures_of_nothing_are_words(landmarks):
    for empty in (landmarks[:0], nl.Landmarks(np.full((2, 3, 2), np.nan), np.zeros((2, 3), bool))):
        assert "<svg" not in empty._repr_html_() and "points" in empty._repr_html_()


def test_landmarks_compare_as_objects(landmarks):
    assert landmarks == landmarks and landmarks != landmarks[:]
