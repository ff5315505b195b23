"""Work for real workers that leaves behind which process began what; a module of its own, which the workers import."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

DISK_IS_FULL = "OMNILINES_TEST_DISK_IS_FULL"
"""A variable of the environment of a worker whose disk is said to be full."""


class Logged:
    """Work that notes each photo that it begins, and is slow enough to be killed in; on a worker whose disk is full it fails."""

    def __init__(self, work: Callable[[Any], Any], folder: Path, slow_s: float) -> None:
        self.work, self.folder, self.slow_s = work, folder, slow_s

    def __call__(self, item: Any) -> Any:
        with open(self.folder / f"{os.getpid()}-{time.monotonic_ns()}", "x"):
            time.sleep(self.slow_s)
        if os.environ.get(DISK_IS_FULL):
            raise OSError(28, "No space left on device")
        return self.work(item)
