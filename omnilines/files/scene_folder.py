"""A scene folder as it lies on disk: cameras, poses, segments and lines."""

from dataclasses import dataclass, replace
from pathlib import Path

from camera_models import Calibration, InputError, load
from omnilines.files.lines import read_lines
from omnilines.files.poses import read_poses
from omnilines.files.segments import read_segments
from omnilines.records import ImagePoses, LengthUnit, Lines, Segments

SCENE_TABLES = ("calibration.yaml", "poses.csv", "segments.csv", "lines.csv")
UNIT_KEY = "length_unit"
"""Of the provenance in a scene's calibration.yaml."""


@dataclass(frozen=True)
class SceneTables:
    """What is known of a scene."""

    cameras: Calibration
    poses: ImagePoses
    segments: Segments
    lines: Lines


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
    tables = SceneTables(calibration, read_poses(place / poses), read_segments(place / segments), known)
    if not {*tables.poses.images} & {*tables.segments.images}:
        raise InputError(
            f"{place}: {poses} and {segments} were expected to be of the same photos, found {tables.poses.images[0]} in one and "
            f"{tables.segments.images[0]} in the other; name a folder as it was written."
        )
    return tables
