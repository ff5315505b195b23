"""The 3D view: boards, lines, cameras and, where known, the truth, in a scene that can be turned."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from omnilines.records import ImagePoses, LengthUnit, Lines, Segments
from omnilines.report.numbers import figure
from omnilines.report.page import Section, fragment
from omnilines.report.plots import PALETTE, QUIET, Trace, axis, broken, numbers, plot, sample, sample_note

SHOWN_LINES = 10_000
"""More lines than this are sampled for the view, and the page says so."""
ASPECT = 1.6
"""Width of the picture over its height."""
OF_LEGEND = 0.12
"""Of the width, left of the view, for the names of up to twenty groups."""
OUTLYING = 0.02
"""Share of the ends of lines, at each side of each axis, that need not be in the first view."""
BEYOND = 0.25
"""Of the extent without them, how far beyond it the view reaches at most."""
FAR_CAMERA = 5.0
"""Cameras farther from the median one than so many median distances need not be in view."""
FIELD_RAD = math.radians(45.0)
"""Plotly's field of view, up and down."""
FILLED = 0.9
"""Of the view, by the box of the scene: its axes have labels."""
OF_LINES = tuple(PALETTE[k] for k in (0, 1, 3, 5, 6, 7, 2))
"""Colours of groups of lines, again and again; the one left out is that of cameras."""
DARKER = 0.6
"""By how much, each time."""


def scene_section(
    *,
    boards: Sequence[tuple[str, Float[np.ndarray, "4 3"]]] = (),
    lines: Lines | None = None,
    groups: Sequence[str] | None = None,
    segments: Segments | None = None,
    cameras: ImagePoses | None = None,
    truth_m: Float[np.ndarray, "n 2 3"] | None = None,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    title: str = "Scene",
    caption: str = "",
) -> Section:
    """A 3D view of what stands in one frame, in metres or in the unit of `lines`; it opens with the whole scene in view.

    `boards` are (name, corners in order around the quadrilateral). `groups` labels each of `lines` for colour and legend
    (by default its status); lines without end points are counted, not drawn. `segments` are those that the lines were made from:
    a line that is clicked names the photos of its own. `cameras` are drawn as pyramids that open along the optical axis.
    `truth_m` holds the ends of the true lines. `up` is the direction drawn upwards: (0, -1, 0) for a camera frame, z for a world.
    A few far lines or cameras lie outside the view and do not shrink it.
    """
    ends = np.empty((0, 2, 3)) if lines is None else lines.ends_m[lines.known]
    centres = np.empty((0, 3)) if cameras is None else cameras.cam_from_world.centre.numpy().reshape(-1, 3)
    corners = np.stack([quad for _, quad in boards]) if boards else np.empty((0, 4, 3))
    truth = np.empty((0, 2, 3)) if truth_m is None else truth_m
    points = np.concatenate([ends.reshape(-1, 3), centres, corners.reshape(-1, 3), truth.reshape(-1, 3)])
    if not len(points):
        return Section(title, fragment("plots", intro="There is nothing to show in 3D.", plots=[]))
    traces = [*_boards(boards), *_truth(truth_m), *_lines(lines, groups), *_cameras(cameras, _pyramid_height(points, centres))]
    limits = _limits(ends.reshape(-1, 3), centres, np.concatenate([corners.reshape(-1, 3), truth.reshape(-1, 3)]))
    outside = int(((points < limits[:, 0]) | (points > limits[:, 1])).any(1).sum())
    extent = limits[:, 1] - limits[:, 0]
    sign = (LengthUnit.METRES if lines is None else lines.unit).sign
    layout = {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"x": 0, "y": 1, "itemsizing": "constant"},
        "showlegend": True,
        **({} if lines is None or segments is None else {"meta": _picks(lines, segments)}),
        "scene": {
            "domain": {"x": [OF_LEGEND, 1.0], "y": [0.0, 1.0]},
            "aspectmode": "manual",
            "aspectratio": _xyz(extent / extent.max()),
            "camera": _camera(np.array(up), extent / extent.max()),
            "dragmode": "turntable" if up == (0.0, 0.0, 1.0) else "orbit",
            **{
                f"{name}axis": axis(f"{name} ({sign})", nticks=6, range=numbers(own))
                for name, own in zip("xyz", limits, strict=True)
            },
        },
    }
    hint = (
        "Drag to turn, scroll to zoom, right-drag to move. A click in the legend hides or shows a group, a double click shows it "
        "alone."
    )
    hint += " Hover over a line for its track, status and standard deviation." if lines is not None else ""
    hint += f" {outside:,} far {'point lies' if outside == 1 else 'points lie'} outside the view." if outside else ""
    figure = plot(traces, layout, label="3D view", caption=f"{caption} {_counts(lines)}{hint}".strip(), wide=True, aspect=ASPECT)
    return Section(title, fragment("plots", intro="", plots=[figure]))


def _counts(lines: Lines | None) -> str:
    if lines is None:
        return ""
    known = int(lines.known.sum())
    text = f"{known:,} of {len(lines):,} tracks have a line in space."
    return f"{text}{sample_note(known, SHOWN_LINES)} ".replace("points", "lines")


def _boards(boards: Sequence[tuple[str, Float[np.ndarray, "4 3"]]]) -> list[Trace]:
    if not boards:
        return []
    quads = np.stack([quad for _, quad in boards])
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    x, y, z = quads.reshape(-1, 3).T
    outline = broken(quads[:, [0, 1, 2, 3, 0]])
    names = [name for name, _ in boards]
    return [
        {
            "type": "mesh3d",
            "x": numbers(x),
            "y": numbers(y),
            "z": numbers(z),
            **{key: triangles[:, k].tolist() for k, key in enumerate("ijk")},
            "color": PALETTE[2],
            "opacity": 0.18,
            "hoverinfo": "skip",
            "legendgroup": "boards",
            "showlegend": False,
            "flatshading": True,
        },
        _strokes(outline, [n for name in names for n in [name] * 6], "boards", PALETTE[2], width=3),
    ]


def _lines(lines: Lines | None, groups: Sequence[str] | None) -> list[Trace]:
    if lines is None:
        return []
    labels = list(lines.status if groups is None else groups)
    rows = np.flatnonzero(lines.known)
    rows = rows[sample(len(rows), SHOWN_LINES)]
    traces = []
    shown = sorted(dict.fromkeys(labels[i] for i in rows), key=_number)
    numbered = [label for label in shown if _number(label) < np.inf]
    for k, label in enumerate(shown):
        own = [int(i) for i in rows if labels[i] == label]
        # The middle is there to be hovered over: only vertices answer the mouse.
        ends = lines.ends_m[own]
        path = broken(np.stack([ends[:, 0], ends.mean(1), ends[:, 1]], 1))
        text = [t for i in own for t in [_describe(lines, i)] * 3 + [""]]
        # What is of no numbered group, such as "no family", has no colour of one.
        colour = QUIET if numbered and label not in numbered else _colour(k)
        traces.append(_strokes(path, text, label, colour, width=4))
    return traces


def _colour(k: int) -> str:
    """Of the k-th group of lines; those that come again are darker each time."""
    again, own = divmod(k, len(OF_LINES))
    red, green, blue = (int(OF_LINES[own][at : at + 2], 16) for at in (1, 3, 5))
    return "#" + "".join(f"{round(part * DARKER**again):02x}" for part in (red, green, blue))


def _number(label: str) -> float:
    """That a label ends in; those without one keep their order, behind."""
    last = label.rpartition(" ")[2]
    return float(last) if last.isdecimal() else np.inf


def _picks(lines: Lines, segments: Segments) -> dict[str, Any]:
    """What the page says of a line that is clicked: its photos, as their numbers, by its track, which its text begins with."""
    seen: dict[str, list[int]] = {track: [] for track in np.array(lines.tracks)[lines.known].tolist()}
    matched = segments.track >= 0
    for track, image in np.unique(np.stack([segments.track, segments.image], 1)[matched], axis=0).tolist():
        if segments.tracks[track] in seen:
            seen[segments.tracks[track]].append(image)
    return {"photos": list(segments.images), "lines": seen}


def _describe(lines: Lines, row: int) -> str:
    sigma = figure(1e3 * lines.sigma_m[row], unit=lines.unit.thousandth)
    share = np.nan if lines.chance_share is None else float(lines.chance_share[row])
    chance = "" if np.isnan(share) else f"<br>of lines like it {figure(100 * share, '.2g')} percent are there by chance"
    return (
        f"{lines.tracks[row]}: {lines.status[row]}, {lines.views[row]} views<br>"
        f"largest sigma across {sigma}, residual {figure(lines.rms_px[row], unit='px')}{chance}"
    )


def _truth(truth_m: Float[np.ndarray, "n 2 3"] | None) -> list[Trace]:
    if truth_m is None:
        return []
    path = broken(truth_m[sample(len(truth_m), SHOWN_LINES)])
    return [_strokes(path, [], "truth", QUIET, width=2)]


def _cameras(cameras: ImagePoses | None, height_m: float) -> list[Trace]:
    """Pyramids from each centre along its optical axis; their bases are 4:3 and stand as the image does, a mark at its top."""
    if cameras is None:
        return []
    u, v = 0.6 * height_m, 0.45 * height_m
    a, b, c, d = np.array([[-u, -v, height_m], [u, -v, height_m], [u, v, height_m], [-u, v, height_m]])
    apex, top = np.zeros(3), np.array([0.0, -1.5 * v, height_m])
    outline = np.stack([apex, a, b, c, d, a, top, b, apex, c, d, apex])
    world_from_cam = cameras.cam_from_world.inverse()
    rotation = world_from_cam.rotation.numpy().reshape(-1, 3, 3)
    centres = world_from_cam.translation.numpy().reshape(-1, 1, 3)
    path = broken(outline @ rotation.transpose(0, 2, 1) + centres)
    text = [name for name in cameras.images for _ in range(len(outline) + 1)]
    return [_strokes(path, text, "cameras", PALETTE[4], width=3)]


def _strokes(path: Float[np.ndarray, "m 3"], text: list[str], name: str, colour: str, width: int) -> Trace:
    """One trace of broken curves under one name of the legend; without `text` it does not answer the mouse."""
    trace: Trace = {
        "type": "scatter3d",
        "mode": "lines",
        "x": numbers(path[:, 0]),
        "y": numbers(path[:, 1]),
        "z": numbers(path[:, 2]),
        "line": {"color": colour, "width": width},
        "name": name,
        "legendgroup": name,
    }
    return {**trace, **({"text": text, "hovertemplate": "%{text}<extra></extra>"} if text else {"hoverinfo": "skip"})}


def _pyramid_height(points: Float[np.ndarray, "n 3"], centres: Float[np.ndarray, "m 3"]) -> float:
    """A fifteenth of the scene, and not so large that neighbouring cameras hide each other."""
    extent = float(np.linalg.norm(np.ptp(np.quantile(points, [0.02, 0.98], axis=0), axis=0))) or 1.0
    if len(centres) < 2:
        return extent / 15
    step = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    return float(np.clip(0.8 * step, extent / 60, extent / 15))


def _limits(
    ends: Float[np.ndarray, "n 3"], centres: Float[np.ndarray, "m 3"], others: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "3 2"]:
    """What the view shows along each axis: a few far lines or cameras must not shrink all else to a dot."""
    boxes = [np.quantile(ends, [OUTLYING, 1 - OUTLYING], axis=0)] if len(ends) else []
    if len(centres):
        away = np.linalg.norm(centres - np.median(centres, axis=0), axis=-1)
        near = centres[away <= FAR_CAMERA * (np.median(away) or np.inf)]
        boxes += [near]
    boxes += [others] if len(others) else []
    core = np.concatenate(boxes)
    low, high = core.min(0), core.max(0)
    reach = BEYOND * max(float((high - low).max()), 1e-9)
    points = np.concatenate([ends, centres, others])
    inside = points[((points >= low - reach) & (points <= high + reach)).all(1)]
    inside = np.concatenate([inside, core])
    pad = max(0.03 * float(np.ptp(inside, axis=0).max()), 1e-9)
    return np.stack([inside.min(0) - pad, inside.max(0) + pad], 1)


def _camera(up: Float[np.ndarray, "3"], sides: Float[np.ndarray, "3"]) -> dict[str, dict[str, float]]:
    """Plotly's camera above and aside (in a camera frame, behind the camera), as near as shows a box of these sides whole.

    A corner p is in view where |p . v - c| <= h (d - p . n), n the direction to the eye, v one across it, d the distance, c
    what the eye is moved along v by, h the half field; so the least d and its c follow from the extreme corners.
    """
    up = up / np.linalg.norm(up)
    aside = np.array([0.7, -1.0, -0.6])
    aside = aside - (aside @ up) * up
    towards = 1.8 * aside / np.linalg.norm(aside) + 0.9 * up
    towards = towards / np.linalg.norm(towards)
    right = np.cross(up, towards)
    right = right / np.linalg.norm(right)
    corners = 0.5 * sides * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    depth, half = corners @ towards, FILLED * math.tan(FIELD_RAD / 2)
    distance, centre = 0.0, np.zeros(3)
    for across, reach in ((right, half * (1.0 - OF_LEGEND) * ASPECT), (np.cross(towards, right), half)):
        low, high = (corners @ across - reach * depth).min(), (corners @ across + reach * depth).max()
        distance, centre = max(distance, float(high - low) / (2 * reach)), centre + 0.5 * (low + high) * across
    return {"up": _xyz(up), "eye": _xyz(centre + distance * towards), "center": _xyz(centre)}


def _xyz(vector: Float[np.ndarray, "3"]) -> dict[str, float]:
    return dict(zip("xyz", (round(float(c), 4) for c in vector), strict=True))
