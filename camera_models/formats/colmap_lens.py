"""COLMAP's THIN_PRISM_FISHEYE, as ETH3D's data sets have it: read as the fisheye624 nearest to it.

    d = theta (x, y) / hypot(x, y),   r2 = |d|^2 = theta^2
    u = fx (d_x (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + 2 p1 d_x d_y + p2 (r2 + 2 d_x^2) + sx1 r2) + cx
    v = fy (d_y (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + 2 p2 d_x d_y + p1 (r2 + 2 d_y^2) + sy1 r2) + cy

Its decentring and thin prism terms take the angle, those of fisheye624 the radius after the radial terms. COLMAP documentation,
"camera models".
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyval

from camera_models.fisheye624 import Fisheye624
from camera_models.formats.nearest import Lens, Nearest, nearest_camera


def nearest_thin_prism_fisheye(values: Sequence[float], centre: tuple[float, float], size: tuple[int, int]) -> Nearest:
    """The fisheye624 nearest to fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1, whose principal point is `centre` (px, ours).

    Raises InputError where the curve does not grow within the image.
    """
    fx, fy, _, _, k1, k2, p1, p2, k3, k4, sx1, sy1 = values
    radial = [1.0, k1, k2, k3, k4]

    def radius(theta: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
        return theta * polyval(theta**2, radial)

    def image(theta: Float[np.ndarray, "m 1"], level: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m n 2"]:
        d = theta[..., None] * level
        x, y, r2 = d[..., 0], d[..., 1], (d * d).sum(-1)
        along = polyval(r2, radial)
        u = x * along + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + sx1 * r2
        v = y * along + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + sy1 * r2
        return np.stack([fx * u, fy * v], -1) + centre

    start = Fisheye624([fx, fy, *centre, k1, k2, k3, k4, 0.0, 0.0, p2, p1, sx1, 0.0, sy1, 0.0], size, 12)
    return nearest_camera(Lens(radius, image, math.sqrt(fx * fy), np.array(centre), size, math.pi / 2), [start])
