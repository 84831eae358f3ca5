"""How many CPU threads PyTorch and NumPy use, for a while."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401, so that SciPy's own linear algebra is there to be found, too
import torch
from threadpoolctl import ThreadpoolController

_LIBRARIES = ThreadpoolController()
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def one_thread(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """A decorator: PyTorch and the linear algebra of NumPy and SciPy take one thread while the function runs.

    On many small matrices a second one costs more than it gives, and on a busy machine ten times as much.
    """

    @wraps(function)
    def alone(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        with use_threads(1), _LIBRARIES.limit(limits=1):
            return function(*arguments, **named)

    return alone


@contextmanager
def use_threads(n: int | None) -> Iterator[None]:
    """Let PyTorch use n CPU threads inside a `with` block (None: as it is), and set it back afterwards."""
    before = torch.get_num_threads()
    if n is not None:
        torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)
