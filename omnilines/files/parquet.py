"""Parquet tables with the columns of the CSV ones, read row group by row group into arrays; needs pyarrow, an optional extra.

Cells are numbers or texts already, so that nothing is parsed and no cell is held as a text of its own: of a column of names only
the distinct ones are kept. Errors name the row, counted from 1.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models.errors import InputError
from omnilines.files.tables import Table

LARGEST_EXACT = 2**53
"""Whole numbers from here on may be another one in double precision."""


@dataclass(frozen=True)
class ParquetTable(Table):
    """As `Table`; a column holds numbers (NaN for a missing one) or names with the index of each row's (-1 for a missing one)."""

    values: dict[str, Float[np.ndarray, " n"]] = field(default_factory=dict)
    texts: dict[str, tuple[Int[np.ndarray, " n"], tuple[str, ...]]] = field(default_factory=dict)

    def has(self, column: str) -> bool:
        """Whether the column is there and holds anything."""
        return column in self.columns and bool(self.filled(column).any())

    def filled(self, column: str) -> Bool[np.ndarray, " n"]:
        """Which cells of a column hold something."""
        return self.texts[column][0] >= 0 if column in self.texts else ~np.isnan(self.values[column])

    def error(self, row: int, column: str, expected: str, advice: str = "correct it") -> InputError:
        """The error that a cell is not what it has to be."""
        if column in self.texts:
            index, names = self.texts[column]
            found = f"'{names[index[row]][:60]}'" if index[row] >= 0 else "an empty cell"
        else:
            found = f"'{self.values[column][row]}'"
        return InputError(f"{self.path}, row {self.lines[row]}, column {column}: expected {expected}, found {found}; {advice}.")

    def numbers(self, *columns: str) -> Float[np.ndarray, "n k"]:
        """Finite numbers of the columns, side by side; raises InputError on a missing one, infinity or text."""
        found = self.numbers_or_nan(*columns)
        for k, name in enumerate(columns):
            self.require(np.isfinite(found[:, k]), name, "a finite number")
        return found

    def numbers_or_nan(self, *columns: str) -> Float[np.ndarray, "n k"]:
        """As `numbers`, with NaN for missing ones."""
        for name in columns:
            if name in self.texts:
                raise self.error(0, name, "a column of numbers", "write it as numbers")
            self.require(~np.isinf(self.values[name]), name, "a finite number or nothing")
        return np.stack([self.values[name] for name in columns], 1)

    def whole_numbers(self, column: str) -> Int[np.ndarray, " n"]:
        """Whole numbers of a column."""
        values = self.numbers(column)[:, 0]
        self.require(values == np.rint(values), column, "a whole number")
        return values.astype(np.int64)

    def names(self, column: str, may_be_empty: bool = False) -> tuple[Int[np.ndarray, " n"], tuple[str, ...]]:
        """Distinct texts of a column in the order of first appearance, and the index of each row's text; -1 for a missing one."""
        if not may_be_empty:
            self.require(self.filled(column), column, "a name", "fill it in")
        return self.texts[column] if column in self.texts else self._numbered(column)

    def _numbered(self, column: str) -> tuple[Int[np.ndarray, " n"], tuple[str, ...]]:
        """Names that are whole numbers, as CSV has them; a column with missing ones comes from tools as floating point."""
        values, filled = self.values[column], self.filled(column)
        whole = (values == np.rint(values)) & (np.abs(values) < LARGEST_EXACT)
        self.require(whole | ~filled, column, "texts or whole numbers", "write them as texts")
        distinct, first, which = np.unique(values[filled], return_index=True, return_inverse=True)
        order = np.argsort(first)
        index = np.full(len(self), -1)
        index[filled] = np.argsort(order)[which]
        return index, tuple(str(int(value)) for value in distinct[order])


def read_parquet_table(path: Path, required: Sequence[str], optional: Sequence[str], may_be_empty: bool) -> ParquetTable:
    """The named columns of a Parquet file; raises InputError as `read_table` does, and where pyarrow is not installed."""
    if importlib.util.find_spec("pyarrow") is None:
        raise InputError(
            f"Reading {path} takes the package pyarrow, which was not found; install it with pip install 'omnilines[parquet]' or "
            "save the table as CSV."
        )
    import pyarrow
    import pyarrow.parquet

    if not path.is_file():
        raise InputError(f"{path} was expected to be a file, found none; check the path.")
    try:
        file = pyarrow.parquet.ParquetFile(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise InputError(f"{path} was expected to be a Parquet file, found none ({error}); write it anew.") from None
    given = file.schema_arrow.names
    missing = [name for name in required if name not in given]
    if missing:
        found = ",".join(given)[:120]
        raise InputError(f"{path}: the column {missing[0]} is missing; expected the columns {','.join(required)}, found {found}.")
    wanted = [*required, *(name for name in optional if name in given)]
    count = file.metadata.num_rows
    if not count and not may_be_empty:
        raise InputError(f"{path} has no rows; expected at least one row.")
    columns = {name: _Column(count) for name in wanted}
    low = 0
    for group in range(file.num_row_groups):
        part = file.read_row_group(group, columns=wanted)
        for name, column in columns.items():
            column.add(low, part.column(name), path, name)
        low += part.num_rows
    values = {name: column.values for name, column in columns.items() if column.values is not None}
    texts = {name: (column.index, tuple(column.known)) for name, column in columns.items() if column.index is not None}
    cells: dict[str, Sequence[str]] = dict.fromkeys(wanted, ())
    return ParquetTable(path, cells, range(1, count + 1), values, texts)


class _Column:
    """One column while the row groups come in."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.values: Float[np.ndarray, " n"] | None = None
        self.index: Int[np.ndarray, " n"] | None = None
        self.known: dict[str, int] = {}

    def add(self, low: int, part: Any, path: Path, name: str) -> None:
        """The cells of a row group from row `low` on; raises InputError where they are neither numbers nor texts."""
        from pyarrow import types

        kind = part.type.value_type if types.is_dictionary(part.type) else part.type
        here = slice(low, low + len(part))
        # A column without any value may come as one of no type.
        if types.is_integer(kind) or types.is_floating(kind) or types.is_null(kind):
            if self.values is None:
                self.values = np.empty(self.count)
            self.values[here] = part.cast("float64", safe=False).to_numpy()
        elif any(is_text(kind) for is_text in (types.is_string, types.is_large_string, types.is_string_view)):
            if self.index is None:
                self.index = np.empty(self.count, dtype=np.int64)
            encoded = part.cast("string").combine_chunks().dictionary_encode()
            own = [
                self.known.setdefault(text, len(self.known)) if text.strip() else -1 for text in encoded.dictionary.to_pylist()
            ]
            place = encoded.indices.fill_null(len(own)).to_numpy(zero_copy_only=False)
            self.index[here] = np.array([*own, -1], dtype=np.int64)[place]
        else:
            raise InputError(f"{path}, column {name}: expected numbers or texts, found {kind}; write it as one of these.")
