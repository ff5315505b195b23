"""The map of the predicted projection uncertainty over the image, in pixels, as mrcal draws it."""

from typing import Any

import numpy as np
from jaxtyping import Float

from camera_models.wording import rounded
from omnilines.report.page import Section, fragment
from omnilines.report.plots import (
    PALETTE,
    Trace,
    curve,
    dots,
    image_axes,
    numbers,
    plot,
    round_number,
    sample,
    sample_note,
)

_DRAWN_RANGE = 100.0
"""Above this many times the smallest value the colour stays the same: what happens there is no longer a measurement, and the
range would take the colours away from where it is one."""
_COLOURS = ((0.0, "#fdf0c4"), (0.33, "#fbcf86"), (0.66, "#f19a5b"), (1.0, "#d9553c"))
"""From good to bad, each light enough for dark lines and dark numbers on it, and dark enough to be told from white."""
INK = "#1d2126"
"""Of lines and numbers on those colours; the same in the light and in the dark page, as the colours are."""


def uncertainty_section(
    sigma_px: Float[np.ndarray, "h w"],
    u_px: Float[np.ndarray, " w"],
    v_px: Float[np.ndarray, " h"],
    image_size: tuple[int, int],
    circle_px: Float[np.ndarray, "k 2"],
    *,
    corners_px: Float[np.ndarray, "n 2"],
    supported_angle_deg: float,
    corners_sigma_px: Float[np.ndarray, " n"] | None = None,
    seen: str = "corners",
    title: str = "Projection uncertainty",
    largest: tuple[str, float, tuple[float, float]] | None = None,
) -> Section:
    """A heat map with labelled contour lines of `sigma_px` at the pixels (u_px, v_px), both increasing.

    `sigma_px` is the standard deviation, in the worst direction of the image, of where the calibrated camera projects a known
    direction, after the best common rotation. Where it is not finite or not positive it is not known, and nothing is
    drawn. `circle_px` is the image of the cone at `supported_angle_deg`, up to which the data reach, cut (NaN) where it has no
    image; `corners_px` are the observed points, with what `sigma_px` is at each where that is known; `seen` says
    what they are. `largest` is the part of the image in words, its largest value
    (px; infinite: not known) and the pixel of that, by default those of the map.
    """
    sigma = np.where(np.isfinite(sigma_px) & (sigma_px > 0), sigma_px, np.nan)
    if not np.isfinite(sigma).any():
        return Section(title, fragment("plots", intro="The uncertainty is not known at any pixel.", plots=[]))
    points = corners_px[np.isfinite(corners_px).all(1)]
    intro = (
        f"The camera is known only as well as the {seen} tell it. The map shows the standard deviation in pixels of where it "
        "would project a known direction, in the worst direction of the image, after the best common rotation. "
        + _figures(sigma, u_px, v_px, seen, corners_sigma_px, largest)
    )
    rows = sample(len(points))
    traces = [
        *map_traces(sigma, u_px, v_px),
        dots(points[rows, 0], points[rows, 1], INK, "", size=3, opacity=0.25, hoverinfo="skip", hovertemplate=None),
        curve(circle_px[:, 0], circle_px[:, 1], PALETTE[0], width=3),
    ]
    caption = (
        "How to read it: pale is well known, red is badly known, blank is not known or shows nothing of the world; the numbers "
        f"on the lines are pixels. Dots are the observed {seen}: where there are none, the uncertainty grows. "
        + _reach(circle_px, image_size, supported_angle_deg, seen)
        + " It is what the standard deviations of the parameters make it; what a wrong model adds is seen in the residuals."
        + sample_note(len(points))
    )
    layout = image_axes(image_size)
    aspect = image_size[0] / image_size[1] * 0.9
    figure = plot(traces, layout, label="Projection uncertainty over the image", caption=caption, wide=True, aspect=aspect)
    return Section(title, fragment("plots", intro=intro, plots=[figure]))


def _reach(circle_px: Float[np.ndarray, "k 2"], image_size: tuple[int, int], supported_angle_deg: float, seen: str) -> str:
    """The sentence on how far the observed points reach, by whether the circle is seen in the image."""
    far = f"{supported_angle_deg:.1f} degrees off axis"
    if ((circle_px >= -0.5) & (circle_px <= np.array(image_size) - 0.5)).all(1).any():
        reach = f"The blue curve is how far the {seen} reach, {far}"
        return f"{reach}: beyond it the map is extrapolation, and holds only if the model does."
    return f"The {seen} reach {far}, past the border of the image: nothing of the map is beyond them."


def _figures(
    sigma: Float[np.ndarray, "h w"],
    u_px: Float[np.ndarray, " w"],
    v_px: Float[np.ndarray, " h"],
    seen: str,
    corners_sigma_px: Float[np.ndarray, " n"] | None,
    largest: tuple[str, float, tuple[float, float]] | None,
) -> str:
    """Sentences on the uncertainty at the observed points, and on its largest value."""
    if largest is None:
        row, column = np.unravel_index(np.nanargmax(sigma), sigma.shape)
        largest = "the image", float(sigma[row, column]), (float(u_px[column]), float(v_px[row]))
    image, value, (u, v) = largest
    at = f"at ({u:.0f}, {v:.0f}) px"
    most = f"at most {rounded(value)} px, {at}" if np.isfinite(value) else f"not known everywhere, least {at}"
    most = f"Over {image} it is {most}."
    known = np.zeros(0) if corners_sigma_px is None else corners_sigma_px[np.isfinite(corners_sigma_px)]
    if not known.size:
        return most
    middle, worst = rounded(np.median(known)), rounded(known.max())
    return f"At the observed {seen} it is {middle} px in the median, at most {worst} px. {most}"


def _levels(low: float, high: float) -> list[float]:
    """Contour levels strictly between two positive values: 1, 2 and 5 times powers of ten, or even steps where those are few."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    levels = [float(f"{step}e{power}") for power in powers for step in (1, 2, 5) if low < step * 10.0**power < high]
    if len(levels) < 3 and high > low:
        step = round_number((high - low) / 3)
        levels = [float(f"{k * step:.6g}") for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]
    return levels


def map_traces(sigma: Float[np.ndarray, "h w"], u_px: Float[np.ndarray, " w"], v_px: Float[np.ndarray, " h"]) -> list[Trace]:
    """The colours, and over them one trace for each contour line, so that its label is in pixels and not their logarithm."""
    low, high = float(np.nanmin(sigma)), float(np.nanmax(sigma))
    top = min(high, _DRAWN_RANGE * low)
    levels = _levels(low, top)
    x, y = numbers(u_px), numbers(v_px)
    ticks, names = levels or [low], [f"{level:.3g}" for level in levels or [low]]
    if top < high:
        # The uppermost tick has its own words; one just below would run into them.
        ticks = [level for level in levels if level < 0.6 * top] + [top]
        names = [f"{level:g}" for level in ticks[:-1]] + [f"≥ {rounded(top)}"]
    # Above the map, where it takes none of its width.
    bar: dict[str, Any] = {"orientation": "h", "y": 1.02, "yanchor": "bottom", "thickness": 14, "outlinewidth": 0}
    colours: Trace = {
        "type": "heatmap",
        "x": x,
        "y": y,
        "z": _table(np.log10(np.minimum(sigma, top))),
        "customdata": _table(sigma),
        "zmin": float(np.log10(low)),
        "zmax": float(np.log10(top)),
        "zsmooth": "best",
        "colorscale": [list(stop) for stop in _COLOURS],
        "colorbar": {
            **bar,
            "title": {"text": "standard deviation (px)", "side": "top"},
            "tickangle": 0,
            "tickvals": numbers(np.log10(ticks)),
            "ticktext": names,
        },
        "hoverongaps": False,
        "hovertemplate": "(%{x:.0f}, %{y:.0f}) px: %{customdata:.3g} px<extra></extra>",
    }
    z = _table(sigma)
    lines: list[Trace] = [
        {
            "type": "contour",
            "x": x,
            "y": y,
            "z": z,
            "autocontour": False,
            "contours": {
                "start": level,
                "end": level,
                "size": level,
                "coloring": "none",
                "showlabels": True,
                "labelformat": "~g",
                "labelfont": {"color": INK, "size": 12},
            },
            "line": {"color": INK, "width": 1},
            "showscale": False,
            "hoverinfo": "skip",
        }
        for level in levels
    ]
    return [colours, *lines]


def _table(values: Float[np.ndarray, "h w"]) -> list[list[float | None]]:
    return [numbers(row, 4) for row in values]
