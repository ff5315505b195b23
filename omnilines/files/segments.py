"""`segments.csv`: observed image segments (chords of arcs), one row each."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from camera_models.errors import InputError
from camera_models.typed import typed
from omnilines.files.tables import LARGEST_PX, LEAST_SIGMA_PX, Table, name_cells, number_cells, read_table, write_table
from omnilines.records import Segments

COLUMNS = ("image", "track", "u1_px", "v1_px", "u2_px", "v2_px")
COVARIANCE = ("suu1", "suv1", "svv1", "suu2", "suv2", "svv2")
OPTIONAL = ("camera", "sigma_px", *COVARIANCE)


@typed
def read_segments(path: str | Path) -> Segments:
    """Segments; photos and tracks in the order of first appearance, track -1 where the cell is empty.

    Raises InputError naming file, line and column where a value is missing or not a finite number, the two ends are one pixel,
    a photo has two cameras, a track the same segment twice, or a covariance (px^2) is incomplete or not one.
    """
    table = read_table(path, COLUMNS, OPTIONAL)
    image, images = table.images()
    track, tracks = table.names("track", may_be_empty=True)
    ends = table.within(LARGEST_PX, "u1_px", "v1_px", "u2_px", "v2_px").reshape(-1, 2, 2)
    table.require((ends[:, 0] != ends[:, 1]).any(1), "u2_px", "an end point other than the first", "remove the row")
    if (pair := repeated(image, track, ends)) is not None:
        first, row = pair
        expected = f"each segment once, not as in line {table.lines[first]} again"
        raise table.error(row, "u1_px", expected, "remove one of the two rows")
    sigma = None
    if table.has("sigma_px"):
        sigma = table.sigmas("sigma_px")
    cameras = table.name_of_each("camera", image, images, "image") if table.has("camera") else None
    return Segments(image, images, track, tracks, ends, sigma, _covariance(table), cameras)


def repeated(
    image: Int[np.ndarray, " n"], track: Int[np.ndarray, " n"], ends: Float[np.ndarray, "n 2 2"]
) -> tuple[int, int] | None:
    """The first two rows of one segment of a photo in one track, either way round: they would count as two; None without any."""
    swapped = (ends[:, 0] > ends[:, 1]).any(1) & ~(ends[:, 0, 0] < ends[:, 1, 0])
    sorted_ends = np.where(swapped[:, None, None], ends[:, ::-1], ends).reshape(-1, 4)
    _, first, which = np.unique(np.column_stack([image, track, sorted_ends]), axis=0, return_index=True, return_inverse=True)
    earlier = first[which.ravel()]
    again = np.flatnonzero(earlier != np.arange(len(image)))
    return (int(earlier[again[0]]), int(again[0])) if len(again) else None


def _covariance(table: Table) -> Float[np.ndarray, "n 2 2 2"] | None:
    given = [name for name in COVARIANCE if table.has(name)]
    if not given:
        return None
    absent = [name for name in COVARIANCE if name not in table.columns]
    if absent:
        raise InputError(
            f"{table.path}: the column {absent[0]} is missing beside {given[0]}; give all of {','.join(COVARIANCE)}."
        )
    suu1, suv1, svv1, suu2, suv2, svv2 = table.within(LARGEST_PX**2, *COVARIANCE).T
    least = LEAST_SIGMA_PX**2
    for end, (suu, suv, svv) in enumerate(((suu1, suv1, svv1), (suu2, suv2, svv2)), 1):
        table.require(suu > 0, f"suu{end}", "a variance above 0")
        table.require(svv > 0, f"svv{end}", "a variance above 0")
        table.require(suu >= least, f"suu{end}", f"a variance of at least {least:g}")
        table.require(svv >= least, f"svv{end}", f"a variance of at least {least:g}")
        limit = np.sqrt(suu) * np.sqrt(svv) * (1 + 1e-9)
        table.require(np.abs(suv) <= limit, f"suv{end}", f"a covariance of at most sqrt(suu{end} svv{end})")
    return np.stack([suu1, suv1, suv1, svv1, suu2, suv2, suv2, svv2], 1).reshape(-1, 2, 2, 2)


@typed
def write_segments(path: str | Path, segments: Segments) -> None:
    """Write segments in one step; photos without one leave no trace; raises InputError on NaN or an unwritable path."""
    columns = {"image": name_cells(segments.images, segments.image, path, "image")}
    if segments.cameras is not None:
        columns["camera"] = name_cells(segments.cameras, segments.image, path, "camera")
    columns["track"] = name_cells(segments.tracks, segments.track, path, "track")
    for name, values in zip(COLUMNS[2:], segments.endpoints_px.reshape(-1, 4).T, strict=True):
        columns[name] = number_cells(values, path, name)
    if segments.sigma_px is not None:
        columns["sigma_px"] = number_cells(segments.sigma_px, path, "sigma_px")
    if segments.covariance_px2 is not None:
        for name, values in zip(COVARIANCE, segments.covariance_px2.reshape(-1, 8)[:, [0, 1, 3, 4, 5, 7]].T, strict=True):
            columns[name] = number_cells(values, path, name)
    write_table(path, columns)
