"""Photos turned level: the rotation of each that makes the vertical of its lines upright, with its covariance.

A level view looks along the ground to where the optical axis points, with its y axis straight down. What the photos of a rig show
at one instant counts together.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from camera_models import Calibration, GeometryError
from omnilines.extraction import ExtractionOptions
from omnilines.files import Photo
from omnilines.pipelines.arcs import extract
from omnilines.pipelines.directions import circles_of, tilt_of, turn_covariance, vertical_of
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.progress import ProgressCallback, on_all_cores
from omnilines.records import Detail
from omnilines.structure.circles import Circles
from omnilines.structure.meeting import largest_sigma
from omnilines.structure.options import DirectionsOptions
from omnilines.structure.upright import level_axes

FORWARD = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Level:
    """How a photo, or those of a rig at one instant, are turned level."""

    level_from_axis: Float[np.ndarray, "3 3"]
    """From the frame that looks along the optical axis to x right, y straight down and z along the ground ahead."""
    covariance: Float[np.ndarray, "3 3"]
    """Of its rotation vector from the left, rad^2; none about the vertical, as where a level view looks is a choice."""
    tilt_rad: float
    """Angle between the vertical and the photo's up."""
    arcs: int
    """That show the vertical."""

    @property
    def sigma_rad(self) -> float:
        """Largest standard deviation of the vertical."""
        return float(largest_sigma(self.covariance[None])[0])

    @staticmethod
    def of_circles(circles: Circles, options: DirectionsOptions) -> "Level | None":
        """From the circles of all arcs in the frame that looks along the optical axis; None where no vertical is found."""
        vertical = vertical_of(circles, options)
        if vertical is None:
            return None
        up = vertical.direction[0]
        x, north, _ = level_axes(np.cross(FORWARD, up), up)
        turn = np.stack([x, -up, north])
        covariance = turn @ turn_covariance(up, vertical.covariance[0]) @ turn.T
        return Level(turn, covariance, tilt_of(up), int(vertical.members[0]))


@dataclass(frozen=True)
class Levels:
    """The photos that are turned level, and those that are left out."""

    found: Mapping[str, Level]
    """By the name of the photo or the instant."""
    left_out: tuple[Detail, ...]


def levels_of(
    groups: Mapping[str, Mapping[str, Photo]],
    cameras: Calibration,
    axis_from_camera: Mapping[str, Float[np.ndarray, "3 3"]],
    *,
    work: str | Path | None,
    extraction: ExtractionOptions,
    options: DirectionsOptions,
    progress: ProgressCallback,
) -> Levels:
    """How each group of photos by camera, those of one instant, or each photo alone, is turned level. Arcs are kept in the folder
    `work`, where one is given.

    Raises InputError where no photo of a camera can be used, GeometryError where no photo shows
    the vertical.
    """
    arcs = _arcs_of(groups, cameras, extraction, work, progress)

    def look(name: str) -> Level | None:
        """The level of one group."""
        used = [one for one in (arcs[photo.name] for photo in groups[name].values()) if one.reason is None]
        parts = [circles_of(one, cameras[one.camera]).turned(axis_from_camera[one.camera]) for one in used]
        return Level.of_circles(Circles.joined(parts), options) if parts else None

    found = dict(zip(groups, on_all_cores(look, list(groups), "finding the vertical", progress), strict=True))
    if not any(found.values()):
        raise GeometryError(
            f"Lines that show the vertical were expected, found none in {len(found)} photos; hold the camera upright to "
            "30 degrees, or leave `upright` out."
        )
    none = [name for name, level in found.items() if level is None]
    left_out = tuple(Detail(name, f"{name} is left out: {_reason(groups[name], arcs)}") for name in none)
    return Levels({name: level for name, level in found.items() if level is not None}, left_out)


def _arcs_of(
    groups: Mapping[str, Mapping[str, Photo]],
    cameras: Calibration,
    extraction: ExtractionOptions,
    work: str | Path | None,
    progress: ProgressCallback,
) -> dict[str, FoundArcs]:
    """By photo. A table of poses may say of which camera each is, so those of each camera are looked at by themselves."""
    found: dict[str, FoundArcs] = {}
    for camera in dict.fromkeys(camera for group in groups.values() for camera in group):
        own = [group[camera] for group in groups.values() if camera in group]
        estimates = {camera: cameras.estimates[camera]} if camera in cameras.estimates else {}
        alone = Calibration({camera: cameras[camera]}, estimates)
        arcs = extract(own, alone, options=extraction, work=work, progress=progress)
        found.update({one.photo.name: one for one in arcs.photos})
    return found


def _reason(group: Mapping[str, Photo], arcs: Mapping[str, FoundArcs]) -> str:
    """Why there is no level, as the end of a sentence."""
    skipped = [arcs[photo.name].reason for photo in group.values()]
    return next((reason for reason in skipped if reason is not None), "no vertical stands out in its lines.")
