"""A measurement in a process of its own: peak memory never goes down again in an old one."""

import multiprocessing
import resource
import sys


def apart(function, *arguments):
    """function(*arguments), a module's function, computed in a fresh process.

    Raises RuntimeError if that process ends without a result.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_send, args=(theirs, function, arguments))
    child.start()
    theirs.close()
    try:
        return ours.recv()
    except EOFError:
        raise RuntimeError(f"the process that measured {function.__name__}{arguments} died.") from None
    finally:
        child.join()


def peak_mb():
    """Largest memory that this process has ever held, in megabytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def _send(pipe, function, arguments):
    pipe.send(function(*arguments))
