"""Pictures of shapes: matplotlib for the page, plotly to turn them. One look for the whole book."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from . import checks, images
from .cameras import rotations
from .data import Landmarks, Reconstruction
from .metrics import align

# Readable on white and on black, and for readers who do not tell red from green.
PREDICTED, TRUE, SEEN = "#e8702a", "#7f8fa6", "#2a9d8f"
INK = "#767676"  # text and axes
_PREDICTED_NAME, _TRUE_NAME, _BAND_NAME = "reconstruction", "truth", "90 % band"
_BAND = 1.645  # standard deviations to either side that hold 90 %


def use_style() -> None:
    """Matplotlib's settings of the book: transparent, without clutter, readable on white and on black.

    >>> nl.plotting.use_style()
    """
    plt.rcParams.update(
        {
            # Matplotlib's types list the keys, and these are put together from parts.
            **{f"{part}.facecolor": "none" for part in ("figure", "axes", "savefig", "legend")},  # type: ignore[misc]
            **{key: INK for key in ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")},
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.prop_cycle": plt.cycler(color=[PREDICTED, TRUE, SEEN, "#8a63d2", "#d1495b"]),
            "legend.frameon": False,
            "figure.dpi": 110,
            "font.size": 10,
        }
    )


def show3d(
    shapes: Any,
    truth: Any = None,
    edges: Any = None,
    *,
    uncertainty: bool = False,
    max_frames: int = 60,
    up: Any = None,
    title: str | None = None,
    height: int = 520,
) -> go.Figure:
    """Shapes to turn, with a frame slider and a play button; standing upright.

    Parameters
    ----------
    shapes : Reconstruction, Landmarks with points3d, or (F, P, 3) array
    truth : Landmarks with points3d, or (F, P, 3) array, optional
        Drawn beside the prediction. Each predicted shape is moved onto its true one (`metrics.align`,
        mirror images allowed), since a reconstruction is known only up to that.
    edges : (E, 2) int, optional
        Default: those of `shapes` or `truth`.
    uncertainty : bool
        Show how far each point may be off: a bar along its most doubtful direction, in which it lies with a probability
        of 90 %. For a Reconstruction that has one.
    max_frames : int
        A longer motion is thinned out evenly, to keep pages small.
    up : (3,), optional
        The direction that points up in the picture. Default: y, except for a Reconstruction without
        truth. There up is where the cameras' images have their top (image y runs down), and if the
        cameras look from everywhere, the longest axis of the mean shape, either end up.
    title : str, optional
    height : int
        In pixels.

    Returns
    -------
    plotly Figure

    Raises
    ------
    ValueError
        If there are no 3D points or no frames, no uncertainty to show, or a value that is not finite; if `shapes`
        and `truth` differ in shape, or if an edge refers to a point that is not there.

    Examples
    --------
    >>> figure = nl.plotting.show3d(nl.datasets.make_motion(50), max_frames=10)
    >>> len(figure.frames)
    10
    """
    max_frames, height = checks.whole("max_frames", max_frames, 1), checks.whole("height", height, 1)
    points, own_edges = _points(shapes, "shapes")
    bars = _bars(shapes) if checks.truth("uncertainty", uncertainty) else None
    centred = points - points.mean(1, keepdims=True)
    if truth is not None:
        true_points, true_edges = _points(truth, "truth")
        if true_points.shape != points.shape:
            raise ValueError(f"truth has shape {true_points.shape}; expected that of shapes, {points.shape}.")
        points, true_points = align(points, true_points)
        own_edges = own_edges if len(own_edges) else true_edges
    else:
        true_points = None
        points = centred
    edges = own_edges if edges is None else checks.as_edges("edges", edges, points.shape[1])
    if up is not None:
        up = checks.as_array("up", up, float)
        if up.shape != (3,) or not 0 < np.linalg.norm(up) < np.inf:
            raise ValueError(f"up={up}; expected a direction, three numbers that are not all zero.")
    elif true_points is None and isinstance(shapes, Reconstruction):
        points = _in_one_pose(points)
        up = _guess_up(points, shapes)
    turn = _upright((0, 1, 0) if up is None else up)
    chosen = _spread(len(points), max_frames)
    layers = [] if true_points is None else [(true_points @ turn, TRUE, _TRUE_NAME)]
    layers.append((points @ turn, PREDICTED, _PREDICTED_NAME if true_points is not None else "shape"))
    ends = None
    if bars is not None:
        moved = bars @ (np.linalg.pinv(centred) @ (points - points.mean(1, keepdims=True)) @ turn)  # as the shape was
        ends = np.stack([layers[-1][0] - moved, layers[-1][0] + moved], 2)  # (F, P, 2, 3)

    def traces(f):
        bodies = [trace for S, colour, name in layers for trace in _body(S[f], edges, colour, name)]
        return bodies if ends is None else [*bodies, _bar(ends[f], PREDICTED)]

    figure = go.Figure(data=traces(chosen[0]), frames=[go.Frame(data=traces(f), name=str(f)) for f in chosen])
    reach = 1.05 * max(np.abs(S[chosen]).max() for S, _, _ in layers)
    _stage(figure, reach, [str(f) for f in chosen], title, height, legend=len(layers) > 1)
    return figure


def show2d(W: Any, edges: Any = None, *, frames: Any = None, visible: Any = None, columns: int = 6) -> Figure:
    """What the cameras saw: a row of frames in matplotlib.

    Parameters
    ----------
    W : Landmarks with points2d, or (F, P, 2) array
    edges : (E, 2) int, optional
        Default: those of the Landmarks.
    frames : sequence of int, optional
        Default: `columns` frames, evenly spread.
    visible : (F, P) bool, optional
        Default: that of the Landmarks, else everything. A hidden point, and its edges, are not drawn.
    columns : int

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        As `images.parse`; also if a frame or an edge is not there.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(50))
    >>> len(nl.plotting.show2d(views, columns=3).axes)
    3
    """
    seen = images.parse(W, visible)
    edges = seen.edges if edges is None else checks.as_edges("edges", edges, seen.n_points)
    frames = _chosen(frames, len(seen), columns)
    W = np.where(seen.visible[..., None], seen.points, np.nan)
    figure, axes = plt.subplots(1, len(frames), figsize=(1.5 * len(frames), 1.9), layout="constrained", squeeze=False)
    middle = np.nanmean(W[frames], axis=1)
    reach = 1.1 * np.nanmax(np.abs(W[frames] - middle[:, None])) or 1.0  # all points at one place
    for axis, f, (x, y) in zip(axes[0], frames, middle, strict=True):
        draw2d(axis, W[f], edges, colour=SEEN)
        axis.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach))
        axis.set_title(f"frame {f}", fontsize=9)
        axis.spines[:].set(color=TRUE, visible=True)
    return figure


def compare(rec: Reconstruction, truth: Landmarks, frames: Any = None, *, columns: int = 5) -> Figure:
    """A page-ready picture of a reconstruction: what the camera saw, and the body from two other sides.

    Parameters
    ----------
    rec : Reconstruction
    truth : Landmarks with points2d and points3d of the same frames, y up
        Points that are hidden are not drawn in the first row.
    frames : sequence of int, optional
        Default: `columns` frames, evenly spread.
    columns : int

    Returns
    -------
    matplotlib Figure of three rows, one column per frame; each prediction is moved onto its truth.

    Raises
    ------
    ValueError
        If `truth` lacks points2d or points3d, if its frames or points are not those of `rec`, or if a frame is not
        there.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(50))
    >>> rec = nl.baselines.tomasi_kanade(views)
    >>> len(nl.plotting.compare(rec, views, columns=2).axes)
    6
    """
    if not isinstance(rec, Reconstruction):
        raise ValueError(f"rec is a {type(rec).__name__}; expected a Reconstruction.")
    if not isinstance(truth, Landmarks) or truth.points2d is None or truth.points3d is None:
        raise ValueError("truth must be Landmarks with points2d and points3d; datasets.make_views makes them.")
    if truth.points3d.shape != rec.shapes.shape:
        raise ValueError(
            f"truth has points3d of shape {truth.points3d.shape}; expected that of rec, {rec.shapes.shape}."
        )
    frames = _chosen(frames, len(rec), columns)
    predicted, true = align(rec.shapes[frames], truth.points3d[frames])
    shown = images.parse(truth)
    seen = np.where(shown.visible[..., None], shown.points, np.nan)[frames]
    seen = seen - np.nanmean(seen, axis=1, keepdims=True)
    reach = 1.02 * max(np.abs(true).max(), np.nanmax(np.abs(seen)))
    rows = {
        "seen by the camera": [(seen, SEEN)],
        "in 3D, from one side": [(true[..., [0, 1]], TRUE), (predicted[..., [0, 1]], PREDICTED)],
        "and from another": [(true[..., [2, 1]], TRUE), (predicted[..., [2, 1]], PREDICTED)],
    }
    size = (1.9 * len(frames), 1.8 * len(rows))
    figure, axes = plt.subplots(len(rows), len(frames), figsize=size, layout="constrained", squeeze=False)
    for line, (title, layers) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(title, color=INK)
        for i, axis in enumerate(line):
            for points, colour in layers:
                draw2d(axis, points[i], truth.edges, colour=colour)
            axis.set(xlim=(-reach, reach), ylim=(-reach, reach))
    return figure


def draw2d(axis: Axes, points: Any, edges: Any, *, colour: str, label: str | None = None) -> None:
    """One stick figure, points (P, 2), on a matplotlib axis; NaN points, and their edges, are left out.

    Raises ValueError if the points have another shape, or if an edge refers to a point that is not there.

    >>> import matplotlib.pyplot as plt
    >>> nl.plotting.draw2d(plt.figure().subplots(), np.eye(3, 2), [(0, 1), (1, 2)], colour="k")
    """
    points = checks.as_array("points", points, float)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points has shape {points.shape}; expected (P, 2).")
    axis.plot(*_segments(points, checks.as_edges("edges", edges, len(points))).T, color=colour, lw=1.5, label=label)
    axis.plot(*points.T, ".", color=colour, ms=4)
    axis.set(aspect="equal", xticks=[], yticks=[])
    axis.spines[:].set_visible(False)


def write_html(figure: go.Figure, path: str | Path) -> Path:
    """A plotly figure as one self-contained page that opens offline; returns its path.

    >>> import tempfile
    >>> figure = nl.plotting.show3d(nl.datasets.make_motion(50), max_frames=1)
    >>> nl.plotting.write_html(figure, tempfile.mkdtemp() + "/scene.html").name
    'scene.html'
    """
    path = Path(path)
    title = figure.layout.title.text or path.stem
    page = figure.to_html(include_plotlyjs=True, full_html=True, config={"displaylogo": False, "responsive": True})
    head = (
        f'<head><title>{escape(title)}</title><meta name="viewport" content="width=device-width, initial-scale=1">'
        "<style>:root{color-scheme:light dark}body{margin:0;font-family:sans-serif}</style>"
        # Pausing an animation makes plotly reject its promise without a reason; that is no error.
        "<script>addEventListener('unhandledrejection',e=>{if(e.reason===undefined)e.preventDefault()})</script>"
    )
    path.write_text(page.replace("<head>", head, 1), encoding="utf-8")
    return path


def _spread(n_frames, at_most):
    """Indices of frames, evenly spread from the first to the last."""
    return np.linspace(0, n_frames - 1, min(n_frames, at_most)).round().astype(int)


def _chosen(frames, n_frames, columns):
    """The frames to draw: those asked for, else `columns` of them, evenly spread."""
    if frames is None:
        return _spread(n_frames, checks.whole("columns", columns, 1))
    frames = checks.as_array("frames", frames, int)
    if frames.ndim != 1 or not len(frames) or frames.min() < 0 or frames.max() >= n_frames:
        raise ValueError(f"frames={frames.tolist()}; expected a sequence of numbers from 0 to {n_frames - 1}.")
    return frames


def _points(source, argument):
    """3D points and edges of whatever was given."""
    if isinstance(source, Reconstruction):
        points, edges = source.shapes, source.edges
    elif isinstance(source, Landmarks):
        if source.points3d is None:
            raise ValueError(f"{argument} has no points3d.")
        points, edges = source.points3d, source.edges
    else:
        points, edges = checks.as_array(argument, source, float), np.zeros((0, 2), int)
    if points.ndim != 3 or points.shape[2] != 3 or not len(points):
        raise ValueError(f"{argument} has shape {points.shape}; expected (F, P, 3) with at least one frame.")
    checks.check_finite(argument, points)
    return points, edges


def _bars(rec):
    """Half of each point's 90 % band along its most doubtful direction: vectors (F, P, 3) in the world."""
    if not isinstance(rec, Reconstruction) or rec.uncertainty is None:
        raise ValueError("uncertainty=True needs a Reconstruction that has one, such as `reconstruct` makes.")
    values, vectors = np.linalg.eigh(rec.uncertainty)
    half = _BAND * np.sqrt(np.maximum(values[..., -1:], 0)) * vectors[..., -1]
    return half @ rotations(rec.cameras).swapaxes(1, 2)


def _bar(ends, colour):
    x, y, z = _segments(ends.reshape(-1, 3), np.arange(2 * len(ends)).reshape(-1, 2)).astype(np.float32).T
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line=dict(color=colour, width=2), opacity=0.5,
                        name=_BAND_NAME, hoverinfo="skip")  # fmt: skip


def _in_one_pose(points):
    """Turn every shape onto the mean shape, so that a motion does not tumble: its rotation is a gauge."""
    mean = points[len(points) // 2]
    for _ in range(5):
        aligned, _ = align(points, np.broadcast_to(mean, points.shape), scale=False, reflections=False)
        mean = aligned.mean(0)
    return aligned


def _guess_up(points, rec):
    """Up in the frame of `points` (the shapes of `rec`, turned): from the cameras, else from the shape."""
    centred = rec.shapes - rec.shapes.mean(1, keepdims=True)
    U, _, Vh = np.linalg.svd(centred.swapaxes(1, 2) @ points)
    image_up = -rec.cameras[:, None, :, 1] @ (U @ Vh)  # row vectors: where the image's top lies
    up = image_up[:, 0].mean(0)
    if np.linalg.norm(up) > 0.3:  # the mean of directions from everywhere would be near zero
        return up
    return np.linalg.svd(points.mean(0))[2][0]


def _upright(up):
    """(3, 3): right-multiplied, it turns the direction `up` into plotly's z."""
    up = np.asarray(up, float)
    z = up / np.linalg.norm(up)
    x = np.eye(3)[np.abs(z).argmin()]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], 1)


def _segments(points, edges):
    """(3E, d) polyline with gaps: both ends of each edge, then NaN."""
    gaps = np.full((len(edges), 1, points.shape[1]), np.nan)
    return np.concatenate([points[edges], gaps], 1).reshape(-1, points.shape[1])


def _body(points, edges, colour, name):
    x, y, z = points.astype(np.float32).T
    lx, ly, lz = _segments(points, edges).astype(np.float32).T
    return [
        go.Scatter3d(x=lx, y=ly, z=lz, mode="lines", line=dict(color=colour, width=5),
                     name=name, legendgroup=name, showlegend=False, hoverinfo="skip"),
        go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=dict(color=colour, size=3.5),
                     name=name, legendgroup=name),
    ]  # fmt: skip


def _stage(figure, reach, frames, title, height, legend):
    """Axes, camera, slider and play button."""
    axis = dict(range=[-reach, reach], showbackground=False, showticklabels=False, title="",
                gridcolor="#9a9a9a", gridwidth=1, zerolinecolor="#9a9a9a", nticks=5, showspikes=False)  # fmt: skip
    still = dict(mode="immediate", frame=dict(duration=0, redraw=True), transition=dict(duration=0))
    moving = dict(fromcurrent=True, frame=dict(duration=60, redraw=True), transition=dict(duration=0))
    control = dict(bgcolor="rgba(127,127,127,.15)", bordercolor="rgba(127,127,127,.4)")
    buttons = [
        dict(label="▶", method="animate", args=[None, moving]),
        dict(label="❚❚", method="animate", args=[[None], still]),
    ]
    many = len(frames) > 1
    figure.update_layout(
        title=title,
        height=height,
        margin=dict(l=0, r=0, t=40 if title else 10, b=10),
        paper_bgcolor="rgba(0,0,0,0)",
        font_color=INK,
        showlegend=legend,
        legend=dict(orientation="h", x=0.5, xanchor="center", y=1.0, bgcolor="rgba(0,0,0,0)"),
        scene=dict(
            aspectmode="cube", xaxis=axis, yaxis=axis, zaxis=axis, camera_eye=dict(x=0.8, y=-1.0, z=0.3)
        ),
        updatemenus=[dict(type="buttons", direction="left", showactive=False, buttons=buttons, x=0, y=0,
                          xanchor="left", yanchor="top", pad=dict(t=22, l=8), **control)] if many else [],
        sliders=[dict(x=0.26, len=0.72, y=0, pad=dict(t=8, b=8), tickcolor="rgba(0,0,0,0)", font_color="rgba(0,0,0,0)",
                      currentvalue=dict(prefix="frame ", font=dict(color=INK)),
                      steps=[dict(label=f, method="animate", args=[[f], still]) for f in frames], **control)]
        if many else [],
    )  # fmt: skip
