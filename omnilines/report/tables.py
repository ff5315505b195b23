"""Sections that are tables: figures and notes, checks, parameters, views."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from camera_models.wording import rounded
from omnilines.records import Check, Summary, ViewResult
from omnilines.report.numbers import NOT_KNOWN, cut_at_sigma, figure
from omnilines.report.page import Section, fragment


def verdict_section(summary: Summary, title: str = "Result") -> Section:
    """How good a result is, what limits it and what to do about it: what stands on top of a page."""
    return Section(title, fragment("verdict", summary=summary))


def summary_section(*summaries: Summary, title: str = "Summary") -> Section:
    """Tables of named figures, each under its own title, with their notes."""
    return Section(title, fragment("summary", summaries=summaries, title=title))


def table_section(
    title: str, head: Sequence[str], rows: Sequence[Sequence[Any]], said: Sequence[str] = (), notes: Sequence[str] = ()
) -> Section:
    """A table as `table` makes it, with paragraphs above and notes below."""
    above = Markup("").join(Markup("<p>{}</p>\n").format(one) for one in said)
    return Section(title, above + table(head, rows) + fragment("notes", notes=notes))


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> Markup:
    """A table whose first column names the row; columns with # before their title hold numbers."""
    number = [title.startswith("#") for title in head]
    kind = [Markup(' class="number"') if n else Markup("") for n in number]
    titles = Markup("").join(
        Markup('<th scope="col"{}>{}</th>').format(k, title.removeprefix("#")) for k, title in zip(kind, head, strict=True)
    )
    body = Markup("")
    for first, *others in rows:
        cells = Markup("").join(Markup("<td{}>{}</td>").format(k, cell) for k, cell in zip(kind[1:], others, strict=True))
        body += Markup('<tr><th scope="row">{}</th>{}</tr>\n').format(first, cells)
    return Markup('<div class="scroll">\n<table>\n<thead><tr>{}</tr></thead>\n<tbody>\n{}</tbody>\n</table>\n</div>\n').format(
        titles, body
    )


def checks_section(checks: tuple[Check, ...], title: str = "Checks") -> Section:
    """Each figure beside its limit and whether it holds."""
    rows = [
        {"name": c.name, "value": _figure(c.value), "limit": f"{c.limit:.6g}", "unit": c.unit, "holds": c.holds} for c in checks
    ]
    return Section(title, fragment("checks", rows=rows, failed=sum(not c.holds for c in checks)))


def parameters_section(
    model_name: str,
    names: Sequence[str],
    values: Float[np.ndarray, " p"],
    sigmas: Float[np.ndarray, " p"] | None,
    title: str = "Camera parameters",
    intervals: Float[np.ndarray, "p 2"] | None = None,
) -> Section:
    """The parameters of a camera model with one standard deviation each (zero or NaN: held, not estimated), and their 95 percent
    intervals where standard deviations do not give them."""
    spreads = np.full(len(values), np.nan) if sigmas is None else sigmas
    rows = [
        {"name": name, "value": _with_sigma(float(value), float(sigma)), "relative": _relative(float(value), float(sigma))}
        for name, value, sigma in zip(names, values, spreads, strict=True)
    ]
    if intervals is not None:
        for row, (low, high) in zip(rows, intervals.tolist(), strict=True):
            row["interval"] = f"{low:.6g} to {high:.6g}" if low < high else ""
    shown = {"has_sigma": sigmas is not None, "has_interval": intervals is not None}
    return Section(title, fragment("parameters", model=model_name, rows=rows, **shown))


def views_section(views: Sequence[ViewResult], title: str = "Views") -> Section:
    """One row per view: whether it was used, why not or what to know of it, its corners, its residual with a bar for comparison,
    and its leverage where that of some view is known."""
    residuals = [v.rms_px_per_point for v in views if v.rms_px_per_point is not None and math.isfinite(v.rms_px_per_point)]
    longest = max(residuals, default=0.0) or 1.0
    rows = [
        {
            "view": v,
            "rms": None if v.rms_px_per_point is None else _figure(v.rms_px_per_point, 3),
            "notes": "; ".join(remark.rstrip(".") for remark in v.remarks) if v.used else v.reason,
            "leverage": None if v.leverage is None else f"{100 * v.leverage:.1f} %",
            "share": 0.0 if v.rms_px_per_point not in residuals else round(100 * (v.rms_px_per_point or 0.0) / longest, 1),
        }
        for v in views
    ]
    cameras = len({v.camera for v in views})
    has_leverage = any(v.leverage is not None for v in views)
    used = sum(v.used for v in views)
    return Section(title, fragment("views", rows=rows, used=used, cameras=cameras, has_leverage=has_leverage))


def _figure(value: float, digits: int = 4) -> str:
    """A number with `digits` significant digits, without an exponent where it is of ordinary size."""
    if not math.isfinite(value):
        return NOT_KNOWN
    if value == int(value) and abs(value) < 1e6:
        return str(int(value))
    exponent = math.floor(math.log10(abs(value)))
    if not -4 <= exponent < 7:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - exponent)}f}"


def _with_sigma(value: float, sigma: float) -> Markup:
    """`value ± sigma`, both cut at the second significant digit of sigma; a power of ten is taken out of small numbers."""
    if not (math.isfinite(sigma) and sigma > 0 and math.isfinite(value)):
        return Markup(_power_of_ten(figure(value, ".7g")))
    power, number, spread = cut_at_sigma(value, sigma)
    text = f"{number} ± {spread}"
    return Markup(text) if power == 0 else Markup(f"({text}) × 10<sup>{power}</sup>")


def _power_of_ten(text: str) -> str:
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa} × 10<sup>{int(exponent)}</sup>" if mark else text


def _relative(value: float, sigma: float) -> str:
    """The standard deviation as a share of the value."""
    if not (math.isfinite(sigma) and sigma > 0):
        return "held"
    if value == 0 or sigma > abs(value):
        return "not told from 0"
    return f"{rounded(100 * sigma / abs(value))} %"
