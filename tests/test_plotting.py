"""Pictures: what they hold, which way is up, and that an exported page needs nobody else."""

import re

import matplotlib
import matplotlib.figure
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


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"truth": lambda m: m[:40]}, r"truth has shape \(40, 31, 3\); expected that of shapes, \(90, 31, 3\)"),
        ({"edges": lambda m: [(0, 31)]}, "edges refers to a point outside 0 … 30"),
        ({"edges": lambda m: [(0, 0.5)]}, "edges cannot be read as an array of whole numbers"),
        ({"edges": lambda m: [0, 1, 2]}, r"expected \(E, 2\)"),
        ({"up": lambda m: (0, 0, 0)}, "expected a direction"),
        ({"up": lambda m: (0, 1)}, "expected a direction"),
        ({"max_frames": lambda m: 0}, "max_frames=0"),
        (
            {"shapes": lambda m: np.where(m.points3d > 1, np.nan, m.points3d)},
            "shapes has .* values that are not finite",
        ),
        ({"shapes": lambda m: m[:0]}, "at least one frame"),
    ],
)
def test_show3d_refuses_what_it_cannot_draw(motion, more, message):
    with pytest.raises(ValueError, match=message):
        nl.plotting.show3d(**{"shapes": motion} | {key: make(motion) for key, make in more.items()})


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


def test_a_hidden_point_with_coordinates_is_not_drawn_as_seen(motion):
    views = nl.datasets.make_views(motion)
    views.visible[:, 3] = False
    far = views.points2d.copy()
    far[:, 3] = 1000
    views.points2d = far
    rec = nl.Reconstruction(views.points3d, views.cameras)
    for figure in (nl.plotting.compare(rec, views, columns=2), nl.plotting.show2d(views, columns=2)):
        lines, dots = figure.axes[0].lines
        assert np.isnan(dots.get_xdata()).nonzero()[0].tolist() == [3]
        assert np.nanmax(lines.get_xdata()) < 100 and figure.axes[0].get_xlim()[1] < 100
    middle = np.nanmean(figure.axes[0].lines[1].get_xdata())
    np.testing.assert_allclose(np.mean(figure.axes[0].get_xlim()), middle)


@pytest.mark.parametrize(
    ("truth", "more", "message"),
    [
        (lambda v: v[:40], {}, r"truth has points3d of shape \(40, 31, 3\); expected that of rec, \(90, 31, 3\)"),
        (lambda v: nl.Landmarks(points3d=v.points3d), {}, "points2d and points3d"),
        (lambda v: nl.Landmarks(v.points2d), {}, "points2d and points3d"),
        (lambda v: v.points3d, {}, "truth must be Landmarks"),
        (lambda v: v, {"frames": [90]}, "frames=.*from 0 to 89"),
        (lambda v: v, {"frames": [-1]}, "frames="),
        (lambda v: v, {"frames": [0.5]}, "frames cannot be read"),
        (lambda v: v, {"frames": []}, "frames="),
        (lambda v: v, {"columns": 0}, "columns=0"),
    ],
)
def test_compare_refuses(motion, truth, more, message):
    views = nl.datasets.make_views(motion)
    rec = nl.Reconstruction(views.points3d, views.cameras)
    with pytest.raises(ValueError, match=message):
        nl.plotting.compare(rec, truth(views), **more)
    with pytest.raises(ValueError, match="expected a Reconstruction"):
        nl.plotting.compare(views.points3d, views)


def test_show2d_and_draw2d_refuse(motion):
    views = nl.datasets.make_views(motion)
    for more, message in [
        ({"frames": [90]}, "frames="),
        ({"edges": [(0, 40)]}, "outside"),
        ({"columns": 1.5}, "columns="),
    ]:
        with pytest.raises(ValueError, match=message):
            nl.plotting.show2d(views, **more)
    with pytest.raises(ValueError, match="no points2d; photograph them"):
        nl.plotting.show2d(motion)
    axis = matplotlib.figure.Figure().subplots()
    for points, edges, message in [(np.eye(3), [], r"points has shape \(3, 3\)"), (np.eye(3, 2), [(0, 3)], "outside")]:
        with pytest.raises(ValueError, match=message):
            nl.plotting.draw2d(axis, points, edges, colour="k")


@pytest.mark.filterwarnings("error")
def test_one_point_is_a_picture():
    nl.plotting.show2d(np.ones((2, 1, 2)))


def test_an_exported_scene_is_one_page_that_asks_nobody(motion, tmp_path):
    nl.plotting.write_html(nl.plotting.show3d(motion, title="<walk>"), tmp_path / "scene.html")
    page = (tmp_path / "scene.html").read_text()
    assert "<title>&lt;walk&gt;</title>" in page and 'name="viewport"' in page
    assert not re.findall(r"""<(?:script|link|img)[^>]+(?:src|href)=["']?(?:https?:)?//""", page)
    assert len(page) < 8e6


def test_bands_are_as_long_as_they_say_and_refused_where_there_are_none():
    views = nl.datasets.make_views(nl.datasets.make_motion(50))
    rec = nl.baselines.em_gaussian(views, progress=False)
    x, y, z = (np.asarray(getattr(nl.plotting.show3d(rec, uncertainty=True).data[-1], k)) for k in "xyz")
    ends = np.stack([x, y, z], 1)
    longest = 2 * 1.645 * np.sqrt(np.linalg.eigvalsh(rec.uncertainty[0])[:, -1])
    np.testing.assert_allclose(np.linalg.norm(ends[1::3] - ends[::3], axis=1), longest, rtol=1e-3)
    with pytest.raises(ValueError, match="uncertainty"):
        nl.plotting.show3d(nl.baselines.tomasi_kanade(views), uncertainty=True)
