"""Poses of photos from a trajectory, whose rows have a time or the number of a frame in place of a photo's name."""

import math
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, InputError
from camera_models.pose import Pose
from omnilines.geometry.between_poses import left_out_errors, poses_between
from omnilines.posing.body import mounts
from omnilines.posing.instant_names import instants
from omnilines.posing.options import GivenOptions
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.photo_times import NANOSECOND_S, number_of, time_of, unit_s
from omnilines.posing.tools import Keys, ToolPoses
from omnilines.records import ImagePoses

TAKEN_FOR_METRES = (
    "Lengths of the trajectory are read as metres; SLAM with one camera alone has a scale of its own, which `scale_from` "
    "PHOTO,PHOTO:METRES gives."
)
LEAST_MM, LEAST_DEG = 0.01, 1e-4
"""Smaller errors are as good as none."""


def poses_from_trajectory(
    path: Path,
    own: ToolPoses,
    photos: Sequence[str],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    *,
    stamps_ns: Mapping[str, int],
    body: Path | None = None,
    options: GivenOptions = GivenOptions(),
) -> PhotoPoses:
    """`cam_from_world` of photos that are named by their time or number, or whose stamps are known.

    The trajectory is that of the body on which the file `body` places the cameras; without one that of the camera, with a rig
    that of the rig frame. Between two rows up to `max_gap_s` apart poses are interpolated, and a note says how far that errs.
    Raises InputError where no photo has a pose.
    """
    by_time, mounted = own.keys is Keys.TIMES, mounts(body, cameras)
    moments = _times_s(own, photos, stamps_ns) if by_time else {photo: number_of(photo) for photo in photos}
    named = {photo: moment for photo, moment in moments.items() if moment is not None}
    lost = {
        photo: f"{photo} has no pose: its name holds no {'time' if by_time else 'number'}, and {path.name} has its poses by them."
        for photo in photos
        if photo not in named
    }
    later_s = [mounted[camera_of[photo]].later_s for photo in named]
    kept, poses, reasons, notes = (
        _by_time(own, named, later_s, path.name, options) if by_time else _by_number(own, named, path.name)
    )
    if not kept:
        raise InputError(_none(path, own, photos))
    lost |= reasons
    names = [camera_of[photo] for photo in kept]
    cam_from_world = Pose.stack([mounted[name].cam_from_body for name in names]) @ poses
    frame_of = instants(photos, camera_of)
    frames = tuple(frame_of[photo] for photo in kept) if cameras.rig else None
    whose = "rig frame" if cameras.rig else "camera"
    if not cameras.rig:
        notes = (TAKEN_FOR_METRES, *notes)
    if body is None:
        notes = (
            f"The trajectory is read as that of the {whose}; where it is that of an IMU, say where this sits (`body`).",
            *notes,
        )
    table = ImagePoses(tuple(kept), cam_from_world, tuple(names), None, frames)
    return PhotoPoses(table, {photo: lost[photo] for photo in photos if photo in lost}, notes, unit=own.unit, up=own.up)


def _none(path: Path, own: ToolPoses, photos: Sequence[str]) -> str:
    """What is to be said where the trajectory has no pose of any photo."""
    what, example = ("time", "1403636579763555584.png") if own.keys is Keys.TIMES else ("number", "0000000123.png")
    first, last = min(own.moments), max(own.moments)
    given = photos[0] if photos else "none"
    return (
        f"{path}: photos named by a {what} from {first.normalize():f} to {last.normalize():f} (as {example} is) were expected, "
        f"found {given}; name the photos so, or give their poses as poses.csv (frames of a bag have times of their own)."
    )


def _times_s(own: ToolPoses, photos: Sequence[str], stamps_ns: Mapping[str, int]) -> dict[str, Decimal | None]:
    """When photos were taken: by their stamps, else by their names, in the unit in which most of these lie in the trajectory."""
    named = {photo: time_of(photo) for photo in photos if photo not in stamps_ns}
    unit = unit_s([time for time in named.values() if time is not None], min(own.moments), max(own.moments))
    times = {photo: None if time is None else time * unit for photo, time in named.items()}
    return {photo: Decimal(stamps_ns[photo]) * NANOSECOND_S if photo in stamps_ns else times[photo] for photo in photos}


_Posed = tuple[list[str], Pose, dict[str, str], tuple[str, ...]]
"""Photos, their body_from_world, why others have none, and notes."""


def _by_number(own: ToolPoses, moments: Mapping[str, Decimal], file: str) -> _Posed:
    row_of = {moment: row for row, moment in enumerate(own.moments)}
    kept = [photo for photo, moment in moments.items() if moment in row_of]
    lost = {
        photo: f"{photo} has no pose: {file} has no frame {moment}." for photo, moment in moments.items() if moment not in row_of
    }
    return kept, own.cam_from_world[[row_of[moments[photo]] for photo in kept]], lost, ()


def _by_time(
    own: ToolPoses, moments: Mapping[str, Decimal], later_s: Sequence[float], file: str, options: GivenOptions
) -> _Posed:
    order = sorted(range(len(own.moments)), key=own.moments.__getitem__)
    start = own.moments[order[0]]
    rows_s = np.array([float(own.moments[k] - start) for k in order])
    times_s = np.array([float(moment - start) for moment in moments.values()]) + np.array(later_s)
    world_from_body = own.cam_from_world[order].inverse()
    before, gap_s = _rows_around(rows_s, times_s)
    after = np.minimum(before + 1, len(rows_s) - 1)
    nearest = np.where(np.abs(rows_s[after] - times_s) < np.abs(rows_s[before] - times_s), after, before)
    same = np.abs(rows_s[nearest] - times_s) <= options.same_time_s
    between = ~same & (gap_s <= options.max_gap_s)
    poses = poses_between(world_from_body, rows_s, times_s, before)
    turned, placed = poses.rotation.clone(), poses.translation.clone()
    turned[same], placed[same] = world_from_body.rotation[nearest[same]], world_from_body.translation[nearest[same]]
    good = same | between
    photos = list(moments)
    lost = {
        photo: f"{photo} has no pose: {_why(gap, file, options.max_gap_s)}."
        for photo, gap, one in zip(photos, gap_s, good, strict=True)
        if not one
    }
    kept = [photo for photo, one in zip(photos, good, strict=True) if one]
    rows = torch.from_numpy(np.flatnonzero(good))
    notes = _interpolated(world_from_body, rows_s, times_s[between], before[between], options.max_gap_s)
    return kept, Pose(turned[rows], placed[rows]).inverse(), lost, notes


def _why(gap_s: float, file: str, most_s: float) -> str:
    if math.isinf(gap_s):
        return f"it was taken before or after the trajectory of {file}"
    return f"the rows of {file} around it are {gap_s:.2g} s apart, more than the {most_s:g} s up to which poses are interpolated"


def _rows_around(rows_s: Float[np.ndarray, " n"], times_s: Float[np.ndarray, " m"]) -> tuple[np.ndarray, Float[np.ndarray, " m"]]:
    """Of each time the last row before it, and how far apart the rows around it are (s): infinitely where it lies outside."""
    after = np.searchsorted(rows_s, times_s, side="right")
    inside = (after > 0) & (after < len(rows_s))
    before = np.clip(after - 1, 0, max(len(rows_s) - 2, 0))
    gap = rows_s[np.minimum(before + 1, len(rows_s) - 1)] - rows_s[before]
    return before, np.where(inside, gap, np.inf)


def _interpolated(
    world_from_body: Pose, rows_s: Float[np.ndarray, " n"], times_s: Float[np.ndarray, " m"], before: np.ndarray, most_s: float
) -> tuple[str, ...]:
    """How far interpolation errs, as rows that are left out tell it."""
    if not len(times_s):
        return ()
    said = f"{len(times_s)} photos were taken between rows of the trajectory, and their poses are interpolated"
    errors = left_out_errors(world_from_body, rows_s, times_s, before, 2 * most_s)
    if errors is None:
        return (f"{said}; its rows are too far apart to tell how well.",)
    turned_deg, moved_mm = math.degrees(errors[0]), 1e3 * errors[1]
    off = f"{_told(moved_mm, LEAST_MM)} mm and {_told(turned_deg, LEAST_DEG)} degrees"
    return (f"{said}: as rows that are left out tell, {off} off (median).",)


def _told(value: float, least: float) -> str:
    return f"less than {least:g}" if value < least else f"{value:.2g}"
