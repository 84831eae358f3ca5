"""The examples in the docstrings do what they show."""

import doctest
import importlib

import matplotlib
import numpy as np
import pytest
import torch

import nrsfm_lite as nl

matplotlib.use("Agg")

MODULES = (
    "cameras", "data", "metrics", "plotting", "sparse_coding",
    "datasets.bvh", "datasets.files", "datasets.motion", "datasets.named", "datasets.skeleton", "datasets.views",
)  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module(name):
    module = importlib.import_module(f"nrsfm_lite.{name}")
    found = doctest.testmod(module, globs={"nl": nl, "np": np, "torch": torch})
    assert found.attempted and not found.failed
