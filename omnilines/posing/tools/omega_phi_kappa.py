"""Tables of omega, phi and kappa: Pix4D's calibrated_external_camera_parameters.txt, Metashape's text file of cameras.

X, Y, Z are the camera's centre. R = Rx(omega) Ry(phi) Rz(kappa), angles in degrees, takes points of a camera with x right, y up
and z backwards to the world, which is that of a map: metres, z up. Pix4D, "How are the internal and external camera parameters
defined?"; K. Kraus, Photogrammetry, 2007.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from camera_models import InputError
from camera_models.formats.disk import read_text
from camera_models.pose import Pose, rotation_from_vector
from omnilines.posing.readings import AXES
from omnilines.posing.tools.contract import PoseFile, ToolPoses, rigid
from omnilines.posing.tools.rows import BETWEEN, MARK, numbers_in
from omnilines.records import LengthUnit

COLUMNS = ("x", "y", "z", "omega", "phi", "kappa")
NAMED = ("imagename", "photoid", "label", "filename", "name", "image")
SUFFIXES = (".txt", ".csv", ".opk")
SYSTEM = "coordinatesystem:"
GEOGRAPHIC = ("geogcs", "geogcrs", "geodcrs", "geoccs")


class OmegaPhiKappaPoses(PoseFile):
    """A table whose header names omega, phi and kappa."""

    TITLE = "a table of omega, phi, kappa (Pix4D, Metashape)"

    def recognises(self, path: Path, head: str) -> bool:
        """Text with such a header."""
        return path.suffix.lower() in SUFFIXES and any(map(_places, head.splitlines()[:20]))

    def _read(self, path: Path) -> ToolPoses:
        lines = read_text(path).lstrip("\ufeff").splitlines()
        header, columns = _header(lines)
        _require_map(lines[:header])
        names, values = [], []
        for index, line in enumerate(lines[header + 1 :], header + 2):
            if not line.strip() or line.lstrip().startswith(MARK):
                continue
            cells = _cells(line, columns.count)
            if len(cells) < columns.count:
                raise InputError(
                    f"{columns.count} columns were expected in line {index}, found {len(cells)}; export the poses again."
                )
            names.append(cells[columns.name].strip('"').replace("\\", "/"))
            values.append(numbers_in([cells[k] for k in columns.numbers], f"line {index}"))
        table = np.array(values).reshape(-1, len(COLUMNS))
        theirs = rigid(list(_rotations(np.radians(table[:, 3:]))), list(table[:, :3]), names).inverse()
        ours = Pose(AXES @ theirs.rotation, theirs.translation @ AXES.mT)
        return ToolPoses(tuple(names), ours, LengthUnit.METRES, up=(0.0, 0.0, 1.0))


@dataclass(frozen=True)
class _Columns:
    """Where a header has the name and the six numbers, and how many it has."""

    name: int
    numbers: tuple[int, ...]
    count: int


def _header(lines: Sequence[str]) -> tuple[int, _Columns]:
    """The first line that names the columns, and these."""
    for index, line in enumerate(lines):
        columns = _places(line)
        if columns is not None:
            return index, columns
    raise InputError(f"A header with a name, {', '.join(COLUMNS)} was expected, found none; export the poses again.")


def _places(line: str) -> _Columns | None:
    """The columns that a header names; None where a line is none."""
    cells = [cell.lower() for cell in BETWEEN.split(line.strip(f"{MARK} \t\ufeff").strip(",;")) if cell]
    name = next((cells.index(name) for name in NAMED if name in cells), None)
    if name is None or not set(COLUMNS) <= set(cells):
        return None
    return _Columns(name, tuple(cells.index(column) for column in COLUMNS), len(cells))


def _require_map(before: Sequence[str]) -> None:
    """Raises InputError where the lines before the header say that X and Y are degrees."""
    for line in before:
        said = line.strip(f"{MARK} ").lower().replace(" ", "")
        if said.startswith(SYSTEM) and said.removeprefix(SYSTEM).startswith(GEOGRAPHIC):
            raise InputError(
                "A projected or local coordinate system was expected, found a geographic one, whose X and Y are degrees; export "
                "the cameras in another system, or as XML."
            )


def _cells(line: str, count: int) -> list[str]:
    """A row; where blanks part it, a name with blanks is one cell."""
    for mark in ("\t", ",", ";"):
        if line.count(mark) >= count - 1:
            return [cell.strip() for cell in line.split(mark)]
    cells = line.split()
    extra = max(len(cells) - count, 0)
    return [" ".join(cells[: extra + 1]), *cells[extra + 1 :]]


def _rotations(angles_rad: np.ndarray) -> Sequence[np.ndarray]:
    """Rx(omega) Ry(phi) Rz(kappa) of n rows."""
    turns = [rotation_from_vector(torch.from_numpy(angles_rad[:, k, None] * np.eye(3)[k])) for k in range(3)]
    return list((turns[0] @ turns[1] @ turns[2]).numpy())
