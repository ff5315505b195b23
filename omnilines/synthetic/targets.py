"""Realistic cameras and the corners that they see, drawn from a seed."""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float

from calib_patterns import Pattern
from camera_models import CameraModel, InputError, model_class
from camera_models.pose import Pose
from omnilines.records import Corners

NARROWEST_FOV_DEG, WIDEST_FOV_DEG = 20.0, 250.0
ANGLE_TO_SPARE_DEG = 25.0
"""The edge of the image circle stays this far below the largest angle of the model: the image's corners lie farther out."""
BOARD_REACH = 85.0 / 95.0
"""How far out boards are shown, as a share of the image circle: to 85 degrees off axis by a lens of 190 degrees."""
SMALLEST_RADIUS_PX = 16.0
"""Of the image circle: a smaller image shows no target."""


def example_camera(model_name: str, fov_deg: float, image_size: tuple[int, int], seed: int) -> CameraModel:
    """A camera with an image circle of `fov_deg` across, and with the imperfections of a real one.

    The image circle is the largest one round the optical axis that lies in the image. The axis is off the middle of the image by
    0.5 to 1.5 percent of its width, the radial curve is off an equidistant (up to 90 degrees: off a rectilinear) one by a few
    percent, and pixel aspect, chip or lens are slightly out of true. Everything follows from `seed`.

    Raises InputError for an unknown model, a field of view that the model cannot hold, a negative seed or a tiny image.
    """
    kind = model_class(model_name)
    half = 0.5 * math.radians(_checked_fov(kind, fov_deg))
    rng = generator(seed, "camera")
    width, height = image_size
    offset, direction = rng.uniform(0.005, 0.015) * width, rng.uniform(0.0, 2.0 * math.pi)
    cx, cy = 0.5 * (width - 1) + offset * math.cos(direction), 0.5 * (height - 1) + offset * math.sin(direction)
    radius = min(cx + 0.5, width - 0.5 - cx, cy + 0.5, height - 0.5 - cy)
    if radius < SMALLEST_RADIUS_PX:
        raise InputError(f"An image of at least 40x40 px was expected, found {width}x{height} px; give a size like 1280x960.")
    theta = torch.linspace(0.0, half, 201, dtype=torch.float64)[1:]
    rho = radius * (_rectilinear if kind.LARGEST_ANGLE <= math.pi / 2 else _equidistant)(theta.numpy() / half, half, rng)
    centre = torch.tensor([cx, cy], dtype=torch.float64)
    ideal = kind.from_radial_curve(torch.as_tensor(rho), theta, centre, image_size)
    # A model of few parameters misses the edge by a little: scaled, its curve meets it.
    edge, _ = ideal.project(torch.tensor([math.sin(half), 0.0, math.cos(half)], dtype=torch.float64))
    ideal = kind.from_radial_curve(torch.as_tensor(rho * radius / float((edge - centre).norm())), theta, centre, image_size)
    camera = ideal.with_parameters(_out_of_true(ideal, half, rng))
    if camera.max_angle <= half:
        raise InputError(
            f"Camera model {model_name} was expected to hold a field of view of {fov_deg:g} degrees, found that its curve "
            f"folds at {2 * math.degrees(camera.max_angle):.0f}; give a smaller one."
        )
    return camera


def board_angle_rad(fov_deg: float) -> float:
    """The angle off axis up to which boards are shown to a camera with that image circle."""
    return 0.5 * math.radians(fov_deg) * BOARD_REACH


def generator(seed: int, purpose: str, index: int = 0) -> np.random.Generator:
    """An independent stream of random numbers for each purpose and index. Raises InputError for a negative seed."""
    if seed < 0:
        raise InputError(f"A seed of at least 0 was expected, found {seed}; give another one.")
    return np.random.default_rng([seed, index, *purpose.encode()])


def _checked_fov(kind: type[CameraModel], fov_deg: float) -> float:
    widest = min(WIDEST_FOV_DEG, 2.0 * (math.degrees(kind.LARGEST_ANGLE) - ANGLE_TO_SPARE_DEG))
    if not NARROWEST_FOV_DEG <= fov_deg <= widest:
        wider = "" if fov_deg <= widest or widest == WIDEST_FOV_DEG else " or take --model opencv-fisheye"
        raise InputError(
            f"A field of view of {NARROWEST_FOV_DEG:g} to {widest:g} degrees was expected for model {kind.NAME}, found "
            f"{fov_deg:g}; give one in this range{wider}."
        )
    return fov_deg


RadialCurve = Callable[[Float[np.ndarray, " k"], float, np.random.Generator], Float[np.ndarray, " k"]]


def _equidistant(share: Float[np.ndarray, " k"], half: float, rng: np.random.Generator) -> Float[np.ndarray, " k"]:
    """rho over its value at the edge for angles given as shares of the edge's; odd terms of a few percent, always growing."""
    k = rng.uniform(-1.0, 1.0, 4) * [0.06, 0.03, 0.015, 0.005]

    def curve(s: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return s * (1.0 + k[0] * s**2 + k[1] * s**4 + k[2] * s**6 + k[3] * s**8)

    return curve(share) / curve(np.ones(1))


def _rectilinear(share: Float[np.ndarray, " k"], half: float, rng: np.random.Generator) -> Float[np.ndarray, " k"]:
    """The same for a mild barrel distortion of tan(theta), which grows far beyond the edge too (1 - 0.15 s + 0.015 s^2 > 0)."""
    k1, k2 = rng.uniform(-0.05, -0.015), rng.uniform(0.003, 0.008)
    t = np.tan(share * half) / math.tan(half)
    return t * (1.0 + k1 * t**2 + k2 * t**4) / (1.0 + k1 + k2)


def _out_of_true(ideal: CameraModel, half: float, rng: np.random.Generator) -> Float[np.ndarray, " p"]:
    """The parameters with an aspect ratio, a slanted chip or a decentred lens, whichever of them the model has."""
    edge = math.tan(min(half, math.radians(65.0)))
    named = ideal.named_parameters()
    nudges = {
        "fy": named.get("fy", 0.0) * rng.uniform(-0.004, 0.004),
        "c": rng.uniform(-0.004, 0.004),
        # Alike, as calibrations hold them: where they differ, the camera is turned about its axis.
        "d": (slant := float(rng.uniform(-0.002, 0.002, 2).mean())),
        "e": slant,
        "p1": rng.uniform(-5e-4, 5e-4) / edge,
        "p2": rng.uniform(-5e-4, 5e-4) / edge,
        "p0": rng.uniform(-5e-4, 5e-4) / edge,
    }
    # Eight digits, so that the last bits of the curve's fit, which vary between machines, leave no trace.
    return np.array([float(f"{value + nudges.get(name, 0.0):.8g}") for name, value in named.items()])


def integer_seed(seed: int, purpose: str, index: int = 0) -> int:
    """An independent seed for each purpose and index. Raises InputError for a negative seed."""
    return int(generator(seed, purpose, index).integers(2**31))


def simulate_corners(model: CameraModel, pattern: Pattern, poses: Pose, sigma_px: float, seed: int) -> Corners:
    """Where a camera sees all corners of a target at a batch of poses cam_from_board, with white noise of `sigma_px` per axis.

    `sigma_px` of 0 gives the exact corners. Corners that the model does not see or that fall outside the image (before the
    noise) are left out.
    """
    board = pattern.points_m
    count = len(poses)
    pixels, seen = model.project(poses.transform(torch.as_tensor(board).expand(count, -1, -1)))
    exact = pixels.detach().numpy()
    inside = ((exact >= -0.5) & (exact <= np.array(model.image_size) - 0.5)).all(-1) & seen.numpy()
    view, ids = np.nonzero(inside)
    noise = sigma_px * generator(seed, "corners").standard_normal((len(view), 2))
    names = tuple(f"view{k:0{max(2, len(str(count - 1)))}d}.png" for k in range(count))
    sigma = np.full(len(view), sigma_px) if sigma_px > 0 else None
    return Corners(view, names, names, board[ids], exact[inside] + noise, sigma, ids)
