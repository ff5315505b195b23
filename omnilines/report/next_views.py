"""The boards to shoot next, drawn over the map of the projection uncertainty."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from omnilines.records import Summary
from omnilines.report.page import Section, fragment
from omnilines.report.plots import PALETTE, broken, curve, dots, image_axes, plot, sample
from omnilines.report.uncertainty import INK, map_traces


def photo_words(place: int) -> str:
    """What the photo at a place, from 0, of those to be shot is called."""
    return "next photo" if place == 0 else f"photo {place + 1}"


def next_views_section(
    summary: Summary,
    boards_px: Sequence[Float[np.ndarray, "k s 2"]],
    sigma_px: Float[np.ndarray, "h w"],
    u_px: Float[np.ndarray, " w"],
    v_px: Float[np.ndarray, " h"],
    image_size: tuple[int, int],
    *,
    corners_px: Float[np.ndarray, "n 2"],
    title: str = "What to shoot next",
) -> Section:
    """Each of the boards as its rows and columns in the image (NaN where they have none) over the uncertainty `sigma_px` at the
    pixels (u_px, v_px), as in `uncertainty_section`, and the table of `summary`."""
    table = fragment("summary", summaries=(summary,), title=title)
    sigma = np.where(np.isfinite(sigma_px) & (sigma_px > 0), sigma_px, np.nan)
    if not np.isfinite(sigma).any() or not boards_px:
        return Section(title, table)
    rows = sample(len(corners_px))
    seen = dots(corners_px[rows, 0], corners_px[rows, 1], INK, "", size=3, opacity=0.25, hoverinfo="skip", hovertemplate=None)
    traces = [map_traces(sigma, u_px, v_px)[0], {**seen, "showlegend": False}]
    for k, lines in enumerate(boards_px):
        path = broken(lines)
        name = photo_words(k)
        traces.append(
            curve(path[:, 0], path[:, 1], PALETTE[k % len(PALETTE)], width=3 if k == 0 else 2, name=name, showlegend=True)
        )
    # Below the title of the axis, however high the figure is.
    below = {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom", "x": 0}
    margin = {"l": 64, "r": 16, "t": 16, "b": 96}
    layout = {**image_axes(image_size), "margin": margin, "showlegend": True, "legend": below}
    caption = (
        "Grids: where the rows and columns of the board should appear, first the photo that helps most. Colours: the standard "
        "deviation of the projection now (px), as in the map of the uncertainty; dots: the corners that were seen."
    )
    aspect = image_size[0] / image_size[1] * 0.9
    figure = plot(traces, layout, label="Boards to shoot next over the image", caption=caption, wide=True, aspect=aspect)
    return Section(title, fragment("plots", intro="", plots=[figure]) + table)
