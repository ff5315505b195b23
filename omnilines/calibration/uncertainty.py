"""What the covariance of the intrinsics means in the image, and which views it comes from.

A calibration with free board poses leaves the frame of the camera open by a rotation, which a scene absorbs. So the bearing
errors B d of a parameter error d are stated after the small rotation w that fits them best over the field of view that the
data support (as mrcal does, D. Kogan, mrcal.secretsauce.net/uncertainty.html):

    e(u) = B(u) d - w x b(u),    w = argmin sum_u |B(u) d - w x b(u)|^2
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards

LINEAR_SHARE = 0.01
"""Of the diagonal of the image: cameras that differ by more no longer move a pixel in proportion, and fold before they reach it
(docs/calibration.md, how certain)."""


def most_stated_px(model: CameraModel) -> float:
    """Above it a standard deviation of the projection says only that the projection is not known there."""
    return LINEAR_SHARE * math.hypot(*model.image_size)


def as_stated_px(sigma_px: float, most_px: float) -> float:
    """A standard deviation of the projection for people: infinite where it is stated as not known (`most_stated_px`)."""
    return sigma_px if sigma_px <= most_px else math.inf


def bearing_jacobian(
    model: CameraModel, pixels: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"], Float[Tensor, "n 3 p"], Float[Tensor, "n 2 3"]]:
    """Bearings of pixels, where they are defined, d bearing / d parameters at a fixed pixel and d pixel / d bearing."""
    bearings, valid = model.unproject(pixels)
    _, imaged, by_point, by_parameter = model.project_with_jacobians(bearings)
    return bearings, valid & imaged, -model.unproject_jacobian(pixels) @ by_parameter, by_point


def supported_grid(
    model: CameraModel, max_angle_rad: float, min_angle_rad: float = 0.0, points: int = 60
) -> Float[Tensor, "n 2"]:
    """Pixels of a uniform grid over the image between these angles from the bearing of the centre pixel."""
    width, height = model.image_size
    step = max(width, height) / points
    u, v = (torch.arange(0.5 * min(step, side), side, step, dtype=torch.float64) - 0.5 for side in (width, height))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)
    _, valid = model.unproject(pixels)
    angle = angles_off_axis(model, pixels)
    return pixels[valid & (angle >= min_angle_rad) & (angle <= max_angle_rad)]


def projection_jacobian(
    model: CameraModel, pixels: Float[Tensor, "n 2"], reference_px: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "n 2 p"], Bool[Tensor, " n"]]:
    """d pixel / d parameters of the world directions that the camera now sees at each pixel, after the common rotation that fits
    best over `reference_px`; and where that is defined."""
    bearings, seen, by_parameter, _ = bearing_jacobian(model, reference_px)
    turn = _common_turn(bearings[seen], by_parameter[seen])
    bearings, valid, by_parameter, by_point = bearing_jacobian(model, pixels)
    return by_point @ (by_parameter - _turned(turn, bearings)), valid


def common_turn(bearings: Float[Tensor, "n 3"], moved: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Of small motions of bearings, what a common rotation makes of them at most."""
    return _turned(_common_turn(bearings, moved[..., None]), bearings)[..., 0]


def _common_turn(bearings: Float[Tensor, "n 3"], moved: Float[Tensor, "n 3 p"]) -> Float[Tensor, "3 p"]:
    # w x b = -[b]x w: the normal matrix of the rotation is sum (I - b b'), its right side sum b x (B d).
    normal = len(bearings) * torch.eye(3, dtype=bearings.dtype) - bearings.mT @ bearings
    right = torch.linalg.cross(bearings[:, :, None].expand_as(moved), moved, dim=1).sum(0)
    return torch.linalg.solve(normal, right)


def _turned(turn: Float[Tensor, "3 p"], bearings: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 p"]:
    count, size = len(bearings), turn.shape[1]
    return torch.linalg.cross(turn.expand(count, 3, size), bearings[:, :, None].expand(count, 3, size), dim=1)


def projection_covariance_px2(
    model: CameraModel, covariance: Float[Tensor, "p p"], pixels: Float[Tensor, "n 2"], reference_px: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "n 2 2"], Bool[Tensor, " n"]]:
    """Covariance (px^2) of where the camera sees the world direction that it now sees at each pixel, after the common rotation
    that fits best over `reference_px`; and where that is defined."""
    in_image, valid = projection_jacobian(model, pixels, reference_px)
    result = in_image @ covariance @ in_image.mT
    return torch.where(valid[:, None, None], 0.5 * (result + result.mT), float("nan")), valid


def worst_sigma_px(covariance_px2: Float[Tensor, "*n 2 2"]) -> Float[Tensor, "*n"]:
    """Standard deviation in the worst direction of the image; NaN stays NaN."""
    a, b, c = covariance_px2[..., 0, 0], covariance_px2[..., 1, 1], covariance_px2[..., 0, 1]
    return (0.5 * (a + b) + torch.hypot(0.5 * (a - b), c)).clamp_min(0).sqrt()


def view_leverage(
    points: BoardPoints,
    state: CameraAndBoards,
    basis: Float[Tensor, "p q"],
    weight: Float[Tensor, " n"] | None,
    covariance: Float[Tensor, "k k"],
) -> Float[Tensor, " v"]:
    """Share of the estimated camera and board terms that each view decides: trace(C S_v) / k with the view's term S_v of the
    reduced normal matrix over the k columns, C its inverse. The shares of all views add up to 1."""
    reduced = BoardProblem(points, basis, weight, state.shape).by_views(state).matrix
    return (reduced * covariance).sum((-2, -1)) / len(covariance)
