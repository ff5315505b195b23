"""Arcs of great circles, and how they lie in the photo."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models import CameraModel
from omnilines.extraction.bearings import changes_at, pixels_at

COARSE = 16
"""Intervals of an arc from which its length in pixels is known."""
_NODES, _SHARES = (0.5 * (values + offset) for values, offset in zip(np.polynomial.legendre.leggauss(5), (1.0, 0.0), strict=True))
"""Of Gauss's quadrature over the unit interval."""
LONGEST_RAD = 2.6
"""An arc ends there: the plane of two ends that are nearly opposite is ill defined."""


@dataclass(frozen=True)
class Arcs:
    """n arcs V(angle) = cos(angle) first + sin(angle) (normal x first), low <= angle <= high."""

    normal: Float[np.ndarray, "n 3"]
    first: Float[np.ndarray, "n 3"]
    """Unit, on the circle, near the middle of the arc."""
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n 2 2"]
    """Of (a, b) in normal + a first + b (normal x first), rad^2."""

    def __len__(self) -> int:
        return len(self.normal)

    @cached_property
    def second(self) -> Float[np.ndarray, "n 3"]:
        """normal x first."""
        return cross(self.normal, self.first)

    @cached_property
    def frame(self) -> Float[np.ndarray, "n 3 3"]:
        """Columns normal, first, second."""
        return np.stack([self.normal, self.first, self.second], -1)

    def keep(self, rows: Bool[np.ndarray, " n"] | Int[np.ndarray, " m"]) -> "Arcs":
        """Some of the rows."""
        return Arcs(self.normal[rows], self.first[rows], self.low[rows], self.high[rows], self.covariance[rows])

    def bearings(self, row: Int[np.ndarray, " m"], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 3"]:
        """Points at angles on some of the circles."""
        return np.cos(angle)[:, None] * self.first[row] + np.sin(angle)[:, None] * self.second[row]

    def centred(self) -> "Arcs":
        """The same arcs with `first` in their middle."""
        middle = 0.5 * (self.low + self.high)
        cosine, sine = np.cos(middle), np.sin(middle)
        # The new axes are the old ones turned; so is the covariance.
        turn = np.stack([np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)], -2)
        first = self.bearings(np.arange(len(self)), middle)
        return Arcs(self.normal, first, self.low - middle, self.high - middle, turn @ self.covariance @ turn.mT)


def arcs_of_ends(
    normal: Float[np.ndarray, "n 3"], ends: Float[np.ndarray, "n 2 3"], information: Float[np.ndarray, "n 3 3"]
) -> Arcs:
    """Arcs on circles from one bearing to another near them, less than half a turn apart; `information` on the normal."""
    first = ends.sum(1)
    first -= (first * normal).sum(-1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = cross(normal, first)
    angles = np.arctan2((ends * second[:, None]).sum(-1), (ends * first[:, None]).sum(-1))
    basis = np.stack([first, second], -1)
    covariance = inverse_2x2(basis.mT @ information @ basis)
    return Arcs(normal, first, angles.min(-1), angles.max(-1), covariance)


def cross(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """As `np.cross`, which takes several times as long for a few hundred rows."""
    following, last = [1, 2, 0], [2, 0, 1]
    return a[:, following] * b[:, last] - a[:, last] * b[:, following]


def inverse_2x2(matrix: Float[np.ndarray, "*n 2 2"]) -> Float[np.ndarray, "*n 2 2"]:
    """Of symmetric positive matrices, however badly scaled."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    determinant = np.maximum(a * d - b * b, 1e-12 * a * d + 1e-300)
    return np.stack([np.stack([d, -b], -1), np.stack([-b, a], -1)], -2) / determinant[..., None, None]


def steps(model: CameraModel, pixel: Float[np.ndarray, "n k 2"]) -> Float[np.ndarray, "n k1 2"]:
    """Differences of neighbouring points, the shorter way round where the image closes."""
    step = np.diff(pixel, axis=1)
    if model.PERIODIC:
        step[..., 0] -= model.image_size[0] * np.round(step[..., 0] / model.image_size[0])
    return step


def lengths_px(model: CameraModel, arcs: Arcs) -> Float[np.ndarray, " n"]:
    """Lengths of arcs in the photo."""
    angle = arcs.low[:, None] + (arcs.high - arcs.low)[:, None] * np.linspace(0.0, 1.0, COARSE + 1)
    pixel, _ = pixels_at(model, arcs.bearings(np.repeat(np.arange(len(arcs)), COARSE + 1), angle.ravel()))
    return np.linalg.norm(steps(model, pixel.reshape(*angle.shape, 2)), axis=-1).sum(-1)


def spans(model: CameraModel, arcs: Arcs) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Lengths of arcs in the photo, by Gauss's quadrature of how fast the pixel moves, and the fewest pixels across an arc for a
    radian at its nodes; 0 where the camera does not see them all."""
    angle = arcs.low[:, None] + (arcs.high - arcs.low)[:, None] * _NODES
    _, along, side, valid = changes_at(model, arcs.frame, np.repeat(np.arange(len(arcs)), len(_NODES)), angle.ravel())
    pace = np.linalg.norm(along, axis=-1).reshape(angle.shape)
    across = np.abs(along[:, 0] * side[:, 1] - along[:, 1] * side[:, 0]).reshape(angle.shape)
    rate = np.where(valid.reshape(angle.shape), across / np.maximum(pace, 1e-12), 0.0).min(-1)
    return pace @ _SHARES * (arcs.high - arcs.low), rate


def across_px(
    model: CameraModel, arcs: Arcs, owner: Int[np.ndarray, " m"], angle: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Float[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Pixels at angles on circles, the unit vector across the curve, pixels along it per radian of the circle, and valid."""
    pixel, along, side, valid = changes_at(model, arcs.frame, owner, angle)
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    length = np.linalg.norm(across, axis=-1)
    across /= np.maximum(length, 1e-12)[:, None]
    rate = (across * side).sum(-1)
    across, rate = np.where(rate[:, None] < 0, -across, across), np.abs(rate)
    return pixel, across, rate, valid & (length > 0) & (rate > 0)
