"""pycolmap, imported when it is needed since it is slow to load, and kept from writing to standard error."""

import signal
import threading
from typing import Any

FATAL_ONLY = 3
"""Of its log: what COLMAP calls an error, such as no model from these photos, is told as a sentence of ours."""


def pycolmap() -> Any:
    """The module."""
    import pycolmap as module

    if threading.current_thread() is threading.main_thread() and (ours := signal.getsignal(signal.SIGTERM)) is not None:
        # Its log takes SIGTERM for a crash, and prints a stack.
        signal.signal(signal.SIGTERM, ours)
    module.logging.minloglevel = FATAL_ONLY
    return module
