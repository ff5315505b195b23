"""Trajectories by the number of the frame: KITTI's poses (12 numbers a row) and those of KITTI-360 (the number before 12 or 16).

Rows hold world_from_body, the upper three rows of its matrix or all four; of KITTI's files the first row is frame 0. Lengths are
metres. https://www.cvlibs.net/datasets/kitti/eval_odometry.php, https://www.cvlibs.net/datasets/kitti-360/documentation.php.
"""

from decimal import Decimal
from itertools import islice
from pathlib import Path

import numpy as np

from camera_models import InputError
from camera_models.formats.disk import read_text
from omnilines.posing.tools.contract import Keys, PoseFile, ToolPoses, rigid
from omnilines.posing.tools.rows import exactly, is_number, numbers_in, rows
from omnilines.records import LengthUnit

SUFFIXES = (".txt", ".csv", ".kitti")
PLAIN, NUMBERED = 12, (13, 17)


class KittiPoses(PoseFile):
    """A table of matrices."""

    TITLE = "a trajectory by frames (KITTI)"

    def recognises(self, path: Path, head: str) -> bool:
        """Rows of 12, 13 or 17 numbers."""
        first = [cells for _, cells in islice(rows(head), 1)] if path.suffix.lower() in SUFFIXES else []
        return bool(first) and len(first[0]) in (PLAIN, *NUMBERED) and all(map(is_number, first[0]))

    def _read(self, path: Path) -> ToolPoses:
        given = list(rows(read_text(path)))
        width = len(given[0][1]) if given else PLAIN
        numbers, rotations, centres = [], [], []
        for index, (where, cells) in enumerate(given):
            if len(cells) != width:
                raise InputError(f"{width} numbers were expected in {where}, found {len(cells)}; export the trajectory again.")
            number = Decimal(index) if width == PLAIN else exactly(cells[0], where)
            if number != number.to_integral_value() or number < 0:
                raise InputError(f"The number of a frame was expected in {where}, found {cells[0]}; export the trajectory again.")
            matrix = numbers_in(cells if width == PLAIN else cells[1:], where).reshape(-1, 4)
            if len(matrix) == 4 and not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
                raise InputError(f"0 0 0 1 was expected at the end of {where}, found others; export the trajectory again.")
            numbers.append(number)
            rotations.append(matrix[:3, :3])
            centres.append(matrix[:3, 3])
        names = tuple(f"frame {number:f}" for number in numbers)
        poses = rigid(rotations, centres, names).inverse()
        return ToolPoses(names, poses, LengthUnit.METRES, keys=Keys.NUMBERS, moments=tuple(numbers))
