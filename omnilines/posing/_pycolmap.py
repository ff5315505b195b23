"""pycolmap, which is an extra: imported when it is needed, and kept from writing to standard error."""

from typing import Any

from camera_models import InputError

ERRORS_ONLY = 2


def pycolmap() -> Any:
    """The module; raises InputError where the extra is not installed."""
    try:
        import pycolmap as module
    except ImportError as error:
        raise InputError(
            f"COLMAP is needed for this, and expected the extra: pip install 'omnilines[sfm]' brings it, found none ({error})."
        ) from error
    module.logging.minloglevel = ERRORS_ONLY
    return module
