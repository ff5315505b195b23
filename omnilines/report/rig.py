"""A rig drawn: cameras with their fields of view, which of them see the same boards, and the weakest link."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from omnilines.report.page import Section, fragment
from omnilines.report.plots import PALETTE, QUIET, Trace, axis, broken, numbers, plot, sample

SHOWN_BOARDS = 300
"""More boards than this are sampled for the drawing."""
WEAK = PALETTE[6]
WIDEST_LINE, THINNEST_LINE = 9.0, 2.0


@dataclass(frozen=True)
class RigCameraDrawing:
    """One camera: its name, where it is in the rig (metres), and its field of view as curves of unit directions in the rig."""

    name: str
    centre_m: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "n k 3"]


@dataclass(frozen=True)
class RigLinkDrawing:
    """Two cameras (their numbers) that see the same boards, what to say of them, and how many corners both see."""

    first: int
    second: int
    text: str
    corners: int
    weakest: bool


def rig_section(
    cameras: Sequence[RigCameraDrawing],
    links: Sequence[RigLinkDrawing],
    boards: Sequence[tuple[str, Float[np.ndarray, "4 3"]]] = (),
    *,
    title: str = "The rig",
) -> Section:
    """The rig in 3D, in the frame of its first camera: x right, y down, z along that camera's axis.

    A field of view is drawn on a sphere round its camera; a link is the thicker the more corners both cameras see; boards are
    those of all frames (a sample where there are many).
    """
    centres = np.stack([camera.centre_m for camera in cameras])
    size = _size(centres, boards)
    traces = [*_boards(boards), *_links(centres, links)]
    for number, camera in enumerate(cameras):
        colour = PALETTE[number % len(PALETTE)]
        curves = camera.centre_m + size * camera.directions
        traces.append(_path(broken(curves), camera.name, colour, 3.0, f"{camera.name}: field of view"))
        traces.append(_dot(camera.centre_m, camera.name, colour))
    up = {"x": 0.0, "y": -1.0, "z": 0.0}
    layout = {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"x": 0, "y": 1, "itemsizing": "constant"},
        "showlegend": True,
        "scene": {
            "aspectmode": "data",
            "camera": {"up": up, "eye": {"x": 0.9, "y": -1.1, "z": -1.2}},
            "dragmode": "orbit",
            **{f"{name}axis": axis(f"{name} (m)", nticks=6) for name in "xyz"},
        },
    }
    caption = (
        "Each camera with what it sees of the sphere round it, in the frame of the first camera. Lines join cameras that see the "
        "same boards: the thicker, the more corners they have in common. Drag to turn, scroll to zoom; a click in the legend "
        "hides a camera or shows the boards of all frames."
    )
    if any(link.weakest for link in links):
        caption += " The weakest link is red."
    figure = plot(traces, layout, label="The rig in 3D", caption=caption, wide=True, aspect=1.6)
    return Section(title, fragment("plots", intro="", plots=[figure]))


def _size(centres: Float[np.ndarray, "n 3"], boards: Sequence[tuple[str, Float[np.ndarray, "4 3"]]]) -> float:
    """Radius at which fields of view are drawn: somewhat less than half of the distance between neighbouring cameras."""
    if len(centres) > 1:
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
        np.fill_diagonal(apart, np.inf)
        return 0.45 * float(np.median(apart.min(1)))
    reach = [float(np.linalg.norm(quad - centres[0], axis=-1).mean()) for _, quad in boards]
    return 0.3 * float(np.median(reach)) if reach else 0.1


def _links(centres: Float[np.ndarray, "n 3"], links: Sequence[RigLinkDrawing]) -> list[Trace]:
    most = max((link.corners for link in links), default=0) or 1
    traces = []
    # The middle is there to be hovered over: only vertices answer the mouse.
    for link in sorted(links, key=lambda item: item.weakest):
        a, b = centres[link.first], centres[link.second]
        width = THINNEST_LINE + (WIDEST_LINE - THINNEST_LINE) * (link.corners / most) ** 0.5
        colour, group = (WEAK, "weakest link") if link.weakest else (QUIET, "common corners")
        traces.append(_path(np.stack([a, 0.5 * (a + b), b]), group, colour, width, link.text))
    shown: set[str] = set()
    for trace in traces:
        trace["showlegend"] = trace["name"] not in shown
        shown.add(trace["name"])
    return traces


def _boards(boards: Sequence[tuple[str, Float[np.ndarray, "4 3"]]]) -> list[Trace]:
    if not boards:
        return []
    chosen = [boards[int(k)] for k in sample(len(boards), SHOWN_BOARDS)]
    path = broken(np.stack([quad for _, quad in chosen])[:, [0, 1, 2, 3, 0]])
    text = [name for name, _ in chosen for _ in range(6)]
    # Hidden at first: boards are far away from small rigs, which they would shrink to a dot.
    return [{**_path(path, "boards", PALETTE[2], 1.0, ""), "text": text, "visible": "legendonly"}]


def _path(path: Float[np.ndarray, "m 3"], name: str, colour: str, width: float, hover: str) -> Trace:
    trace: dict[str, Any] = {"type": "scatter3d", "mode": "lines", "name": name, "legendgroup": name}
    trace |= {key: numbers(path[:, k]) for k, key in enumerate("xyz")}
    return {**trace, "line": {"color": colour, "width": width}, "text": hover, "hovertemplate": "%{text}<extra></extra>"}


def _dot(centre: Float[np.ndarray, "3"], name: str, colour: str) -> Trace:
    trace: dict[str, Any] = {"type": "scatter3d", "mode": "markers+text", "name": name, "legendgroup": name, "showlegend": False}
    trace |= {key: numbers(centre[k : k + 1]) for k, key in enumerate("xyz")}
    return {**trace, "marker": {"size": 5, "color": colour}, "text": [name], "hovertemplate": f"{name}<extra></extra>"}
