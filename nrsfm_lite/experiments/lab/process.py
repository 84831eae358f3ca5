"""A measurement in a process of its own: peak memory never goes down again in an old one."""

import multiprocessing
import os
import resource
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest import mock

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # read when the libraries load


def apart(function: Callable[..., Any], *arguments: Any, one_thread: bool = False) -> Any:
    """function(*arguments), a module's function, computed in a fresh process, of one thread if wanted.

    Raises RuntimeError if that process ends without a result.

    >>> apart(max, 2, 3)
    3
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_send, args=(theirs, function, arguments))
    with mock.patch.dict(os.environ, dict.fromkeys(_THREADS, "1") if one_thread else {}):
        child.start()
    theirs.close()
    try:
        return ours.recv()
    except EOFError:
        raise RuntimeError(f"the process that measured {function.__name__}{arguments} died.") from None
    finally:
        child.join()


def peak_mb() -> float:
    """Largest memory that this process has ever held, in megabytes.

    >>> peak_mb() > 1
    True
    """
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would count what the parent held, too
        (line,) = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        return int(line.split()[1]) / 1e3
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def _send(pipe: Connection, function: Callable[..., Any], arguments: tuple) -> None:
    pipe.send(function(*arguments))
