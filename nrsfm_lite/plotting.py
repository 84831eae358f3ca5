"""Pictures of shapes: matplotlib for the page, plotly to turn them. One look for the whole book."""

from html import escape
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import plotly.graph_objects as go

from .data import Landmarks, Reconstruction
from .images import parse
from .metrics import align

# Readable on white and on black, and for readers who do not tell red from green.
PREDICTED, TRUE, SEEN = "#e8702a", "#7f8fa6", "#2a9d8f"
INK = "#767676"  # text and axes
_PREDICTED_NAME, _TRUE_NAME = "reconstruction", "truth"


def use_style():
    """Matplotlib's settings of the book: transparent, without clutter, readable on white and on black."""
    plt.rcParams.update(
        {
            **{f"{part}.facecolor": "none" for part in ("figure", "axes", "savefig", "legend")},
            **{key: INK for key in ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")},
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.prop_cycle": plt.cycler(color=[PREDICTED, TRUE, SEEN, "#8a63d2", "#d1495b"]),
            "legend.frameon": False,
            "figure.dpi": 110,
            "font.size": 10,
        }
    )


def show3d(shapes, truth=None, edges=None, *, max_frames=60, up=None, title=None, height=520):
    """Shapes to turn, with a frame slider and a play button; standing upright.

    Parameters
    ----------
    shapes : Reconstruction, Landmarks with points3d, or (F, P, 3) array
    truth : Landmarks with points3d, or (F, P, 3) array, optional
        Drawn beside the prediction. Each predicted shape is moved onto its true one (`metrics.align`,
        mirror images allowed), since a reconstruction is known only up to that.
    edges : (E, 2) int, optional
        Default: those of `shapes` or `truth`.
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
        If there are no 3D points, or if `shapes` and `truth` differ in shape.
    """
    points, own_edges = _points(shapes, "shapes")
    if truth is not None:
        true_points, true_edges = _points(truth, "truth")
        points, true_points = align(points, true_points)
        own_edges = own_edges if len(own_edges) else true_edges
    else:
        true_points = None
        points = points - points.mean(1, keepdims=True)
    edges = own_edges if edges is None else np.asarray(edges, int).reshape(-1, 2)
    if up is None and true_points is None and isinstance(shapes, Reconstruction):
        points = _in_one_pose(points)
        up = _guess_up(points, shapes)
    turn = _upright((0, 1, 0) if up is None else up)
    chosen = _spread(len(points), max_frames)
    layers = [] if true_points is None else [(true_points @ turn, TRUE, _TRUE_NAME)]
    layers.append((points @ turn, PREDICTED, _PREDICTED_NAME if true_points is not None else "shape"))

    def traces(f):
        return [trace for S, colour, name in layers for trace in _body(S[f], edges, colour, name)]

    figure = go.Figure(data=traces(chosen[0]), frames=[go.Frame(data=traces(f), name=str(f)) for f in chosen])
    reach = 1.05 * max(np.abs(S[chosen]).max() for S, _, _ in layers)
    _stage(figure, reach, [str(f) for f in chosen], title, height, legend=len(layers) > 1)
    return figure


def show2d(W, edges=None, frames=None, *, visible=None, columns=6):
    """What the cameras saw: a row of frames in matplotlib.

    Parameters
    ----------
    W : Landmarks with points2d, or (F, P, 2) array
    edges : (E, 2) int, optional
    frames : sequence of int, optional
        Default: `columns` frames, evenly spread.
    visible : (F, P) bool, optional

    Returns
    -------
    matplotlib Figure
    """
    images = parse(W, visible)
    W = np.where(images.visible[..., None], images.points, np.nan)
    edges = np.asarray(images.edges if edges is None else edges, int).reshape(-1, 2)
    frames = _spread(len(W), columns) if frames is None else np.asarray(frames)
    figure, axes = plt.subplots(1, len(frames), figsize=(1.5 * len(frames), 1.9), layout="constrained", squeeze=False)
    middle = np.nanmean(W[frames], axis=1)
    reach = 1.1 * np.nanmax(np.abs(W[frames] - middle[:, None]))
    for axis, f, (x, y) in zip(axes[0], frames, middle, strict=True):
        draw2d(axis, W[f], edges, SEEN)
        axis.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach))
        axis.set_title(f"frame {f}", fontsize=9)
        axis.spines[:].set(color=TRUE, visible=True)
    return figure


def compare(rec, truth, frames=None, *, columns=5):
    """A page-ready picture of a reconstruction: what the camera saw, and the body from two other sides.

    Parameters
    ----------
    rec : Reconstruction
    truth : Landmarks with points2d and points3d, y up
    frames : sequence of int, optional
        Default: `columns` frames, evenly spread.

    Returns
    -------
    matplotlib Figure of three rows, one column per frame; each prediction is moved onto its truth.
    """
    frames = _spread(len(rec), columns) if frames is None else np.asarray(frames)
    predicted, true = align(rec.shapes[frames], truth.points3d[frames])
    seen = truth.points2d[frames] - np.nanmean(truth.points2d[frames], axis=1, keepdims=True)
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
                draw2d(axis, points[i], truth.edges, colour)
            axis.set(xlim=(-reach, reach), ylim=(-reach, reach))
    return figure


def draw2d(axis, points, edges, colour, label=None):
    """One stick figure, points (P, 2), on a matplotlib axis; NaN points are left out."""
    axis.plot(*_segments(points, edges).T, color=colour, lw=1.5, label=label)
    axis.plot(*points.T, ".", color=colour, ms=4)
    axis.set(aspect="equal", xticks=[], yticks=[])
    axis.spines[:].set_visible(False)


def write_html(figure, path):
    """A plotly figure as one self-contained page that opens offline."""
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


def _spread(n_frames, at_most):
    """Indices of frames, evenly spread from the first to the last."""
    return np.linspace(0, n_frames - 1, min(n_frames, at_most)).round().astype(int)


def _points(source, argument):
    """3D points and edges of whatever was given."""
    if isinstance(source, Reconstruction):
        return source.shapes, source.edges
    if isinstance(source, Landmarks):
        if source.points3d is None:
            raise ValueError(f"{argument} has no points3d.")
        return source.points3d, source.edges
    points = np.asarray(source.detach().cpu() if hasattr(source, "detach") else source, float)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"{argument} has shape {points.shape}; expected (F, P, 3).")
    return points, np.zeros((0, 2), int)


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
