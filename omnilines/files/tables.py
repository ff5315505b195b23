"""CSV tables with one header line: strict in what they hold, kind in how they are written, errors that name the cell.

A byte order mark, any line ends, blank lines, quotes and columns nobody asked for are accepted. Cells are converted by the
column; only where that fails are they looked at one by one, to name the one at fault.
"""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models.errors import InputError
from camera_models.formats.disk import read_text, write_atomically
from camera_models.formats.values import is_text, stray

LARGEST_PX = 1e7
"""Of a pixel, and of its standard deviation, in a table."""
LEAST_SIGMA_PX = 1e-6
PARQUET_SUFFIXES = (".parquet", ".pq")


@dataclass(frozen=True)
class Table:
    """The cells of a CSV file as text, by column, with the line each row ends on."""

    path: Path
    columns: Mapping[str, Sequence[str]]
    lines: Sequence[int]

    def __len__(self) -> int:
        return len(self.lines)

    def has(self, column: str) -> bool:
        """Whether the column is there and holds anything."""
        return any(cell.strip() for cell in self.columns.get(column, ()))

    def error(self, row: int, column: str, expected: str, advice: str = "correct it") -> InputError:
        """The error that a cell is not what it has to be."""
        cell = self.columns[column][row]
        found = f"'{cell[:60]}'" if cell.strip() else "an empty cell"
        return InputError(f"{self.path}, line {self.lines[row]}, column {column}: expected {expected}, found {found}; {advice}.")

    def require(self, holds: Bool[np.ndarray, " n"], column: str, expected: str, advice: str = "correct it") -> None:
        """Raise InputError for the first row in which `holds` is false."""
        if not holds.all():
            raise self.error(int(np.argmin(holds)), column, expected, advice)

    def within(self, most: float, *columns: str) -> Float[np.ndarray, "n k"]:
        """As `numbers`; raises InputError where one is beyond `most` either way."""
        values = self.numbers(*columns)
        for k, name in enumerate(columns):
            self.require(np.abs(values[:, k]) <= most, name, f"a number from {-most:g} to {most:g}")
        return values

    def sigmas(self, column: str) -> Float[np.ndarray, " n"]:
        """Standard deviations in pixels; raises InputError where one is 0, negative or beyond reason."""
        sigma = self.numbers(column)[:, 0]
        self.require(sigma > 0, column, "a standard deviation above 0")
        self.require(
            (sigma >= LEAST_SIGMA_PX) & (sigma <= LARGEST_PX), column, f"a number from {LEAST_SIGMA_PX:g} to {LARGEST_PX:g}"
        )
        return sigma

    def images(self, column: str = "image") -> tuple[Int[np.ndarray, " n"], tuple[str, ...]]:
        """As `names`; raises InputError where one is not the name of a photo inside a folder."""
        index, names = self.names(column)
        for k, name in enumerate(names):
            why = stray(name)
            if why is not None:
                raise self.error(int(np.argmax(index == k)), column, "a photo inside the folder of the photos", f"it {why}")
        return index, names

    def numbers(self, *columns: str) -> Float[np.ndarray, "n k"]:
        """Finite numbers of the columns, side by side; raises InputError on an empty cell, NaN, infinity or text."""
        return np.stack([self._converted(self.columns[name], name, float, "a finite number") for name in columns], 1)

    def numbers_or_nan(self, *columns: str) -> Float[np.ndarray, "n k"]:
        """As `numbers`, with NaN for empty cells."""
        result = np.full((len(self), len(columns)), np.nan)
        for k, name in enumerate(columns):
            filled = self.filled(name)
            cells = [cell if there else "0" for cell, there in zip(self.columns[name], filled.tolist(), strict=True)]
            values = self._converted(cells, name, float, "a finite number or nothing")
            result[filled, k] = values[filled]
        return result

    def whole_numbers(self, column: str) -> Int[np.ndarray, " n"]:
        """Whole numbers of a column."""
        return self._converted(self.columns[column], column, int, "a whole number")

    def filled(self, column: str) -> Bool[np.ndarray, " n"]:
        """Which cells of a column hold something."""
        return np.array([bool(cell.strip()) for cell in self.columns[column]], dtype=bool)

    def names(self, column: str, may_be_empty: bool = False) -> tuple[Int[np.ndarray, " n"], tuple[str, ...]]:
        """Distinct texts of a column in the order of first appearance, and the index of each row's text; -1 for an empty cell.

        Raises InputError where one holds control characters.
        """
        filled = self.filled(column)
        if not may_be_empty:
            self.require(filled, column, "a name", "fill it in")
        known: dict[str, int] = {}
        cells = zip(self.columns[column], filled.tolist(), strict=True)
        index = [known.setdefault(cell, len(known)) if there else -1 for cell, there in cells]
        for name, k in known.items():
            if not is_text(name):
                raise self.error(index.index(k), column, "a name", "it holds characters that are not text; rename it")
        return np.array(index, dtype=np.int64), tuple(known)

    def name_of_each(self, column: str, group: Int[np.ndarray, " n"], groups: Sequence[str], kind: str) -> tuple[str, ...]:
        """The text that all rows of a group share in a column, for each group; raises InputError where they differ."""
        index, names = self.names(column)
        _, first = np.unique(group, return_index=True)
        own = index[first]
        wrong = np.flatnonzero(index != own[group])
        if len(wrong):
            row = int(wrong[0])
            expected = f"'{names[own[group[row]]]}' as in line {self.lines[first[group[row]]]} of the same {kind}"
            raise self.error(row, column, f"{expected} '{groups[group[row]]}'", f"give one {column} to each {kind}")
        return tuple(names[k] for k in own.tolist())

    def _converted(self, cells: Sequence[str], column: str, kind: Callable[[str], Any], expected: str) -> Any:
        dtype = np.float64 if kind is float else np.int64
        try:
            values = np.fromiter(map(kind, cells), dtype, len(cells))
            if np.isfinite(values).all() and "_" not in "".join(cells):
                return values
        except (ValueError, OverflowError):
            pass  # the cell at fault is named below
        raise self.error(next(row for row, cell in enumerate(cells) if not _is(kind, cell)), column, expected)


def _is(kind: Callable[[str], Any], cell: str) -> bool:
    # Python reads 1_000 as a number; no other reader of CSV does.
    try:
        return bool(np.isfinite(np.array(kind(cell), dtype=np.float64 if kind is float else np.int64))) and "_" not in cell
    except (ValueError, OverflowError):
        return False


def read_table(path: str | Path, required: Sequence[str], optional: Sequence[str] = (), may_be_empty: bool = False) -> Table:
    """The named columns of a CSV file, or of a Parquet file (by its suffix) of the same columns.

    Raises InputError on what is no table, lacks a column or (unless allowed) has no rows.
    """
    file = Path(path)
    if is_parquet(file):
        from omnilines.files.parquet import read_parquet_table

        return read_parquet_table(file, required, optional, may_be_empty)
    rows: list[list[str]] = []
    lines: list[int] = []
    reader = csv.reader(io.StringIO(read_text(file), newline=""), strict=True)
    try:
        for row in reader:
            if "".join(row).strip():
                rows.append(row)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise InputError(f"{file}, line {reader.line_num} is not valid CSV ({error}); correct its quotes.") from None
    if not rows:
        raise InputError(f"{file} is empty; expected a header line with the columns {','.join(required)}.")
    position = _positions(file, lines[0], [cell.strip() for cell in rows[0]], required, optional)
    width = len(rows[0])
    rows, lines = rows[1:], lines[1:]
    if not rows and not may_be_empty:
        raise InputError(f"{file} has a header line and no rows; expected at least one row.")
    if set(map(len, rows)) - {width}:
        bad = next(k for k, row in enumerate(rows) if len(row) != width)
        raise InputError(
            f"{file}, line {lines[bad]}: expected {width} fields as in the header, found {len(rows[bad])}; "
            "add what is missing, or put quotes around text that holds a comma."
        )
    cells = list(zip(*rows, strict=True)) if rows else [()] * width
    return Table(file, {name: cells[k] for name, k in position.items()}, lines)


def _positions(file: Path, line: int, header: list[str], required: Sequence[str], optional: Sequence[str]) -> dict[str, int]:
    expected = f"expected a header line with the columns {','.join(required)}"
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and mark in header[0]:
            raise InputError(f"{file}, line {line} is separated by {name}; save the table with commas.")
    missing = [name for name in required if name not in header]
    if missing:
        found = ",".join(header)[:120]
        raise InputError(f"{file}, line {line}: the column {missing[0]} is missing; {expected}, found {found}.")
    position: dict[str, int] = {}
    for name in [*required, *(name for name in optional if name in header)]:
        if header.count(name) > 1:
            raise InputError(f"{file}, line {line}: the column {name} stands there twice; remove one.")
        position[name] = header.index(name)
    return position


def is_parquet(path: str | Path) -> bool:
    """Whether a file is one of Parquet by its name."""
    return Path(path).suffix.lower() in PARQUET_SUFFIXES


def write_table(path: str | Path, columns: Mapping[str, Iterable[str]]) -> None:
    """Write columns of finished cells under a header line, in one step. Raises InputError where the file cannot be written, or is
    one of Parquet by its name, which is read only."""
    if is_parquet(path):
        raise InputError(f"{path}: tables are written as CSV, found a name of Parquet; give one that ends in .csv.")
    rows = map(",".join, zip(*columns.values(), strict=True))
    write_atomically(path, "\n".join([",".join(columns), *rows]) + "\n")


def number_cells(values: Float[np.ndarray, " n"], path: str | Path, column: str, may_be_nan: bool = False) -> list[str]:
    """The shortest text that reads back to each number; NaN, where allowed, is an empty cell. Raises InputError on others."""
    unknown = np.isnan(values) & may_be_nan
    wrong = ~np.isfinite(values) & ~unknown
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(f"{path}, column {column}: row {row + 1} would be {values[row]}; expected finite numbers, leave it out.")
    cells = list(map(repr, values.tolist()))
    for row in np.flatnonzero(unknown).tolist():
        cells[row] = ""
    return cells


def name_cells(names: Sequence[str], index: Int[np.ndarray, " n"] | None, path: str | Path, column: str) -> list[str]:
    """The name of each row (all names in order without an index), quoted where CSV needs it; an empty cell for index -1.

    Raises InputError on names that the readers refuse.
    """
    for name in names:
        if not name.strip():
            raise InputError(f"{path}, column {column}: expected names that are not blank, found '{name}'; give it a name.")
        if (why := stray(name)) is not None and (column == "image" or not is_text(name)):
            raise InputError(f"{path}, column {column}: a name was expected, found {name[:80]!r}, which {why}.")
    quoted = [f'"{name.replace(chr(34), chr(34) * 2)}"' if any(c in name for c in ',"\r\n') else name for name in names]
    return quoted if index is None else list(map([*quoted, ""].__getitem__, index.tolist()))
