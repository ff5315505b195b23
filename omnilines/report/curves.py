"""Plots of coverage, of the projection curve, and of quantities before and after."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from omnilines.report.page import Section, fragment
from omnilines.report.plots import PALETTE, QUIET, axis, curve, dots, image_axes, legend_above, plot, sample, sample_note

_CELLS = 12
"""Along the longer side of the image, for the share of it that holds a corner."""


def coverage_section(
    pixels: Float[np.ndarray, "n 2"],
    image_size: tuple[int, int],
    supported_curve_px: Float[np.ndarray, "k 2"] | None = None,
    *,
    supported_angle_deg: float | None = None,
    title: str = "Coverage",
) -> Section:
    """Where the observed points lie in the image, with the closed curve up to which the data support the model.

    `supported_curve_px` is the image of the cone at `supported_angle_deg`, cut (NaN) where it has no image.
    """
    pixels = pixels[np.isfinite(pixels).all(1)]
    rows = sample(len(pixels))
    traces = [dots(pixels[rows, 0], pixels[rows, 1], PALETTE[0], "(%{x:.1f}, %{y:.1f}) px", opacity=0.8)]
    caption = (
        f"{len(pixels):,} observed points. {100 * _covered(pixels, image_size):.0f} % of the cells of a grid with {_CELLS} along "
        f"the longer side hold one.{sample_note(len(pixels))}"
    )
    if supported_curve_px is not None:
        traces.append(curve(supported_curve_px[:, 0], supported_curve_px[:, 1], PALETTE[1]))
        angle = "" if supported_angle_deg is None else f", {supported_angle_deg:.1f} degrees off axis"
        caption += f" The curve is the supported field of view{angle}: outside it the calibration extrapolates."
    aspect = image_size[0] / image_size[1] * 0.97
    figure = plot(traces, image_axes(image_size), label="Points in the image", caption=caption, wide=True, aspect=aspect)
    return Section(title, fragment("plots", intro="", plots=[figure]))


def _covered(pixels: Float[np.ndarray, "n 2"], image_size: tuple[int, int]) -> float:
    """The share of about square grid cells that hold a point."""
    size = np.array(image_size, dtype=np.float64)
    cells = np.maximum(1, np.round(_CELLS * size / size.max())).astype(int)
    inside = pixels[((pixels >= -0.5) & (pixels <= size - 0.5)).all(1)]
    cell = np.minimum((inside + 0.5) / size * cells, cells - 1).astype(int)
    return len(np.unique(cell, axis=0)) / int(cells.prod())


def radial_section(
    theta_deg: Float[np.ndarray, " k"],
    radius_px: Float[np.ndarray, " k"],
    *,
    supported_angle_deg: float | None = None,
    title: str = "Projection curve",
) -> Section:
    """The distance from the image centre of a ray at each angle off axis (increasing), and the resolution, its slope."""
    shapes = []
    ending = ""
    if supported_angle_deg is not None:
        line = {"color": QUIET, "width": 1, "dash": "dash"}
        end = supported_angle_deg
        shapes = [{"type": "line", "yref": "paper", "x0": end, "x1": end, "y0": 0, "y1": 1, "line": line}]
        ending = f" Dashed: the supported angle, {end:.1f} degrees."
    plots = [
        _angle_curve(
            theta_deg,
            radius_px,
            "distance from the centre (px)",
            "Projection curve",
            "How far from the centre a ray lands." + ending,
            shapes,
        )
    ]
    if len(theta_deg) > 2:
        caption = "Pixels per degree along the radius; it should be smooth and stay above zero." + ending
        slope = np.gradient(radius_px, theta_deg)
        plots.append(_angle_curve(theta_deg, slope, "resolution (px per degree)", "Radial resolution", caption, shapes))
    return Section(title, fragment("plots", intro="", plots=plots))


def _angle_curve(
    theta_deg: Float[np.ndarray, " k"],
    values: Float[np.ndarray, " k"],
    y_title: str,
    label: str,
    caption: str,
    shapes: list[dict],
) -> Markup:
    traces = [curve(theta_deg, values, PALETTE[0], "%{x:.1f}°: %{y:.4g}")]
    layout = {
        "xaxis": axis("angle off axis (degrees)", rangemode="tozero"),
        "yaxis": axis(y_title, rangemode="tozero"),
        "shapes": shapes,
        "showlegend": False,
    }
    return plot(traces, layout, label=label, caption=caption)


def histogram_section(
    title: str,
    values: Mapping[str, Float[np.ndarray, "..."]],
    quantity: str,
    caption: str = "",
    *,
    logarithmic: bool = False,
) -> Section:
    """The distributions of one quantity (`quantity` names it with its unit) in several cases, say before and after.

    With `logarithmic`, for positive values that span decades, the bins are equally wide in the logarithm.
    """
    finite = {name: v[np.isfinite(v)].ravel() for name, v in values.items()}
    if logarithmic:
        finite = {name: v[v > 0] for name, v in finite.items()}
    everything = np.concatenate([*finite.values(), np.empty(0)])
    if not everything.size:
        return Section(title, fragment("plots", intro="There is no value to show.", plots=[]))
    scaled = np.log10(everything) if logarithmic else everything
    low, high = float(scaled.min()), float(scaled.max())
    pad = 0.5 * max(abs(low), 1e-6) if low == high else 0.0
    edges = np.linspace(low - pad, high + pad, int(np.clip(2 * everything.size ** (1 / 3), 10, 60)) + 1)
    edges = 10.0**edges if logarithmic else edges
    traces = []
    for k, (name, v) in enumerate(finite.items()):
        counts = np.histogram(v, edges)[0]
        median = f" (median {np.median(v):.3g})" if v.size else " (none)"
        steps = np.concatenate([[0], np.repeat(counts, 2), [0]]).astype(np.float64)
        own: dict[str, Any] = {"fill": "tozeroy", "name": name + median}
        traces.append(curve(np.repeat(edges, 2), steps, PALETTE[k % len(PALETTE)], "%{x:.3g}: %{y}", **own))
    decades = {"type": "log", "dtick": "D2" if high - low < 4 else 1, "tickformat": "~g"} if logarithmic else {}
    layout = {
        "xaxis": axis(quantity, **decades),
        "yaxis": axis("count", rangemode="tozero"),
        "showlegend": len(traces) > 1,
        "legend": legend_above(),
    }
    figure = plot(traces, layout, label=f"Histogram of {quantity}", caption=caption, wide=True, aspect=2.4)
    return Section(title, fragment("plots", intro="", plots=[figure]))


def curve_section(
    title: str,
    curves: Mapping[str, tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]],
    x_title: str,
    y_title: str,
    caption: str = "",
    *,
    logarithmic: bool = False,
    reference: Mapping[str, tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]] | None = None,
) -> Section:
    """Curves (x, y) by name over common axes, whose titles state the units; `logarithmic` is for y. Those of `reference`, such
    as a limit, are dashed."""
    traces = []
    for k, (name, (x, y)) in enumerate(curves.items()):
        own: dict[str, Any] = {"mode": "lines+markers", "marker": {"size": 6, "symbol": k % 8}, "name": name}
        traces.append(curve(x, y, PALETTE[k % len(PALETTE)], "%{x:.4g}: %{y:.4g}", **own))
    for name, (x, y) in (reference or {}).items():
        dashed: dict[str, Any] = {"name": name, "line": {"color": QUIET, "width": 2, "dash": "dash"}}
        traces.append({**curve(x, y, QUIET, "%{x:.4g}: %{y:.4g}"), **dashed})
    y_axis = axis(y_title, type="log", dtick=1) if logarithmic else axis(y_title)
    layout = {
        "xaxis": axis(x_title),
        "yaxis": {**y_axis, "exponentformat": "power"},
        "showlegend": len(traces) > 1,
        "legend": legend_above(),
    }
    figure = plot(traces, layout, label=title, caption=caption, wide=True, aspect=2.4)
    return Section(title, fragment("plots", intro="", plots=[figure]))
