"""Fixtures, and the bridge from nbval to the book: every notebook is executed once, for both."""

import copy
import os
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]


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


def pytest_sessionfinish(session):
    """Store what nbval's kernels printed and drew in the book's cache, so that `make book` runs nothing."""
    cells_of = defaultdict(list)
    for item in getattr(session, "items", []):
        if type(item).__name__ == "IPyNbCell":
            cells_of[item.parent].append(item)
    for file, cells in cells_of.items():
        notebook = _finished(file, cells)
        if notebook is not None:
            _store(file.path, notebook)


def _finished(file, cells):
    """A copy of the notebook with fresh outputs, or None if a cell did not run or raised."""
    notebook = copy.deepcopy(file.nb)
    code = [c for c in notebook.cells if c.cell_type == "code"]
    if len(code) != len(cells):
        return None
    for count, (cell, item) in enumerate(zip(code, cells, strict=True), 1):
        if item.options["skip"]:
            cell.outputs, cell.execution_count = [], None
            continue
        outputs = item.test_outputs
        if outputs is None:
            return None
        if not item.options["check_exception"] and any(o.output_type == "error" for o in outputs):
            return None
        for output in outputs:
            if output.output_type == "execute_result":
                output.execution_count = count
        cell.outputs, cell.execution_count = outputs, count
    return notebook


def _store(path, notebook):
    from jupyter_cache import get_cache
    from jupyter_cache.base import CacheBundleIn

    cache = os.environ.get("NRSFM_BOOK_CACHE", str(ROOT / "_build/.jupyter_cache"))
    get_cache(cache).cache_notebook_bundle(
        CacheBundleIn(notebook, str(path), data={}), check_validity=False, overwrite=True
    )
