"""OCamCalib's inverse polynomial: the radius in the image as a polynomial of the angle above the plane of the lens.

rho = p_0 + p_1 theta + ... + p_n theta^n,  theta = atan2(f(rho), rho),  f(rho) = ss_0 + ss_1 rho + ss_2 rho^2 + ...
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial import Chebyshev, Polynomial
from numpy.polynomial.polynomial import polyval

SAMPLES = 2000
HIGHEST_DEGREE = 16
"""Beyond, the powers of theta cancel each other and the fit gains nothing."""
SMALL_PX = 1e-3
"""Largest error at which a degree is enough."""
HARMLESS_PX = 1e-2
"""Largest error of which nothing is said; OCamCalib itself stops there."""


@dataclass(frozen=True)
class Inverse:
    """p_0 ... p_n, and how far they are from the direct polynomial."""

    coefficients: list[float]
    off_px: float
    """The largest error."""
    angles_deg: tuple[float, float] | None = None
    """The angles off axis within which that is so; None for all that the image sees."""


def fit_inverse(poly: list[float], radius_px: float, angles_deg: tuple[float, float] | None = None) -> Inverse:
    """The polynomial of the least degree whose error over the image is small, else of the best one.

    Where none follows the whole, it is fitted within `angles_deg` off axis, the angles that the data of the calibration reach:
    beyond them, as in the middle of a mirror, the direct polynomial says nothing that was measured.
    """
    rho, theta = _samples(poly, radius_px)
    coefficients, off_px = _fitted(rho, theta)
    if off_px > HARMLESS_PX and angles_deg is not None:
        away = _off_axis_deg(theta)
        first, last = np.interp(angles_deg, away, rho).tolist()
        if last > first:
            rho = np.linspace(first, last, SAMPLES)
            coefficients, off_px = _fitted(rho, np.arctan2(polyval(rho, np.array(poly)), rho))
            return Inverse(coefficients, off_px, angles_deg)
    return Inverse(coefficients, off_px)


def compare(
    poly: list[float], inverse: list[float], radius_px: float, near_px: float
) -> tuple[float, tuple[float, float] | None]:
    """Largest difference (px) of the two up to a radius in the image; the angles off axis (degrees) between which it stays below
    `near_px`, the widest such part, None where there is none."""
    rho, theta = _samples(poly, radius_px)
    off = np.abs(polyval(theta, np.array(inverse or [0.0])) - rho)
    part = _longest(off < near_px)
    away = _off_axis_deg(theta)[part]
    return float(off.max()), (float(away[0]), float(away[-1])) if len(away) > 1 else None


def _fitted(rho: Float[np.ndarray, " n"], theta: Float[np.ndarray, " n"]) -> tuple[list[float], float]:
    """The coefficients and their largest error (px)."""
    best, least = [0.0, 0.0], np.inf
    for degree in range(1, HIGHEST_DEGREE + 1):
        fitted = Chebyshev.fit(theta, rho, degree).convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1]).coef
        off = float(np.abs(polyval(theta, fitted) - rho).max())
        if off < least:
            best, least = fitted.tolist(), off
        if least < SMALL_PX:
            break
    return best, least


def _samples(poly: list[float], radius_px: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Radii, and the angles theta at them, as far as these grow one way."""
    rho = np.linspace(0.0, radius_px, SAMPLES)
    theta = np.arctan2(polyval(rho, np.array(poly)), rho)
    turned = np.flatnonzero(np.diff(theta) * np.sign(theta[1] - theta[0]) <= 0)
    end = turned[0] + 1 if len(turned) else SAMPLES
    return rho[:end], theta[:end]


def _off_axis_deg(theta: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Angles from the bearing of the centre pixel, which is the first; of lens and mirror alike they grow."""
    return np.degrees(np.abs(theta - theta[0]))


def _longest(true: Bool[np.ndarray, " n"]) -> slice:
    """The longest run that is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(int)))
    runs = edges.reshape(-1, 2)
    first, end = runs[np.argmax(runs[:, 1] - runs[:, 0])] if len(runs) else (0, 0)
    return slice(int(first), int(end))
