"""How a test run goes: one thread a process, the long files first, every notebook executed once and kept for the book.

It lies here, not in `tests`, because it serves the notebooks and the examples in the package's docstrings as well.
"""

import copy
import os
from collections import defaultdict
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parent

# Two processes share two cores, so each takes one thread. The kernels of the notebooks inherit this. It must be
# said before NumPy is loaded; a value that is set already stays.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

# Measured seconds, the longest files only; the run prints new ones at its end. The order is all that they decide: a
# long file that starts last would keep one process busy while the other has nothing to do.
SECONDS = {
    "tests/test_experiments.py": 190,
    "tests/test_reconstruction.py": 97,
    "notebooks/11_missing.ipynb": 71,
    "notebooks/00_quickstart.ipynb": 65,
    "notebooks/10_shape_prior.ipynb": 60,
    "notebooks/08_training.ipynb": 54,
    "notebooks/14_noise.ipynb": 49,
    "notebooks/13_translation.ipynb": 47,
    "tests/test_shape_prior.py": 45,
    "notebooks/09_thresholds.ipynb": 42,
    "notebooks/12_weak_perspective.ipynb": 42,
    "notebooks/02_priors.ipynb": 35,
    "notebooks/05_hierarchy.ipynb": 22,
    "tests/test_baselines_low_rank.py": 22,
    "notebooks/07_camera.ipynb": 20,
    "notebooks/10a_quality.ipynb": 15,
    "notebooks/06_encoder_decoder.ipynb": 15,
    "tests/test_baselines.py": 15,
    "notebooks/03_ista.ipynb": 13,
    "notebooks/04_block_ista.ipynb": 12,
    "tests/test_quality.py": 12,
    "tests/test_model.py": 11,
    "tests/test_baselines_cns.py": 10,
}
UNKNOWN = 5  # a file that is not listed

_times = defaultdict(float)


@pytest.fixture(autouse=True, scope="session")
def _names_of_the_examples(doctest_namespace):
    """What the examples in docstrings may use without importing it."""
    import math

    import matplotlib
    import numpy as np
    import torch

    import nrsfm_lite as nl

    matplotlib.use("Agg")  # no window opens. Not as an environment variable: the notebooks' kernels would inherit it
    doctest_namespace.update(nl=nl, np=np, torch=torch, math=math)


def pytest_configure(config):
    if config.pluginmanager.hasplugin("nbval"):
        _start_kernels_patiently()


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: -SECONDS.get(_file_of(item.nodeid), UNKNOWN))  # a stable sort keeps a file together


def pytest_runtest_logreport(report):
    _times[_file_of(report.nodeid)] += report.duration


def pytest_terminal_summary(terminalreporter):
    chapters = sorted(file for file in _times if file.endswith(".ipynb"))
    others = sorted(_times.keys() - set(chapters), key=_times.get, reverse=True)[:10]
    if chapters and "PYTEST_XDIST_WORKER" not in os.environ:
        for title, files in (("seconds for each chapter", chapters), ("the longest test files", others)):
            terminalreporter.section(title)
            for file in files:
                terminalreporter.line(f"{_times[file]:7.1f} s  {file}")


def pytest_sessionfinish(session):
    """Store what nbval's kernels printed and drew in the book's cache, so that `make book` runs nothing."""
    cells_of = defaultdict(list)
    for item in getattr(session, "items", []):
        if type(item).__name__ == "IPyNbCell":
            cells_of[item.parent].append(item)
    notebooks = {str(file.path): _finished(file, cells) for file, cells in cells_of.items()}
    finished = {path: nbformat.writes(notebook) for path, notebook in notebooks.items() if notebook is not None}
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["notebooks"] = finished  # one process writes: the cache is no place for two
    else:
        _store(finished)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    _store(getattr(node, "workeroutput", {}).get("notebooks", {}))


def _file_of(nodeid):
    return nodeid.split("::")[0]


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


def _store(notebooks):
    """Put finished notebooks, path -> text, into the book's cache."""
    from jupyter_cache import get_cache
    from jupyter_cache.base import CacheBundleIn

    cache = os.environ.get("NRSFM_BOOK_CACHE", str(ROOT / "_build/.jupyter_cache"))
    for path, text in notebooks.items():
        bundle = CacheBundleIn(nbformat.reads(text, nbformat.NO_CONVERT), path, data={})
        get_cache(cache).cache_notebook_bundle(bundle, check_validity=False, overwrite=True)


def _start_kernels_patiently():
    """Let nbval try a kernel's start three times.

    Two processes that start kernels at the same moment may choose the same port. One of the kernels then dies.
    """
    from nbval import plugin

    class PatientKernel(plugin.RunningKernel):
        def __init__(self, *arguments, **named):
            for attempts_left in (2, 1, 0):
                try:
                    return super().__init__(*arguments, **named)
                except RuntimeError:
                    if not attempts_left:
                        raise
                    if hasattr(self, "km"):  # it started, but does not talk
                        self.kc.stop_channels()
                        self.km.shutdown_kernel(now=True)

    plugin.RunningKernel = PatientKernel
