"""Generated motion: an articulated body of 31 points that walks, jumps, kicks and dances.

The body stands on a floor, y is up, it faces +z and its left is +x; units are metres. An action is
a cycle of key poses. Every passage through the cycle draws new poses around the keys, so no two
steps are alike, and each sequence has a subject of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from ..checks import whole
from ..data import Landmarks
from .skeleton import forward_kinematics, kept_edges

# name: (parent, offset in the parent's frame). The arms are stretched out; a left side is mirrored to the right.
_TRUNK = {
    "hip": (None, (0, 0, 0)),
    "abdomen": ("hip", (0, 0.11, -0.01)),
    "chest": ("abdomen", (0, 0.15, 0)),
    "neck": ("chest", (0, 0.26, -0.01)),
    "head": ("neck", (0, 0.09, 0.02)),
}
_SIDE = {
    "eye": ("head", (0.035, 0.09, 0.08)),
    "collar": ("chest", (0.04, 0.19, 0)),
    "shoulder": ("collar", (0.14, 0.01, 0)),
    "elbow": ("shoulder", (0.28, 0, 0)),
    "wrist": ("elbow", (0.25, 0, 0)),
    "thumb": ("wrist", (0.08, 0, 0.06)),
    "middle_finger": ("wrist", (0.18, 0, 0.01)),
    "little_finger": ("wrist", (0.13, 0, -0.05)),
    "buttock": ("hip", (0.04, -0.02, 0)),
    "thigh": ("buttock", (0.07, -0.06, 0)),
    "knee": ("thigh", (0, -0.42, 0.01)),
    "ankle": ("knee", (0, -0.41, -0.02)),
    "toe": ("ankle", (0.02, -0.07, 0.19)),
}


def _skeleton():
    bones: dict[str, tuple[str, tuple[float, float, float]]] = dict(_TRUNK)
    for side, sign in (("left_", 1), ("right_", -1)):
        for joint, (parent, (x, y, z)) in _SIDE.items():
            bones[side + joint] = (side + parent if parent in _SIDE else parent, (sign * x, y, z))
    names = tuple(bones)
    parents = [-1 if p is None else names.index(p) for p, _ in bones.values()]
    return names, parents, np.array([offset for _, offset in bones.values()], float)


NAMES, _PARENTS, _OFFSETS = _skeleton()
_OTHER_SIDE = {"left": "right", "right": "left"}
_MIRROR = [NAMES.index("_".join([_OTHER_SIDE.get(head, head), *rest])) for head, *rest in (n.split("_") for n in NAMES)]

# Angles in degrees: (bend about x, turn about y, tilt about z), tilt first. A bend below zero lifts a
# thigh or an upper arm forward; a knee bends above zero; an elbow turns below zero; a tilt above zero
# takes a left limb away from the body. The right side mirrors turn and tilt.
_STANDING = {"shoulder": (0, 0, -78), "elbow": (0, -15, 0), "thigh": (-2, 0, 3), "knee": (4, 0, 0)}
# How far a pose strays from its key, standard deviation in degrees.
_STRAY = {
    "abdomen": (4, 5, 4), "chest": (4, 6, 4), "neck": (5, 8, 4), "head": (4, 5, 3), "collar": (2, 3, 3),
    "shoulder": (13, 12, 9), "elbow": (8, 13, 2), "wrist": (6, 5, 9),
    "thigh": (8, 6, 4), "knee": (8, 0, 0), "ankle": (6, 3, 2),
}  # fmt: skip


def _pose(lift=0.0, **angles):
    """Angles (J, 3) and the height of the jump; a name without a side means both sides."""
    pose = np.zeros((len(NAMES), 3))
    for joint, angle in [*_STANDING.items(), *angles.items()]:
        for i, name in enumerate(NAMES):
            if name in (joint, "left_" + joint, "right_" + joint):
                mirror = (1, -1, -1) if name.startswith("right_") else (1, 1, 1)
                pose[i] = np.multiply(angle, mirror)
    return pose, lift


def _mirrored(pose):
    """The same pose with left and right exchanged."""
    angles, lift = pose
    return angles[_MIRROR] * (1, -1, -1), lift


def _both_sides(*poses):
    return [*poses, *map(_mirrored, poses)]


_REST = _pose()[0]
_VIGOUR = (0.48, 0.72)  # how much of a key pose a subject reaches for

# action: (seconds per key pose, walking speed in m/s, key poses)
_GUARD = {"shoulder": (-45, 15, -70), "elbow": (0, -115, 0), "thigh": (-18, 10, 12), "knee": (28, 0, 0)}
_ACTIONS = {
    "walk": (0.28, 1.2, _both_sides(
        _pose(left_thigh=(-28, 0, 2), left_knee=(6, 0, 0), right_thigh=(18, 0, 2), right_knee=(14, 0, 0),
              right_ankle=(18, 0, 0), left_shoulder=(24, 0, -78), right_shoulder=(-26, 0, -78),
              elbow=(0, -22, 0), chest=(2, 8, 0), abdomen=(2, -6, 0)),
        _pose(left_thigh=(-4, 0, 2), left_knee=(6, 0, 0), right_thigh=(-12, 0, 2), right_knee=(58, 0, 0),
              elbow=(0, -25, 0), abdomen=(2, 0, 3)))),
    "run": (0.18, 3.0, _both_sides(
        _pose(left_thigh=(-58, 0, 2), left_knee=(55, 0, 0), right_thigh=(26, 0, 2), right_knee=(30, 0, 0),
              right_ankle=(28, 0, 0), left_shoulder=(45, 0, -74), right_shoulder=(-48, 0, -74),
              elbow=(0, -95, 0), abdomen=(10, -10, 0), chest=(6, 14, 0), lift=0.08),
        _pose(left_thigh=(-22, 0, 2), left_knee=(22, 0, 0), right_thigh=(-8, 0, 2), right_knee=(112, 0, 0),
              elbow=(0, -95, 0), abdomen=(12, 0, 0), chest=(6, 0, 0)))),
    "jump": (0.28, 0.0, [
        _pose(),
        _pose(thigh=(-88, 0, 8), knee=(104, 0, 0), ankle=(-24, 0, 0), abdomen=(26, 0, 0), chest=(18, 0, 0),
              shoulder=(48, 0, -74)),
        _pose(thigh=(6, 0, 4), knee=(4, 0, 0), ankle=(42, 0, 0), shoulder=(-165, 0, -70), elbow=(0, -8, 0),
              lift=0.12),
        _pose(thigh=(-42, 0, 14), knee=(64, 0, 0), ankle=(30, 0, 0), shoulder=(-140, 0, -50), lift=0.5),
        _pose(thigh=(-62, 0, 8), knee=(76, 0, 0), ankle=(-16, 0, 0), abdomen=(20, 0, 0),
              shoulder=(-70, 0, -62))]),
    "squat": (0.6, 0.0, [
        _pose(),
        _pose(thigh=(-112, 18, 14), knee=(128, 0, 0), ankle=(-20, 0, 0), abdomen=(24, 0, 0), chest=(12, 0, 0),
              shoulder=(-88, 0, -80), elbow=(0, -6, 0))]),
    "wave": (0.3, 0.0, [
        _pose(right_shoulder=(-20, 0, 25), right_elbow=(0, -75, 0), right_wrist=(0, 0, 25), abdomen=(0, 0, -5)),
        _pose(right_shoulder=(-10, 0, 40), right_elbow=(0, -30, 0), right_wrist=(0, 0, -25), head=(0, 0, 8)),
        _pose(right_shoulder=(-30, 0, 30), right_elbow=(0, -95, 0), left_thigh=(0, 0, 10), abdomen=(0, 0, 6))]),
    "dance": (0.36, 0.2, _both_sides(
        _pose(hip=(0, 0, 10), abdomen=(0, 14, -14), chest=(0, 18, -8), left_shoulder=(-40, 0, 60),
              left_elbow=(0, -50, 0), right_shoulder=(-10, 0, -40), right_elbow=(0, -90, 0),
              left_thigh=(-24, 20, 16), left_knee=(48, 0, 0)),
        _pose(abdomen=(14, -10, 0), shoulder=(-80, 40, -30), elbow=(0, -70, 0), thigh=(-38, 0, 16),
              knee=(58, 0, 0), head=(10, 20, 0)),
        _pose(hip=(0, 0, -10), abdomen=(-8, -20, 14), shoulder=(-20, 0, 20), elbow=(0, -25, 0),
              right_thigh=(-70, 25, 24), right_knee=(95, 0, 0), head=(-8, -16, 6)))),
    "kick": (0.25, 0.0, _both_sides(
        _pose(**_GUARD),
        _pose(**_GUARD | {"right_thigh": (-104, 10, 14), "right_knee": (112, 0, 0), "abdomen": (-6, 0, 0)}),
        _pose(**_GUARD | {"right_thigh": (-100, 0, 26), "right_knee": (8, 0, 0), "abdomen": (-18, 12, 0),
                          "chest": (-8, 14, 0), "left_shoulder": (30, 0, -40)}),
        _pose(**_GUARD | {"right_thigh": (-82, 0, 16), "right_knee": (96, 0, 0)}))),
    "punch": (0.2, 0.2, _both_sides(
        _pose(**_GUARD),
        _pose(**_GUARD | {"left_shoulder": (-88, -12, -82), "left_elbow": (0, -6, 0), "chest": (6, -30, 0),
                          "abdomen": (6, -18, 0), "left_thigh": (-42, 0, 8), "left_knee": (40, 0, 0)}))),
    "stretch": (0.8, 0.0, [
        _pose(shoulder=(-12, 0, 78), elbow=(0, -10, 0), chest=(-12, 0, 0)),
        *_both_sides(_pose(abdomen=(0, 0, 24), chest=(0, 0, 22), left_shoulder=(0, 0, -70),
                           right_shoulder=(-10, 0, 84), right_elbow=(0, -25, 0), thigh=(0, 0, 12))),
        _pose(hip=(40, 0, 0), thigh=(-40, 0, 6), abdomen=(38, 0, 0), chest=(30, 0, 0), shoulder=(-75, 0, -80),
              elbow=(0, -4, 0)),
        _pose(shoulder=(25, 0, 5), elbow=(0, -20, 0), chest=(-18, 0, 0), head=(-16, 0, 0))]),
    "jumping jack": (0.3, 0.0, [
        _pose(),
        _pose(shoulder=(-10, 0, 74), elbow=(0, -12, 0), thigh=(0, 0, 28), lift=0.1)]),
    "throw": (0.3, 0.3, [
        _pose(shoulder=(-40, 0, -60), elbow=(0, -90, 0)),
        _pose(abdomen=(-8, -24, 0), chest=(-8, -32, 0), right_shoulder=(20, 0, 15), right_elbow=(0, -100, 0),
              left_shoulder=(-70, 0, -60), left_thigh=(-70, 0, 8), left_knee=(70, 0, 0)),
        _pose(abdomen=(14, 18, 0), chest=(10, 26, 0), right_shoulder=(-120, 0, -50), right_elbow=(0, -15, 0),
              left_thigh=(-46, 0, 4), left_knee=(36, 0, 0), right_thigh=(22, 0, 8)),
        _pose(abdomen=(32, 26, 0), chest=(20, 20, 0), right_shoulder=(-40, -40, -70), left_shoulder=(40, 0, -60),
              left_thigh=(-56, 0, 4), left_knee=(44, 0, 0), right_thigh=(30, 0, 8), right_knee=(24, 0, 0))]),
    "lunge": (0.6, 0.4, _both_sides(
        _pose(),
        _pose(left_thigh=(-88, 0, 4), left_knee=(88, 0, 0), right_thigh=(24, 0, 4), right_knee=(62, 0, 0),
              right_ankle=(30, 0, 0), shoulder=(-20, 0, -20), elbow=(0, -60, 0)))),
    "sit": (0.7, 0.0, [
        _pose(),
        _pose(abdomen=(28, 0, 0), thigh=(-60, 0, 6), knee=(70, 0, 0), shoulder=(-40, 0, -76)),
        _pose(thigh=(-90, 8, 8), knee=(90, 0, 0), shoulder=(-28, 0, -74), elbow=(0, -55, 0)),
        _pose(abdomen=(10, 12, 0), thigh=(-90, 0, 4), knee=(84, 0, 0), shoulder=(-34, 20, -70),
              elbow=(0, -90, 0), head=(14, 0, 0))]),
    "pick up": (0.6, 0.2, [
        _pose(),
        _pose(hip=(30, 0, 0), abdomen=(36, 10, 0), chest=(22, 8, 0), thigh=(-84, 0, 10), knee=(76, 0, 0),
              shoulder=(-62, 0, -80), elbow=(0, -10, 0), head=(-20, 0, 0)),
        _pose(abdomen=(-4, 0, 0), shoulder=(-60, 0, -76), elbow=(0, -70, 0))]),
}  # fmt: skip

ACTIONS = tuple(_ACTIONS)
_FPS = 30
_SEQUENCE = 200  # frames of one subject
_PER_ACTION = 50  # frames of one action, about


def make_motion(n_frames: int = 4000, seed: int = 0, *, actions: Sequence[str] | None = None) -> Landmarks:
    """Generated 3D motion of a 31-point body, many subjects and actions; nothing is downloaded.

    Parameters
    ----------
    n_frames : int
        Frames in total, at 30 per second. They come in sequences of about 200 frames; in each, one
        subject with bone lengths of its own goes through about four actions.
    seed : int
        The same seed gives the same motion.
    actions : sequence of str, optional
        Some of ``datasets.ACTIONS``; default: all of them in turn.

    Returns
    -------
    Landmarks with points3d (n_frames, 31, 3) in metres, y up, feet on the floor y = 0, and the time of each frame in
    seconds from the beginning of its sequence.

    Raises
    ------
    ValueError
        If n_frames is no whole number above 0, if seed is none of at least 0, or if actions is a single string.
    KeyError
        If an action is unknown.

    Examples
    --------
    >>> nl.datasets.make_motion(600, actions=["walk", "wave"])
    Landmarks('motion': 600 frames × 31 points; 3D truth, 3 sequences)
    """
    n_frames, seed = whole("n_frames", n_frames, 1), whole("seed", seed, 0)
    if isinstance(actions, str):
        raise ValueError(f"actions={actions!r}; expected a sequence of names.")
    actions = ACTIONS if actions is None else tuple(actions)
    unknown = [a for a in actions if a not in _ACTIONS]
    if unknown or not actions:
        raise KeyError(f"unknown action {', '.join(map(repr, unknown)) or '(none)'}; there are {', '.join(ACTIONS)}.")
    n_sequences = max(1, round(n_frames / _SEQUENCE))
    lengths = [len(part) for part in np.array_split(np.arange(n_frames), n_sequences)]
    shuffle = np.random.default_rng([seed, 0])
    motions = []
    deck: list[str] = []
    for i, length in enumerate(lengths):
        n_actions = -(-length // _PER_ACTION)
        while len(deck) < n_actions:
            deck += shuffle.permutation(actions).tolist()
        programme, deck = deck[:n_actions], deck[n_actions:]
        motions.append(_perform(programme, length, np.random.default_rng([seed, 1, i])))
    return Landmarks(
        points3d=np.concatenate(motions),
        sequence=np.repeat(np.arange(n_sequences), lengths),
        time=np.concatenate([np.arange(length) / _FPS for length in lengths]),
        names=NAMES,
        edges=kept_edges(_PARENTS, range(len(NAMES))),
        name="motion",
    )


def _perform(programme, n_frames, rng):
    """One subject doing several actions, one after the other: (n_frames, 31, 3)."""
    duration = n_frames / len(programme) / _FPS  # of each action, in seconds
    poses, lifts, steps, speeds = [], [], [], []
    for action in programme:
        seconds, speed, keys = _ACTIONS[action]
        if rng.random() < 0.5:
            keys = [_mirrored(key) for key in keys]  # half of them are left-handed
        n_keys = max(2, round(duration / seconds))
        first, vigour = rng.integers(len(keys)), rng.uniform(*_VIGOUR)
        for k in range(n_keys):
            angles, lift = keys[(first + k) % len(keys)]
            poses.append(_REST + vigour * (angles - _REST))
            lifts.append(vigour * lift)
            steps.append(duration / n_keys * rng.uniform(0.8, 1.25))
            speeds.append(vigour * speed)
    times = np.cumsum(steps) - steps[0]
    t = np.linspace(0, times[-1], n_frames)
    angles = PchipInterpolator(times, np.stack(poses) + _stray(rng, len(poses)))(t)  # (F, J, 3)
    lift, speed = PchipInterpolator(times, np.stack([lifts, speeds], 1))(t).T

    rotations = Rotation.from_euler("YXZ", angles[..., [1, 0, 2]].reshape(-1, 3), degrees=True)
    rotations = rotations.as_matrix().reshape(n_frames, len(NAMES), 3, 3)
    heading = rng.uniform(0, 2 * np.pi) + rng.normal(0, 0.4) * np.arange(n_frames) / _FPS
    turn = Rotation.from_rotvec(heading[:, None] * [0, 1, 0]).as_matrix()
    rotations[:, 0] = turn @ rotations[:, 0]
    points = forward_kinematics(_PARENTS, _subject(rng), rotations)
    path = np.cumsum(turn[:, :, 2] * speed[:, None] / _FPS, axis=0)
    path[:, 1] = np.maximum(lift, 0) - points[..., 1].min(1)  # the lowest point stands, or jumps
    return points + path[:, None]


def _stray(rng, n_keys):
    """How each key pose of one subject strays: a habit that stays, and a whim per passage. (n_keys, J, 3)."""
    spread = np.zeros((len(NAMES), 3))
    for i, name in enumerate(NAMES):
        spread[i] = _STRAY.get(name.removeprefix("left_").removeprefix("right_"), (0, 0, 0))
    habit = rng.standard_normal((1, len(NAMES), 3))
    whim = rng.standard_normal((n_keys, len(NAMES), 3))
    return spread * (0.6 * habit + 0.6 * whim)


def _subject(rng):
    """Bone offsets of one person: overall size, and proportions that both sides share. (J, 3)."""
    proportion = {name: rng.uniform(0.95, 1.05) for name in (*_TRUNK, *_SIDE)}
    factors = [proportion[name.removeprefix("left_").removeprefix("right_")] for name in NAMES]
    return rng.uniform(0.98, 1.02) * _OFFSETS * np.array(factors)[:, None]
