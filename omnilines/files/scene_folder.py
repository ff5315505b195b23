"""A scene folder as it lies on disk: cameras, poses, segments and lines."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, InputError, load
from omnilines.files.lines import read_lines
from omnilines.files.poses import read_poses
from omnilines.files.segments import read_segments
from omnilines.records import ImagePoses, LengthUnit, Lines, Segments

SCENE_TABLES = ("calibration.yaml", "poses.csv", "segments.csv", "lines.csv")
UNIT_KEY = "length_unit"
UP_KEY = "up"
"""Of the provenance in a scene's calibration.yaml."""
Z_UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class SceneTables:
    """What is known of a scene."""

    cameras: Calibration
    poses: ImagePoses
    segments: Segments
    lines: Lines
    up: tuple[float, float, float] = Z_UP
    """The direction (unit) of the world that is up."""


def read_scene(folder: str | Path) -> SceneTables:
    """The scene that `reconstruct` or `adjust` wrote into a folder; raises InputError where a table is missing or damaged,
    or poses are of other photos than segments."""
    place = Path(folder)
    absent = [name for name in SCENE_TABLES if not (place / name).is_file()]
    if absent:
        raise InputError(
            f"{place} was expected to be a folder that reconstruct or adjust wrote, with {', '.join(SCENE_TABLES)}, found no "
            f"{absent[0]} in it; name such a folder."
        )
    cameras, poses, segments, lines = SCENE_TABLES
    calibration = load(place / cameras)
    unit = LengthUnit.OPEN if calibration.provenance.get(UNIT_KEY) == LengthUnit.OPEN.sign else LengthUnit.METRES
    known = replace(read_lines(place / lines), unit=unit)
    up = stated_up(calibration.provenance, place / cameras) or Z_UP
    tables = SceneTables(calibration, read_poses(place / poses), read_segments(place / segments), known, up)
    if not {*tables.poses.images} & {*tables.segments.images}:
        raise InputError(
            f"{place}: {poses} and {segments} were expected to be of the same photos, found {tables.poses.images[0]} in one and "
            f"{tables.segments.images[0]} in the other; name a folder as it was written."
        )
    return tables


def stated_up(provenance: Mapping[str, Any], where: Path) -> tuple[float, float, float] | None:
    """None where the file does not say; raises InputError where it says what is no direction."""
    if UP_KEY not in provenance:
        return None
    said = provenance[UP_KEY]
    numbers = isinstance(said, list | tuple) and len(said) == 3 and all(isinstance(value, int | float) for value in said)
    length = float(np.linalg.norm(said)) if numbers else 0.0
    if not (numbers and np.isfinite(length) and length > 0):
        raise InputError(
            f"{where}: `{UP_KEY}` in `provenance` was expected to be three numbers, a direction, found {said}; correct "
            "it, or take it out, which stands for z."
        )
    x, y, z = (float(value) / length for value in said)
    return x, y, z
