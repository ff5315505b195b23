"""Metashape's frame and fisheye cameras with terms that no model here has: read as the camera nearest to them.

    (x, y) = rho (cos phi, sin phi), rho = tan(theta) (frame) or theta (fisheye), r = rho
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + (p1 (r^2 + 2 x^2) + 2 p2 x y) (1 + p3 r^2 + p4 r^4)
    u = w / 2 + cx + f x' + b1 x' + b2 y',   v = h / 2 + cy + f y'

y' likewise with p1 and p2 exchanged; the corner of the image is (0, 0). Metashape User Manual, appendix "Camera models".
"""

import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from numpy.polynomial.polynomial import polyval

from camera_models.fisheye624 import Fisheye624
from camera_models.formats.nearest import SAMPLES, Lens, Nearest, nearest_camera
from camera_models.pinhole import Pinhole
from camera_models.unified import Unified


def nearest_metashape(terms: Mapping[str, float], centre: tuple[float, float], size: tuple[int, int], fisheye: bool) -> Nearest:
    """The nearest camera to f, b1, b2, k1 ... k4, p1 ... p4, whose principal point is `centre` (px, ours): a `pinhole` with all
    its terms, of a fisheye a `unified` or a `fisheye624` one, or a `scaramuzza` polynomial.

    Raises InputError where the curve does not grow within the image.
    """
    middle = np.array(centre)
    radial = [1.0, *(terms[f"k{k}"] for k in range(1, 5))]
    ratio = np.array([[1 + terms["b1"] / terms["f"], terms["b2"] / terms["f"]], [0.0, 1.0]])

    def along(theta: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
        return theta if fisheye else np.tan(theta)

    def radius(theta: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
        return along(theta) * polyval(along(theta) ** 2, radial)

    def image(theta: Float[np.ndarray, "m 1"], level: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m n 2"]:
        """u and v."""
        plane = along(theta)[..., None] * level
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        growing = 1 + terms["p3"] * r2 + terms["p4"] * r2 * r2
        across = growing * (terms["p1"] * (r2 + 2 * x * x) + 2 * terms["p2"] * x * y)
        down = growing * (terms["p2"] * (r2 + 2 * y * y) + 2 * terms["p1"] * x * y)
        moved = plane * polyval(r2, radial)[..., None] + np.stack([across, down], -1)
        return terms["f"] * moved @ ratio.T + middle

    lens = Lens(radius, image, terms["f"], middle, size, math.pi if fisheye else math.pi / 2)
    if fisheye:
        theta = np.linspace(0.0, lens.end_rad(), SAMPLES + 1)[1:]
        rho_px, angle = torch.from_numpy(terms["f"] * radius(theta)), torch.from_numpy(theta)
        curve = (rho_px, angle, torch.from_numpy(middle), size)
        return nearest_camera(lens, [Unified.from_radial_curve(*curve), Fisheye624.from_radial_curve(*curve, coefficients=12)])
    values = [terms["f"] + terms["b1"], terms["f"], *centre, terms["b2"]]
    distortion = [terms["k1"], terms["k2"], terms["p2"], terms["p1"], terms["k3"], 0.0, 0.0, 0.0]
    return nearest_camera(lens, [Pinhole(values + distortion, size)])
