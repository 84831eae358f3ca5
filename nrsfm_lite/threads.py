"""How many CPU threads PyTorch uses, for a while."""

from contextlib import contextmanager

import torch


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
