"""Ctrl-C, SIGTERM and a terminal that closes end a command at once, with one sentence and the exit status that shells expect: 128
and the number of the signal.

Python raises an exception for a signal between two steps of its own, in the main thread: what is being written is cleaned up, and
the cursor comes back. But a compiled step may last for minutes, threads of a pool are waited for, and what is raised while an
object is taken down or a compiled module calls back is lost. So a second thread, which is woken as the signal comes, ends the
process when the first has not within GRACE_S.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

GRACE_S = 1.0
"""Time to clean up."""
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
SHOW_CURSOR = "\x1b[?25h"


class Stopped(BaseException):
    """A signal came; not an Exception, so that nothing takes it for an error of its own."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def _stopped() -> str:
    return "stopped."


_sentence = _stopped


def say_when_stopped(sentence: Callable[[], str]) -> None:
    """What is said when the command that runs is stopped, asked for then."""
    global _sentence
    _sentence = sentence


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Within it, a signal ends the process. Elsewhere than in the main thread nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    # What is ignored stays so: nohup, and commands that a script starts in the background.
    heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _raise) for number in heard}
    told = sys.unraisablehook
    sys.unraisablehook = lambda lost: None if isinstance(lost.exc_value, Stopped) else told(lost)
    woken = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()
    try:
        yield
    except Stopped as stopped:
        _end(stopped.number)
    finally:
        signal.set_wakeup_fd(woken)
        sys.unraisablehook = told
        for number, handler in before.items():
            signal.signal(number, handler)
        writer.close()


def _raise(number: int, frame: FrameType | None) -> NoReturn:
    # A second signal while the first is cleaned up after ends it at once.
    signal.signal(number, lambda again, _: _end(again))
    raise Stopped(number)


def _watch(reader: socket.socket) -> None:
    """Wait for a signal, then for the main thread to end the process, then end it; without one, until the other end closes."""
    with reader:
        while came := reader.recv(1):
            if came[0] in SIGNALS:
                time.sleep(GRACE_S)
                _end(came[0])


_ending = threading.Lock()


def _end(number: int) -> NoReturn:
    """Say so and leave: threads that still work are not waited for."""
    if _ending.acquire(blocking=False):
        # Standard error may be closed, or its terminal gone.
        with contextlib.suppress(OSError, AttributeError, ValueError):
            cursor = f"\r{SHOW_CURSOR}" if sys.stderr.isatty() else ""
            os.write(sys.stderr.fileno(), f"{cursor}omnilines: {_sentence()}\n".encode(errors="backslashreplace"))
    os._exit(128 + number)
