"""Biovision hierarchy (.bvh) motion capture files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..checks import whole
from ..data import Landmarks
from .skeleton import forward_kinematics, kept_edges

# A 31-point body in the public BVH conversion of the CMU motion capture database: the paper's
# number of points, without the inner joints of the fingers.
CMU_BODY = (
    "hip", "abdomen", "chest", "neck", "head", "leftEye_end", "rightEye_end",
    *(side + part for side in "rl" for part in (
        "Collar", "Shldr", "ForeArm", "Hand", "Thumb2_end", "Mid2_end", "Pinky2_end")),
    *(side + part for side in "rl" for part in ("Buttock", "Thigh", "Shin", "Foot", "Foot_end")),
)  # fmt: skip


def load_bvh(path: str | Path | Sequence[str | Path], joints: Sequence[str] | None = None, every: int = 1) -> Landmarks:
    """3D joint positions of one or many .bvh files, as `Landmarks` with points3d.

    Parameters
    ----------
    path : path, list of paths, or folder
        All files must have the joints asked for. Each file is one sequence, in name order for a folder.
    joints : sequence of str, optional
        Names of the joints to keep, in this order; an end site is called ``<parent>_end``. Of joints of one name
        the second is called ``<name>_2``, the third ``<name>_3``, passing over names that are taken.
        Default: every joint and end site. ``datasets.CMU_BODY`` is a 31-point choice.
    every : int
        Keep every n-th frame of each file.

    Returns
    -------
    Landmarks with points3d (F, P, 3) in the units of the file, sequence, names and edges, and the time of each frame
    in seconds from the beginning of its file, unless a file gives no frame time above zero. y is up in most files.

    Raises
    ------
    FileNotFoundError
        If a path does not exist or a folder has no .bvh file.
    KeyError
        If a joint is not in a file.
    ValueError
        If a file is empty, broken or truncated (with file and line), if `every` is no whole number above 0, or if
        a joint is asked for twice.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp(), "arm.bvh")
    >>> hierarchy = "HIERARCHY ROOT arm { OFFSET 0 0 0 CHANNELS 1 Zrotation End Site { OFFSET 1 0 0 } }"
    >>> _ = file.write_text(hierarchy + "\\nMOTION\\nFrames: 1\\nFrame Time: .1\\n90")
    >>> data = nl.datasets.load_bvh(file)
    >>> data.names, data.points3d[0, 1].round(3) + 0
    (('arm', 'arm_end'), array([0., 1., 0.]))
    """
    every = whole("every", every, 1)
    if isinstance(joints, str):
        raise ValueError(f"joints={joints!r}; expected a sequence of names.")
    joints = None if joints is None else tuple(joints)
    if joints == ():
        raise ValueError("joints is empty; expected a sequence of names, or None for all.")
    if joints is not None and len(set(joints)) < len(joints):
        raise ValueError(f"joints has {next(j for j in joints if joints.count(j) > 1)!r} twice.")
    files = _files(path)
    points, sequence, times = [], [], []
    names = edges = None
    for i, file in enumerate(files):
        all_names, parents, positions, frame_time = read_bvh(file, every)
        wanted = tuple(all_names) if joints is None else joints
        missing = [j for j in wanted if j not in all_names]
        if missing:
            raise KeyError(f"{file}: no joint named {', '.join(missing)}; it has {', '.join(all_names)}.")
        if names is not None and wanted != names:
            raise ValueError(f"{file}: other joints than {files[0]}; choose common ones with joints=.")
        keep = range(len(all_names)) if joints is None else [all_names.index(j) for j in wanted]
        names, edges = wanted, kept_edges(parents, keep)
        points.append(positions[:, keep])
        sequence.append(np.full(len(positions), i))
        times.append(None if frame_time is None else frame_time * every * np.arange(len(positions)))
    label = Path(path).stem if isinstance(path, (str, Path)) else "bvh"
    return Landmarks(
        points3d=np.concatenate(points),
        sequence=np.concatenate(sequence),
        time=None if any(t is None for t in times) else np.concatenate(times),
        names=names,
        edges=edges,
        name=label,
    )


def read_bvh(file: str | Path, every: int = 1) -> tuple[list[str], list[int], np.ndarray, float | None]:
    """Names (J), parents (J) and positions (F, J, 3) of all joints and end sites of one file, and its frame time.

    The frame time is that of the file, in seconds, whatever `every` is; None if it is not above zero. Names are
    unique, as `load_bvh` says, and it raises as `load_bvh`.
    """
    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file.")
    lines = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    if not any(line.strip() for line in lines):
        raise ValueError(f"{file}: the file is empty.")
    names, parents, offsets, channels, at = _hierarchy(file, lines)
    motion, frame_time = _motion(file, lines, at, sum(len(c) for c in channels))
    motion = motion[::every]
    rotations = np.broadcast_to(np.eye(3), (len(motion), len(names), 3, 3)).copy()
    moved = np.broadcast_to(offsets, (len(motion), len(names), 3)).copy()
    column = 0
    for j, joint_channels in enumerate(channels):
        values = motion[:, column : column + len(joint_channels)]
        column += len(joint_channels)
        turns = [k for k, c in enumerate(joint_channels) if c.endswith("rotation")]
        for k, channel in enumerate(joint_channels):
            if channel.endswith("position"):  # takes the place of that coordinate of OFFSET
                moved[:, j, "xyz".index(channel[0])] = values[:, k]
        if turns:
            order = "".join(joint_channels[k][0].upper() for k in turns)  # capitals: intrinsic, as listed
            rotations[:, j] = Rotation.from_euler(order, values[:, turns], degrees=True).as_matrix()
    return names, parents, forward_kinematics(parents, moved, rotations), frame_time


def _files(path):
    if not isinstance(path, (str, Path)):
        if not len(path):
            raise ValueError("path is an empty list; expected at least one .bvh file.")
        return [Path(p) for p in path]
    path = Path(path)
    if not path.is_dir():
        return [path]
    files = sorted(p for p in path.iterdir() if p.suffix.lower() == ".bvh")
    if not files:
        raise FileNotFoundError(f"{path}: no .bvh file in this folder.")
    return files


def _hierarchy(file, lines):
    """Names, parents, offsets (J, 3), channel names per joint, and the line where MOTION stands."""
    tokens = [(token, n) for n, line in enumerate(lines, 1) for token in line.split()]
    labels, parents, offsets = [], [], []  # an end site has no label
    channels: list[tuple[str, ...]] = []
    stack: list[int] = []
    position = 0

    def fail(message, n=None):
        raise ValueError(f"{file}, line {n or tokens[min(position, len(tokens)) - 1][1]}: {message}")

    def take():
        nonlocal position
        if position >= len(tokens):
            fail("the file ends inside the hierarchy.")
        position += 1
        return tokens[position - 1]

    def number():
        token, n = take()
        try:
            value = float(token)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            fail(f"expected a number, found {token!r}.", n)
        return value

    if tokens[0][0].upper() != "HIERARCHY":
        fail("not a BVH file: it does not begin with HIERARCHY.", tokens[0][1])
    position = 1
    pending = None  # the joint whose opening brace comes next
    while True:
        token, n = take()
        word = token.upper()
        if word in ("ROOT", "JOINT", "END"):
            if (word == "ROOT") != (not stack):
                fail(f"{token} in the wrong place.", n)
            label, _ = take()
            labels.append(None if word == "END" else label)
            parents.append(stack[-1] if stack else -1)
            offsets.append(np.zeros(3))
            channels.append(())
            pending = len(labels) - 1
        elif word == "{":
            if pending is None:
                fail("'{' without a joint.", n)
            stack.append(pending)
            pending = None
        elif word == "}":
            if not stack:
                fail("'}' without a '{'.", n)
            stack.pop()
        elif word == "OFFSET" and stack:
            offsets[stack[-1]] = np.array([number() for _ in range(3)])
        elif word == "CHANNELS" and stack:
            count = number()
            if count != int(count) or count < 0:
                fail(f"expected a whole number of channels, found {count:g}.", n)
            channels[stack[-1]] = tuple(take()[0].lower() for _ in range(int(count)))
            unknown = [c for c in channels[stack[-1]] if not re.fullmatch("[xyz](position|rotation)", c)]
            if unknown:
                fail(f"unknown channel {unknown[0]!r}.", n)
            if len(set(channels[stack[-1]])) < len(channels[stack[-1]]):
                fail("a channel is named twice.", n)
        elif word == "MOTION" and not stack and labels:
            return _unique_names(labels, parents), parents, np.array(offsets), channels, n
        else:
            fail(f"unexpected {token!r} in the hierarchy.", n)


def _unique_names(labels, parents):
    """A name for every joint and end site; a label that stands in the file belongs to the first joint that has it."""
    taken, names = {label for label in labels if label is not None}, list(labels)
    used: dict[str, int] = {}

    def name(label):
        used[label] = number = used.get(label, 0) + 1
        if number == 1:
            return label
        while f"{label}_{number}" in taken:
            number += 1
        used[label] = number
        return f"{label}_{number}"

    for j, label in enumerate(labels):
        if label is not None:
            names[j] = name(label)
            taken.add(names[j])
    for j, label in enumerate(labels):  # end sites are called after the final names of their parents
        if label is None:
            end = f"{names[parents[j]]}_end"
            names[j] = name(end)
            taken.add(names[j])
    return names


def _motion(file, lines, at, n_channels):
    """The numbers under MOTION, which stands in line `at`, (F, n_channels), and the frame time, None if unknown."""
    rest = [(n, line) for n, line in enumerate(lines[at:], at + 1) if line.strip()]
    count = re.fullmatch(r"\s*frames:\s*(\d+)\s*", rest[0][1], re.I) if rest else None
    if not count:
        raise ValueError(f"{file}, line {at + 1}: expected 'Frames: n' after MOTION.")
    duration = re.match(r"\s*frame\s+time:\s*(\S+)", rest[1][1], re.I) if len(rest) > 1 else None
    try:
        frame_time = float(duration[1]) if duration else None
    except ValueError:
        frame_time = None
    if frame_time is None:
        raise ValueError(f"{file}, line {rest[0][0] + 1}: expected 'Frame Time: seconds'.")
    n_frames, rows = int(count[1]), rest[2:]
    if n_frames == 0:
        raise ValueError(f"{file}, line {rest[0][0]}: the file has no frames.")
    try:
        values = np.array(" ".join(line for _, line in rows).split(), float)
    except ValueError:
        values = None
    if values is None or values.size != n_frames * n_channels or not np.isfinite(values).all():
        _explain_motion(file, rows, n_frames, n_channels, last=rest[-1][0])
    return values.reshape(n_frames, n_channels), frame_time if 0 < frame_time < np.inf else None


def _explain_motion(file, rows, n_frames, n_channels, last):
    """Raise ValueError for the first line of the motion that is wrong."""
    for n, line in rows:
        for token in line.split():
            try:
                finite = np.isfinite(float(token))
            except ValueError:
                raise ValueError(f"{file}, line {n}: expected a number, found {token!r}.") from None
            if not finite:
                raise ValueError(f"{file}, line {n}: a motion value is {token}.")
        if len(line.split()) != n_channels:
            raise ValueError(
                f"{file}, line {n}: {len(line.split())} values, expected {n_channels}; the file may be truncated."
            )
    hint = "; the file may be truncated" if len(rows) < n_frames else ""
    raise ValueError(f"{file}, line {last}: {len(rows)} frames of motion, but 'Frames: {n_frames}' promised{hint}.")
