"""Names and numbers in sentences."""

from collections.abc import Iterable, Sequence
from typing import Any

MOST_LISTED = 12


def rounded(value: float, digits: int = 2) -> str:
    """A number with so many significant digits, without an exponent where it is of ordinary size: 120 in place of 1.2e+02."""
    return f"{float(f'{value:.{digits}g}'):g}"


def either(choices: Sequence[Any]) -> str:
    """Two or more of which one is to be chosen: `0, 5 or 8`."""
    return f"{', '.join(map(str, choices[:-1]))} or {choices[-1]}"


def listed(names: Iterable[Any]) -> str:
    """Names with commas; of many the first, and how many more there are."""
    given = [str(name) for name in names]
    more = f" and {len(given) - MOST_LISTED} more" if len(given) > MOST_LISTED else ""
    return ", ".join(given[:MOST_LISTED]) + more
