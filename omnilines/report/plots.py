"""What the plots share: the palette, arrays as JSON numbers, sampling of large point sets, image axes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup

from omnilines.report.page import fragment

PALETTE = ("#2f7fc1", "#d06a0b", "#0f8f6c", "#b9589a", "#7a6fd0", "#a07d00", "#c2413b", "#5b7f95")
"""Eight colours told apart with the common colour deficiencies in this order, each at least 3:1 on white and on near-black."""
QUIET = "#8a8f98"
"""Reference curves, frames and truth."""
SHOWN_POINTS = 5000
"""More points than this are sampled for drawing, and the page says so; figures and histograms use all of them."""

Trace = dict[str, Any]


def plot(
    traces: Sequence[Trace],
    layout: Mapping[str, Any],
    *,
    label: str,
    caption: str | Markup,
    wide: bool = False,
    aspect: float = 1.5,
) -> Markup:
    """A plotly figure with its caption; colours of text and axes come from the page, which knows light from dark.

    `label` names it for screen readers; `aspect` is width over height; `wide` gives it the whole width of the page.
    """
    spec = {"data": list(traces), "layout": {"margin": {"l": 64, "r": 16, "t": 16, "b": 52}, **layout}}
    return fragment("plot", spec=spec, label=label, caption=caption, wide=wide, aspect=round(aspect, 3))


def numbers(values: Float[np.ndarray, "..."] | Int[np.ndarray, "..."], digits: int = 5) -> list[float | None]:
    """A flat list with `digits` significant digits; None, where a curve breaks, for what is not finite."""
    return [float(f"{x:.{digits}g}") if math.isfinite(x) else None for x in np.ravel(values).tolist()]


def dots(
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " n"],
    colour: str,
    hover: str,
    *,
    text: Sequence[str] | None = None,
    size: int = 4,
    opacity: float = 1.0,
    **more: Any,
) -> Trace:
    """A trace of points that show `hover`, plotly's template, under the mouse; `%{text}` in it is the point's own."""
    trace = {"type": "scatter", "mode": "markers", "x": numbers(x), "y": numbers(y), "hovertemplate": f"{hover}<extra></extra>"}
    own = {} if text is None else {"text": list(text)}
    return {**trace, **own, "marker": {"size": size, "color": colour, "opacity": opacity}, **more}


def curve(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], colour: str, hover: str | None = None, *, width: int = 2, **more: Any
) -> Trace:
    """A trace of one curve, broken at NaN, that shows `hover` under the mouse or nothing."""
    own = {"hoverinfo": "skip"} if hover is None else {"hovertemplate": f"{hover}<extra></extra>"}
    line = {"color": colour, "width": width}
    return {"type": "scatter", "mode": "lines", "x": numbers(x), "y": numbers(y), "line": line, **own, **more}


def broken(curves: Float[np.ndarray, "n k d"]) -> Float[np.ndarray, "m d"]:
    """n curves of k points as one curve that breaks (NaN) after each."""
    n, k, d = curves.shape
    gaps = np.full((n, 1, d), np.nan)
    return np.concatenate([curves, gaps], axis=1).reshape(n * (k + 1), d)


def sample(n: int, shown: int = SHOWN_POINTS) -> Int[np.ndarray, " m"]:
    """Sorted indices of at most `shown` of `n` points, the same ones every time."""
    if n <= shown:
        return np.arange(n)
    return np.sort(np.random.default_rng(0).choice(n, shown, replace=False))


def sample_note(n: int, shown: int = SHOWN_POINTS) -> str:
    """The sentence that says that not all points are drawn; empty where they are."""
    return f" A random {shown:,} of {n:,} points are drawn; all of them are counted." if n > shown else ""


def axis(title: str, **options: Any) -> dict[str, Any]:
    """A plotly axis with its title."""
    return {"title": {"text": title}, **options}


def image_axes(image_size: tuple[int, int]) -> dict[str, Any]:
    """Axes of the image plane in pixels, u right and v down, equal scales, with the image's frame drawn."""
    width, height = image_size
    frame = {"type": "rect", "x0": -0.5, "y0": -0.5, "x1": width - 0.5, "y1": height - 0.5, "line": {"color": QUIET, "width": 1}}
    pad_u, pad_v = 0.01 * width, 0.01 * height
    return {
        "xaxis": axis("u (px)", range=[-0.5 - pad_u, width - 0.5 + pad_u], constrain="domain", showgrid=False, zeroline=False),
        "yaxis": axis(
            "v (px)",
            range=[height - 0.5 + pad_v, -0.5 - pad_v],
            scaleanchor="x",
            constrain="domain",
            showgrid=False,
            zeroline=False,
        ),
        "shapes": [frame],
        "showlegend": False,
    }


def legend_above() -> dict[str, Any]:
    """A legend in one row over the plot, where it hides nothing."""
    return {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0}


def round_number(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `value` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-12))
