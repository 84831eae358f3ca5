"""Fixtures of the tests. How a run goes is in the conftest.py above."""

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def real_data():
    """The folder of public data sets; skips where there is none."""
    folder = os.environ.get("NRSFM_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("NRSFM_DATA does not name a folder of data sets")
    return Path(folder)
