"""The camera nearest to one of another tool, which no model here holds exactly: the scaramuzza polynomial of its radial curve, or
what comes nearer from a start."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.fitting import refine
from camera_models.formats.calibration_data import CameraEstimate
from camera_models.scaramuzza import Scaramuzza

DEGREES = range(3, 13)
"""Of the polynomials that are tried."""
SMALL_PX = 1e-4
"""Error at which a degree is enough."""
PARTS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)
"""Of the curve of a lens that does not fill the image: what it says beyond its image circle was never measured."""
NEAR_PX = 0.1
"""Error of a polynomial that follows the curve."""
SAMPLES = 500
"""Of a curve."""
RINGS, AROUND = 60, 32
FINER = 3
"""Times as many rings and directions as were fitted are compared."""


@dataclass(frozen=True)
class Fit:
    """How near a camera is to the curve of a lens."""

    off_px: float
    """The largest distance."""
    upto_deg: float
    """Off axis."""


def nearest_lens(
    delta_px: Float[np.ndarray, " n"], theta: Float[np.ndarray, " n"], centre: Float[np.ndarray, "2"], size: tuple[int, int]
) -> tuple[Scaramuzza, Fit]:
    """`nearest_polynomial` without an affine matrix, over as much of the curve as a polynomial follows."""
    tried: list[tuple[Scaramuzza, Fit]] = []
    for part in PARTS:
        upto = round(part * len(theta))
        camera, off_px = nearest_polynomial(delta_px[:upto], theta[:upto], np.array([1.0, 0.0, 0.0]), centre, size)
        tried.append((camera, Fit(off_px, math.degrees(theta[upto - 1]))))
        if off_px < NEAR_PX:
            break
    return min(tried, key=lambda pair: pair[1].off_px)


def nearest_polynomial(
    delta_px: Float[np.ndarray, " n"],
    theta: Float[np.ndarray, " n"],
    affine: Float[np.ndarray, "3"],
    centre: Float[np.ndarray, "2"],
    size: tuple[int, int],
) -> tuple[Scaramuzza, float]:
    """The camera p = A delta(theta) (x, y) / hypot(x, y) + centre, A = [[c, d], [e, 1]], and its largest error (px) on the curve.

    `delta_px` and `theta` (rad) grow together, from above 0. Raises InputError where no polynomial follows the curve.
    """
    c, d, e = affine.tolist()
    # u = c (x + d / c y), v = e / c (c x) + 1 / c (c y): radii in the image are c times those of the polynomial.
    rho, angle = torch.from_numpy(c * delta_px), torch.from_numpy(theta)
    rays = torch.stack([torch.sin(angle), torch.zeros_like(angle), torch.cos(angle)], -1)
    best, least = None, math.inf
    for degree in DEGREES:
        curve = Scaramuzza.from_radial_curve(rho, angle, torch.from_numpy(centre), size, degree=degree)
        model = Scaramuzza([*centre.tolist(), 1.0 / c, e / c, d / c, *curve.parameters[5:].tolist()], size)
        pixels, valid = model.project(rays)
        off = float((pixels[:, 0] - centre[0] - rho).abs().max()) if bool(valid.all()) else math.inf
        if off < least:
            best, least = model, off
        if least < SMALL_PX:
            break
    if best is None:
        raise InputError(
            "A polynomial that grows with the angle over the image was expected, found one that no lens has; correct it."
        )
    return best, least


@dataclass(frozen=True)
class Lens:
    """A camera of another tool."""

    radius: Callable[[Float[np.ndarray, "*m"]], Float[np.ndarray, "*m"]]
    """Of theta (rad) off axis, over the focal length: its radial part."""
    image: Callable[[Float[np.ndarray, "m 1"], Float[np.ndarray, "n 2"]], Float[np.ndarray, "m n 2"]]
    """Pixels of directions theta off axis and (x, y), of length 1, about it: the whole camera."""
    focal_px: float
    centre: Float[np.ndarray, "2"]
    size: tuple[int, int]
    limit_rad: float
    """Off axis, beyond which it sees nothing."""

    def end_rad(self) -> float:
        """The angle up to which the curve grows and some of the image shows it; raises InputError where it does not grow."""
        theta = np.linspace(0.0, self.limit_rad, SAMPLES + 2)[1:-1]
        w, h = self.size
        reach = math.hypot(max(self.centre[0], w - 1 - self.centre[0]), max(self.centre[1], h - 1 - self.centre[1]))
        radius_px = self.focal_px * self.radius(theta)
        use = (np.diff(radius_px, prepend=0.0) > 0) & (radius_px <= reach)
        stop = len(theta) if use.all() else int(np.argmin(use))
        if stop < 2:
            raise InputError("A curve that grows with the angle was expected, found one that does not; correct the parameters.")
        return float(theta[stop - 1])

    def seen(self, end_rad: float, finer: int) -> tuple[Float[torch.Tensor, "n 3"], Float[torch.Tensor, "n 2"]]:
        """Bearings up to an angle off axis whose images lie within the image, and these."""
        theta = np.linspace(0.0, end_rad, finer * RINGS + 1)[1:, None]
        phi = np.linspace(0.0, 2 * math.pi, finer * AROUND, endpoint=False)
        corners = np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) * (np.array(self.size) - 1.0) - self.centre
        corners = corners[corners.any(1)]
        # The corners are farthest off axis, where cameras differ most.
        level = np.concatenate([np.stack([np.cos(phi), np.sin(phi)], -1), corners / np.linalg.norm(corners, axis=1)[:, None]])
        pixels = self.image(theta, level)
        ahead = np.broadcast_to(np.cos(theta)[..., None], (*pixels.shape[:2], 1))
        bearings = np.concatenate([np.sin(theta)[..., None] * level, ahead], -1)
        inside = ((pixels >= 0) & (pixels <= np.array(self.size) - 1.0)).all(-1)
        return torch.from_numpy(bearings[inside]), torch.from_numpy(pixels[inside])


@dataclass(frozen=True)
class Nearest:
    """A camera, and how far it is from the one that a file describes, within the image."""

    camera: CameraModel
    rms_px: float
    max_px: float
    upto_deg: float
    """Off axis."""

    def note(self, name: str) -> str:
        """For people: what a camera of this name was read as."""
        return (
            f"{name} has terms for which no camera model here has a place: it is read as the {self.camera.NAME} camera nearest "
            f"to it, up to {self.upto_deg:.1f} degrees off axis and within {self.max_px:.2g} px ({self.rms_px:.2g} px RMS)."
        )


class Told(NamedTuple):
    """Cameras by name, how far those that are only near are known, and what is to be said of them."""

    cameras: dict[str, CameraModel]
    estimates: dict[str, CameraEstimate]
    notes: tuple[str, ...]


def told(found: Mapping[str, CameraModel | Nearest]) -> Told:
    """Of cameras that a file holds."""
    near = {name: one for name, one in found.items() if isinstance(one, Nearest)}
    return Told(
        {name: one.camera if isinstance(one, Nearest) else one for name, one in found.items()},
        {name: CameraEstimate(max_angle_deg=one.upto_deg) for name, one in near.items()},
        tuple(one.note(name) for name, one in near.items()),
    )


def nearest_camera(lens: Lens, starts: Sequence[CameraModel] = ()) -> Nearest:
    """The scaramuzza polynomial of the radial part whose centre and affine matrix are nearest, or the nearest camera of the model
    of a start.

    Raises InputError where the curve does not grow within the image, or no camera follows it.
    """
    theta = np.linspace(0.0, lens.end_rad(), SAMPLES + 1)[1:]
    polynomial, fit = nearest_lens(lens.focal_px * lens.radius(theta), theta, lens.centre, lens.size)
    end_rad = math.radians(fit.upto_deg)
    # What the other terms add is the same in opposite directions, so the radial part stays what it is.
    radial = {name: value for name, value in polynomial.named_parameters().items() if name.startswith("a")}
    some, all_of = lens.seen(end_rad, 1), lens.seen(end_rad, FINER)
    tried = [refine(polynomial, *some, held=radial), *(refine(start, *some) for start in starts)]
    found = [
        Nearest(camera, float(off.square().mean().sqrt()), float(off.max()), fit.upto_deg)
        for camera in tried
        for off in [_off_px(camera, *all_of)]
        if off is not None
    ]
    if not found:
        raise InputError("A camera that some model follows was expected, found one that none does; correct its parameters.")
    return min(found, key=lambda one: one.rms_px)


def _off_px(
    camera: CameraModel, bearings: Float[torch.Tensor, "n 3"], pixels: Float[torch.Tensor, "n 2"]
) -> Float[torch.Tensor, " n"] | None:
    """How far images are off; None where the camera does not see all of them."""
    projected, valid = camera.project(bearings)
    return (projected - pixels).norm(dim=-1) if bool(valid.all()) else None
