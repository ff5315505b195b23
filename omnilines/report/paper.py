"""The figures of a report for papers: what a page holds for plotly, drawn by matplotlib as PNG and SVG, black on white.

Only what the sections of this package use of plotly is known: `plots.py` and its neighbours say what that is.
"""

import io
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from camera_models.formats.disk import read_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = ("png", "svg")
WIDTH_IN, DOTS_PER_IN = 6.4, 300
"""Of a figure; a wide one of the page is as wide."""
POINTS_PER_PX = 0.6
"""Strokes and dots of the page, which is wider, on paper."""


@dataclass(frozen=True)
class PaperFigure:
    """A figure of a page."""

    name: str
    """Of its files, without their endings."""
    spec: dict[str, Any]
    """Its data and layout, as plotly takes them."""
    aspect: float
    """Width over height."""

    def file(self, kind: str) -> bytes:
        """As a file of one of KINDS; the same figure gives the same bytes."""
        import matplotlib

        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": self.name, "font.size": 8}):
            content = io.BytesIO()
            metadata = {"Date": None} if kind == "svg" else {"Software": None}
            self.drawing.savefig(content, format=kind, dpi=DOTS_PER_IN, metadata=metadata)
        return content.getvalue()

    @cached_property
    def drawing(self) -> "Figure":
        """By matplotlib."""
        from matplotlib.figure import Figure

        drawing = Figure(figsize=(WIDTH_IN, WIDTH_IN / self.aspect), layout="constrained")
        if "scene" in self.spec["layout"]:
            _draw_scene(drawing, self.spec)
        else:
            _draw_plane(drawing, self.spec)
        return drawing


def paper_figures(page: str | Path) -> list[PaperFigure]:
    """All figures of a report, in their order. Raises InputError where the page cannot be read."""
    reader = _Reader()
    reader.feed(read_text(Path(page)))
    return reader.found


class _Reader(HTMLParser):
    """Collects the figures of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[PaperFigure] = []
        self._plot: tuple[str, float] | None = None
        self._inside = False
        self._heading, self._camera = False, ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        own = dict(attrs)
        self._heading = tag == "h2"
        if own.get("class") == "plot":
            self._plot = own.get("aria-label") or "figure", float((own.get("style") or "").rpartition(":")[2] or 1.5)
        self._inside = self._plot is not None and tag == "script" and own.get("type") == "application/json"

    def handle_data(self, data: str) -> None:
        if self._heading:
            # Sections of one camera of several are called after it.
            self._camera, self._heading = data.rpartition(": ")[0], False
        if self._inside and self._plot is not None:
            label, aspect = self._plot
            words = re.sub(r"[^a-z0-9]+", "-", f"{self._camera} {label}".lower()).strip("-")
            self.found.append(PaperFigure(f"{len(self.found) + 1:02d}-{words}", json.loads(data), aspect))
            self._plot, self._inside = None, False


def _values(given: Sequence[float | None]) -> Float[np.ndarray, " n"]:
    """None, where a curve breaks, is NaN."""
    return np.array([math.nan if value is None else value for value in given], dtype=np.float64)


def _line(style: dict[str, Any]) -> dict[str, Any]:
    dashes = {"dash": "--", "dot": ":"}
    return {
        "color": style.get("color", "black"),
        "linewidth": POINTS_PER_PX * style.get("width", 2),
        "linestyle": dashes.get(style.get("dash", ""), "-"),
    }


def _draw_plane(drawing: "Figure", spec: dict[str, Any]) -> None:
    """Figures of the plane; each vertical axis is a panel of its own."""
    layout = spec["layout"]
    panels = list(dict.fromkeys(trace.get("yaxis", "y") for trace in spec["data"]))
    every = drawing.subplots(1, len(panels), squeeze=False, sharey=len(panels) > 1)[0]
    for name, axes in zip(panels, every, strict=True):
        for trace in spec["data"]:
            if trace.get("yaxis", "y") == name:
                _draw_trace(drawing, axes, trace)
        for shape in layout.get("shapes", ()):
            _draw_shape(axes, shape)
    # Axes that panels share end where the highest of them does: they are set when all is drawn.
    for name, axes in zip(panels, every, strict=True):
        across, up = (layout.get(f"{axis}axis{name[1:].removeprefix('1')}", {}) for axis in "xy")
        _set_axis(axes, "x", across)
        _set_axis(axes, "y", up)
        if "scaleanchor" in up:
            axes.set_aspect("equal")
    shown = every[0].get_legend_handles_labels()
    if layout.get("showlegend", len(shown[1]) > 1):
        drawing.legend(*shown, loc="outside upper left", ncols=3, frameon=False)


def _draw_trace(drawing: "Figure", axes: "Axes", trace: dict[str, Any]) -> None:
    kind, name = trace["type"], trace.get("name")
    if kind == "heatmap":
        _draw_map(drawing, axes, trace)
    elif kind == "contour":
        level = trace["contours"]["start"]
        z = np.array([_values(row) for row in trace["z"]])
        lines = axes.contour(trace["x"], trace["y"], z, levels=[level], colors="black", linewidths=0.6)
        axes.clabel(lines, fmt=lambda value: f"{value:g}")
    elif kind == "bar":
        axes.bar(trace["x"], trace["y"], trace["width"], color=trace["marker"]["color"], alpha=trace["marker"]["opacity"])
    else:
        x, y = _values(trace["x"]), _values(trace["y"])
        mode, marker = trace["mode"], trace.get("marker", {})
        if "lines" in mode:
            axes.plot(x, y, label=name, **_line(trace["line"]))
            if trace.get("fill"):
                axes.fill_between(x, y, color=trace["line"]["color"], alpha=0.2)
        if "markers" in mode:
            colour = marker.get("color", trace.get("line", {}).get("color"))
            size = (POINTS_PER_PX * marker.get("size", 4)) ** 2
            label = None if "lines" in mode else name
            axes.scatter(x, y, s=size, color=colour, alpha=marker.get("opacity", 1.0), linewidths=0, label=label)


def _draw_map(drawing: "Figure", axes: "Axes", trace: dict[str, Any]) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("map", [(stop, colour) for stop, colour in trace["colorscale"]])
    z = np.array([_values(row) for row in trace["z"]])
    shown = axes.pcolormesh(
        trace["x"], trace["y"], z, cmap=colours, vmin=trace["zmin"], vmax=trace["zmax"], shading="nearest", rasterized=True
    )
    bar = trace["colorbar"]
    scale = drawing.colorbar(shown, ax=axes, location="top", shrink=0.8, aspect=40)
    scale.set_label(bar["title"]["text"])
    scale.set_ticks(bar["tickvals"], labels=bar["ticktext"])


def _draw_shape(axes: "Axes", shape: dict[str, Any]) -> None:
    """The frame of an image, and lines right across a figure."""
    from matplotlib.patches import Rectangle

    if shape["type"] == "rect":
        corner, sides = (shape["x0"], shape["y0"]), (shape["x1"] - shape["x0"], shape["y1"] - shape["y0"])
        axes.add_patch(Rectangle(corner, *sides, fill=False, edgecolor=shape["line"]["color"], linewidth=0.6))
    elif shape.get("xref") == "paper":
        axes.axhline(shape["y0"], **_line(shape["line"]))
    else:
        axes.axvline(shape["x0"], **_line(shape["line"]))


def _set_axis(axes: "Axes", name: str, given: dict[str, Any]) -> None:
    text = given.get("title", {}).get("text", "")
    logarithmic = given.get("type") == "log"
    scale, label, limits = (getattr(axes, f"set_{name}{what}") for what in ("scale", "label", "lim"))
    if logarithmic:
        scale("log")
    label(text)
    if given.get("range"):
        limits(*(10.0**end if logarithmic else end for end in given["range"]))
    elif given.get("rangemode") == "tozero":
        limits(0.0, None)


def _draw_scene(drawing: "Figure", spec: dict[str, Any]) -> None:
    """Figures of space, seen as the page first shows them."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axes: Any = drawing.add_subplot(projection="3d", computed_zorder=False)
    scene = spec["layout"]["scene"]
    upright, names = _upright(np.array([scene["camera"]["up"][k] for k in "xyz"]))
    named: set[str] = set()
    points = [np.empty((0, 3))]
    for trace in spec["data"]:
        if trace.get("visible") == "legendonly":
            continue
        path = np.stack([_values(trace[k]) for k in "xyz"], 1) @ upright.T
        points.append(path)
        if trace["type"] == "mesh3d":
            triangles = path[np.stack([trace[k] for k in "ijk"], 1)]
            axes.add_collection3d(Poly3DCollection(triangles, facecolor=trace["color"], alpha=trace["opacity"]))
            continue
        label = trace["name"] if trace.get("showlegend", True) and trace["name"] not in named else None
        named.add(trace["name"])
        if "lines" in trace["mode"]:
            axes.plot(*path.T, label=label, **_line({**trace["line"], "width": 0.5 * trace["line"]["width"]}))
        if "markers" in trace["mode"]:
            axes.scatter(*path.T, s=6, color=trace["marker"]["color"])
            for place, words in zip(path.tolist(), trace["text"], strict=True):
                axes.text(*place, f" {words}")
    low, high = _seen(scene, np.concatenate(points) @ upright, upright)
    sides = np.maximum(high - low, 1e-9)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(np.maximum(sides / sides.max(), 0.05), zoom=1.2)
    for name, words in zip("xyz", names, strict=True):
        getattr(axes, f"set_{name}label")(words and words + scene["xaxis"]["title"]["text"].removeprefix("x"))
    camera = scene["camera"]
    centre = camera.get("center", dict.fromkeys("xyz", 0.0))
    x, y, z = upright @ np.array([camera["eye"][k] - centre[k] for k in "xyz"])
    axes.view_init(elev=math.degrees(math.atan2(z, math.hypot(x, y))), azim=math.degrees(math.atan2(y, x)))
    if named:
        drawing.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=4, frameon=False)


def _seen(
    scene: dict[str, Any], points: Float[np.ndarray, "n 3"], upright: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The box that the page shows, or that holds all, in the axes of the drawing."""
    points = points[np.isfinite(points).all(1)]
    box = np.array([scene[f"{k}axis"].get("range") or (points[:, i].min(), points[:, i].max()) for i, k in enumerate("xyz")])
    corners = np.array([[x, y, z] for x in box[0] for y in box[1] for z in box[2]]) @ upright.T
    return corners.min(0), corners.max(0)


def _upright(up: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3 3"], tuple[str, str, str]]:
    """The turn that puts `up` on z, and what the axes then are; nothing where they are no axes of the scene."""
    up = up / np.linalg.norm(up)
    if up[2] > 0.999:
        return np.eye(3), ("x", "y", "z")
    if up[1] < -0.999:
        return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), ("x", "z", "−y")
    across = np.cross([0.0, 1.0, 0.0], up) if abs(up[1]) < 0.9 else np.cross([1.0, 0.0, 0.0], up)
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up]), ("", "", "")
