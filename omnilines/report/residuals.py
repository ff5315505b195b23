"""Plots of reprojection residuals: what they look like, where in the image, how they grow, how they are distributed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from markupsafe import Markup

from omnilines.report.page import Section, fragment
from omnilines.report.plots import (
    PALETTE,
    QUIET,
    Trace,
    axis,
    broken,
    curve,
    dots,
    image_axes,
    legend_above,
    numbers,
    plot,
    round_number,
    sample,
    sample_note,
)

_ARROW_SHARE = 0.04
"""Of the image's width: the length at which the 95th percentile of the residuals is drawn."""
_SHOWN_ARROWS = 1500


def residual_section(
    pixels: Float[np.ndarray, "n 2"],
    residuals_px: Float[np.ndarray, "n 2"],
    image_size: tuple[int, int],
    view: Int[np.ndarray, " n"],
    view_names: Sequence[str],
    *,
    theta_deg: Float[np.ndarray, " n"] | None = None,
    title: str = "Residuals",
) -> Section:
    """Four plots of residuals, observed minus predicted, in pixels.

    `view` indexes `view_names`. With `theta_deg`, the angle of each point off the optical axis, the magnitude is plotted
    against it, else against the distance from the centre of the image. Rows that are not finite are left out and counted.
    """
    keep = np.isfinite(residuals_px).all(1) & np.isfinite(pixels).all(1)
    dropped = int(len(keep) - keep.sum())
    pixels, residuals_px, view = pixels[keep], residuals_px[keep], view[keep]
    if not len(pixels):
        return Section(title, fragment("plots", intro="There is no residual to show.", plots=[]))
    squares = (residuals_px**2).sum(1)
    per_point = float(np.sqrt(squares.mean()))
    intro = (
        f"{len(pixels):,} residuals, observed minus predicted. rms_px_per_axis = {per_point / np.sqrt(2):.4f} px, "
        f"rms_px_per_point = {per_point:.4f} px; the largest is {np.sqrt(squares.max()):.3g} px long."
    )
    if dropped:
        intro += f" {dropped:,} more are not known (their point has no image) and are left out."
    distance, distance_title = _distance(pixels, image_size, theta_deg, keep)
    names = [view_names[k] for k in view]
    plots = [
        _cloud(residuals_px, names),
        _histograms(residuals_px),
        _arrows(pixels, residuals_px, image_size, names),
        _magnitude(distance, np.sqrt(squares), distance_title, names),
    ]
    return Section(title, fragment("plots", intro=intro, plots=plots))


def _distance(
    pixels: Float[np.ndarray, "n 2"],
    image_size: tuple[int, int],
    theta_deg: Float[np.ndarray, " m"] | None,
    keep: Bool[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, " n"], str]:
    if theta_deg is not None:
        return theta_deg[keep], "angle off axis (degrees)"
    centre = (np.array(image_size, dtype=np.float64) - 1) / 2
    return np.hypot(*(pixels - centre).T), "distance from the image centre (px)"


def _cloud(residuals_px: Float[np.ndarray, "n 2"], names: list[str]) -> Markup:
    n = len(residuals_px)
    rows = sample(n)
    x, y = residuals_px[rows].T
    sigma = float(np.sqrt((residuals_px**2).mean()))
    phase = np.linspace(0, 2 * np.pi, 121)
    span = 1.08 * max(float(np.abs(residuals_px).max()), 2 * sigma, 1e-12)
    hover = "%{text}<br>(%{x:.3f}, %{y:.3f}) px"
    traces = [
        dots(x, y, PALETTE[0], hover, text=[names[i] for i in rows], opacity=0.45),
        curve(sigma * np.cos(phase), sigma * np.sin(phase), PALETTE[1]),
    ]
    layout = {
        "xaxis": axis("residual in u (px)", range=[-span, span], constrain="domain"),
        "yaxis": axis("residual in v (px)", range=[span, -span], scaleanchor="x", constrain="domain"),
        "showlegend": False,
    }
    caption = (
        f"The cloud should be round, centred and without arms or separate clumps. Circle: one standard deviation per axis, "
        f"{sigma:.3g} px.{sample_note(n)}"
    )
    return plot(traces, layout, label="Residual vectors", caption=caption, aspect=1.15)


def _histograms(residuals_px: Float[np.ndarray, "n 2"]) -> Markup:
    n, mean, spread = len(residuals_px), residuals_px.mean(0), residuals_px.std(0)
    half = max(4 * float(spread.max()), 1e-12)
    edges = np.linspace(-half, half, int(np.clip(3 * n ** (1 / 3), 12, 80)) + 1)
    centres, width = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    fine = np.linspace(-half, half, 161)
    traces: list[Trace] = []
    for k, name in enumerate("uv"):
        own: dict[str, Any] = {"xaxis": f"x{k + 1}", "yaxis": f"y{k + 1}"}
        bars = {"x": numbers(centres), "y": np.histogram(residuals_px[:, k], edges)[0].tolist(), "width": float(f"{width:.4g}")}
        hover = f"{name}: %{{x:.3f}} px<br>%{{y}} residuals<extra></extra>"
        traces.append({"type": "bar", **bars, "marker": {"color": PALETTE[0], "opacity": 0.6}, "hovertemplate": hover, **own})
        if spread[k] > 0:
            z = (fine - mean[k]) / spread[k]
            normal = n * width * np.exp(-0.5 * z * z) / (spread[k] * np.sqrt(2 * np.pi))
            traces.append(curve(fine, normal, PALETTE[1], **own))
    layout = {
        "xaxis": axis("residual in u (px)", range=[-half, half], domain=[0, 0.46]),
        "yaxis": axis("residuals", rangemode="tozero"),
        "xaxis2": axis("residual in v (px)", range=[-half, half], domain=[0.54, 1], anchor="y2"),
        "yaxis2": {"anchor": "x2", "matches": "y", "showticklabels": False},
        "bargap": 0,
        "showlegend": False,
    }
    outside = int((np.abs(residuals_px) > half).any(1).sum())
    caption = (
        f"Bars: residuals in u (mean {mean[0]:+.2g} px, standard deviation {spread[0]:.3g} px) and in v "
        f"({mean[1]:+.2g} px, {spread[1]:.3g} px). Curve: the normal distribution of the same mean and spread. "
        "A tall middle with long tails means outliers; a mean far from zero, a wrong model."
        + (f" {outside:,} residuals lie outside the plot." if outside else "")
    )
    return plot(traces, layout, label="Histogram of the residuals per axis", caption=caption, aspect=1.15)


def _arrows(
    pixels: Float[np.ndarray, "n 2"], residuals_px: Float[np.ndarray, "n 2"], image_size: tuple[int, int], names: list[str]
) -> Markup:
    n = len(pixels)
    rows = sample(n, _SHOWN_ARROWS)
    typical = float(np.percentile(np.hypot(*residuals_px.T), 95))
    magnification = round_number(_ARROW_SHARE * image_size[0] / typical) if typical > 0 else 1.0
    tail, shaft = pixels[rows], magnification * residuals_px[rows]
    tip, across = tail + shaft, np.stack([-shaft[:, 1], shaft[:, 0]], 1)
    barbs = [tip - 0.25 * shaft + side * 0.12 * across for side in (1, -1)]
    path = broken(np.stack([tail, tip, barbs[0], tip, barbs[1]], 1))
    text = [f"{names[i]}: ({residuals_px[i, 0]:.3f}, {residuals_px[i, 1]:.3f}) px" for i in rows]
    traces = [
        curve(path[:, 0], path[:, 1], PALETTE[0], width=1),
        dots(tail[:, 0], tail[:, 1], PALETTE[1], "%{text}", text=text, size=3),
    ]
    caption = (
        f"Arrows point from the observed point along its residual, magnified {magnification:g} times. Neighbours should point in "
        f"random directions: a common direction or a swirl is what the model does not explain.{sample_note(n, _SHOWN_ARROWS)}"
    )
    aspect = image_size[0] / image_size[1] * 0.97
    return plot(traces, image_axes(image_size), label="Residuals over the image", caption=caption, wide=True, aspect=aspect)


def _magnitude(distance: Float[np.ndarray, " n"], length: Float[np.ndarray, " n"], title: str, names: list[str]) -> Markup:
    n, known = len(distance), np.flatnonzero(np.isfinite(distance))
    rows = sample(n)
    order = known[np.argsort(distance[known], kind="stable")]
    groups = [g for g in np.array_split(order, int(np.clip(len(order) // 25, 1, 16))) if len(g)]
    middle = np.array([distance[g].mean() for g in groups])
    rms = np.array([np.sqrt((length[g] ** 2).mean()) for g in groups])
    overall = float(np.sqrt((length**2).mean()))
    text = [names[i] for i in rows]
    grouped: dict[str, Any] = {"mode": "lines+markers", "marker": {"size": 7}, "name": "RMS of groups of equal size"}
    traces = [
        dots(distance[rows], length[rows], PALETTE[0], "%{text}<br>%{y:.3f} px", text=text, opacity=0.35, name="one point"),
        curve(middle, rms, PALETTE[1], "RMS %{y:.3f} px", **grouped),
    ]
    line = {"color": QUIET, "width": 1, "dash": "dash"}
    layout = {
        "xaxis": axis(title, rangemode="tozero"),
        "yaxis": axis("length of the residual (px)", rangemode="tozero"),
        "shapes": [{"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": overall, "y1": overall, "line": line}],
        "legend": legend_above(),
    }
    caption = (
        f"The curve should be level at the overall RMS per point ({overall:.3g} px, dashed); a rise towards the rim means that "
        f"the model fails there or that corners are found less well.{sample_note(n)}"
    )
    return plot(traces, layout, label=f"Residual against {title}", caption=caption, wide=True, aspect=2.4)
