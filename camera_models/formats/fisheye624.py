"""Project Aria's fisheye624 with terms that no model here has: read as the scaramuzza polynomial nearest to it.

    d = theta (1 + k0 theta^2 + ... + k5 theta^12) (x, y) / hypot(x, y),   r2 = |d|^2
    u = f (d_x + 2 d_x (p . d) + p0 r2 + s0 r2 + s1 r2^2) + cx
    v = f (d_y + 2 d_y (p . d) + p1 r2 + s2 r2 + s3 r2^2) + cy

Up to 90 degrees off axis. Project Aria documentation, "Camera intrinsic models".
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.polynomial.polynomial import polyder, polyval

from camera_models.errors import InputError
from camera_models.fitting import refine
from camera_models.formats.nearest import nearest_lens
from camera_models.scaramuzza import Scaramuzza

_SAMPLES = 500
_RINGS, _AROUND = 60, 32
_FINER = 3
"""Times as many rings and directions as were fitted are compared."""


class Nearest(NamedTuple):
    """A camera, and how far it is from the one that the file describes, within the image."""

    camera: Scaramuzza
    rms_px: float
    max_px: float
    upto_deg: float
    """Off axis."""


def nearest_fisheye624(values: Float[np.ndarray, "15"], size: tuple[int, int]) -> Nearest:
    """The scaramuzza polynomial of the radial terms whose centre and affine matrix are nearest to f cx cy k0 ... p0 p1 s0 ... s3.

    Raises InputError where the curve does not grow within the image.
    """
    theta = np.linspace(0.0, _end(values, size), _SAMPLES + 1)[1:]
    start, fit = nearest_lens(values[0] * polyval(theta, _curve(values)), theta, values[1:3], size)
    end = math.radians(fit.upto_deg)
    # What the other terms add is the same in opposite directions, so the radial part stays what it is.
    radial = {name: value for name, value in start.named_parameters().items() if name.startswith("a")}
    camera = refine(start, *_seen(values, size, end, 1), held=radial)
    assert isinstance(camera, Scaramuzza)
    bearings, pixels = _seen(values, size, end, _FINER)
    projected, valid = camera.project(bearings)
    if not bool(valid.all()):
        raise InputError("A camera that some polynomial follows was expected, found one that none does; correct its Params.")
    off = (projected - pixels).norm(dim=-1)
    return Nearest(camera, float(off.square().mean().sqrt()), float(off.max()), fit.upto_deg)


def _curve(values: Float[np.ndarray, "15"]) -> Float[np.ndarray, "14"]:
    """The polynomial of theta."""
    curve = np.zeros(14)
    curve[1::2] = [1.0, *values[3:9]]
    return curve


def _end(values: Float[np.ndarray, "15"], size: tuple[int, int]) -> float:
    """The angle (rad) up to which the curve grows and some of the image shows it."""
    theta = np.linspace(0.0, math.pi / 2, _SAMPLES + 2)[1:-1]
    w, h = size
    reach = math.hypot(max(values[1], w - 1 - values[1]), max(values[2], h - 1 - values[2]))
    curve = _curve(values)
    use = (polyval(theta, polyder(curve)) > 0) & (values[0] * polyval(theta, curve) <= reach)
    stop = len(theta) if use.all() else int(np.argmin(use))
    if not (values[0] > 0 and stop > 1):
        raise InputError("A curve that grows with the angle was expected, found one that does not; correct the Params.")
    return float(theta[stop - 1])


def _seen(
    values: Float[np.ndarray, "15"], size: tuple[int, int], end: float, finer: int
) -> tuple[Float[torch.Tensor, "n 3"], Float[torch.Tensor, "n 2"]]:
    """Bearings up to an angle off axis whose images lie within the image, and these."""
    theta = np.linspace(0.0, end, finer * _RINGS + 1)[1:, None]
    phi = np.linspace(0.0, 2 * math.pi, finer * _AROUND, endpoint=False)
    level = np.stack([np.cos(phi), np.sin(phi)], -1)
    d = polyval(theta, _curve(values))[..., None] * level
    p, s = values[9:11], values[11:15].reshape(2, 2)
    r2 = (d * d).sum(-1, keepdims=True)
    plane = d + 2 * d * (d @ p)[..., None] + r2 * p + r2 * s[:, 0] + r2 * r2 * s[:, 1]
    pixels = values[0] * plane + values[1:3]
    bearings = np.concatenate(
        [np.sin(theta)[..., None] * level, np.broadcast_to(np.cos(theta)[..., None], (*d.shape[:2], 1))], -1
    )
    inside = ((pixels >= 0) & (pixels <= np.array(size) - 1.0)).all(-1)
    return torch.from_numpy(bearings[inside]), torch.from_numpy(pixels[inside])
