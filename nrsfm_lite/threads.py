"""How many CPU threads PyTorch and NumPy use, for a while."""

from contextlib import contextmanager

import scipy.linalg  # noqa: F401, so that SciPy's own linear algebra is there to be found, too
import torch
from threadpoolctl import ThreadpoolController

# A decorator: while the function runs, linear algebra takes one thread. On many small matrices a second one costs
# more than it gives, and on a busy machine ten times as much.
one_thread = ThreadpoolController().wrap(limits=1)


@contextmanager
def use_threads(n):
    """Let PyTorch use n CPU threads inside a `with` block (None: as it is), and set it back afterwards."""
    before = torch.get_num_threads()
    if n is not None:
        torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)
