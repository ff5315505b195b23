"""What a line scene says of the noise of the end points of its arcs."""

import math
from typing import Any

from omnilines.adjustment.noise import Noise

WORTH_SAYING = 1.1
"""Factor on standard deviations from which on it is said in a sentence."""
MANY = 0.01
"""Ten times the share of observations that noise alone takes so far."""


def noise_row(noise: Noise) -> str:
    """What the residuals say of it."""
    if not math.isfinite(noise.measured):
        return "as stated; nothing is left over that tells" if noise.stated else "unknown: nothing is left over that tells"
    unit = "times what is stated" if noise.stated else "px"
    return f"{noise.measured:.3g} {unit}, from {noise.redundancy:.0f} degrees of freedom"


def noise_notes(noise: Noise, far_share: float = 0.0) -> tuple[str, ...]:
    """Where the stated noise does not hold, and where too little is left over to tell it; `far_share` of the observations lie
    farther from their line than 99.9 percent should."""
    if noise.stated:
        return _of_stated(noise, far_share)
    if not math.isfinite(noise.measured):
        return (
            "No noise of the end points is stated and nothing is left over that tells it: there are no uncertainties; state "
            "sigma_px, or give more views.",
        )
    widening = math.sqrt(noise.widening(4))
    if widening > WORTH_SAYING:
        return (
            f"No noise of the end points is stated, and {noise.redundancy:.0f} degrees of freedom tell little of it: standard "
            f"deviations of lines are {widening:.2f} times as large as the residuals say, so that ellipsoids of 95 percent hold.",
        )
    return ()


def _of_stated(noise: Noise, far_share: float) -> tuple[str, ...]:
    limit = f"(chi-square, below {100 * noise.significance:g} percent)"
    if not noise.holds and noise.measured > WORTH_SAYING:
        return (
            f"The residuals are {noise.measured:.2f} times as large as the stated noise of the end points allows {limit}: all "
            "uncertainties are for that much noise. Wrong matches, poses that are held although they are off, or a poor "
            "calibration look like this.",
        )
    if noise.overstated and noise.measured < 1 / WORTH_SAYING and far_share > MANY:
        return (
            f"Most residuals are smaller than the stated noise of the end points lets expect, yet {100 * far_share:.0f} percent "
            "of the observations lie far from their lines. Uncertainties are for noise alone: expect errors several times as "
            "large, of poses above all.",
        )
    if noise.overstated and noise.measured < 1 / WORTH_SAYING:
        return (
            f"The residuals are {noise.measured:.2f} times what the stated noise of the end points lets expect {limit}: the "
            "uncertainties, which are for the stated noise, are likely to be too large.",
        )
    return ()


def noise_data(noise: Noise) -> dict[str, Any]:
    """For `--json`."""
    measured = noise.measured if math.isfinite(noise.measured) else None
    holds = noise.holds if noise.stated else None
    return {"stated": noise.stated, "measured": measured, "redundancy": noise.redundancy, "holds": holds}
