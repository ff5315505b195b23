"""Rows of numbers in the text files of other tools: cells parted by blanks, tabs, commas or semicolons, comments behind #."""

import re
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation

import numpy as np
from jaxtyping import Float

from camera_models import InputError
from camera_models.formats.values import number, of_text

BETWEEN = re.compile(r"[\s,;]+")
MARK = "#"


def rows(text: str) -> Iterator[tuple[str, list[str]]]:
    """The name and the cells of each line that is neither empty nor a comment."""
    for index, line in enumerate(text.lstrip("\ufeff").splitlines(), 1):
        whole = line.strip().strip(",;")
        if whole and not whole.startswith(MARK):
            yield f"line {index}", BETWEEN.split(whole)


def comments(text: str) -> Iterator[str]:
    """The lines that are comments, without their mark."""
    for line in text.lstrip("\ufeff").splitlines():
        if line.lstrip().startswith(MARK):
            yield line.lstrip().lstrip(MARK)


def is_number(cell: str) -> bool:
    """Whether a cell holds one."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def numbers_in(cells: Sequence[str], where: str) -> Float[np.ndarray, " n"]:
    """Finite numbers. Raises InputError naming what is none."""
    values = []
    for cell in cells:
        try:
            values.append(number(of_text(cell), where))
        except ValueError:
            raise InputError(f"Numbers were expected in {where}, found '{cell[:40]}'; export the poses again.") from None
    return np.array(values)


def exactly(cell: str, where: str) -> Decimal:
    """A number with all its digits: times of nanoseconds have more than a float holds."""
    try:
        value = Decimal(cell)
    except InvalidOperation:
        value = Decimal("nan")
    if not value.is_finite():
        raise InputError(f"A number was expected in {where}, found '{cell[:40]}'; export the poses again.")
    return value
