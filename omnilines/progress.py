"""How work tells of its progress and is stopped, and the threads that it runs on.

Kernels release the interpreter's lock, and plain threads run them. A threading layer of numba would be one more pool beside
torch's: OpenMP's must not be forked, and the simplest one must not be entered twice, which worker pools of photos would do.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Protocol, TypeVar, runtime_checkable

import torch

from omnilines.machine import cores

T = TypeVar("T")
R = TypeVar("R")

ProgressCallback = Callable[[str, int, int], None]
"""Told (stage, done, total) as work goes on; total 0 where it is not known. What it raises stops the work and reaches the caller:
raise `Cancelled` from it to cancel."""


@runtime_checkable
class Each(Protocol):
    """Does a piece of work with every item: here, or by workers."""

    def __call__(self, work: Callable[[T], R], items: Sequence[T], /) -> list[R]:
        """The results in order."""
        ...


class Cancelled(Exception):
    """Raised by a progress callback to stop the work that calls it."""


def silent(stage: str, done: int, total: int) -> None:
    """The progress callback that says nothing."""


def on_all_cores(
    work: Callable[[T], R], items: Sequence[T], stage: str, progress: ProgressCallback, at_once: int | None = None
) -> list[R]:
    """The results in order, one item per core at a time, `at_once` at most where each takes much memory. Torch starts no threads
    within them: every core has its item, and they would wait for each other at several times the cost of the work."""
    results = []
    pool = ThreadPoolExecutor(min(cores(), at_once or cores()), initializer=torch.set_num_threads, initargs=(1,))
    try:
        for done, result in enumerate(pool.map(work, items), 1):
            results.append(result)
            progress(stage, done, len(items))
    finally:
        # After an error, or where the user stops it, what has not begun does not begin.
        pool.shutdown(cancel_futures=True)
    return results


def ahead(work: Callable[[T], R], items: Iterable[T], at_once: int) -> Iterator[R]:
    """The results in order, of which the next ones are worked on, one per core and `at_once` at most, while one is used."""
    threads = min(cores(), at_once)
    if threads == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        begun: deque[Future[R]] = deque()
        for item in items:
            begun.append(pool.submit(work, item))
            if len(begun) > threads:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()


def interruptible(work: Callable[[], R], cancel: Callable[[], None]) -> R:
    """The result of work that holds the interpreter, in a thread of its own, so that an interrupt is heard meanwhile: then
    `cancel` is called, which has to end the work."""
    with ThreadPoolExecutor(1) as pool:
        task = pool.submit(work)
        try:
            return task.result()
        except BaseException:  # Ctrl-C, and the signals that end a command
            cancel()
            raise


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
    """work(share, low, high) of each share [ends[k], ends[k + 1]), on as many threads as torch uses; results in their order."""
    shares = [(k, ends[k], ends[k + 1]) for k in range(len(ends) - 1)]
    threads = min(len(shares), torch.get_num_threads())
    if threads == 1:
        return [work(*share) for share in shares]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda share: work(*share), shares))
