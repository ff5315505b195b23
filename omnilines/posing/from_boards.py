"""Poses of photos from a calibration target that each of them shows: the board frame is the world."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from calib_patterns import Detection, DetectionOptions, Pattern
from calib_patterns.fitted_again import fitted_again
from calib_patterns.guided_part import guided_search_of_part
from calib_patterns.tangent_views import detect_in_views
from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from camera_models.pose_fit import pose_covariance, refit_pose, robust_scale_px
from omnilines.posing.options import PosingOptions
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.resection import resect
from omnilines.progress import ProgressCallback, silent
from omnilines.records import ImagePoses, PosePoints


@dataclass(frozen=True)
class BoardPose:
    """The pose of a photo that shows a board, and the corners that it was found from."""

    cam_from_board: Pose
    covariance: Float[np.ndarray, "6 6"]
    """Of the left perturbation."""
    corners: PosePoints


def poses_from_boards(
    photos: Sequence[str],
    read: Callable[[str], np.ndarray],
    cameras: Mapping[str, CameraModel],
    camera_of: Mapping[str, str],
    pattern: Pattern,
    *,
    progress: ProgressCallback = silent,
    options: PosingOptions = PosingOptions(),
    detection: DetectionOptions = DetectionOptions(),
) -> PhotoPoses:
    """`cam_from_world` of the photos that show a board which does not move; its frame is the world, in metres.

    `read` gives the photo of a name as (h, w) or (h, w, 3), 8 or 16 bits. Corners are detected, completed with the help of the
    calibrated camera (guided.py), and the pose fitted to them in pixels; its covariance is that of the fit, with the residuals'
    own standard deviation. Photos without a board, or with one that does not fit the camera, are left out.

    A plain board with nx + ny even looks the same after half a turn (a square one after a quarter too, but for its colours): each
    photo's pose is right up to that turn, and several need not agree. Raises InputError for such a board with more than one photo
    that shows it, and where no photo shows the board.
    """
    found: dict[str, BoardPose] = {}
    lost = {}
    for done, photo in enumerate(photos):
        progress("finding boards", done, len(photos))
        outcome = board_pose(read(photo), cameras[camera_of[photo]], pattern, options, detection)
        if isinstance(outcome, str):
            lost[photo] = f"{photo} has no pose: {outcome}"
        else:
            found[photo] = outcome
    progress("finding boards", len(photos), len(photos))
    if not found:
        raise InputError(
            f"A {pattern.specification} was expected in some photo, found none; {next(iter(lost.values()), 'give photos.')}"
        )
    notes: tuple[str, ...] = ("The world is the board frame.",)
    if pattern.looks_same_turned:
        if len(found) > 1:
            raise InputError(
                f"A board whose ends can be told apart was expected to give the poses of {len(found)} photos, found "
                f"{pattern.specification}, which looks the same after half a turn; use a ChArUco board, an AprilGrid or a "
                "checkerboard with an even and an odd number of inner corners."
            )
        notes += (f"The {pattern.specification} looks the same after half a turn: its x axis is taken to point to the right.",)
    table = ImagePoses(
        tuple(found),
        Pose.stack([one.cam_from_board for one in found.values()]),
        tuple(camera_of[photo] for photo in found),
        np.stack([one.covariance for one in found.values()]),
    )
    return PhotoPoses(table, lost, notes, points={photo: one.corners for photo, one in found.items()})


def is_mirrored(model: CameraModel) -> bool:
    """Whether photos of a camera show the world as a mirror does."""
    centre = model.centre_px.detach()
    with torch.no_grad():
        around, _ = model.unproject(centre + torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64))
    axis, by_u, by_v = around[0], around[1] - around[0], around[2] - around[0]
    return float((torch.linalg.cross(by_u, by_v) * axis).sum()) < 0


def board_pose(
    image: np.ndarray,
    model: CameraModel,
    pattern: Pattern,
    options: PosingOptions = PosingOptions(),
    detection: DetectionOptions = DetectionOptions(),
) -> BoardPose | str:
    """The pose of a photo, or one sentence why there is none."""
    if image.shape[1::-1] != model.image_size:
        size = f"{image.shape[1]}x{image.shape[0]} px"
        return f"a photo of {model.image_size[0]}x{model.image_size[1]} px was expected for its camera, found one of {size}."
    mirrored = is_mirrored(model)
    found, reason = pattern.detect(image, mirrored=mirrored, options=detection)
    whole = _completed(image, model, pattern, found, options, detection=detection)
    if whole is None:
        lost = detect_in_views(image, pattern, model, mirrored=mirrored, options=detection)
        whole = _completed(image, model, pattern, lost, options, detection=detection)
    if whole is None:
        return reason or "the corners found do not fit the camera; check the pattern and the calibration."
    return whole


def _completed(
    image: np.ndarray,
    model: CameraModel,
    pattern: Pattern,
    found: Detection,
    options: PosingOptions,
    *,
    detection: DetectionOptions,
) -> BoardPose | None:
    """The pose from all corners that the camera leads to from those found; None where they are too few or contradict it."""
    start = _resected(model, pattern, found, options, detection.min_corners)
    if start is None:
        return None
    guided = guided_search_of_part(image, pattern, model, start, found, detection)
    if not guided.fits or len(guided.detection) < detection.min_corners:
        return None
    corners = fitted_again(image, pattern, model, guided.cam_from_board, guided.detection, detection)
    board_m = pattern.points_m[corners.ids]
    pose, residual = refit_pose(model, guided.cam_from_board, board_m, corners.pixels)
    covariance = robust_scale_px(residual) ** 2 * pose_covariance(model, pose, board_m, 1.0)
    return BoardPose(pose, covariance, PosePoints(board_m, corners.pixels))


def _resected(model: CameraModel, pattern: Pattern, found: Detection, options: PosingOptions, min_corners: int) -> Pose | None:
    bearings, valid = model.unproject(found.pixels)
    if valid.sum() < min_corners:
        return None
    jacobian = model.unproject_jacobian(torch.as_tensor(found.pixels[valid])).detach()
    sigma = options.given.corner_sigma_px * torch.linalg.matrix_norm(jacobian, ord=2).numpy()
    least = max(min_corners, int(options.given.min_corner_share * valid.sum()))
    try:
        points = pattern.points_m[found.ids[valid]]
        return resect(bearings[valid], points, sigma, min_inliers=least, options=options.resection).pose
    except GeometryError:
        return None
