"""The two things that travel between the modules: what was seen, and what was reconstructed.

`Landmarks` holds 2D points with, where it is known, the 3D truth. `Reconstruction` holds what a
method made of them. Both are plain dataclasses of NumPy arrays and are saved without pickle.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Collection
from dataclasses import KW_ONLY, dataclass, field, fields
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from . import checks

# The per-frame arrays of Landmarks: name -> (shape with F frames and P points, dtype).
_FRAME_ARRAYS = {
    "points2d": (("F", "P", 2), float),
    "visible": (("F", "P"), bool),
    "confidence": (("F", "P"), float),
    "points3d": (("F", "P", 3), float),
    "cameras": (("F", 3, 2), float),
    "translations": (("F", 2), float),
    "sequence": (("F",), int),
    "time": (("F",), float),
}

# (config, weights) -> network. Set by `model`, the only module that knows how a network is built, so that this
# one, at the bottom of the package, needs to know no network.
network_from_arrays: Callable[[dict, dict[str, np.ndarray]], Any] | None = None


def _no_edges() -> np.ndarray:
    return np.zeros((0, 2), int)


@dataclass(eq=False, repr=False)
class Landmarks:
    """2D landmarks of F frames with P points each, and the truth where it is known.

    Attributes
    ----------
    points2d : (F, P, 2) float or None
        Image coordinates; a hidden point may be NaN. None for a motion nobody has photographed yet.
    visible : (F, P) bool
        False where a point is missing. Default: everything is visible.
    confidence : (F, P) float or None
        From 0 to 1, how far to trust a visible point.
    points3d : (F, P, 3) float or None
        The true shapes. Only for evaluation and for making views.
    cameras : (F, 3, 2) float or None
        The true cameras, orthonormal columns; ``points2d = points3d @ camera + translation``.
    translations : (F, 2) float or None
        In the units of points2d.
    sequence : (F,) int
        Which motion or file a frame comes from. Default: all from one.
    time : (F,) float or None
        In seconds from the beginning of the sequence; frames may be missing.
    names : tuple of P str
    edges : (E, 2) int
        Pairs of points that a drawing connects.
    name : str

    Raises
    ------
    ValueError
        If neither points2d nor points3d is given, if a shape does not fit, or if a visible point
        is not a finite number.

    Examples
    --------
    >>> nl.Landmarks(points2d=np.zeros((5, 3, 2)), names=["left", "middle", "right"], name="three")
    Landmarks('three': 5 frames × 3 points; images, all visible)
    """

    points2d: np.ndarray | None = None
    visible: np.ndarray | None = None
    confidence: np.ndarray | None = None
    _: KW_ONLY
    points3d: np.ndarray | None = None
    cameras: np.ndarray | None = None
    translations: np.ndarray | None = None
    sequence: np.ndarray | None = None
    time: np.ndarray | None = None
    names: tuple[str, ...] = ()
    edges: np.ndarray = field(default_factory=_no_edges)
    name: str = "landmarks"

    def __post_init__(self) -> None:
        first = self.points2d if self.points2d is not None else self.points3d
        if first is None:
            raise ValueError("Landmarks needs points2d (F, P, 2) or points3d (F, P, 3); got neither.")
        if np.ndim(first) != 3:
            raise ValueError(f"points2d and points3d have three axes, (F, P, 2) and (F, P, 3); got {np.shape(first)}.")
        n_frames, n_points = np.shape(first)[:2]
        if self.visible is None:
            self.visible = np.ones((n_frames, n_points), bool)
        if self.sequence is None:
            self.sequence = np.zeros(n_frames, int)
        sizes = {"F": n_frames, "P": n_points}
        for key, (axes, dtype) in _FRAME_ARRAYS.items():
            value = getattr(self, key)
            if value is None:
                continue
            value = checks.as_array(key, value, dtype)
            checks.check_shape(key, value, tuple(a if isinstance(a, int) else sizes[a] for a in axes))
            setattr(self, key, value)
        if self.points2d is not None:
            checks.check_visible_finite("points2d", self.points2d, self.visible)
        for key in ("points3d", "time"):
            if getattr(self, key) is not None:
                checks.check_finite(key, getattr(self, key))
        self.names, self.edges = _names_and_edges(self.names, self.edges, n_points)

    def __len__(self) -> int:
        return len(self.visible)

    @property
    def n_points(self) -> int:
        """P, the number of points."""
        return self.visible.shape[1]

    def __getitem__(self, frames: Any) -> Landmarks:
        """The same landmarks with only some frames: a slice, indices or a boolean mask."""
        if isinstance(frames, (int, np.integer)):
            frames = [frames]
        chosen = {key: None if getattr(self, key) is None else getattr(self, key)[frames] for key in _FRAME_ARRAYS}
        return Landmarks(**chosen, names=self.names, edges=self.edges, name=self.name)

    def __repr__(self) -> str:
        parts = []
        if self.points2d is not None:
            parts.append(f"images, {_share(self.visible)} visible")
            parts += ["confidence"] if self.confidence is not None else []
        parts += ["3D truth"] if self.points3d is not None else []
        parts += ["true cameras"] if self.cameras is not None else []
        n_sequences = len(np.unique(self.sequence))
        parts += [f"{n_sequences} sequences"] if n_sequences > 1 else []
        return f"Landmarks({self.name!r}: {_size(self.visible)}; {', '.join(parts)})"

    def _repr_html_(self) -> str:
        """A line of text and a few frames as small pictures: of the images, or else of the shapes from the front."""
        drawn = self.points3d[..., :2] if self.points2d is None else self.points2d
        visible = np.ones_like(self.visible) if self.points2d is None else self.visible
        return _html(repr(self), drawn, visible, self.edges, "#2a9d8f")

    def split(self, test: float = 0.2) -> tuple[Landmarks, Landmarks]:
        """(train, test) by whole sequences: the last max(1, round(test · n)) sequences are the test.

        Raises ValueError with fewer than two sequences, or if nothing is left to train on.

        >>> train, test = nl.datasets.make_motion(1000).split()
        >>> len(train), len(test)
        (800, 200)
        """
        test = checks.at_least("test", test)
        ids = np.unique(self.sequence)
        n_test = max(1, round(test * len(ids)))
        if n_test >= len(ids):
            raise ValueError(f"split(test={test}) needs sequences on both sides; these landmarks have {len(ids)}.")
        unseen = np.isin(self.sequence, ids[-n_test:])
        return self[~unseen], self[unseen]

    def save(self, path: str | Path) -> Path:
        """Write an .npz that `datasets.load_npz` reads; returns its path (the ending is added if missing)."""
        arrays = {key: getattr(self, key) for key in _FRAME_ARRAYS if getattr(self, key) is not None}
        path = _npz(path)
        np.savez_compressed(path, names=np.array(self.names), edges=self.edges, name=np.array(self.name), **arrays)
        return path


@dataclass(eq=False, repr=False)
class Reconstruction:
    """What a method made of F frames: ``projections == shapes @ cameras + translations[:, None]``.

    Attributes
    ----------
    shapes : (F, P, 3)
        Centred over the points, in the units of the input.
    cameras : (F, 3, 2)
        Orthonormal columns.
    translations : (F, 2)
        The image of the centroid of all points.
    visible : (F, P) bool
        What the method was shown.
    names, edges
        As in `Landmarks`.
    uncertainty : (F, P, 3, 3) or None
        Covariance of each point about where it was put, in the frame of its camera: the image's two axes, then
        depth (the cross product of the camera's columns); in squared units of the input (chapter 10). That the whole
        shape may be mirrored in depth is not in it. None for methods that do not say.
    agreement : float or None
        Mean normalised error between the shapes from the start that was chosen and those from the start that comes
        nearest to it. Where it is small, two ways have led to the same shapes; where it is large, one of them is wrong,
        and it may be the other (chapter 10a). None where only one start was tried.
    coherence : float or None
        Mutual coherence of the last dictionary (chapter 10a); None for methods without one.
    method : str
    converged : bool
        False if an iterative method was stopped by a limit before it was done. A network is trained
        for a given number of steps and is always done.
    model : DeepNRSfM or None
        The trained network, to be used again on new frames.

    Raises
    ------
    ValueError
        If a shape does not fit.

    Examples
    --------
    >>> nl.Reconstruction(np.zeros((5, 3, 3)), nl.cameras.random_cameras(5), method="none")
    Reconstruction('none': 5 frames × 3 points; shown all points, converged)
    """

    shapes: np.ndarray
    cameras: np.ndarray
    translations: np.ndarray | None = None
    _: KW_ONLY
    visible: np.ndarray | None = None
    names: tuple[str, ...] = ()
    edges: np.ndarray = field(default_factory=_no_edges)
    uncertainty: np.ndarray | None = None
    agreement: float | None = None
    coherence: float | None = None
    method: str = ""
    converged: bool = True
    model: Any = None

    def __post_init__(self) -> None:
        self.shapes = checks.as_array("shapes", self.shapes, float)
        if self.shapes.ndim != 3 or self.shapes.shape[2] != 3:
            raise ValueError(f"shapes has shape {self.shapes.shape}; expected (F, P, 3).")
        n_frames, n_points = self.shapes.shape[:2]
        if self.translations is None:
            self.translations = np.zeros((n_frames, 2))
        if self.visible is None:
            self.visible = np.ones((n_frames, n_points), bool)
        for key, dtype, expected in [
            ("cameras", float, (n_frames, 3, 2)),
            ("translations", float, (n_frames, 2)),
            ("visible", bool, (n_frames, n_points)),
            *([("uncertainty", float, (n_frames, n_points, 3, 3))] if self.uncertainty is not None else []),
        ]:
            value = checks.as_array(key, getattr(self, key), dtype)
            checks.check_shape(key, value, expected)
            setattr(self, key, value)
        self.names, self.edges = _names_and_edges(self.names, self.edges, n_points)

    def __len__(self) -> int:
        return len(self.shapes)

    def __repr__(self) -> str:
        shown = _share(self.visible)
        parts = ["shown all points" if shown == "all" else f"shown {shown} of the points"]
        parts += ["converged" if self.converged else "stopped before it converged"]
        parts += [f"agreement {self.agreement:.3f}"] if self.agreement is not None else []
        parts += [f"coherence {self.coherence:.3f}"] if self.coherence is not None else []
        parts += ["with its network"] if self.model is not None else []
        return f"Reconstruction({self.method!r}: {_size(self.visible)}; {', '.join(parts)})"

    def _repr_html_(self) -> str:
        """A line of text and a few frames as small pictures: each shape as its camera sees it."""
        return _html(repr(self), self.shapes @ self.cameras, np.ones_like(self.visible), self.edges, "#e8702a")

    @property
    def projections(self) -> np.ndarray:
        """(F, P, 2), the shapes seen by their cameras, in the units of the input."""
        return self.shapes @ self.cameras + self.translations[:, None]

    @property
    def doubt(self) -> float | None:
        """How far points may be off in the mean, as a share of the shapes' size; None without an uncertainty.

        The square root of the trace of each point's covariance, over the root mean square distance of the points from
        their centroid. Of all scores without truth it ranks results best (chapter 10a).
        """
        if self.uncertainty is None:
            return None
        off = np.sqrt(np.trace(self.uncertainty, axis1=2, axis2=3)).mean()
        return float(off / np.sqrt(np.square(self.shapes).sum(2).mean()))

    def save(self, path: str | Path) -> Path:
        """Write everything, the network's weights included, to one .npz without pickle; returns its path."""
        arrays = {}
        if self.model is not None:
            config, weights = self.model.to_arrays()
            arrays = {"config": np.array(json.dumps(config)), **{f"model/{k}": v for k, v in weights.items()}}
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name != "model" and value is not None:
                arrays[f.name] = np.array(value)
        path = _npz(path)
        np.savez_compressed(path, **arrays)
        return path

    @classmethod
    def load(cls, path: str | Path) -> Reconstruction:
        """Read what `save` wrote; the ending .npz may be left out.

        Raises FileNotFoundError if there is no such file, ValueError if it is not a reconstruction, or if the
        network in it cannot be built.
        """
        path = find_npz(path)
        arrays = read_npz(path)
        if not {"shapes", "cameras"} <= arrays.keys():
            raise ValueError(f"{path}: not a saved reconstruction (it has {', '.join(sorted(arrays)) or 'nothing'}).")
        values: dict[str, Any] = {f.name: arrays[f.name] for f in fields(cls) if f.name in arrays}
        if "config" in arrays:
            weights = {k.removeprefix("model/"): v for k, v in arrays.items() if k.startswith("model/")}
            try:
                values["model"] = network_from_arrays(json.loads(arrays["config"].item()), weights)
            except Exception:  # a network with a part missing, or of another version, can fail in any way
                raise ValueError(f"{path}: the network in it is incomplete or of another version.") from None
        try:
            for key in {"agreement", "coherence", "method", "converged"} & values.keys():
                values[key] = values[key].item()
            return cls(**values)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def find_npz(path: str | Path) -> Path:
    """The file of that name, or else the one with the ending .npz, which `save` adds."""
    return Path(path) if Path(path).is_file() else _npz(path)


def read_npz(path: str | Path, keys: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an .npz file as a dict, never unpickling; only those named in `keys`, if given.

    Raises FileNotFoundError if there is no such file, ValueError if it is empty or broken, or if an
    array that is wanted holds objects.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: the file is empty.")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not an .npz file, or a truncated one.")
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files if keys is None or key in keys}
    except Exception as error:  # a broken archive can raise nearly anything, down to zlib and the tokenizer
        raise ValueError(f"{path}: could not be read as .npz ({error}).") from None


def _names_and_edges(names: Any, edges: Any, n_points: int) -> tuple[tuple[str, ...], np.ndarray]:
    names = () if names is None else tuple(str(n) for n in names)
    names = names or tuple(f"point_{i}" for i in range(n_points))
    if len(names) != n_points:
        raise ValueError(f"names has {len(names)} entries for {n_points} points.")
    return names, checks.as_edges("edges", edges, n_points)


def _npz(path: str | Path) -> Path:
    path = Path(path)
    return path if path.suffix == ".npz" else path.with_name(path.name + ".npz")


def _size(visible: np.ndarray) -> str:
    n_frames, n_points = visible.shape
    return f"{n_frames} frame{'s' * (n_frames != 1)} × {n_points} point{'s' * (n_points != 1)}"


def _share(visible: np.ndarray) -> str:
    return "all" if visible.all() else f"{visible.mean():.1%}"


def _html(text: str, points: np.ndarray, visible: np.ndarray, edges: np.ndarray, colour: str) -> str:
    """The text, and up to five frames of points (F, P, 2) side by side as one small SVG; y runs up.

    The colour is readable on white and on black, and the text takes the page's own.
    """
    text = f"<div>{escape(text)}</div>"
    side, most = 100, 250  # pixels of a frame; points, and edges, that are drawn of a large set
    dots = np.arange(0, points.shape[1], -(-points.shape[1] // most) or 1)
    edges = edges[:: -(-len(edges) // most) or 1]
    n_frames = min(5, len(points), max(1, 2 * most // max(1, len(dots) + len(edges))))
    chosen = np.linspace(0, len(points) - 1, n_frames).round().astype(int)
    shown = visible[chosen] & np.isfinite(points[chosen]).all(-1)
    if not shown.any():
        return text
    points = np.where(shown[..., None], points[chosen], np.nan)
    low, high = (
        np.array([f(p[s], axis=0) if s.any() else (0, 0) for p, s in zip(points, shown, strict=True)])
        for f in (np.min, np.max)
    )
    reach = (high - low).max() or 1.0
    points = side / 2 + 0.9 * side * (points - (low + high)[:, None] / 2) / reach * (1, -1)
    lines = spots = ""
    for i, (frame, seen) in enumerate(zip(points, shown, strict=True)):
        at = [f"{x + i * side:.0f} {y:.0f}" if s else "" for (x, y), s in zip(frame, seen, strict=True)]
        lines += "".join(f"M{at[a]}L{at[b]}" for a, b in edges if seen[a] and seen[b])
        spots += "".join(f"M{at[p]}h0" for p in dots if seen[p])  # a line of no length with round ends is a dot
    width = n_frames * side
    return (
        f'{text}<svg width="{width}" height="{side}" viewBox="0 0 {width} {side}" role="img" '
        f'aria-label="{n_frames} of the frames" fill="none" stroke="{colour}" stroke-linecap="round">'
        f'<path d="{lines}" stroke-width="1.5"/><path d="{spots}" stroke-width="4"/></svg>'
    )
