"""Tables that compiled loops take as they are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, Shaped


class Picture(NamedTuple):
    """A photo as it is read."""

    image: Shaped[np.ndarray, "h w c"]
    unit: float
    """Grey level of the image that stands for one of 255."""
    closed: bool
    """The image goes on around its seam."""


class Edgels(NamedTuple):
    """Edge points, row by row."""

    number: Int32[np.ndarray, "h w"]
    """Index of the edge point of each pixel, or -1."""
    points: Float32[np.ndarray, "n 4"]
    """(u, v) and the unit direction across the edge, either of two."""
    closed: bool
    """The image goes on around its seam."""


class Charts(NamedTuple):
    """Pixels of nodes on the half spheres of z >= 0 and z < 0, at equal steps of (x, y) / (length + |z|) of their rays (the
    stereographic projection); one chart after the other, row after row."""

    begin: Int[np.ndarray, "2"]
    """The first node of each chart."""
    shape: Int[np.ndarray, "2 2"]
    """Rows (of x) and columns (of y), 0 of a chart without nodes."""
    origin: Float[np.ndarray, "2 2"]
    step: Float[np.ndarray, "2"]
    node: Float[np.ndarray, "n 8"]
    """Pixel, and its derivatives per step down, across and both."""
    good: Bool[np.ndarray, " n"]
    """Between a node and the next ones."""


class SeenChains(NamedTuple):
    """Chains of edge points that the camera model sees, one after another."""

    starts: Int[np.ndarray, " n1"]
    """Where each chain begins, and one more."""
    bearings: Float[np.ndarray, "m 3"]
    acrosses: Float[np.ndarray, "m 3"]
    """Change of the bearing with a pixel along the direction across the edge."""


class Curves(NamedTuple):
    """Nodes of arcs, and the cubics between them."""

    starts: Int[np.ndarray, " n1"]
    angle: Float[np.ndarray, " m"]
    table: Float[np.ndarray, "m 6"]
    """Pixel (going on across a seam), change along and change across per radian."""
    slope: Float[np.ndarray, "m 6"]
    """Derivatives of the table times the step to the next node."""
    good: Bool[np.ndarray, " m"]
    """Of the cubic to the next node."""


class Samples(NamedTuple):
    """Points along arcs about a pixel apart, arc after arc."""

    owner: Int[np.ndarray, " m"]
    starts: Int[np.ndarray, " n1"]
    """Where each arc begins, and one more."""
    angle: Float[np.ndarray, " m"]
    pixel: Float[np.ndarray, "m 2"]
    across: Float[np.ndarray, "m 2"]
    """Unit vector across the curve in the photo, towards the side of the normal."""
    rate: Float[np.ndarray, " m"]
    """Pixels along `across` per radian that the circle moves towards its normal."""
    valid: Bool[np.ndarray, " m"]


class Places(NamedTuple):
    """Where the edge lies across the samples of arcs."""

    angle: Float[np.ndarray, " m"]
    rate: Float[np.ndarray, " m"]
    shift: Float[np.ndarray, " m"]
    """Pixels across the arc."""
    strength: Float[np.ndarray, " m"]
    """Square of the contrast, or the inverse variance."""
    usable: Bool[np.ndarray, " m"]


class Crossed(NamedTuple):
    """Points of arcs that profiles across other arcs may cross, or through which profiles go."""

    owner: Int[np.ndarray, " m"]
    pixel: Float[np.ndarray, "m 2"]
    across: Float[np.ndarray, "m 2"]


class Window(NamedTuple):
    """The values of a profile that a fit takes, equally far apart, from number `begin` on."""

    begin: int
    offsets_px: Float[np.ndarray, " k"]
    weight: Float[np.ndarray, " k"]


class Stepped(NamedTuple):
    """Profiles of colour across pieces of arcs, and the steps in them."""

    profile: Float32[np.ndarray, "m c k"]
    place: Float[np.ndarray, "m s"]
    """Of the steps, px across; the first is that of the arc itself."""
    steps: Int[np.ndarray, " m"]
    """How many of them there are."""


class Ranked(NamedTuple):
    """Arcs of which pairs are looked for."""

    frame: Float[np.ndarray, "n 3 3"]
    """Columns normal, first, second."""
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    rank: Float[np.ndarray, " n"]
    """Its length in pixels, where gaps are allowed."""
    beside: Float[np.ndarray, " n"]
    """How far (radians) off the circle the ends of another may lie."""


class PairLimits(NamedTuple):
    """Of pairs of arcs: angle between their normals, gap between them, and what both span."""

    near_rad: float
    max_gap_px: float
    max_gap_rad: float
    longest_rad: float
