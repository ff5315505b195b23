"""When a photo was taken, as its name says it: a time, or the number of a frame."""

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import PurePosixPath

SPLIT = re.compile(r"(\d{9,10})[_-](\d{9})(?!\d)")
"""Seconds and nanoseconds, as ROS counts them."""
NUMBER = re.compile(r"\d+(?:\.\d+)?")
LEAST = Decimal("1e9")
"""A whole number below is that of a frame: seconds have had ten digits since 2001, and finer units more."""
NANOSECOND_S = Decimal("1e-9")
UNITS_S = (Decimal(1), Decimal("1e-3"), Decimal("1e-6"), NANOSECOND_S)


def time_of(photo: str) -> Decimal | None:
    """The number with most digits in a photo's name, where it may be a time: one with a fraction, or of 1e9 and more."""
    stem = PurePosixPath(photo).stem
    split = SPLIT.search(stem)
    if split:
        return Decimal(f"{split[1]}.{split[2]}")
    longest = max(NUMBER.findall(stem), key=len, default=None)
    if longest is None:
        return None
    value = Decimal(longest)
    return value if "." in longest or value >= LEAST else None


def number_of(photo: str) -> Decimal | None:
    """The last whole number in a photo's name."""
    found = re.findall(r"\d+", PurePosixPath(photo).stem)
    return Decimal(found[-1]) if found else None


def unit_s(times: Sequence[Decimal], first_s: Decimal, last_s: Decimal) -> Decimal:
    """The unit (s) in which most times lie between two; seconds where none does."""
    return max(UNITS_S, key=lambda unit: sum(first_s <= time * unit <= last_s for time in times))
