"""Mutual coherence."""

import numpy as np
import pytest

from nrsfm_lite.sparse_coding import mutual_coherence


def test_orthogonal_and_parallel_columns():
    assert mutual_coherence(np.eye(4)) == 0
    assert mutual_coherence(np.array([[1.0, -2.0], [1.0, -2.0]])) == pytest.approx(1)


def test_against_every_pair(rng):
    D = rng.normal(size=(5, 8))
    pairs = [
        abs(D[:, i] @ D[:, j]) / np.linalg.norm(D[:, i]) / np.linalg.norm(D[:, j]) for i in range(8) for j in range(i)
    ]
    assert mutual_coherence(D) == pytest.approx(max(pairs))


def test_a_column_of_zeros_is_orthogonal_to_all():
    assert mutual_coherence(np.array([[1.0, 0.0], [0.0, 0.0]])) == 0


def test_one_column_is_refused():
    with pytest.raises(ValueError, match="K >= 2"):
        mutual_coherence(np.ones((3, 1)))
