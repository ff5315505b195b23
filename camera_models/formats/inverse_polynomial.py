"""OCamCalib's inverse polynomial: the radius in the image as a polynomial of the angle above the plane of the lens.

rho = p_0 + p_1 theta + ... + p_n theta^n,  theta = atan2(f(rho), rho),  f(rho) = ss_0 + ss_1 rho + ss_2 rho^2 + ...
"""

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Chebyshev, Polynomial
from numpy.polynomial.polynomial import polyval

SAMPLES = 2000
HIGHEST_DEGREE = 16
"""Beyond, the powers of theta cancel each other and the fit gains nothing."""
SMALL_PX = 1e-3
"""Largest error at which a degree is enough; OCamCalib itself stops at 0.01 px."""


def fit_inverse(poly: list[float], radius_px: float) -> list[float]:
    """p_0 ... p_n, of the least degree whose error over the image is small, else of the best one."""
    rho, theta = _samples(poly, radius_px)
    best, least = [0.0, 0.0], np.inf
    for degree in range(1, HIGHEST_DEGREE + 1):
        fitted = Chebyshev.fit(theta, rho, degree).convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1]).coef
        off = float(np.abs(polyval(theta, fitted) - rho).max())
        if off < least:
            best, least = fitted.tolist(), off
        if least < SMALL_PX:
            break
    return best


def compare(poly: list[float], inverse: list[float], radius_px: float) -> float:
    """Largest difference (px) of the two up to a radius in the image."""
    rho, theta = _samples(poly, radius_px)
    return float(np.abs(polyval(theta, np.array(inverse or [0.0])) - rho).max())


def _samples(poly: list[float], radius_px: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Radii, and the angles theta at them, as far as these grow one way."""
    rho = np.linspace(0.0, radius_px, SAMPLES)
    theta = np.arctan2(polyval(rho, np.array(poly)), rho)
    turned = np.flatnonzero(np.diff(theta) * np.sign(theta[1] - theta[0]) <= 0)
    end = turned[0] + 1 if len(turned) else SAMPLES
    return rho[:end], theta[:end]
