"""Places on the earth: east-north-up metres at an origin -> latitude, longitude and height on the ellipsoid WGS84.

The way back from earth-centred coordinates is closed (M. Heikkinen, Geschlossene Formeln zur Berechnung räumlicher geodätischer
Koordinaten aus rechtwinkligen Koordinaten, ZfV 107, 1982), exact to rounding farther than 43 km from the earth's centre.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

AXIS_M, FLATTENING = 6378137.0, 1 / 298.257223563
NEAR_SURFACE = 0.01
"""Of the half axis: the poles are 0.0034 below it, aircraft 0.002 above the ground."""
_POLAR_M = AXIS_M * (1 - FLATTENING)
_E2 = FLATTENING * (2 - FLATTENING)
"""Square of the first eccentricity."""


class Origin(NamedTuple):
    """Where the frame of a scene stands: x east, y north, z up."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Above the ellipsoid."""


def geodetic(points_m: Float[np.ndarray, "*n 3"], origin: Origin) -> Float[np.ndarray, "*n 3"]:
    """Longitude and latitude (degrees) and height above the ellipsoid (m) of points in metres east, north and up of an origin."""
    latitude, longitude = math.radians(origin.latitude_deg), math.radians(origin.longitude_deg)
    across = AXIS_M / math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
    level = (across + origin.height_m) * math.cos(latitude)
    centre = np.array([
        level * math.cos(longitude), level * math.sin(longitude), (across * (1 - _E2) + origin.height_m) * math.sin(latitude),
    ])  # fmt: skip
    s, c, t, k = math.sin(longitude), math.cos(longitude), math.sin(latitude), math.cos(latitude)
    earth_from_world = np.array([[-s, -t * c, k * c], [c, -t * s, k * s], [0.0, k, t]])
    return _geodetic_of_earth(points_m @ earth_from_world.T + centre)


def near_surface(point_m: Float[np.ndarray, "3"]) -> bool:
    """Whether a point in earth-centred metres is where photos are taken, and not, say, near the origin of a frame of its own."""
    return abs(float(np.linalg.norm(point_m)) / AXIS_M - 1) < NEAR_SURFACE


def up_at(point_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The unit normal of the ellipsoid below a point in earth-centred metres."""
    longitude, latitude = np.radians(_geodetic_of_earth(point_m)[:2])
    level = math.cos(latitude)
    return np.array([level * math.cos(longitude), level * math.sin(longitude), math.sin(latitude)])


def _geodetic_of_earth(points_m: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    x, y, z = np.moveaxis(points_m, -1, 0)
    a2, b2 = AXIS_M**2, _POLAR_M**2
    p = np.hypot(x, y)
    f = 54 * b2 * z * z
    g = p * p + (1 - _E2) * z * z - _E2 * (a2 - b2)
    c = _E2 * _E2 * f * p * p / g**3
    s = np.cbrt(1 + c + np.sqrt(c * c + 2 * c))
    q3 = f / (3 * (s + 1 + 1 / s) ** 2 * g * g)
    q = np.sqrt(1 + 2 * _E2 * _E2 * q3)
    root = a2 / 2 * (1 + 1 / q) - q3 * (1 - _E2) * z * z / (q * (1 + q)) - q3 * p * p / 2
    r0 = -q3 * _E2 * p / (1 + q) + np.sqrt(np.maximum(root, 0.0))
    u = np.hypot(p - _E2 * r0, z)
    v = np.sqrt((p - _E2 * r0) ** 2 + (1 - _E2) * z * z)
    height = u * (1 - b2 / (AXIS_M * v))
    latitude = np.arctan2(z + (a2 - b2) * z / (AXIS_M * v), p)
    return np.stack([np.degrees(np.arctan2(y, x)), np.degrees(latitude), height], -1)
