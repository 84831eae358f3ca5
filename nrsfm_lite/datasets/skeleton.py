"""A tree of joints: forward kinematics, and the edges that a drawing needs."""

import numpy as np


def forward_kinematics(parents, offsets, rotations):
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


def kept_edges(parents, keep):
    """Edges among the kept joints: each one to its nearest kept ancestor.

    Parameters
    ----------
    parents : sequence of J int
    keep : sequence of P joint indices, in the order of the points

    Returns
    -------
    (E, 2) int, in the numbering of the kept points.
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
