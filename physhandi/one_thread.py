"""Runs torch on one thread, where several are slower and give other bits on another machine."""

from collections.abc import Generator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Generator[None]:
    """Run torch on one thread.

    The tensors of a fit are small: threads wait for each other longer than they work, and on a
    busy machine several times as long (measured on two cores: six times in stage 1). Sums are
    split by the number of threads, so with one the bits are those of any machine.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
