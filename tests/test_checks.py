"""The sentences in which arguments are refused, and what passes."""

import numpy as np
import pytest
import torch

from nrsfm_lite import checks


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        ([0.9], int),
        ([np.nan], int),
        ([1e30], int),
        ([2], bool),
        (["a"], float),
        ([1j], float),
        (np.ones(2) * 1j, float),
    ],
)
def test_arrays_are_not_bent_into_a_type(value, dtype):
    with pytest.raises(ValueError, match="x cannot be read as an array of"):
        checks.as_array("x", value, dtype)


def test_arrays_and_tensors_are_copied_into_a_type():
    mine = np.zeros(3)
    checks.as_array("x", mine, float)[0] = 1
    assert mine[0] == 0
    assert checks.as_array("x", [1.0, 2.0], int).dtype == int
    assert checks.as_array("x", [1, 0], bool).tolist() == [True, False]
    for dtype in (torch.bfloat16, torch.float32, torch.int8, torch.bool):
        assert checks.as_array("x", torch.ones(2, dtype=dtype, requires_grad=dtype.is_floating_point), float).sum() == 2


def test_edges():
    assert checks.as_edges("edges", None, 3).shape == checks.as_edges("edges", [], 3).shape == (0, 2)
    assert checks.as_edges("edges", torch.tensor([[0, 2]]), 3).tolist() == [[0, 2]]
    for wrong, message in [
        ([0, 1], r"\(E, 2\)"),
        ([(0, 3)], "outside 0 … 2"),
        ([(-1, 0)], "outside"),
        ([(0.5, 1)], "whole"),
    ]:
        with pytest.raises(ValueError, match=message):
            checks.as_edges("edges", wrong, 3)


def test_the_first_frame_that_is_not_finite_is_named():
    checks.check_finite("x", np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"x has 2 values that are not finite numbers \(the first in frame 1\)"):
        checks.check_finite("x", np.array([[0, 0], [0, np.nan], [np.inf, 0]]))
