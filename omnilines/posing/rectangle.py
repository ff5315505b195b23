"""The pose of a camera from a rectangle of known size: its corners as bearings, then its four sides as arcs, for any camera.

The world is the rectangle: the origin at a corner, x along the width, y along the height, z into it, away from who sees its front
(as x right, y down, z forward of a camera that looks straight at it).

1. Bearings V_k of the corners, in their order round it, and their distances l_k: opposite sides are equal as vectors, so
   l_1 V_1 + l_3 V_3 - l_0 V_0 = l_2 V_2, a linear system of three unknowns up to the scale. Nothing asks for z > 0.
2. Of each arc both ends V lie in the plane of its side: the residual V . n / |n| over its standard deviation, n the normal of the
   plane through the camera and the side, is minimised by Gauss-Newton. Eight residuals, six unknowns: the covariance is that of
   the stated noise of the arcs.
"""

import re
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from calib_patterns import parse_length
from camera_models import InputError
from camera_models.pose import Pose, hat
from camera_models.repeatable import least_squares

PREFIX = "rectangle:"
MIN_M, MAX_M = 0.005, 50.0
"""Sides outside of this are taken for a wrong unit."""
MIN_UNEQUAL = 1.05
"""Ratio of the sides from which on they can be told apart."""
STEPS, SETTLED = 20, 1e-10


@dataclass(frozen=True)
class Rectangle:
    """A flat sheet."""

    width_m: float
    height_m: float

    @property
    def corners_m(self) -> Float[np.ndarray, "4 3"]:
        """Clockwise as seen from its front, from the origin."""
        w, h = self.width_m, self.height_m
        return np.array([[0.0, 0.0, 0.0], [w, 0.0, 0.0], [w, h, 0.0], [0.0, h, 0.0]])

    @property
    def half_turn(self) -> Pose:
        """The motion that it looks the same after."""
        turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
        return Pose(turn, torch.tensor([self.width_m, self.height_m, 0.0], dtype=torch.float64))


def parse_rectangle(text: str) -> Rectangle:
    """The rectangle written `rectangle:279x216mm` or `rectangle:27.9cmx21.6cm`; raises InputError otherwise."""
    match = re.fullmatch(r"rectangle:\s*([\d.]+)\s*(mm|cm|m|)\s*[xX]\s*([\d.]+)\s*(mm|cm|m)\s*", text.strip())
    if match is None:
        raise InputError(
            f"A sheet was expected as rectangle:WIDTHxHEIGHT with mm, cm or m, such as rectangle:279x216mm, found '{text}'."
        )
    width, unit, height, last = match.groups()
    sides = [parse_length(f"{number}{own}", text) for number, own in ((width, unit or last), (height, last))]
    if not all(MIN_M <= side <= MAX_M for side in sides):
        raise InputError(f"Sides of 5 mm to 50 m were expected, found {sides[0]:g} x {sides[1]:g} m in '{text}'; check the unit.")
    if max(sides) < MIN_UNEQUAL * min(sides):
        raise InputError(
            f"A rectangle with sides 5 percent apart or more was expected, found {sides[0]:g} x {sides[1]:g} m: after a quarter "
            "turn it looks nearly the same; take a sheet of paper."
        )
    return Rectangle(*sides)


def corner_distances(corners: Float[Tensor, "*n 4 3"]) -> tuple[Float[Tensor, "*n 4"], Bool[Tensor, "*n"]]:
    """Distances l_k along unit bearings of the corners of a parallelogram, l_2 = 1, and whether all lie before the camera."""
    matrix = torch.stack([corners[..., 1, :], corners[..., 3, :], -corners[..., 0, :]], -1)
    volume = torch.linalg.det(matrix).abs()
    sound = volume > 1e-12
    eye = torch.eye(3, dtype=corners.dtype)
    one, three, zero = torch.linalg.solve(torch.where(sound[..., None, None], matrix, eye), corners[..., 2, :, None])[
        ..., 0
    ].unbind(-1)
    distances = torch.stack([zero, one, torch.ones_like(one), three], -1)
    return distances, sound & (distances > 1e-6).all(-1)


def pose_of_corners(corners: Float[Tensor, "*n 4 3"], rectangle: Rectangle) -> tuple[Pose, Bool[Tensor, "*n"]]:
    """cam_from_world that sees the corners near unit bearings (exactly, where they are of the rectangle); if there is one."""
    distances, sound = corner_distances(corners)
    at = distances[..., None] * corners
    along, down = at[..., 1, :] - at[..., 0, :], at[..., 3, :] - at[..., 0, :]
    scale = 0.5 * (rectangle.width_m / along.norm(dim=-1) + rectangle.height_m / down.norm(dim=-1))
    x, y = along / along.norm(dim=-1, keepdim=True), down / down.norm(dim=-1, keepdim=True)
    # The two axes that are nearest to both sides and across each other.
    middle, across = x + y, x - y
    middle, across = middle / middle.norm(dim=-1, keepdim=True), across / across.norm(dim=-1, keepdim=True)
    x, y = (middle + across) / 2**0.5, (middle - across) / 2**0.5
    rotation = torch.stack([x, y, torch.linalg.cross(x, y)], -1)
    centre = rotation @ torch.tensor([rectangle.width_m / 2, rectangle.height_m / 2, 0.0], dtype=torch.float64)
    finite = sound & torch.isfinite(rotation).flatten(-2).all(-1)
    return Pose(rotation, scale[..., None] * at.mean(-2) - centre), finite


@dataclass(frozen=True)
class SidesFit:
    """Poses from the arcs of the sides of n quadrilaterals."""

    pose: Pose
    covariance: Float[Tensor, "n 6 6"]
    """Of the left perturbation, for the stated noise."""
    chi_square: Float[Tensor, " n"]
    """Sum of the squared residuals, two degrees of freedom."""
    misfit_rad: Float[Tensor, " n"]
    """Root mean square of the distances of the arc ends from the sides."""


def pose_of_sides(
    ends: Float[Tensor, "n 4 2 3"], noise: Float[Tensor, "n 4 2 3 3"], start: Pose, rectangle: Rectangle
) -> SidesFit:
    """Poses from unit end bearings of an arc on each side, from corner k to the next, with the covariance of each bearing."""
    corners = torch.as_tensor(rectangle.corners_m)
    direction = corners.roll(-1, 0) - corners
    pose = start
    for _ in range(STEPS if len(ends) else 0):
        residual, jacobian, _ = _sides(ends, noise, pose, corners, direction)
        normal = jacobian.mT @ jacobian
        step = -least_squares(normal, jacobian.mT @ residual[..., None])[..., 0]
        pose = Pose.exp(step) @ pose
        if float(step.abs().max()) < SETTLED:
            break
    residual, jacobian, distance = _sides(ends, noise, pose, corners, direction)
    covariance = torch.linalg.pinv(jacobian.mT @ jacobian, hermitian=True)
    return SidesFit(pose, covariance, residual.square().sum(-1), distance.square().mean(-1).sqrt())


def _sides(
    ends: Float[Tensor, "n 4 2 3"],
    noise: Float[Tensor, "n 4 2 3 3"],
    pose: Pose,
    corners: Float[Tensor, "4 3"],
    direction: Float[Tensor, "4 3"],
) -> tuple[Float[Tensor, "n 8"], Float[Tensor, "n 8 6"], Float[Tensor, "n 8"]]:
    """Residuals in standard deviations, their derivatives by the left perturbation, and the distances (rad)."""
    seen = torch.einsum("nij,kj->nki", pose.rotation, corners) + pose.translation[:, None]
    along = torch.einsum("nij,kj->nki", pose.rotation, direction)
    normal = torch.linalg.cross(seen, along)
    length = normal.norm(dim=-1, keepdim=True)
    unit = normal / length
    distance = torch.einsum("nkei,nki->nke", ends, unit)
    sigma = torch.einsum("nki,nkeij,nkj->nke", unit, noise, unit).sqrt()
    # d normal = omega x normal + v x along; the part along the normal changes nothing.
    by_unit = (ends - distance[..., None] * unit[:, :, None]) / (length[:, :, None] * sigma[..., None])
    by_normal = torch.cat([-hat(normal), -hat(along)], -1)
    jacobian = torch.einsum("nkei,nkij->nkej", by_unit, by_normal)
    return (distance / sigma).flatten(1), jacobian.flatten(1, 2), distance.flatten(1)
