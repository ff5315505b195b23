"""The scaramuzza polynomial nearest to a radial curve of another tool, which no model here holds exactly."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from camera_models.errors import InputError
from camera_models.scaramuzza import Scaramuzza

DEGREES = range(3, 13)
"""Of the polynomials that are tried."""
SMALL_PX = 1e-4
"""Error at which a degree is enough."""
PARTS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)
"""Of the curve of a lens that does not fill the image: what it says beyond its image circle was never measured."""
NEAR_PX = 0.1
"""Error of a polynomial that follows the curve."""


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
