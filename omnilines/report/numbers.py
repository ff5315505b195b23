"""Numbers as text: one that is not known is said so, and never printed as NaN."""

import math

from camera_models.wording import rounded

NOT_KNOWN = "not known"


def figure(value: float, form: str = ".3g", unit: str = "") -> str:
    """The number in the form of `format`, with its unit behind it; `not known` where it is NaN or infinite."""
    if not math.isfinite(value):
        return NOT_KNOWN
    text = rounded(value, int(form[1])) if form in (".1g", ".2g", ".3g") else f"{value:{form}}"
    return f"{text} {unit}".rstrip()


def with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """The number with its standard deviation, both cut at the second significant digit of that; `held` where it is 0."""
    if not math.isfinite(value):
        return NOT_KNOWN
    if not (math.isfinite(sigma) and sigma > 0):
        parts = (f"{value:.7g}", unit, "(held)") if sigma == 0 else (f"{value:.7g} ± {NOT_KNOWN}", unit)
        return " ".join(filter(None, parts))
    power, number, spread = cut_at_sigma(value, sigma)
    text = f"{number} ± {spread}" if power == 0 else f"({number} ± {spread})e{power:+03d}"
    return f"{text} {unit}".rstrip()


def cut_at_sigma(value: float, sigma: float) -> tuple[int, str, str]:
    """A power of ten, and the number and its positive standard deviation in it, both cut at the second significant digit of that;
    0 but for numbers that are very small or very large."""
    size = math.floor(math.log10(max(abs(value), sigma)))
    power = size if size < -4 or size > 6 else 0
    decimals = 1 - math.floor(math.log10(float(f"{sigma:.1e}"))) + power
    number, spread = (round(part * 10.0**-power, decimals) for part in (value, sigma))
    shown = max(0, decimals)
    return power, f"{number + 0.0:.{shown}f}", f"{spread:.{shown}f}"
