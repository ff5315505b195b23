"""Bearings of many places in a photo, and pixels of many rays.

Both change smoothly: the camera model is asked for nodes about STEP_PX apart, once for all photos of a camera, and bicubics
through them give the rest. Where fourth differences of the nodes say that the bicubics are not good enough, the model
is asked for every place or ray.
"""

import functools
import math

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models import CameraModel
from omnilines.extraction.kernels.bearing import chart_table, read_bearings, read_changes, read_pixels, smooth_cells
from omnilines.extraction.kernels.curve import rays_beside
from omnilines.extraction.kernels.tables import Charts

STEP_PX = 8.0
MOST_ERROR_PX = 3e-4
"""Of places that are interpolated."""
MOST_CHART_ERROR_PX = 2e-4
"""Of rays that are interpolated, three times over: derivatives are differences of nodes. Those of a pixel are then good to a
share of 3e-5."""
MOST_ASKED = 0.01
"""Of the nodes of an image that a chart shows: so few may lie where it is not good."""
STEP_RAD = 1e-4
"""Of the differences that give directions in the photo where the model is asked."""
_MOST_NODES = 4
"""Of a chart, for each node of the image: a model may stretch a few of them over any range."""
_MOST_FINER = 150_000
"""Nodes of a chart at half the step: some 0.1 s of CPU, once for a camera."""
_MOST_AROUND = 300_000
"""Nodes of a chart with those around what it shows: a camera may show the world as a strip, along which they would be many."""
_BEYOND = 6
"""Nodes around the image, and around what of a chart it shows."""
_INSIDE = (slice(_BEYOND, -_BEYOND), slice(_BEYOND, -_BEYOND))
"""The nodes of an image that lie in it."""
_CAMERAS = 8
"""Whose nodes are kept."""
_AHEAD = (0.0, 0.0, 1.0)
"""Stands for a bearing that is none."""
AT_A_TIME = 8_000
"""Places or rays of which the model is asked at a time: what lies below 32768 numbers torch does without threads of its own,
which burn more time than they save where every core looks at a photo already."""
FARTHEST_PX = 1e6
"""From the first pixel; a place beyond is taken to be there, and not seen. Compiled loops count places in whole numbers,
and a model with coefficients of any size may put one anywhere."""


def bearings_at(model: CameraModel, places: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """`model.unproject` of places in or near the image, to MOST_ERROR_PX; the bearings have a length of 1 to the same share of
    a pixel's angle."""
    node, _, good = _grid(model)
    bearings, valid = read_bearings(node, good, -_BEYOND * STEP_PX, STEP_PX, places)
    rows = np.flatnonzero(~valid)
    bearings[rows], valid[rows] = _asked(model, places[rows])
    return bearings, valid


@functools.lru_cache(_CAMERAS)
def _grid(model: CameraModel) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Bearings of nodes in and around the image, whether the camera sees there, and between which the bicubics are good."""
    u, v = (np.arange(-_BEYOND * STEP_PX, side + _BEYOND * STEP_PX, STEP_PX) for side in model.image_size)
    nodes, seen = _asked(model, np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    node, seen = nodes.reshape(len(v), len(u), 3), seen.reshape(len(v), len(u))
    return node, seen, smooth_cells(node, seen, MOST_ERROR_PX / STEP_PX)


@functools.lru_cache(_CAMERAS)
def axis_of(model: CameraModel) -> Float[np.ndarray, "3"]:
    """The bearing of the centre pixel."""
    with torch.no_grad():
        return model.unproject(model.centre_px.detach().numpy())[0]


def _asked(model: CameraModel, places: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    bearings, valid = np.empty((len(places), 3)), np.zeros(len(places), dtype=bool)
    for start in range(0, len(places), AT_A_TIME):
        part = slice(start, start + AT_A_TIME)
        with torch.no_grad():
            bearings[part], valid[part] = model.unproject(places[part])
    lost = ~np.isfinite(bearings).all(-1)
    bearings[lost], valid[lost] = _AHEAD, False
    return bearings, valid


def pixels_at(model: CameraModel, rays: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
    """`model.project` of many rays, to MOST_CHART_ERROR_PX in and near the image; finite and at most FARTHEST_PX away whatever
    the model."""
    flat = rays.reshape(-1, 3)
    pixels, valid = read_pixels(_charts(model), flat)
    rows = np.flatnonzero(~valid)
    if len(rows):
        pixels[rows], valid[rows] = _projected(model, flat[rows])
    return pixels.reshape(*rays.shape[:-1], 2), valid.reshape(rays.shape[:-1])


def changes_at(
    model: CameraModel, frame: Float[np.ndarray, "n 3 3"], owner: Int[np.ndarray, " m"], angle: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
    """Pixels at angles on circles whose frames have the columns normal, first, second; their changes per radian along the circle
    and towards its normal, and valid."""
    pixel, along, side, valid = read_changes(_charts(model), frame, owner, angle)
    rows = np.flatnonzero(~valid)
    if len(rows):
        rays = rays_beside(frame, owner[rows], angle[rows], STEP_RAD)
        found, seen = (part.reshape(5, len(rows), *part.shape[1:]) for part in _projected(model, rays.reshape(-1, 3)))
        step = np.stack([found[2] - found[1], found[4] - found[3]])
        if model.PERIODIC:
            step[..., 0] -= model.image_size[0] * np.round(step[..., 0] / model.image_size[0])
        pixel[rows], along[rows], side[rows] = found[0], step[0] / STEP_RAD, step[1] / STEP_RAD
        valid[rows] = seen.all(0)
    return pixel, along, side, valid


def _projected(model: CameraModel, rays: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    pixels, valid = np.empty((len(rays), 2)), np.zeros(len(rays), dtype=bool)
    for start in range(0, len(rays), AT_A_TIME):
        part = slice(start, start + AT_A_TIME)
        with torch.no_grad():
            pixels[part], valid[part] = model.project(rays[part])
    valid &= (np.abs(pixels) <= FARTHEST_PX).all(-1)
    return np.nan_to_num(pixels, copy=False, nan=FARTHEST_PX).clip(-FARTHEST_PX, FARTHEST_PX), valid


@functools.lru_cache(_CAMERAS)
def _charts(model: CameraModel) -> Charts:
    """Pixels of nodes on both half spheres, where they show the image: at the median step of the image's nodes, halved while
    more than MOST_ASKED of what a half sphere shows lies between nodes that are not good, as far as _MOST_FINER allows."""
    node, seen, _ = _grid(model)
    begin, shape, origin, step = np.zeros(2, dtype=np.int64), np.zeros((2, 2), dtype=np.int64), np.zeros((2, 2)), np.ones(2)
    nodes, good = [np.zeros((0, 8))], [np.zeros(0, dtype=bool)]
    for side in range(2):
        own = seen & ((node[..., 2] < 0) == (side == 1))
        both = own[:, 1:] & own[:, :-1]
        if not both.any():
            continue
        place = node[..., :2] / (1.0 + np.abs(node[..., 2:]))
        shown, inside = place[own], place[_INSIDE][own[_INSIDE]]
        # Where a polynomial runs out of the image's scene, nearly all steps may be next to nothing.
        extent = np.ptp(shown, axis=0)
        area = float((extent + 1e-9).prod())
        median = float(np.median(np.linalg.norm(np.diff(place, axis=1)[both], axis=-1)))
        between = max(median, math.sqrt(area / (_MOST_NODES * own.size)))
        while _nodes(extent, between) > _MOST_AROUND:
            between *= 2.0
        # The half sphere goes on beyond the last node of the image in it.
        reach = (shown.min(0) - between).clip(-1.0, 1.0), (shown.max(0) + between).clip(-1.0, 1.0)
        table, cells, low = _chart(model, side, reach, between)
        while (
            4.0 * area / between**2 <= _MOST_FINER
            and _nodes(extent, 0.5 * between) <= _MOST_AROUND
            and _left(cells, (inside - low) / between) > MOST_ASKED
        ):
            between *= 0.5
            table, cells, low = _chart(model, side, reach, between)
        shape[side], origin[side], step[side], begin[side] = cells.shape, low, between, sum(map(len, good))
        nodes.append(table.reshape(-1, 8))
        good.append(cells.ravel())
    return Charts(begin, shape, origin, step, np.concatenate(nodes), np.concatenate(good))


def _nodes(extent: Float[np.ndarray, "2"], between: float) -> float:
    """Of a chart that shows so much, with those around it."""
    return float((extent / between + 2.0 * (_BEYOND + 1)).prod())


def _left(cells: Bool[np.ndarray, "h w"], place: Float[np.ndarray, "n 2"]) -> float:
    """The share of places, in steps of a chart, whose cells are not good."""
    return float((~cells[tuple(place.astype(np.int64).T)]).sum()) / max(len(place), 1)


def _chart(
    model: CameraModel, side: int, reach: tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]], between: float
) -> tuple[Float[np.ndarray, "h w 8"], Bool[np.ndarray, "h w"], Float[np.ndarray, "2"]]:
    """The `chart_table` of one half sphere from the one place of `reach` to the other and around, the good cells, and the place
    of the first node."""
    low, high = reach[0] - _BEYOND * between, reach[1] + _BEYOND * between
    count = ((high - low) / between + 1.0).astype(np.int64)
    beside = np.stack(np.meshgrid(*(low[k] + between * np.arange(count[k]) for k in (0, 1)), indexing="ij"), -1)
    ahead = (1.0 - 2.0 * side) * (1.0 - (beside**2).sum(-1, keepdims=True))
    pixel, valid = _projected(model, np.concatenate([2.0 * beside, ahead], -1).reshape(-1, 3))
    middle = 0.5 * np.array(model.image_size)
    valid &= (np.abs(pixel - middle) <= middle + _BEYOND * STEP_PX).all(-1)
    pixel = pixel.reshape(beside.shape)
    # Hermite's cubic is nine times as good as Lagrange's.
    cells = smooth_cells(pixel, valid.reshape(ahead.shape[:2]), 3.0 * MOST_CHART_ERROR_PX / STEP_PX)
    # Fourth differences vanish here and there: the cells around have to be good as well.
    cells = cv2.erode(cells.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return chart_table(pixel), cells, low
