"""`directions.csv`: directions in which the lines of each photo meet; `arcs.csv`: the arcs that belong to them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from omnilines.files.tables import name_cells, number_cells, write_table

COVARIANCE = ("sxx", "sxy", "sxz", "syy", "syz", "szz")
COLUMNS = ("image", "direction", "x", "y", "z", *COVARIANCE, "arcs")
ARC_COLUMNS = ("image", "direction", "u1_px", "v1_px", "u2_px", "v2_px")


def write_directions(
    path: str | Path,
    *,
    images: Sequence[str],
    names: Sequence[str],
    direction: Float[np.ndarray, "n 3"],
    covariance: Float[np.ndarray, "n 3 3"],
    arcs: Int[np.ndarray, " n"],
) -> None:
    """Write one row for each direction of each photo in one step: in the camera frame (x right, y down, z forward), covariance in
    rad^2. Raises InputError on NaN."""
    columns = {"image": name_cells(images, None, path, "image"), "direction": list(names)}
    for name, values in zip("xyz", direction.T, strict=True):
        columns[name] = number_cells(values, path, name)
    for name, values in zip(COVARIANCE, covariance[:, *np.triu_indices(3)].T, strict=True):
        columns[name] = number_cells(values, path, name)
    columns["arcs"] = list(map(str, arcs.tolist()))
    write_table(path, columns)


def write_directed_arcs(
    path: str | Path, *, images: Sequence[str], names: Sequence[str], endpoints_px: Float[np.ndarray, "n 2 2"]
) -> None:
    """Write one row for each arc, with its photo and its direction, which is empty where it has none."""
    columns = {"image": name_cells(images, None, path, "image")}
    columns["direction"] = list(names)
    for name, values in zip(ARC_COLUMNS[2:], endpoints_px.reshape(-1, 4).T, strict=True):
        columns[name] = number_cells(values, path, name)
    write_table(path, columns)
