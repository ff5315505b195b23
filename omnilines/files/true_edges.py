"""`truth.csv`: the straight edges of a rendered scene; `visibility.csv`: which stretches of them each photo sees."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from omnilines.files.tables import name_cells, number_cells, read_table, write_table

EDGE_COLUMNS = ("edge", "x1_m", "y1_m", "z1_m", "x2_m", "y2_m", "z2_m")
STRETCH_COLUMNS = ("image", "edge", "t1", "t2")
STRETCH_OPTIONAL = ("length_px", "contrast_grey", "contrast_rgb")


@dataclass(frozen=True)
class TrueEdges:
    """Straight edges of a scene, one row each; none overlaps another."""

    names: tuple[str, ...]
    ends_m: Float[np.ndarray, "e 2 3"]
    """(edge, end, xyz) in the world."""

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Stretches:
    """Stretches of edges that photos see, one row each, sorted by image, edge and t1.

    Rows that touch (t1 of the one is t2 of the other) are one unbroken stretch whose contrast changes on the way.
    """

    images: tuple[str, ...]
    image: Int[np.ndarray, " n"]
    """Index into `images`, which lists all photos, also those that see nothing."""
    edge: Int[np.ndarray, " n"]
    """Index into the edges."""
    t: Float[np.ndarray, "n 2"]
    """Where the stretch begins and ends, as fractions of the way from the first end point to the second."""
    length_px: Float[np.ndarray, " n"]
    """Along the curve in the photo."""
    contrast_grey: Float[np.ndarray, " n"]
    """Mean difference in grey level between both sides, without noise and texture: `omnilines.scenes.visibility`."""
    contrast_rgb: Float[np.ndarray, " n"]
    """The same of the colour channel that differs most."""

    def __len__(self) -> int:
        return len(self.image)

    def keep(self, rows: Bool[np.ndarray, " n"]) -> "Stretches":
        """Some of the rows."""
        return Stretches(
            self.images,
            self.image[rows],
            self.edge[rows],
            self.t[rows],
            self.length_px[rows],
            self.contrast_grey[rows],
            self.contrast_rgb[rows],
        )


def write_true_edges(path: str | Path, edges: TrueEdges) -> None:
    """Write truth.csv in one step; raises InputError on an unwritable path."""
    columns = {"edge": name_cells(edges.names, np.arange(len(edges)), path, "edge")}
    for name, values in zip(EDGE_COLUMNS[1:], edges.ends_m.reshape(-1, 6).T, strict=True):
        columns[name] = number_cells(values, path, name)
    write_table(path, columns)


def read_true_edges(path: str | Path) -> TrueEdges:
    """Read truth.csv; raises InputError naming the cell at fault, also where an edge is named twice or has no length."""
    table = read_table(path, EDGE_COLUMNS)
    index, names = table.names("edge")
    _, first = np.unique(index, return_index=True)
    table.require(np.isin(np.arange(len(index)), first), "edge", "a name that no row above has")
    ends = table.numbers(*EDGE_COLUMNS[1:]).reshape(-1, 2, 3)
    table.require((ends[:, 0] != ends[:, 1]).any(-1), "x2_m", "a second end other than the first")
    return TrueEdges(names, ends)


def write_stretches(path: str | Path, stretches: Stretches, edges: TrueEdges) -> None:
    """Write visibility.csv in one step; photos that see no edge leave no trace; raises InputError on an unwritable path."""
    columns = {
        "image": name_cells(stretches.images, stretches.image, path, "image"),
        "edge": name_cells(edges.names, stretches.edge, path, "edge"),
        "t1": number_cells(stretches.t[:, 0], path, "t1"),
        "t2": number_cells(stretches.t[:, 1], path, "t2"),
    }
    for name in STRETCH_OPTIONAL:
        columns[name] = number_cells(getattr(stretches, name).round(4), path, name)
    write_table(path, columns)


def read_stretches(path: str | Path, edges: TrueEdges) -> Stretches:
    """Read visibility.csv of those edges; optional columns that are absent are NaN.

    Raises InputError naming the cell at fault: an edge that is not known, or fractions that are not 0 <= t1 < t2 <= 1.
    """
    table = read_table(path, STRETCH_COLUMNS, STRETCH_OPTIONAL, may_be_empty=True)
    image, images = table.names("image")
    index, names = table.names("edge")
    known = {name: k for k, name in enumerate(edges.names)}
    number = np.array([known.get(name, -1) for name in names], dtype=np.int64)[index]
    table.require(number >= 0, "edge", "an edge of truth.csv")
    t = table.numbers("t1", "t2")
    table.require((t[:, 0] >= 0) & (t[:, 0] < 1), "t1", "a fraction of at least 0 and below 1")
    table.require((t[:, 1] > t[:, 0]) & (t[:, 1] <= 1), "t2", "a fraction above t1 and of at most 1")
    extra = [table.numbers(name)[:, 0] if name in table.columns else np.full(len(table), np.nan) for name in STRETCH_OPTIONAL]
    order = np.lexsort((t[:, 0], number, image))
    return Stretches(images, image[order], number[order], t[order], *(values[order] for values in extra))
