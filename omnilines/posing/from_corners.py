"""Poses of photos from points of known place in the world and where each photo shows them: a `corners.csv`."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float

from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from camera_models.pose_fit import pose_covariance, refit_pose, robust_scale_px
from omnilines.posing.options import PosingOptions
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.resection import MIN_POINTS, resect
from omnilines.records import Corners, ImagePoses, PosePoints


def poses_from_corners(
    corners: Corners,
    cameras: Mapping[str, CameraModel],
    camera_of: Mapping[str, str],
    options: PosingOptions = PosingOptions(),
) -> PhotoPoses:
    """`cam_from_world` of the photos of a table, whose board is the world; `camera_of` names the camera of each photo.

    The covariance is that of the stated noise of the points, or of points picked by hand, times the variance that the residuals
    show where it is more. Photos of fewer than four points, and those whose points do not fit, are left out. Raises InputError
    where none is left.
    """
    found: dict[str, tuple[Pose, Float[np.ndarray, "6 6"]]] = {}
    points: dict[str, PosePoints] = {}
    lost: dict[str, str] = {}
    for view, image in enumerate(corners.images):
        if image not in camera_of:
            continue
        own = corners.view == view
        sigma = options.given.picked_sigma_px if corners.sigma_px is None else corners.sigma_px[own]
        try:
            model = cameras[camera_of[image]]
            found[image] = pose_of_points(model, corners.pixels[own], corners.board_m[own], sigma, options)
            points[image] = PosePoints(corners.board_m[own], corners.pixels[own])
        except GeometryError as error:
            lost[image] = f"{image} has no pose: {error}"
    if not found:
        reason = next(iter(lost.values()), f"the table is of {', '.join(corners.images[:3])}.")
        raise InputError(f"Four points or more of a photo that fit its camera were expected, found none; {reason}")
    lost |= {name: f"{name} has no pose: the table has no points of it." for name in camera_of if name not in (*found, *lost)}
    names = tuple(found)
    poses, covariance = Pose.stack([found[name][0] for name in names]), np.stack([found[name][1] for name in names])
    table = ImagePoses(names, poses, tuple(camera_of[name] for name in names), covariance)
    return PhotoPoses(table, lost, ("The world is that of the points in the table.",), points=points)


def pose_of_points(
    model: CameraModel,
    pixels: Float[np.ndarray, "n 2"],
    points_m: Float[np.ndarray, "n 3"],
    sigma_px: float | Float[np.ndarray, " n"],
    options: PosingOptions = PosingOptions(),
) -> tuple[Pose, Float[np.ndarray, "6 6"]]:
    """cam_from_world and its covariance (left perturbation); raises GeometryError where the points do not determine one or do
    not fit."""
    sigma, gross = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(pixels)), options.given.gross_misfit
    bearings, valid = model.unproject(pixels)
    if int(valid.sum()) < MIN_POINTS:
        raise GeometryError(f"{MIN_POINTS} points that the camera sees were expected, found {int(valid.sum())}; give more.")
    jacobian = model.unproject_jacobian(torch.as_tensor(pixels[valid])).detach()
    usual = np.maximum(sigma[valid], options.given.corner_sigma_px)
    sigma_rad = gross * usual * torch.linalg.matrix_norm(jacobian, ord=2).numpy()
    start = resect(bearings[valid], points_m[valid], sigma_rad, options=options.resection).pose
    pose, residual = refit_pose(model, start, points_m[valid], pixels[valid])
    if robust_scale_px(residual / usual[:, None]) > gross:
        worst = float(np.linalg.norm(residual, axis=-1).max())
        raise GeometryError(
            f"points that fit the camera were expected, found one {worst:.1f} px off; check order, unit and camera."
        )
    shown = robust_scale_px(residual / sigma[valid, None])
    return pose, pose_covariance(model, pose, points_m[valid], sigma[valid]) * max(1.0, shown) ** 2
