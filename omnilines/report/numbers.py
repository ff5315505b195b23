"""Numbers as text: one that is not known is said so, and never printed as NaN."""

import math

NOT_KNOWN = "not known"


def figure(value: float, form: str = ".3g", unit: str = "") -> str:
    """The number in the form of `format`, with its unit behind it; `not known` where it is NaN or infinite."""
    return f"{value:{form}} {unit}".rstrip() if math.isfinite(value) else NOT_KNOWN


def with_sigma(value: float, sigma: float, form: str = ".8g", unit: str = "") -> str:
    """The number with its standard deviation; `held` where that is 0."""
    text = figure(value, form)
    if sigma == 0:
        return " ".join(part for part in (text, unit, "(held)") if part)
    return f"{text} ± {figure(sigma, '.2g')} {unit}".rstrip()
