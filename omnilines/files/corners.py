"""`corners.csv`: observed target corners, one row each."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from camera_models.errors import InputError
from camera_models.formats.disk import read_text
from camera_models.typed import typed
from omnilines.files.frames import LATEST_S
from omnilines.files.tables import (
    LARGEST_PX,
    Table,
    is_parquet,
    name_cells,
    number_cells,
    read_table,
    write_table,
)
from omnilines.records import LARGEST_M, Corners

COLUMNS = ("view", "image", "board_x_m", "board_y_m", "u_px", "v_px")
OPTIONAL = ("camera", "frame", "board", "id", "board_z_m", "sigma_px", "time_s")


@typed
def read_corners(path: str | Path) -> Corners:
    """Corners of one camera, views in the order of first appearance.

    `board_z_m` is 0 and `times_s` None where these columns are absent. Raises InputError naming file, line and column where a
    value is missing, is not a finite number, a corner stands twice in a view, a view has two images or times, or the rows are of
    more than one camera.
    """
    table = read_table(path, COLUMNS, OPTIONAL)
    if table.has("camera"):
        _require_one_camera(table)
    view, view_names = table.names("view")
    times_s = _times(table, view, np.unique(view, return_index=True)[1]) if table.has("time_s") else None
    return replace(_corners(table, view, view_names), times_s=times_s)


@typed
def read_rig_corners(path: str | Path) -> Corners:
    """Corners of a rig. Rows with the same view, camera and board are one view; `frames` and `times_s` are None where these
    columns are absent. Raises InputError as `read_corners`, and where a view has two frames or times."""
    table = read_table(path, COLUMNS, OPTIONAL)
    keys = [table.names(name) if table.has(name) else None for name in ("view", "camera", "board")]
    combined = np.zeros(len(table), dtype=np.int64)
    for key in keys:
        if key is not None:
            combined = combined * len(key[1]) + key[0]
    _, first, group = np.unique(combined, return_index=True, return_inverse=True)
    # In the order of first appearance.
    order = np.argsort(first)
    view = np.argsort(order)[group.ravel()]
    own = first[order]
    names = [None if key is None else tuple(key[1][k] for k in key[0][own].tolist()) for key in keys]
    view_names, cameras, boards = names
    assert view_names is not None
    corners = _corners(table, view, view_names)
    frames = table.name_of_each("frame", view, view_names, "view") if table.has("frame") else None
    return replace(
        corners,
        cameras=cameras or ("cam0",) * len(view_names),
        frames=frames,
        boards=boards,
        times_s=_times(table, view, first[order]) if table.has("time_s") else None,
    )


def _times(table: Table, view: Int[np.ndarray, " n"], first: Int[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
    """Of every view, whose first rows are given."""
    each = table.within(LATEST_S, "time_s")[:, 0]
    times = each[first]
    table.require(each == times[view], "time_s", "the time of the rows above of the same view", "give one time to each view")
    return times


@typed
def is_corners_table(path: str | Path) -> bool:
    """Whether the header of a file has all columns of corners.csv."""
    if is_parquet(path):
        return False
    header = read_text(path).split("\n", 1)[0].lstrip("\ufeff")
    return set(COLUMNS) <= {cell.strip().strip('"') for cell in header.split(",")}


@typed
def is_rig_table(path: str | Path) -> bool:
    """Whether the rows are of more than one camera, or of more than one board."""
    table = read_table(path, COLUMNS, OPTIONAL)
    return any(table.has(name) and len(table.names(name, may_be_empty=True)[1]) > 1 for name in ("camera", "board"))


def _corners(table: Table, view: Int[np.ndarray, " n"], view_names: tuple[str, ...]) -> Corners:
    table.images()
    images = table.name_of_each("image", view, view_names, "view")
    board = np.zeros((len(table), 3))
    board[:, :2] = table.within(LARGEST_M, "board_x_m", "board_y_m")
    if table.has("board_z_m"):
        board[:, 2] = table.within(LARGEST_M, "board_z_m")[:, 0]
    _require_distinct(table, np.column_stack([view, board]))
    sigma = None
    if table.has("sigma_px"):
        sigma = table.sigmas("sigma_px")
    ids = table.whole_numbers("id") if table.has("id") else None
    return Corners(view, view_names, images, board, table.within(LARGEST_PX, "u_px", "v_px"), sigma, ids)


@typed
def write_corners(path: str | Path, corners: Corners) -> None:
    """Write corners in one step; views without a corner leave no trace. Raises InputError on NaN or an unwritable path."""
    x, y, z = corners.board_m.T
    columns = {
        "view": name_cells(corners.view_names, corners.view, path, "view"),
        "image": name_cells(corners.images, corners.view, path, "image"),
        "board_x_m": number_cells(x, path, "board_x_m"),
        "board_y_m": number_cells(y, path, "board_y_m"),
    }
    if z.any() or np.signbit(z).any():
        columns["board_z_m"] = number_cells(z, path, "board_z_m")
    for k, name in enumerate(("u_px", "v_px")):
        columns[name] = number_cells(corners.pixels[:, k], path, name)
    if corners.ids is not None:
        columns["id"] = list(map(str, corners.ids.tolist()))
    if corners.sigma_px is not None:
        columns["sigma_px"] = number_cells(corners.sigma_px, path, "sigma_px")
    for name, values in (("camera", corners.cameras), ("frame", corners.frames), ("board", corners.boards)):
        if values is not None:
            columns[name] = name_cells(values, corners.view, path, name)
    if corners.times_s is not None:
        columns["time_s"] = number_cells(corners.times_s[corners.view], path, "time_s")
    write_table(path, columns)


def _require_one_camera(table: Table) -> None:
    _, cameras = table.names("camera")
    if len(cameras) > 1:
        raise InputError(
            f"{table.path}, column camera: expected the corners of one camera, found those of {len(cameras)} "
            f"('{cameras[0]}', '{cameras[1]}'); give each camera a file of its own."
        )


def _require_distinct(table: Table, keys: np.ndarray) -> None:
    order = np.lexsort(keys.T)
    again = np.flatnonzero((keys[order[1:]] == keys[order[:-1]]).all(1))
    if len(again):
        # lexsort is stable: of two equal rows the earlier comes first.
        pair = min(again.tolist(), key=lambda k: int(order[k + 1]))
        first, second = int(order[pair]), int(order[pair + 1])
        raise InputError(
            f"{table.path}, line {table.lines[second]}, columns view, board_x_m, board_y_m: expected each board corner once in a "
            f"view, found that of line {table.lines[first]} again; remove one of the two."
        )
