"""Directions in which the lines of each photo meet, gravity, and Manhattan frames: `directions`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, CameraModel, InputError
from camera_models.pose import Pose
from camera_models.typed import typed
from omnilines.files import write_covariance, write_poses
from omnilines.files.directions import write_directed_arcs, write_directions
from omnilines.files.sets import claimed
from omnilines.options import require_ranges
from omnilines.pipelines.pages import claimed_report
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.provenance import provenance
from omnilines.records import Detail, ImagePoses
from omnilines.structure.circles import Circles
from omnilines.structure.manhattan import manhattan_frame
from omnilines.structure.meeting import Meeting, meeting_directions
from omnilines.structure.options import DirectionsOptions
from omnilines.structure.upright import level_axes, vertical_direction

DIRECTIONS, ARCS, POSES, COVARIANCE = "directions.csv", "arcs.csv", "poses.csv", "covariance.npz"
RIGHT, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
"""Of a photo, camera frame."""


class Wanted(Enum):
    """What is asked of photos."""

    ALL = "direction in which lines meet"
    FRAME = "Manhattan frame"
    VERTICAL = "vertical direction"


@dataclass(frozen=True)
class FoundDirections:
    """The directions of one photo; none where none stands out."""

    arcs: FoundArcs
    names: tuple[str, ...]
    """1, 2, ... of all directions, that with the most arcs first; x, y, z of a frame; up."""
    meeting: Meeting
    cam_from_world: Float[np.ndarray, "3 3"] | None = None
    """To the camera frame from a world with z up, where a frame or the vertical was asked for."""
    covariance: Float[np.ndarray, "3 3"] | None = None
    """Of its rotation vector from the left, rad^2; the turn about the vertical is without error where it is a choice."""

    def __repr__(self) -> str:
        return f"FoundDirections({self.arcs.photo.name!r}, directions={len(self)}, arcs={len(self.arcs)})"

    def __len__(self) -> int:
        return len(self.meeting)

    @property
    def tilt_rad(self) -> float | None:
        """Angle between the photo's up and the world's."""
        return None if self.cam_from_world is None else tilt_of(self.cam_from_world[:, 2])


@dataclass(frozen=True)
class PhotoDirections:
    """The directions of a set of photos."""

    arcs: PhotoArcs
    photos: tuple[FoundDirections, ...]
    """Of every photo that can be used, in the order of `arcs.used`."""
    wanted: Wanted
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What they were made from."""

    def __repr__(self) -> str:
        return f"PhotoDirections(photos={len(self.photos)}, directions={len(self)})"

    def __len__(self) -> int:
        return sum(map(len, self.photos))

    @property
    def poses(self) -> ImagePoses | None:
        """Of the photos with a frame, or a vertical, all at one place, as that of a photo alone is open; None where there are
        none."""
        known = [one for one in self.photos if one.cam_from_world is not None]
        if not known:
            return None
        turns = torch.as_tensor(np.stack([one.cam_from_world for one in known if one.cam_from_world is not None]))
        covariance = np.zeros((len(known), 6, 6))
        covariance[:, :3, :3] = np.stack([one.covariance for one in known if one.covariance is not None])
        names = tuple(one.arcs.photo.name for one in known)
        cameras = tuple(one.arcs.camera for one in known)
        return ImagePoses(names, Pose(turns, torch.zeros(len(known), 3, dtype=turns.dtype)), cameras, covariance)

    @property
    def details(self) -> tuple[Detail, ...]:
        """Photos that are skipped, and those in which nothing stands out."""
        none = [one.arcs.photo.name for one in self.photos if not len(one)]
        said = f"no {self.wanted.value} stands out from chance"
        return (*self.arcs.skipped_details, *(Detail(name, f"{name}: {said}.") for name in none))

    @property
    def provenance(self) -> dict[str, Any]:
        """Software, and what the directions were made from."""
        return provenance(self.inputs)

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        return (DIRECTIONS, ARCS, *((POSES, COVARIANCE) if self.poses is not None else ()))

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write directions.csv, arcs.csv and, where rotations are known, poses.csv and covariance.npz into a folder, which is
        made; the files written."""
        with claimed(folder, self.file_names, by="directions") as out:
            rows = [(one, k) for one in self.photos for k in range(len(one))]
            write_directions(
                out / DIRECTIONS,
                images=[one.arcs.photo.name for one, _ in rows],
                names=[one.names[k] for one, k in rows],
                direction=np.array([one.meeting.direction[k] for one, k in rows]).reshape(-1, 3),
                covariance=np.array([one.meeting.covariance[k] for one, k in rows]).reshape(-1, 3, 3),
                arcs=np.array([one.meeting.members[k] for one, k in rows], dtype=np.int64),
            )
            write_directed_arcs(
                out / ARCS,
                images=[one.arcs.photo.name for one in self.photos for _ in range(len(one.arcs))],
                names=[(*one.names, "")[k] for one in self.photos for k in one.meeting.direction_of.tolist()],
                endpoints_px=np.concatenate([one.arcs.endpoints_px for one in self.photos]),
            )
            if self.poses is not None:
                write_poses(out / POSES, self.poses)
                write_covariance(out / COVARIANCE, self.poses)
        return tuple(out / name for name in self.file_names)

    @typed
    def report(self, path: str | Path, *, plots: str | Path | None = None) -> Path:
        """Write the report, one self-contained HTML file; its path. Its figures
        are written as PNG and SVG into the folder `plots`, where one is given."""
        from omnilines.pages.directions import directions_sections
        from omnilines.report import write_report

        with claimed_report(path, plots):
            return write_report(path, "Directions", directions_sections(self))


@typed
def directions(
    arcs: PhotoArcs,
    *,
    orthogonal: bool = False,
    vertical: bool = False,
    options: DirectionsOptions = DirectionsOptions(),
    progress: ProgressCallback = silent,
) -> PhotoDirections:
    """The directions in which the lines of each photo meet, by its arcs alone, in the camera frame (x right, y down, z forward).

    `orthogonal`: three at right angles (a Manhattan frame), with the rotation of the photo; `vertical`: only that which is
    vertical, by photos that were held about upright, with a rotation that is right but for a turn about it. A photo in which
    none stands out from chance has none.

    Raises InputError where both are asked for, or an option is out of its range.

        >>> found = ol.directions(ol.extract("room/", ol.load("room/calibration.yaml")), orthogonal=True)
        >>> len(found.photos), found.photos[0].names
        (6, ('x', 'y', 'z'))
    """
    require_one(orthogonal, vertical)
    require_ranges(options)
    wanted = Wanted.FRAME if orthogonal else Wanted.VERTICAL if vertical else Wanted.ALL

    def look(found: FoundArcs) -> FoundDirections:
        """The directions of one photo."""
        return _found(found, arcs.cameras[found.camera], wanted, options)

    photos = on_all_cores(look, arcs.used, "finding directions", progress)
    return PhotoDirections(arcs, tuple(photos), wanted, {**arcs.inputs, "wanted": wanted.value, "directions": options})


def require_one(orthogonal: bool, vertical: bool) -> None:
    """Raises InputError where both are asked for."""
    if orthogonal and vertical:
        raise InputError("One of `orthogonal` and `vertical` was expected, found both; a frame has the vertical as its z.")


def _found(arcs: FoundArcs, model: CameraModel, wanted: Wanted, options: DirectionsOptions) -> FoundDirections:
    circles = circles_of(arcs, model)
    if wanted is Wanted.FRAME:
        frame = manhattan_frame(circles, options)
        if frame is None:
            return FoundDirections(arcs, (), Meeting.none(len(arcs)))
        return FoundDirections(arcs, ("x", "y", "z"), frame.axes, frame.cam_from_world, frame.covariance)
    if wanted is Wanted.ALL:
        meeting = meeting_directions(circles, options)
        return FoundDirections(arcs, tuple(str(k + 1) for k in range(len(meeting))), meeting)
    vertical = vertical_of(circles, options)
    if vertical is None:
        return FoundDirections(arcs, (), Meeting.none(len(arcs)))
    up = vertical.direction[0]
    return FoundDirections(arcs, ("up",), vertical, level_axes(RIGHT, up).T, turn_covariance(up, vertical.covariance[0]))


def vertical_of(circles: Circles, options: DirectionsOptions = DirectionsOptions()) -> Meeting | None:
    """The vertical alone, upwards, of a photo that is held about upright; None where none stands out or it is not clear which."""
    meeting = meeting_directions(circles, options)
    upright = vertical_direction(meeting.direction, meeting.members, UP[None], options.upright)
    return None if upright is None or upright.family is None else meeting.only(upright.family, upright.up)


def world_verticals(
    found: Sequence[FoundArcs], poses: ImagePoses, cameras: Calibration, options: DirectionsOptions, progress: ProgressCallback
) -> Float[np.ndarray, "m 3"]:
    """Where up is in the world by the vertical that each photo with a pose shows, of those that show one."""
    row = {name: k for k, name in enumerate(poses.images)}
    posed = [one for one in found if one.photo.name in row]

    def look(one: FoundArcs) -> Meeting | None:
        """The vertical of one photo."""
        return vertical_of(circles_of(one, cameras[one.camera]), options)

    verticals = zip(posed, on_all_cores(look, posed, "finding the vertical", progress), strict=True)
    rotation = poses.cam_from_world.rotation.numpy()
    ups = [one.direction[0] @ rotation[row[arcs.photo.name]] for arcs, one in verticals if one is not None]
    return np.array(ups).reshape(-1, 3)


def turn_covariance(up: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Of the rotation vector that goes with a unit vector of this covariance, without error about it."""
    moves = np.cross(up, np.eye(3))
    turned: Float[np.ndarray, "3 3"] = moves.T @ covariance @ moves
    return turned


def tilt_of(up: Float[np.ndarray, "3"]) -> float:
    """Angle (rad) between the photo's up and a unit vector that is up in the camera frame."""
    return math.acos(min(max(float(up @ UP), -1.0), 1.0))


def circles_of(arcs: FoundArcs, model: CameraModel) -> Circles:
    """The great circles of the arcs of a photo."""
    ends = torch.as_tensor(arcs.endpoints_px)
    with torch.no_grad():
        bearings, by_pixel = model.unproject(ends)[0].numpy(), model.unproject_jacobian(ends).numpy()
    return Circles.of_arcs(bearings, by_pixel, arcs.covariance_px2)
