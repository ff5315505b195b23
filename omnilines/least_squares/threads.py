"""Compiled loops on several threads.

Kernels release the interpreter's lock, and plain threads run them. A threading layer of numba would be one more pool beside
torch's: OpenMP's must not be forked, and the simplest one must not be entered twice, which worker pools of photos would do.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")

LEAST_SHARE = 200
"""Items for a thread below which another one is not worth its start."""


def threads_for(count: int) -> int:
    """Number of threads for so many items: as many as torch uses (OMP_NUM_THREADS, torch.set_num_threads), fewer for few."""
    return max(1, min(torch.get_num_threads(), count // LEAST_SHARE))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch works on one thread meanwhile: for many small products, which its threads wait for longer than they work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def in_shares(work: Callable[[int, int, int], T], ends: list[int]) -> list[T]:
    """work(share, low, high) of each share [ends[k], ends[k + 1]), each on a thread of its own; results in their order."""
    shares = [(k, ends[k], ends[k + 1]) for k in range(len(ends) - 1)]
    if len(shares) == 1:
        return [work(*shares[0])]
    with ThreadPoolExecutor(len(shares)) as pool:
        return list(pool.map(lambda share: work(*share), shares))
