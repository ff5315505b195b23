"""`corners.csv`: observed target corners, one row each."""

from pathlib import Path

import numpy as np

from camera_models.errors import InputError
from omnilines.files.tables import Table, name_cells, number_cells, read_table, write_table
from omnilines.records import Corners

COLUMNS = ("view", "image", "board_x_m", "board_y_m", "u_px", "v_px")
OPTIONAL = ("camera", "frame", "board", "id", "board_z_m", "sigma_px")


def read_corners(path: str | Path) -> Corners:
    """Corners of one camera, views in the order of first appearance.

    `board_z_m` is 0 where the column is absent. Raises InputError naming file, line and column where a value is missing, is not
    a finite number, a corner stands twice in a view, a view has two images, or the rows are of more than one camera.
    """
    table = read_table(path, COLUMNS, OPTIONAL)
    view, view_names = table.names("view")
    images = table.name_of_each("image", view, view_names, "view")
    if table.has("camera"):
        _require_one_camera(table)
    board = np.zeros((len(table), 3))
    board[:, :2] = table.numbers("board_x_m", "board_y_m")
    if table.has("board_z_m"):
        board[:, 2] = table.numbers("board_z_m")[:, 0]
    _require_distinct(table, np.column_stack([view, board]))
    sigma = None
    if table.has("sigma_px"):
        sigma = table.numbers("sigma_px")[:, 0]
        table.require(sigma > 0, "sigma_px", "a standard deviation above 0")
    ids = table.whole_numbers("id") if table.has("id") else None
    return Corners(view, view_names, images, board, table.numbers("u_px", "v_px"), sigma, ids)


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
