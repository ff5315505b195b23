"""`upright.csv`: how upright views are turned from their photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from camera_models.formats.quaternions import quaternion_for_file, rotation_from_file
from omnilines.files.directions import COVARIANCE
from omnilines.files.tables import name_cells, number_cells, read_table, write_table

TURN = ("qw", "qx", "qy", "qz")
COLUMNS = ("image", *TURN, *COVARIANCE, "tilt_deg", "arcs")


@dataclass(frozen=True)
class LevelRow:
    """One upright view."""

    image: str
    """Its file."""
    view_from_camera: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "3 3"]
    """Of the rotation vector from the left, rad^2."""
    tilt_rad: float
    arcs: int


def write_levels(path: str | Path, rows: Sequence[LevelRow]) -> None:
    """Write one row for each view in one step. Raises InputError on NaN."""
    turns = quaternion_for_file(torch.as_tensor(np.stack([row.view_from_camera for row in rows]))).numpy()
    covariance = np.stack([row.covariance for row in rows])[:, *np.triu_indices(3)]
    columns = {"image": name_cells([row.image for row in rows], None, path, "image")}
    for names, values in ((TURN, turns), (COVARIANCE, covariance)):
        for name, column in zip(names, values.T, strict=True):
            columns[name] = number_cells(column, path, name)
    columns["tilt_deg"] = number_cells(np.degrees([row.tilt_rad for row in rows]), path, "tilt_deg")
    columns["arcs"] = [str(row.arcs) for row in rows]
    write_table(path, columns)


def read_levels(path: str | Path) -> list[LevelRow]:
    """The rows of such a file. Raises InputError where it is none."""
    table = read_table(path, COLUMNS)
    index, images = table.images()
    turns = rotation_from_file(torch.from_numpy(table.within(1.0, *TURN))).numpy()
    covariance = np.zeros((len(table), 3, 3))
    upper, right = np.triu_indices(3)
    covariance[:, upper, right] = covariance[:, right, upper] = table.numbers(*COVARIANCE)
    tilt, arcs = table.numbers("tilt_deg", "arcs").T
    return [
        LevelRow(images[index[k]], turns[k], covariance[k], float(np.radians(tilt[k])), int(arcs[k])) for k in range(len(table))
    ]
