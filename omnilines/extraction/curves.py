"""Points a pixel apart along arcs in the photo.

They lie on a smooth curve: the camera model is asked for nodes some NODE_PX apart, and cubics through them give the rest. Where
fourth differences of the nodes say that the cubics are not good enough (near the pole of a panorama), and where the camera's
domain ends, the model is asked for every point.
"""

import numpy as np
from jaxtyping import Float, Int

from camera_models import CameraModel
from omnilines.extraction.arcs import COARSE, LONGEST_RAD, Arcs, across_px, steps
from omnilines.extraction.bearings import MOST_ERROR_PX, STEP_RAD, axis_of, changes_at, pixels_at
from omnilines.extraction.kernels.curve import leave_out_far, lengths_along, read_curves, slopes, smooth_intervals, unwrapped
from omnilines.extraction.kernels.tables import Curves, Samples

NODE_PX = 20.0
LEAST_INTERVALS, MOST_INTERVALS = 4, 128
"""Between the nodes of an arc: powers of 2."""
MOST_ERROR_SHARE = 3e-5
"""Error of the cubics, of the change of a pixel with the angle along the arc and across it."""
MOST_PERIMETERS = 4
"""Of the image, an arc's most samples: one that is longer runs back and forth, as no camera shows a line."""
_SAFETY = 3.0
"""Over the bound of Hermite's cubic: its derivatives are differences themselves."""


def _five_nodes() -> Float[np.ndarray, "5 5"]:
    """Weights of values at five equal steps for the derivative, per step, at each of them."""
    place = np.arange(5.0)
    return np.stack([np.linalg.inv(np.vander(place - at, increasing=True))[1] for at in place])


_WEIGHTS = _five_nodes()


def samples(model: CameraModel, arcs: Arcs, beyond_px: float) -> Samples:
    """Points a pixel apart along arcs (at least one) and some pixels beyond either end, as far as LONGEST_RAD allows."""
    first, last = _ends_px(model, arcs)
    interval, most = (arcs.high - arcs.low) / COARSE, np.maximum(0.5 * (LONGEST_RAD - (arcs.high - arcs.low)), 0.0)
    low = arcs.low - np.minimum(beyond_px * interval / np.maximum(first, 1e-9), most)
    high = arcs.high + np.minimum(beyond_px * interval / np.maximum(last, 1e-9), most)
    wanted = np.log2((COARSE * np.maximum(first, last) + 2.0 * beyond_px) / NODE_PX + 1e-9)
    intervals = np.exp2(np.ceil(wanted)).clip(LEAST_INTERVALS, MOST_INTERVALS).astype(np.int64)
    curves = _curves(model, arcs, low, high, intervals)
    run = lengths_along(curves, COARSE)
    most = MOST_PERIMETERS * 2 * sum(model.image_size)
    starts = np.concatenate([[0], np.cumsum(np.ceil(run[:, -1]).clip(2, most).astype(np.int64))])
    owner, angle, pixel, across, rate, smooth = read_curves(curves, run, starts)
    valid = np.ones(len(owner), dtype=bool)
    rows = np.flatnonzero(~smooth)
    if len(rows):
        pixel[rows], across[rows], rate[rows], valid[rows] = across_px(model, arcs, owner[rows], angle[rows])
    if model.PERIODIC:
        pixel[:, 0] = np.mod(pixel[:, 0] + 0.5, model.image_size[0]) - 0.5
    return Samples(owner, starts, angle, pixel, across, rate, valid)


def _ends_px(model: CameraModel, arcs: Arcs) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Lengths of the first and the last of the COARSE intervals of arcs."""
    interval = (arcs.high - arcs.low) / COARSE
    angle = np.stack([arcs.low, arcs.low + interval, arcs.high - interval, arcs.high], -1)
    pixel, _ = pixels_at(model, arcs.bearings(np.repeat(np.arange(len(arcs)), 4), angle.ravel()))
    step = np.linalg.norm(steps(model, pixel.reshape(len(arcs), 4, 2)), axis=-1)
    return step[:, 0], step[:, 2]


def _curves(
    model: CameraModel,
    arcs: Arcs,
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
    intervals: Int[np.ndarray, " n"],
) -> Curves:
    starts = np.concatenate([[0], np.cumsum(intervals + 1)])
    owner = np.repeat(np.arange(len(arcs)), intervals + 1)
    step = (high - low) / intervals
    angle = low[owner] + (np.arange(len(owner)) - starts[owner]) * step[owner]
    pixel, along, side, valid = changes_at(model, arcs.frame, owner, angle)
    table = np.concatenate([pixel, along, side], -1)
    if model.PERIODIC:
        unwrapped(table, starts, float(model.image_size[0]))
    slope = slopes(table, starts, step, _WEIGHTS)
    good = smooth_intervals(table, valid, starts, most_px=MOST_ERROR_PX, most_share=MOST_ERROR_SHARE, safety=_SAFETY)
    if model.max_angle < np.pi:
        axis = axis_of(model)
        limit = float(np.cos(model.max_angle - 3.0 * STEP_RAD))
        leave_out_far(good, angle, starts, first=arcs.first @ axis, second=arcs.second @ axis, least=limit)
    return Curves(starts, angle, table, slope, good)
