"""Pictures: what they hold, which way is up, and that an exported page needs nobody else."""

import re

import matplotlib
import numpy as np
import pytest

import nrsfm_lite as nl

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def motion():
    return nl.datasets.make_motion(90, seed=0, actions=["walk"])


def markers(figure, frame=None):
    traces = figure.data if frame is None else figure.frames[frame].data
    return [np.stack([t.x, t.y, t.z], 1) for t in traces if t.mode == "markers"]


def test_show3d_has_a_slider_a_play_button_and_both_bodies(motion):
    figure = nl.plotting.show3d(motion.points3d + 0.01, truth=motion, max_frames=20)
    assert len(figure.frames) == 20 and len(figure.layout.sliders[0].steps) == 20
    assert [b.label for b in figure.layout.updatemenus[0].buttons] == ["▶", "❚❚"]
    assert {t.name for t in figure.data} == {"reconstruction", "truth"}
    assert figure.frames[-1].name == "89"
    lines = next(t for t in figure.data if t.mode == "lines")
    assert len(lines.x) == 3 * len(motion.edges)


def test_show3d_stands_upright(motion):
    (points,) = markers(nl.plotting.show3d(motion), frame=0)
    assert points[:, 2].argmax() in [motion.names.index(n) for n in ("head", "left_eye", "right_eye")]
    assert np.ptp(points[:, 2]) > 1.4


def test_a_reconstruction_stands_upright_without_a_truth(motion):
    """As photographs have it: image y runs down, the cameras stand on the ground."""
    rng = np.random.default_rng(0)
    from scipy.spatial.transform import Rotation

    around = Rotation.from_rotvec(rng.uniform(0, 6, (90, 1)) * [0, 1, 0]).as_matrix()
    cameras = around @ np.array([[1.0, 0], [0, -1], [0, 0]])
    gauge = nl.cameras.random_rotations(1, seed=5)[0]
    rec = nl.Reconstruction(motion.points3d @ gauge, gauge.T @ cameras, edges=motion.edges)
    (points,) = markers(nl.plotting.show3d(rec), frame=0)
    at = {n: points[i, 2] for i, n in enumerate(motion.names)}
    assert at["head"] > at["hip"] + 0.3 > at["left_toe"] + 0.8


def test_cameras_from_everywhere_fall_back_on_the_longest_axis(motion):
    rec = nl.Reconstruction(motion.points3d @ nl.cameras.random_rotations(1)[0], nl.cameras.random_cameras(90))
    (points,) = markers(nl.plotting.show3d(rec), frame=0)
    assert np.ptp(points[:, 2]) > 1.4


def test_one_frame_needs_no_slider(motion):
    figure = nl.plotting.show3d(motion[:1])
    assert not figure.layout.sliders and not figure.layout.updatemenus


def test_show3d_refuses(motion):
    with pytest.raises(ValueError, match="truth has no points3d"):
        nl.plotting.show3d(motion, truth=nl.Landmarks(points2d=motion.points3d[..., :2]))
    with pytest.raises(ValueError, match=r"expected \(F, P, 3\)"):
        nl.plotting.show3d(motion.points3d[..., :2])


def test_show2d_draws_what_is_visible(motion):
    views = nl.datasets.make_views(motion, missing=5)
    figure = nl.plotting.show2d(views, columns=3)
    assert len(figure.axes) == 3
    x = figure.axes[0].lines[1].get_xdata()
    np.testing.assert_array_equal(np.isnan(x), ~views.visible[0])


def test_pictures_of_few_frames_and_hidden_points(motion):
    views = nl.datasets.make_views(motion, missing=5)
    assert len(nl.plotting.show2d(views[:3]).axes) == 3
    rec = nl.Reconstruction(views.points3d, views.cameras)
    figure = nl.plotting.compare(rec, views, columns=2)
    assert np.isfinite(figure.axes[0].lines[1].get_xdata()).sum() == views.visible[0].sum()


def test_an_exported_scene_is_one_page_that_asks_nobody(motion, tmp_path):
    nl.plotting.write_html(nl.plotting.show3d(motion, title="<walk>"), tmp_path / "scene.html")
    page = (tmp_path / "scene.html").read_text()
    assert "<title>&lt;walk&gt;</title>" in page and 'name="viewport"' in page
    assert not re.findall(r"""<(?:script|link|img)[^>]+(?:src|href)=["']?(?:https?:)?//""", page)
    assert len(page) < 8e6
