"""The result that every source of poses hands back, and moving poses into the frame of others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from camera_models import GeometryError
from camera_models.pose import Pose
from camera_models.rotations import nearest_rotation
from omnilines.records import Advice, ImagePoses, LengthUnit, PosePoints


@dataclass(frozen=True, eq=False)
class CameraByPoints:
    """What points of structure from motion ask of one camera."""

    change: Float[np.ndarray, " p"]
    """Of its parameters."""
    covariance: Float[np.ndarray, "p p"]
    """Of the change, for residuals that scatter as those of the points do."""
    max_angle_rad: float
    """Off axis, up to which it saw them."""


@dataclass(frozen=True)
class PhotoPoses:
    """`cam_from_world` of photos, and what became of the others."""

    poses: ImagePoses
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Of each photo without a pose one sentence: its name and the reason."""
    notes: tuple[str, ...] = ()
    """What a person should know of the poses, one sentence each."""
    source: str = "table"
    """What they come from: table, colmap, tool (another tool's file), rig, boards, rectangle or sfm. The world of sfm is the
    frame of a photo."""
    unit: LengthUnit = LengthUnit.METRES
    up: tuple[float, float, float] | None = None
    """The direction (unit) of the world that is up, where the scene that they are of says so."""
    points: Mapping[str, PosePoints] = field(default_factory=dict)
    """Of photos whose pose was found from points of known place: with another camera it would be another one."""
    rig: Mapping[str, Pose] = field(default_factory=dict)
    """cam_from_rig of every camera where photos tell others than the calibration: the poses are with these."""
    cameras: Mapping[str, CameraByPoints] = field(default_factory=dict)
    """What points ask of the cameras that poses were found with; nothing of cameras without parameters."""
    advice: tuple[Advice, ...] = ()
    """What puts the poses in doubt, and what to do about it."""


def image_poses(
    images: Sequence[str], poses: Sequence[Pose], cameras: Sequence[str], frames: Sequence[str] | None = None
) -> ImagePoses:
    """A table of single poses; none at all is an empty one."""
    whole = Pose.stack(list(poses)) if poses else Pose.identity(0)
    return ImagePoses(tuple(images), whole, tuple(cameras), None, None if frames is None else tuple(frames))


def align_to(poses: ImagePoses, reference: ImagePoses) -> tuple[ImagePoses, float, Pose]:
    """Poses in the world of others: X_reference = s R X + t from the photos that both hold; also s (1) and (R, t).

    R maximises the sum of the mean correlation of the centres, in units of their spread, and of the rotations,
    tr(R' R_ref' R_own): rotations count as much as places, so that cameras on a straight line are aligned too. s and t
    follow from the centres (Umeyama 1991). Covariances are moved along. Raises GeometryError where fewer than two photos are in
    both, or their centres coincide in either.
    """
    place = {name: k for k, name in enumerate(reference.images)}
    rows = [(k, place[name]) for k, name in enumerate(poses.images) if name in place]
    if len(rows) < 2:
        raise GeometryError(f"At least two photos with poses in both sets were expected, found {len(rows)}; name them alike.")
    here, there = (torch.tensor(index) for index in zip(*rows, strict=True))
    own, other = poses.cam_from_world[here], reference.cam_from_world[there]
    a, b = own.centre, other.centre
    mean_a, mean_b = a.mean(0), b.mean(0)
    spread_a, spread_b = ((c - c.mean(0)).square().sum(-1).mean().sqrt() for c in (a, b))
    if float(spread_a) <= 1e-12 * float(1 + a.abs().max()) or float(spread_b) <= 1e-12 * float(1 + b.abs().max()):
        raise GeometryError("Photos at two or more places were expected to find a scale, found all at one place; give others.")
    moved = (b - mean_b).mT @ (a - mean_a) / (spread_a * spread_b * len(a))
    turned = (other.rotation.mT @ own.rotation).mean(0)
    rotation = nearest_rotation(moved + turned)
    scale = float(((b - mean_b) * ((a - mean_a) @ rotation.mT)).sum() / (a - mean_a).square().sum())
    if not scale > 0:
        raise GeometryError("Photos at like places in both sets were expected, found places that contradict; check the names.")
    similarity = Pose(rotation, mean_b - scale * rotation @ mean_a)
    return moved_poses(poses, scale, similarity), scale, similarity


def moved_poses(poses: ImagePoses, scale: float, similarity: Pose) -> ImagePoses:
    """Poses in the world X' = s R X + t."""
    covariance = poses.covariance
    if covariance is not None:
        # The perturbation is that of the camera's own frame: only lengths change.
        unit = np.array([1.0, 1.0, 1.0, scale, scale, scale])
        covariance = covariance * unit[:, None] * unit
    return replace(poses, cam_from_world=poses.cam_from_world.after_similarity(scale, similarity), covariance=covariance)
