"""A Manhattan frame of one photo: three directions at right angles in which its lines meet, with the covariance of the rotation.

Directions in which pairs of arcs meet are tried as one axis a; with any further arc of the normal n the second is a x n, and
the third follows. The frames under which the arcs are most likely are refined as a whole (`mixture.py`). A frame is there where
chance does not make it (`meeting.py`): the arcs count with the mean of their ratios to the axes, without the three lines that
place it; and those that are not of its strongest axis count again with those to the two others, without the one that turns it
about that axis.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from omnilines.structure.circles import Circles
from omnilines.structure.meeting import (
    AT_ONCE,
    STRAYS_TOLD_APART,
    Meeting,
    described,
    gain_over_chance,
    largest_sigma,
    line_weights,
    tried_directions,
)
from omnilines.structure.mixture import Mixture, fitted
from omnilines.structure.options import DirectionsOptions


@dataclass(frozen=True)
class Frame:
    """A Manhattan world in one photo: z up, x to the right as far as the frame has it."""

    axes: Meeting
    """x, y and z as directions of the camera frame, and the arcs of each."""
    cam_from_world: Float[np.ndarray, "3 3"]
    """Its columns are x, y and z."""
    covariance: Float[np.ndarray, "3 3"]
    """Of its rotation vector from the left (camera frame), rad^2."""


def manhattan_frame(circles: Circles, options: DirectionsOptions = DirectionsOptions()) -> Frame | None:
    """The frame under which the arcs are most likely; None where there is none beyond chance.

    Up is the axis nearest to -y of the camera: of a photo that looks up or down, or lies on its side, another axis may be.
    """
    own = circles.rows(circles.sharpest(options.used_arcs))
    weight = line_weights(own, options.tried_rad)
    frames = _tried_frames(own, weight, options)
    if not len(frames):
        return None
    fits = [fitted(own, weight, frame, np.array(options.strays_rad), as_frame=True) for frame in frames]
    best = max(fits, key=lambda fit: fit.log_likelihood)
    if not _stands(own, weight, best, options):
        return None
    return _upright(circles, best)


def _tried_frames(
    circles: Circles, weight: Float[np.ndarray, " n"], options: DirectionsOptions
) -> list[Float[np.ndarray, "3 3"]]:
    """The frames (axes as rows) under which the arcs are most likely, none near another."""
    first = tried_directions(circles, weight, options.tried_axes, options)
    second = np.cross(first[:, None], circles.normal[circles.sharpest(options.paired_arcs)])
    length = np.linalg.norm(second, axis=-1)
    axis, arc = np.nonzero(length > options.separation_rad)
    if not len(axis):
        return []
    second = second[axis, arc] / length[axis, arc, None]
    frames = np.stack([first[axis], second, np.cross(first[axis], second)], 1)
    stray = np.array([options.tried_rad])
    of_first = circles.ratio(first, stray)[0]
    scores = [np.zeros(0)]
    for low in range(0, len(frames), AT_ONCE // 2):
        own = slice(low, low + AT_ONCE // 2)
        others = circles.ratio(frames[own, 1:].reshape(-1, 3), stray)[0].reshape(-1, 2, len(circles)).sum(1)
        scores.append(np.log1p(options.share * (of_first[axis[own]] + others)) @ weight)
    frames = frames[np.argsort(-np.concatenate(scores), kind="stable")]
    kept: list[np.ndarray] = []
    while len(frames) and len(kept) < options.refined:
        kept.append(frames[0])
        near = np.abs(frames[1:] @ frames[0].T).max(-1) > math.cos(options.separation_rad)
        frames = frames[1:][~near.all(-1)]
    return kept


def _stands(circles: Circles, weight: Float[np.ndarray, " n"], fit: Mixture, options: DirectionsOptions) -> bool:
    if float(largest_sigma(fit.turn_covariance)[0]) > options.max_sigma_rad:
        return False
    h, ratio = fit.belongs(circles), fit.ratio(circles)
    tests, count = STRAYS_TOLD_APART / options.false_directions, len(circles)
    strongest = int(np.argmax(weight @ h))
    others = h[:, strongest] < 0.5
    all_gain = gain_over_chance(circles, weight, ratio.mean(0), 3, options.tried_rad)
    its = np.delete(ratio, strongest, 0)[:, others].mean(0)
    turn_gain = gain_over_chance(circles.rows(others), weight[others], its, 1, options.tried_rad)
    return all_gain >= math.log(tests * count**3 / 6) and turn_gain >= math.log(tests * 3 * count)


def _upright(circles: Circles, fit: Mixture) -> Frame:
    """The axes as x, y and z."""
    axes = fit.direction
    up = int(np.argmax(np.abs(axes[:, 1])))
    right = max((k for k in range(3) if k != up), key=lambda k: abs(float(axes[k, 0])))
    z = axes[up] * (-1.0 if axes[up, 1] > 0 else 1.0)
    x = axes[right] * (-1.0 if axes[right, 0] < 0 else 1.0)
    named = np.stack([x, np.cross(z, x), z])
    order = [right, 3 - right - up, up]
    return Frame(described(circles, replace(fit, direction=named, share=fit.share[:, order])), named.T, fit.turn_covariance[0])
