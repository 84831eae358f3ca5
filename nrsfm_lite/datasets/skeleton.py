"""A tree of joints: forward kinematics, and the edges that a drawing needs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def forward_kinematics(parents: Sequence[int], offsets: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Joint positions of a chain of local rotations, all frames at once.

    Parameters
    ----------
    parents : sequence of J int
        Parent of each joint, −1 for the root; a parent stands before its children.
    offsets : (J, 3) or (F, J, 3)
        Position of each joint in its parent's frame; for the root, in the world.
    rotations : (F, J, 3, 3)
        Rotation of each joint relative to its parent.

    Returns
    -------
    (F, J, 3) positions in the world.

    Examples
    --------
    >>> nl.datasets.skeleton.forward_kinematics([-1, 0], np.eye(3)[:2], np.eye(3)[None, None].repeat(2, 1))[0]
    array([[1., 0., 0.],
           [1., 1., 0.]])
    """
    n_frames, n_joints = rotations.shape[:2]
    offsets = np.broadcast_to(offsets, (n_frames, n_joints, 3))
    positions = np.empty((n_frames, n_joints, 3))
    world = np.empty((n_frames, n_joints, 3, 3))
    for j, parent in enumerate(parents):
        if parent < 0:
            positions[:, j], world[:, j] = offsets[:, j], rotations[:, j]
        else:
            positions[:, j] = positions[:, parent] + np.einsum("fij,fj->fi", world[:, parent], offsets[:, j])
            world[:, j] = world[:, parent] @ rotations[:, j]
    return positions


def kept_edges(parents: Sequence[int], keep: Sequence[int]) -> np.ndarray:
    """Edges among the kept joints: each one to its nearest kept ancestor.

    Parameters
    ----------
    parents : sequence of J int
    keep : sequence of P joint indices, in the order of the points

    Returns
    -------
    (E, 2) int, in the numbering of the kept points.

    Examples
    --------
    >>> nl.datasets.skeleton.kept_edges([-1, 0, 1], keep=[0, 2])
    array([[0, 1]])
    """
    point_of = {joint: point for point, joint in enumerate(keep)}
    edges = []
    for point, joint in enumerate(keep):
        ancestor = parents[joint]
        while ancestor >= 0 and ancestor not in point_of:
            ancestor = parents[ancestor]
        if ancestor >= 0:
            edges.append((point_of[ancestor], point))
    return np.array(edges, int).reshape(-1, 2)
