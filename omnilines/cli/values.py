"""Values of options as they are typed: sizes, pixels, vectors."""

import math

from camera_models.errors import InputError

LARGEST_SIDE_PX, LARGEST_PX = 100_000, 2**28
"""Of an image that is asked for: OpenCV's own limits are little above."""


def parse_size(text: str, option: str) -> tuple[int, int]:
    """(width, height) of a text such as 1280x960; raises InputError otherwise."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and part.strip("0") for part in parts):
        raise InputError(f"{option} was expected as WIDTHxHEIGHT in pixels, such as 1280x960, found '{text[:40]}'.")
    width, height = (int(part) if len(part.lstrip("0")) < 10 else LARGEST_SIDE_PX + 1 for part in parts)
    if max(width, height) > LARGEST_SIDE_PX or width * height > LARGEST_PX:
        raise InputError(
            f"{option} was expected to have sides of at most {LARGEST_SIDE_PX} px, and {LARGEST_PX} px in all, found "
            f"'{text[:40]}'."
        )
    return width, height


def parse_px(text: str, option: str) -> float:
    """Pixels of a text such as 0.1px; raises InputError otherwise."""
    try:
        value = float(text.strip().removesuffix("px"))
    except ValueError:
        value = 0.0
    if not 0 < value < LARGEST_SIDE_PX:
        raise InputError(f"{option} was expected as a positive number of pixels, such as 0.1px, found '{text[:40]}'.")
    return value


def parse_three(text: str, option: str) -> tuple[float, float, float]:
    """Three numbers of a text such as 48.1,11.6,520; raises InputError otherwise."""
    try:
        first, second, third = (float(part) for part in text.split(","))
    except ValueError:
        first = second = third = math.nan
    if not all(math.isfinite(value) for value in (first, second, third)):
        raise InputError(f"{option} was expected as three numbers, such as 48.137,11.575,520.0, found '{text[:40]}'.")
    return first, second, third


def parse_each(text: str, option: str) -> dict[str, str]:
    """Values by camera of a text such as cam0=pinhole,cam1=scaramuzza; one without a name stands under "" for all others."""
    found: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, mark, value = item.rpartition("=")
        if name.strip() in found or not value.strip() or (mark and not name.strip()):
            raise InputError(f"{option} was expected as a value, or as CAMERA=VALUE with a comma between, found '{text}'.")
        found[name.strip()] = value.strip()
    return found
