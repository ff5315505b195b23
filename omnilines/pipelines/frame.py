"""The frame that a scene is written in: its unit of length, and which way is up.

Structure from motion without a rig leaves the unit open, and the frame wherever the first photo stands. A known distance between
two photos gives metres; the families of parallel lines, and photos that were taken about upright, give up and level.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
import torch
from jaxtyping import Float

from camera_models import InputError
from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.pipelines.options import SceneOptions
from omnilines.posing.from_trajectory import TAKEN_FOR_METRES
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.posing.sfm import OPEN_SCALE
from omnilines.records import LARGEST_M, ImagePoses, LengthUnit, Lines
from omnilines.structure.families import Families
from omnilines.structure.upright import agreed_up, better_known, photos_up, upright_from_world, vertical_family

SFM = "sfm"
"""The source whose poses are in the frame of a photo."""
UNDECIDED = (
    "No family of parallel lines is clearly vertical, and the photos by themselves do not agree on a vertical: the world is "
    "the frame of the first photo."
)
BY_PHOTOS = "No family of lines is clearly vertical: up is the vertical that most photos show by themselves."


@dataclass(frozen=True)
class KnownDistance:
    """Two photos whose distance is known."""

    first: str
    second: str
    metres: float


@dataclass(frozen=True)
class SceneFrame:
    """Lines, poses and families as they are written, and what is to be said of their frame."""

    lines: Lines
    poses: ImagePoses
    families: Families
    up: tuple[float, float, float]
    """The direction (unit) that is up."""
    notes: tuple[str, ...]


def parse_known_distance(text: str, photos: Sequence[str], scale_is_open: bool) -> KnownDistance:
    """`a,b:2.5` as two of the photos, by name or by its end without folders and suffix, and metres.

    Raises InputError where it is not of this form, names no two photos, or the scale of the poses is not open.
    """
    if not scale_is_open:
        raise InputError(
            "`scale_from` is for poses whose scale is open (`poses` sfm without a rig, a COLMAP model, a trajectory of one "
            "camera), found poses in metres; leave it out."
        )
    pair, _, distance = text.rpartition(":")
    try:
        metres = float(distance.strip().removesuffix("m"))
    except ValueError:
        metres = math.nan
    named = [tuple(_photo(part.strip(), photos) for part in (pair[:k], pair[k + 1 :])) for k, c in enumerate(pair) if c == ","]
    if not named or not 1 / LARGEST_M <= metres <= LARGEST_M:
        raise InputError(
            f"`scale_from` was expected as PHOTO,PHOTO:METRES with a distance above 0 (up to {LARGEST_M:g}), such as "
            f"a.jpg,b.jpg:2.5, found '{text}'."
        )
    first, second = next((both for both in named if None not in both), (None, None))
    if first is None or second is None or first == second:
        raise InputError(
            f"`scale_from` was expected to name two of the photos ({', '.join(photos[:3])}, ...), found '{pair}'; names are "
            "paths relative to the photo folder."
        )
    return KnownDistance(first, second, metres)


def _photo(name: str, photos: Sequence[str]) -> str | None:
    if name in photos:
        return name
    alike = [photo for photo in photos if name in (PurePosixPath(photo).name, PurePosixPath(photo).stem)]
    return alike[0] if len(alike) == 1 else None


def require_poses(known: KnownDistance, posed: PhotoPoses) -> None:
    """Raises InputError where one of the two photos has no pose, or both are at one place."""
    poses = posed.poses
    for name in (known.first, known.second):
        if name not in poses.images:
            why = posed.left_out.get(name, f"{name} has no pose.")
            raise InputError(f"`scale_from` was expected to name photos with poses, found {name}: {why} Name others.")
    if not distance_and_sigma(known, poses)[0] > 0:
        raise InputError(
            f"`scale_from` was expected to name photos from two places, found {known.first} and {known.second} at one place; "
            "name others."
        )


def distance_and_sigma(known: KnownDistance, poses: ImagePoses) -> tuple[float, float]:
    """Distance of the two photos in the unit of the poses, and its standard deviation (NaN where it is not known).

    A left perturbation (w, v) of a pose moves its centre by -R' v; what both have in common is left out of account.
    """
    rows = [poses.images.index(name) for name in (known.first, known.second)]
    a, b = poses.cam_from_world.centre[rows].numpy()
    distance = float(np.linalg.norm(b - a))
    if poses.covariance is None or not distance > 0:
        return distance, math.nan
    along = poses.cam_from_world.rotation[rows].numpy() @ ((b - a) / distance)
    return distance, math.sqrt(max(float(np.einsum("ki,kij,kj->", along, poses.covariance[rows, 3:, 3:], along)), 0.0))


def scene_frame(
    lines: Lines,
    poses: ImagePoses,
    families: Families,
    *,
    source: str,
    unit: LengthUnit,
    stated_up: tuple[float, float, float] | None = None,
    known: KnownDistance | None,
    verticals: Callable[[], Float[np.ndarray, "m 3"]],
    options: SceneOptions,
) -> SceneFrame:
    """Lines and poses in metres where a distance is known, and upright where the frame was that of a photo (sfm).

    `source`, `unit` and `stated_up` are those of `PhotoPoses`; `verticals` finds where up is in the world by the lines of each
    photo alone; it is asked where the world is turned upright. Under a turn and a scale of the world a pose keeps the
    perturbation of its own camera, whose translation is scaled, and a line its chart: S is turned from the left and perturbed
    from the right, and phi compares two lengths.
    """
    notes: tuple[str, ...] = ()
    scale, turn = 1.0, torch.eye(3, dtype=torch.float64)
    if known is not None:
        distance, sigma = distance_and_sigma(known, poses)
        scale, unit = known.metres / distance, LengthUnit.METRES
        notes += (_scaled(known, sigma / distance),)
    elif unit is LengthUnit.OPEN:
        notes += (_open(source),)
    upright = vertical_family(families, poses.cam_from_world, options.structure.upright)
    if source == SFM:
        by_lines = upright
        upright = better_known(by_lines, agreed_up(verticals(), options.structure.upright), options.structure.upright)
        notes += (BY_PHOTOS,) if by_lines is None and upright is not None else ()
    up = photos_up(poses.cam_from_world) if upright is None else upright.up
    if source == SFM and upright is not None:
        turn = upright_from_world(families, upright, poses.cam_from_world, options.structure.upright)
        up = np.array([0.0, 0.0, 1.0])
    elif source == SFM:
        notes += (UNDECIDED,)
    elif upright is None and stated_up is not None:
        up = np.array(stated_up)
    elif (upright is None and source == "table") or up[2] > math.cos(options.frame.z_up_rad):
        up = np.array([0.0, 0.0, 1.0])
    return SceneFrame(
        replace(moved_lines(lines, scale, turn), unit=unit),
        moved_poses(poses, scale, Pose(turn, torch.zeros(3, dtype=torch.float64))),
        families.turned(turn),
        (float(up[0]), float(up[1]), float(up[2])),
        notes,
    )


def moved_lines(lines: Lines, scale: float, turn: torch.Tensor) -> Lines:
    """Lines in the world X' = scale turn X; covariances stay as they are (`scene_frame`)."""
    rotation = turn.numpy()
    return replace(
        lines,
        ends_m=scale * (lines.ends_m @ rotation.T),
        sigma_m=scale * lines.sigma_m,
        chart_centre_m=None if lines.chart_centre_m is None else scale * (lines.chart_centre_m @ rotation.T),
        chart_scale_m=None if lines.chart_scale_m is None else scale * lines.chart_scale_m,
        calibration_sigma_m=None if lines.calibration_sigma_m is None else scale * lines.calibration_sigma_m,
    )


def without_scale(notes: Sequence[str], known: KnownDistance | None) -> tuple[str, ...]:
    """The notes on poses but for those on their unit, where `scene_frame` says it anew."""
    anew = (OPEN_SCALE,) if known is None else (OPEN_SCALE, TAKEN_FOR_METRES)
    return tuple(note for note in notes if note not in anew)


def _open(source: str) -> str:
    what = "one unit is the cameras' root mean square distance from their middle"
    if source != SFM:
        what = "lengths are in units of the given poses"
    return f"The scale is not known: {what}; `scale_from` PHOTO,PHOTO:METRES gives metres."


def _scaled(known: KnownDistance, share: float) -> str:
    also = f", and the {rounded(100 * share)} % to which the poses know it," if math.isfinite(share) and share > 0 else ""
    return (
        f"Lengths are metres by the {known.metres:g} m between {known.first} and {known.second}: an error of that distance{also} "
        "scales all of them and is not in the stated uncertainties."
    )
