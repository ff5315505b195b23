"""Trajectories by time: TUM's `timestamp tx ty tz qx qy qz qw` (evo, ORB-SLAM, many others), EuRoC's data.csv (Basalt, Monado),
VINS-Mono's and VINS-Fusion's vio.csv.

Rows hold world_from_body, the body being the camera, or what the camera sits on. Without a header the order of eight columns is
TUM's, that of eleven VINS's, which has the velocity behind; a header behind # names the columns, as EuRoC's does, and the unit of
time. Lengths are metres. https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats; M. Burri et al., The EuRoC micro aerial
vehicle datasets, IJRR 2016; VINS-Fusion's sources, `utility/visualization.cpp`.
"""

from collections.abc import Sequence
from decimal import Decimal
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from camera_models import InputError
from camera_models.formats.disk import read_text
from camera_models.formats.quaternions import rotation_from_file
from omnilines.posing.tools.contract import Keys, PoseFile, ToolPoses, rigid
from omnilines.posing.tools.rows import BETWEEN, comments, exactly, is_number, numbers_in, rows
from omnilines.records import LengthUnit

TUM = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
EUROC = ("p_RS_R_x", "p_RS_R_y", "p_RS_R_z", "q_RS_x", "q_RS_y", "q_RS_z", "q_RS_w")
SHORT = ("px", "py", "pz", "qx", "qy", "qz", "qw")
VINS = ("tx", "ty", "tz", "qw", "qx", "qy", "qz", "vx", "vy", "vz")
SUFFIXES = (".txt", ".csv", ".tum", ".traj", ".log")
UNITS_S = {"[s]": Decimal(1), "[ms]": Decimal("1e-3"), "[us]": Decimal("1e-6"), "[ns]": Decimal("1e-9")}
ROUNDED = 0.01
"""By which the length of a quaternion may differ from 1."""
SUBDIVIDED = ((Decimal("1e17"), "[ns]"), (Decimal("1e14"), "[us]"), (Decimal("1e11"), "[ms]"))
"""From which number on a time since 1970 counts nanoseconds, microseconds, milliseconds: in seconds these would be far off."""


class TimedPoses(PoseFile):
    """A table of times and poses."""

    TITLE = "a trajectory by time (TUM, EuRoC, VINS)"

    def recognises(self, path: Path, head: str) -> bool:
        """Rows of numbers alone: eight or eleven, or as many as a header names that has those of a pose."""
        if path.suffix.lower() not in SUFFIXES:
            return False
        first = [cells for _, cells in islice(rows(head), 1)]
        if not first or not all(map(is_number, first[0])):
            return False
        return _columns(head) is not None or len(first[0]) in (1 + len(TUM), 1 + len(VINS))

    def _read(self, path: Path) -> ToolPoses:
        text = read_text(path)
        given = list(rows(text))
        order, unit = _columns(text) or (_order(len(given[0][1]) if given else 0), None)
        least = 1 + max(order)
        for where, cells in given:
            if len(cells) < least:
                raise InputError(f"{least} numbers were expected in {where}, found {len(cells)}; export the trajectory again.")
        stamps = [exactly(cells[0], where) for where, cells in given]
        values = [numbers_in([cells[k] for k in order], where) for where, cells in given]
        names = tuple(cells[0] for _, cells in given)
        table = np.array(values).reshape(-1, len(TUM))
        quaternions = torch.from_numpy(table[:, [6, 3, 4, 5]])
        length = quaternions.norm(dim=-1)
        kept = length > 0
        for k in torch.nonzero(kept & ((length - 1).abs() > ROUNDED)).flatten()[:1].tolist():
            raise InputError(
                f"Quaternions of length 1 were expected, found one of length {float(length[k]):.3g} in {given[k][0]}; export the "
                "trajectory again."
            )
        # Trackers write zeros where they have lost the body.
        held = torch.nonzero(kept).flatten().tolist()
        rotations = rotation_from_file(quaternions[kept]).numpy()
        poses = rigid(list(rotations), list(table[held, :3]), [names[k] for k in held]).inverse()
        second = UNITS_S[unit or _unit_of(stamps)]
        return ToolPoses(
            tuple(names[k] for k in held),
            poses,
            LengthUnit.METRES,
            keys=Keys.TIMES,
            moments=tuple(stamps[k] * second for k in held),
        )


def _columns(text: str) -> tuple[tuple[int, ...], str | None] | None:
    """Where a header has the pose, and its unit of time; None without such a header."""
    for line in comments(text):
        cells = BETWEEN.split(line.strip().strip(",;"))
        named = [cell for cell in cells if not cell.startswith("[")]
        for columns in (TUM, EUROC, SHORT):
            if set(columns) <= set(named):
                unit = next((cell for cell in cells[1:2] if cell in UNITS_S), None)
                return tuple(named.index(name) for name in columns), unit
    return None


def _order(count: int) -> tuple[int, ...]:
    """Where rows of so many columns without a header have the pose, in the order of TUM's."""
    named = VINS if count == 1 + len(VINS) else TUM
    return tuple(1 + named.index(name) for name in TUM)


def _unit_of(stamps: Sequence[Decimal]) -> str:
    """The unit of times without a header."""
    latest = max(stamps, default=Decimal(0))
    return next((unit for least, unit in SUBDIVIDED if latest >= least), "[s]")
