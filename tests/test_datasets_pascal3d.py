"""The CAD models of PASCAL3D+."""

import numpy as np
import pytest
from scipy.io import savemat

import nrsfm_lite as nl

NAMES = ["left", "right", "rare"]


def write(path, models, names=NAMES):
    absent = np.zeros((0, 0), np.uint8)
    savemat(path, {path.stem: [{"pnames": names} | {n: m.get(n, absent) for n in names} for m in models]})
    return path


def test_kept_are_the_points_that_most_models_have_and_the_models_that_have_them_all(tmp_path, rng):
    points = rng.normal(size=(4, 3, 3))
    models = [dict(zip(NAMES, p, strict=True)) for p in points]
    for lacking, name in ((0, "rare"), (1, "rare"), (3, "left")):  # half the models have "rare": not most
        del models[lacking][name]
    data = nl.datasets.load_pascal3d(write(tmp_path / "sofa.mat", models))
    assert data.names == ("left", "right") and data.name == "sofa"
    np.testing.assert_array_equal(data.points3d, points[:3, :2])


def test_one_model_and_one_point_are_read(tmp_path):
    data = nl.datasets.load_pascal3d(write(tmp_path / "bus.mat", [{"roof": [1.0, 2.0, 3.0]}], ["roof"]))
    np.testing.assert_array_equal(data.points3d, [[[1.0, 2.0, 3.0]]])


def test_other_files_are_refused_in_words(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.mat: no such file"):
        nl.datasets.load_pascal3d(tmp_path / "none.mat")
    for content in (b"", b"not a MATLAB file, but long enough to be taken for one" * 9):
        (tmp_path / "text.mat").write_bytes(content)
        with pytest.raises(ValueError, match=r"text\.mat: not a MATLAB file"):
            nl.datasets.load_pascal3d(tmp_path / "text.mat")
    savemat(tmp_path / "other.mat", {"W": np.eye(3)})
    with pytest.raises(ValueError, match="no structure with the field pnames"):
        nl.datasets.load_pascal3d(tmp_path / "other.mat")
    with pytest.raises(ValueError, match="more than half of its 2 models"):
        nl.datasets.load_pascal3d(write(tmp_path / "bare.mat", [{"left": [0.0, 0, 1]}, {"right": [0.0, 0, 1]}]))


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "models", "points"), [("bicycle", 5, 11), ("chair", 8, 10), ("diningtable", 5, 8)])
def test_the_real_models(name, models, points):
    data = nl.datasets.load(name)
    assert data.points3d.shape == (models, points, 3) and np.isfinite(data.points3d).all()
