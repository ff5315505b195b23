"""Project Aria's fisheye624 with terms that no model here has: read as the scaramuzza polynomial nearest to it.

    d = theta (1 + k0 theta^2 + ... + k5 theta^12) (x, y) / hypot(x, y),   r2 = |d|^2
    u = f (d_x + 2 d_x (p . d) + p0 r2 + s0 r2 + s1 r2^2) + cx
    v = f (d_y + 2 d_y (p . d) + p1 r2 + s2 r2 + s3 r2^2) + cy

Up to 90 degrees off axis. Project Aria documentation, "Camera intrinsic models".
"""

import math

import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyval

from camera_models.formats.nearest import Lens, Nearest, nearest_camera


def nearest_fisheye624(values: Float[np.ndarray, "15"], size: tuple[int, int]) -> Nearest:
    """The scaramuzza polynomial nearest to f cx cy k0 ... p0 p1 s0 ... s3.

    Raises InputError where the curve does not grow within the image.
    """
    focal, p, s = values[0], values[9:11], values[11:15].reshape(2, 2)
    curve = np.zeros(14)
    curve[1::2] = [1.0, *values[3:9]]

    def radius(theta: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
        return polyval(theta, curve)

    def image(theta: Float[np.ndarray, "m 1"], level: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m n 2"]:
        d = radius(theta)[..., None] * level
        r2 = (d * d).sum(-1, keepdims=True)
        plane = d + 2 * d * (d @ p)[..., None] + r2 * p + r2 * s[:, 0] + r2 * r2 * s[:, 1]
        return focal * plane + values[1:3]

    return nearest_camera(Lens(radius, image, focal, values[1:3], size, math.pi / 2))
