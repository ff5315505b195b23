"""The contract of a file in which another tool keeps poses of photos."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from enum import StrEnum
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float

from camera_models import InputError
from camera_models.pose import Pose
from camera_models.rotations import nearest_rotation
from omnilines.records import LARGEST_M, LengthUnit

ROUNDED = 1e-3
"""By which entries of R'R may differ from those of I: files round, and some tools keep single precision."""


class Keys(StrEnum):
    """What photos find their poses in a file by."""

    NAMES = "names"
    TIMES = "times"
    """Of a trajectory: seconds that photos are named by."""
    NUMBERS = "numbers"
    """Of a trajectory: the number of the frame, which photos are named by."""


@dataclass(frozen=True)
class ToolPoses:
    """`cam_from_world` of photos under the names that the tool has for them; of a rig's trajectory, `rig_from_world`."""

    names: tuple[str, ...]
    cam_from_world: Pose
    unit: LengthUnit
    lost: Mapping[str, str] = field(default_factory=dict)
    """Of each photo in the file without a pose the reason, as the end of a sentence."""
    notes: tuple[str, ...] = ()
    up: tuple[float, float, float] | None = None
    """The direction (unit) of its world that is up, where the file says so."""
    keys: Keys = Keys.NAMES
    moments: tuple[Decimal, ...] = ()
    """Of a trajectory, the times (s) or numbers of its rows."""


class PoseFile(ABC):
    """One file format; its cameras are not read here but by `camera_models.formats`."""

    TITLE: ClassVar[str]
    """In messages, with the usual name of the file."""

    @abstractmethod
    def recognises(self, path: Path, head: str) -> bool:
        """Whether a file is of this format, by its name and the first 64 KiB of it (as Latin-1 text)."""

    @abstractmethod
    def _read(self, path: Path) -> ToolPoses:
        """The poses of one file."""

    def read(self, path: Path) -> ToolPoses:
        """The poses of one file. Raises InputError with the file, what was expected in it and what was found."""
        try:
            found = self._read(path)
        except InputError as error:
            raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None
        twice = sorted(name for name, count in Counter(found.names).items() if count > 1)
        if twice:
            one = "photo" if found.keys is Keys.NAMES else "row"
            raise InputError(f"{path}: each {one} was expected once, found {twice[0]} several times; export the poses again.")
        if not found.names:
            todo = "align the photos there first" if found.keys is Keys.NAMES else "export it again"
            raise InputError(f"{path}: poses were expected in {self.TITLE}, found none; {todo}.")
        return found


def rigid(
    rotations: Sequence[Float[np.ndarray, "3 3"]], translations: Sequence[Float[np.ndarray, "3"]], names: Sequence[str]
) -> Pose:
    """Of rotations that are so but for rounding, which is taken out. Raises InputError with the photo of one that is not."""
    rotation = torch.from_numpy(np.array(rotations, dtype=np.float64).reshape(-1, 3, 3))
    translation = torch.from_numpy(np.array(translations, dtype=np.float64).reshape(-1, 3))
    off = (rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().flatten(1).amax(-1)
    for index in torch.nonzero((off > ROUNDED) | (torch.linalg.det(rotation) < 0)).flatten()[:1].tolist():
        kind = "a reflection" if float(off[index]) <= ROUNDED else "a matrix whose columns are not orthonormal"
        raise InputError(f"A rotation was expected of {names[index]}, found {kind}; export the poses again.")
    for index in torch.nonzero((translation.abs() > LARGEST_M).any(-1)).flatten()[:1].tolist():
        raise InputError(
            f"Translations up to {LARGEST_M:g} were expected, found {translation[index].tolist()} of {names[index]}; export the "
            "poses again."
        )
    return Pose(nearest_rotation(rotation), translation)
