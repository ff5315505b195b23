"""Functions compiled by several processes at a time.

numba compiles one function after another, whoever calls it: it holds a lock. Processes of their own do it on all cores, and keep
what they compiled where the process that started them finds it.
"""

import math
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby

from omnilines.compiling.entries import Entry
from omnilines.machine import POOLS, available_bytes, cores

MOST_PROCESSES = 8
"""More gain nothing: the longest function takes a seventh of all."""
MEMORY_OF_ONE = 1 << 30
"""Bytes that a process takes which compiles half of all functions; fewer take less."""


def compile_ahead(wanted: Sequence[Entry], progress: Callable[[int, int], None]) -> tuple[str, ...]:
    """Compile functions; the names of those that could not be: whoever calls them compiles them, and says why that fails.

    `progress` is told how many of how many are done; what it raises ends the processes and reaches the caller.
    """
    done: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    shares = shared_out(wanted, _processes())
    running = [_started(share) for share in shares]
    try:
        for process in running:
            threading.Thread(target=_follow, args=(process, done), daemon=True).start()
        missing, ended = {entry.function for entry in wanted}, 0
        progress(0, len(wanted))
        while ended < len(running):
            name = done.get()
            if name is None:
                ended += 1
                continue
            missing.discard(name)
            progress(len(wanted) - len(missing), len(wanted))
    finally:
        for process in running:
            _ended(process)
    return tuple(sorted(missing))


@contextmanager
def before_first_compiled(work: Callable[[], None]) -> Iterator[None]:
    """Within it, `work` is done once: where this process would compile a function because numba keeps nothing of it."""
    from numba.core import event

    class Before(event.Listener):
        """Told by numba, which holds its lock: one thread at a time."""

        begun = False

        def on_start(self, told: event.Event) -> None:
            """A function is going to be compiled."""
            if not self.begun:
                self.begun = True
                work()

        def on_end(self, told: event.Event) -> None:
            """It is compiled."""

    with event.install_listener("numba:compile", Before()):
        yield


def shared_out(wanted: Sequence[Entry], processes: int) -> list[list[Entry]]:
    """The work of each process: modules whole, since their functions share helpers, the longest first."""
    modules = [list(its) for _, its in groupby(sorted(wanted, key=lambda entry: entry.module), key=lambda entry: entry.module)]
    shares: list[list[Entry]] = [[] for _ in range(min(processes, len(modules)))]
    for module in sorted(modules, key=_seconds, reverse=True):
        min(shares, key=_seconds).extend(module)
    return shares


def seconds_for(wanted: Sequence[Entry]) -> float:
    """About how long `compile_ahead` will take, if all cores are as fast as the one of which the list tells, and free."""
    return max((_seconds(share) for share in shared_out(wanted, _processes())), default=0.0)


def _seconds(share: Sequence[Entry]) -> float:
    return math.fsum(entry.seconds for entry in share)


def _processes() -> int:
    free = available_bytes()
    return max(1, min(cores(), MOST_PROCESSES, MOST_PROCESSES if free is None else free // MEMORY_OF_ONE))


def _started(share: Sequence[Entry]) -> "subprocess.Popen[str]":
    one_thread = dict.fromkeys(POOLS, "1")
    # It ends with its standard input, which ends with this process however that ends; signals to a terminal are not its own.
    return subprocess.Popen(
        [sys.executable, "-m", "omnilines.compiling", *(entry.function for entry in share)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        env={**os.environ, **one_thread},
    )


def _ended(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _follow(process: "subprocess.Popen[str]", done: "queue.SimpleQueue[str | None]") -> None:
    """Pass on what a process says, then None."""
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            done.put(line.strip())
    done.put(None)
