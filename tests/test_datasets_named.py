"""Data by name, and where real data is looked for."""

from pathlib import Path

import numpy as np
import pytest

from nrsfm_lite import datasets
from nrsfm_lite.datasets import named


def test_generated_data_by_name():
    assert [len(datasets.load(name)) for name in ("motion-small", "motion-70")] == [600, 70]
    np.testing.assert_array_equal(datasets.load("motion-70").points3d, datasets.make_motion(70, seed=0).points3d)


def test_every_call_gives_a_copy():
    first = datasets.load("motion-70")
    first.points3d[:] = 0
    first.edges[:] = 0
    again = datasets.load("motion-70")
    assert again.points3d.any() and again.edges.any()


@pytest.mark.parametrize("name", ["x", "motion-", "motion-N", "motion-1.5", "motion--1", "", None, ("a",)])
def test_unknown_names_are_refused_with_the_known_ones(name):
    with pytest.raises(KeyError, match=r"unknown data .*; there are motion, motion-small, motion-N, martial"):
        datasets.load(name)
    with pytest.raises(ValueError, match="n_frames=0"):
        datasets.load("motion-0")


@pytest.mark.parametrize(
    "name", ["cmu_bvh/martial", "cmu_bvh/05", "classic/drink.npz", "animals/monkey.npz", "pascal3d/sofa.mat"]
)
def test_absent_data_says_what_to_do(name, monkeypatch, tmp_path):
    monkeypatch.setenv("NRSFM_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=f"set NRSFM_DATA to a folder that holds {name}"):
        datasets.load(Path(name).stem)


def test_the_folder_is_that_of_the_variable_or_the_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("NRSFM_DATA", str(tmp_path))
    assert datasets.data_folder() == tmp_path
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NRSFM_DATA", "~/sets")
    assert datasets.data_folder() == tmp_path / "sets"
    for unset in (lambda: monkeypatch.setenv("NRSFM_DATA", ""), lambda: monkeypatch.delenv("NRSFM_DATA")):
        unset()
        assert datasets.data_folder() == tmp_path / ".cache/nrsfm_lite"


def test_another_folder_holds_other_data(monkeypatch, tmp_path, rng):
    for n in (3, 5):
        (tmp_path / str(n) / "classic").mkdir(parents=True)
        np.savez(tmp_path / str(n) / "classic" / "drink.npz", S=rng.normal(size=(n, 4, 3)))
        monkeypatch.setenv("NRSFM_DATA", str(tmp_path / str(n)))
        assert len(datasets.load("drink")) == n


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["05", *named.CLASSIC, "monkey"])
def test_real_data_by_name(real_data, name, monkeypatch):
    monkeypatch.setenv("NRSFM_DATA", str(real_data))
    try:
        data = datasets.load(name)
    except FileNotFoundError as absent:
        pytest.skip(str(absent))
    assert data.points3d is not None and len(data) > 200
    assert data.n_points == (31 if name in named.CMU else data.n_points)
