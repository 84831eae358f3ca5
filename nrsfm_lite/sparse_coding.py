"""Sparse coding: what the network is made of, and how its dictionaries are judged."""

import torch


def mutual_coherence(D):
    """Largest absolute cosine between two different columns of D.

    Parameters
    ----------
    D : (n, K) tensor or array
        One atom per column; a column of zeros counts as orthogonal to all others.

    Returns
    -------
    float in [0, 1]
        0 for orthogonal columns, 1 if two are parallel. On the last dictionary of a trained network
        it goes with the 3D error, without any truth (paper, section on dictionary coherence).

    Raises
    ------
    ValueError
        If D is not a matrix of at least two columns.
    """
    D = torch.as_tensor(D).detach()
    if D.ndim != 2 or D.shape[1] < 2:
        raise ValueError(f"D has shape {tuple(D.shape)}; expected (n, K) with K >= 2.")
    unit = torch.nn.functional.normalize(D, dim=0)
    cosines = (unit.mT @ unit).abs()
    return cosines.fill_diagonal_(0).max().item()
