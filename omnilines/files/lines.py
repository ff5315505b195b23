"""`lines.csv`: 3D lines, one row per track, and the covariances of lines and poses that no table holds."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float

from camera_models.errors import InputError
from camera_models.formats.disk import write_atomically
from camera_models.typed import typed
from omnilines.files.tables import Table, name_cells, number_cells, read_table, write_table
from omnilines.records import LINE_STATUSES, ImagePoses, Lines

ENDS = ("x1_m", "y1_m", "z1_m", "x2_m", "y2_m", "z2_m")
COLUMNS = ("track", *ENDS, "views", "rms_px", "sigma_m", "status")
SHARES = ("shown_share", "chance_share")
"""Of lines that were found in photos."""
BY_CALIBRATION = "calibration_sigma_m"
OPTIONAL = (*SHARES, BY_CALIBRATION)


@typed
def read_lines(path: str | Path) -> Lines:
    """Lines in the order of the file; empty cells are NaN, a table without rows is one of no lines.

    Raises InputError naming file, line and column where a track stands twice, a status is not one of `LINE_STATUSES`, the
    coordinates are not there for `ok` and `weak` or are there for others, or a number is none.
    """
    table = read_table(path, COLUMNS, OPTIONAL, may_be_empty=True)
    track, tracks = table.names("track")
    _, first = np.unique(track, return_index=True)
    once = np.zeros(len(table), dtype=bool)
    once[first] = True
    table.require(once, "track", "each track once", "remove one of its rows")
    kind, kinds = table.names("status", may_be_empty=True)
    status = tuple(kinds[k] if k >= 0 else "" for k in kind.tolist())
    table.require(np.array([s in LINE_STATUSES for s in status], dtype=bool), "status", f"one of {', '.join(LINE_STATUSES)}")
    known = np.array([s in ("ok", "weak") for s in status], dtype=bool)
    ends = table.numbers_or_nan(*ENDS)
    for k, name in enumerate(ENDS):
        there = np.isfinite(ends[:, k])
        table.require(there | ~known, name, "a finite number, as the status is ok or weak")
        table.require(~there | known, name, "nothing, as the status is neither ok nor weak")
    views = table.whole_numbers("views")
    table.require(views >= 0, "views", "a number of views, not negative")
    rms, sigma = table.numbers_or_nan("rms_px", "sigma_m").T
    shown, chance = (_share(table, name) for name in SHARES)
    by_calibration = table.numbers_or_nan(BY_CALIBRATION)[:, 0].copy() if BY_CALIBRATION in table.columns else None
    ends = ends.reshape(-1, 2, 3)
    table_of = (tracks, ends, views, np.ascontiguousarray(rms), np.ascontiguousarray(sigma), status)
    return Lines(*table_of, shown_share=shown, chance_share=chance, calibration_sigma_m=by_calibration)


def _share(table: Table, name: str) -> Float[np.ndarray, " n"] | None:
    """A column of shares; None where the file has none."""
    if name not in table.columns:
        return None
    share = table.numbers_or_nan(name)[:, 0].copy()
    table.require(~((share < 0.0) | (share > 1.0)), name, "a share between 0 and 1")
    return share


@typed
def write_lines(path: str | Path, lines: Lines) -> None:
    """Write lines in one step, coordinates empty unless the status is `ok` or `weak`; raises InputError where those have none."""
    columns = {"track": name_cells(lines.tracks, None, path, "track")}
    known = lines.known
    for name, values in zip(ENDS, lines.ends_m.reshape(-1, 6).T, strict=True):
        cells = iter(number_cells(values[known], path, name))
        columns[name] = [next(cells) if there else "" for there in known.tolist()]
    columns["views"] = list(map(str, lines.views.tolist()))
    columns["rms_px"] = number_cells(lines.rms_px, path, "rms_px", may_be_nan=True)
    columns["sigma_m"] = number_cells(lines.sigma_m, path, "sigma_m", may_be_nan=True)
    columns["status"] = list(lines.status)
    for name in OPTIONAL:
        values = getattr(lines, name)
        if values is not None:
            columns[name] = number_cells(values, path, name, may_be_nan=True)
    write_table(path, columns)


@typed
def write_covariance(path: str | Path, poses: ImagePoses | None = None, lines: Lines | None = None) -> None:
    """Write `covariance.npz` in one step: what is known of the following arrays, for `numpy.load`.

    `image` (n,) and `pose_covariance` (n, 6, 6) of the left perturbation (rotation_rad, translation_m); `track` (m,) and
    `line_covariance` (m, 4, 4) in the line chart (right perturbation of S, 3; phi, 1) with `line_chart_centre_m` (m, 3) and
    `line_chart_scale_m` (m,). Raises InputError where neither holds a covariance.
    """
    arrays: dict[str, np.ndarray] = {}
    if poses is not None and poses.covariance is not None:
        arrays |= {"image": np.array(poses.images, dtype=np.str_), "pose_covariance": poses.covariance}
    if lines is not None and lines.covariance is not None:
        if lines.chart_centre_m is None or lines.chart_scale_m is None:
            raise InputError(f"{path}: a covariance of lines needs the centre and scale of their charts, found none; give both.")
        arrays |= {
            "track": np.array(lines.tracks, dtype=np.str_),
            "line_covariance": lines.covariance,
            "line_chart_centre_m": lines.chart_centre_m,
            "line_chart_scale_m": lines.chart_scale_m,
        }
    if not arrays:
        raise InputError(f"{path}: expected poses or lines with a covariance, found none; estimate one first.")
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())
