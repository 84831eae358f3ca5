"""The command line: the job end to end, and one sentence with exit code 2 for every bad file."""

import subprocess
import sys

import numpy as np
import pytest

import nrsfm_lite as nl
from nrsfm_lite import reconstruction
from nrsfm_lite.cli import main
from tests.test_datasets_bvh import ARM


@pytest.fixture(scope="module")
def points(tmp_path_factory):
    file = tmp_path_factory.mktemp("cli") / "points.npz"
    nl.datasets.make_views(nl.datasets.make_motion(60, actions=["walk"])).save(file)
    return file


def test_reconstruct_then_view(points, tmp_path, capsys):
    scene, result, again = tmp_path / "scene.html", tmp_path / "result.npz", tmp_path / "again.html"
    command = ["reconstruct", str(points), "--out", str(scene), "--save", str(result), "--steps", "20", "--quiet"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    for words in (
        "mean normalised 3D error: 0.",
        "with rotations only: ",
        "frames mirrored against the others: ",
        "points may be off by ",
    ):
        assert words in printed
    assert scene.stat().st_size > 1e6 and nl.Reconstruction.load(result).model is not None
    assert main(["view", str(result), "--out", str(again)]) == 0 and again.exists()


def test_a_motion_is_photographed_first(tmp_path, capsys):
    file = tmp_path / "walk.npz"
    nl.datasets.make_motion(60, actions=["walk"]).save(file)
    assert main(["reconstruct", str(file), "--steps", "5", "--quiet"]) == 0
    assert "one random orthographic camera each" in capsys.readouterr().out


def test_points_without_a_truth_have_no_error(tmp_path, capsys):
    np.savez(tmp_path / "w.npz", W=np.random.default_rng(0).normal(size=(30, 6, 2)))
    assert main(["reconstruct", str(tmp_path / "w.npz"), "--steps", "5", "--quiet"]) == 0
    assert "error" not in capsys.readouterr().out


def files(tmp_path):
    """Bad file -> what the sentence must say."""
    (tmp_path / "empty.bvh").write_text("")
    (tmp_path / "empty.npz").write_text("")
    (tmp_path / "empty").write_text("")
    (tmp_path / "cut.bvh").write_text(ARM[: len(ARM) - 30])
    (tmp_path / "letter.txt").write_text("Dear sir or madam")
    (tmp_path / "letter.bvh").write_text("Dear sir or madam")
    (tmp_path / "letter.npz").write_text("Dear sir or madam")
    (tmp_path / "two.bvh").write_text(ARM)
    np.savez(tmp_path / "two.npz", W=np.random.default_rng(0).normal(size=(2, 6, 2)))
    W = np.random.default_rng(0).normal(size=(30, 6, 2))
    W[3, 2] = np.nan
    np.savez(tmp_path / "nan.npz", W=W)
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    return {
        "none.bvh": "no such file",
        "empty.bvh": "the file is empty",
        "empty.npz": "the file is empty",
        "empty": "the file is empty",
        "cut.bvh": "line 19",
        "letter.txt": "give --format npz or bvh",
        "letter.bvh": "line 1: not a BVH file",
        "letter.npz": "not an .npz file",
        "two.bvh": "at least 10 frames and 4 points; got 2 frames of 3 points",
        "two.npz": "at least 10 frames and 4 points; got 2 frames of 6 points",
        "nan.npz": "1 visible points that are NaN or infinite (the first in frame 3)",
        "other.npz": "it has x",
    }


def test_bad_files_get_one_sentence_and_exit_code_2(tmp_path, capsys):
    for name, words in files(tmp_path).items():
        assert main(["reconstruct", str(tmp_path / name), "--quiet"]) == 2, name
        error = capsys.readouterr().err
        assert words in error, error
        assert error.startswith("nrsfm: ") and error.count("\n") == 1 and "Traceback" not in error


def test_numbers_out_of_range_get_one_sentence(points, capsys):
    for option, value, words in [
        ("--steps", "0", "--steps=0; expected a whole number, at least 1."),
        ("--seed", "-1", "--seed=-1; expected a whole number, at least 0."),
    ]:
        assert main(["reconstruct", str(points), option, value]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1, error


def test_every_counts_frames(tmp_path, capsys):
    (tmp_path / "two.bvh").write_text(ARM)
    assert main(["reconstruct", str(tmp_path / "two.bvh"), "--every", "-2"]) == 2
    assert "--every=-2; expected a whole number, at least 1." in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["--version"],
        ["reconstruct", "none.bvh"],
        ["reconstruct", __file__],
        ["reconstruct", "none.npz", "--out", "no/scene.html"],
        ["view", "none.npz", "--out", "scene.html"],
        ["experiment", "none"],
    ],
    ids=["version", "no file", "other format", "no folder", "nothing to view", "no experiment"],
)
def test_a_slip_is_answered_without_loading_anything_heavy(words):
    heavy = "{'torch', 'scipy', 'matplotlib', 'plotly'} & sys.modules.keys()"
    code = f"import sys, nrsfm_lite.cli as cli\ntry: cli.main({words!r})\nfinally: print('loaded:', *{heavy})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip().endswith("loaded:"), done.stdout


def test_an_interruption_is_exit_code_130(points, monkeypatch, capsys):
    def stop(*arguments, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr(reconstruction, "reconstruct", stop)
    assert main(["reconstruct", str(points)]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_a_folder_that_is_not_there_is_noticed_before_training(points, tmp_path, capsys):
    assert main(["reconstruct", str(points), "--out", str(tmp_path / "no" / "scene.html")]) == 2
    assert "no such folder" in capsys.readouterr().err
    assert main(["reconstruct", str(points), "--out", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    assert main(["reconstruct", str(points), "--checkpoint", str(tmp_path / "no" / "c.pt")]) == 2
    assert "no such folder" in capsys.readouterr().err


def test_view_of_something_else(points, tmp_path, capsys):
    assert main(["view", str(points), "--out", str(tmp_path / "s.html")]) == 2
    assert "not a saved reconstruction" in capsys.readouterr().err


def test_the_installed_command_answers():
    done = subprocess.run([sys.executable, "-m", "nrsfm_lite.cli", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == f"nrsfm {nl.__version__}"
