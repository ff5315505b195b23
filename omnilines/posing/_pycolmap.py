"""pycolmap, imported when it is needed since it is slow to load, and kept from writing to standard error."""

from typing import Any

ERRORS_ONLY = 2


def pycolmap() -> Any:
    """The module."""
    import pycolmap as module

    module.logging.minloglevel = ERRORS_ONLY
    return module
