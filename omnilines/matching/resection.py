"""The pose of a photo, or of photos that move as one (of a rig at one instant), from lines that are known.

Its arcs are given to the lines that pass near them and look like them, the pose is refined, and so in turn with a reach that
narrows. With M = R m + t x R d the normal of the plane of a line (camera frame) the residual of an end V of an arc is the sine of
its angle to the plane,

    h = V . M / |M|,    dh = w . (M x U) + v . (d x U),    U = (V - h M / |M|) / |M|,

for the left perturbation (w, v) of the pose of its photo. That of photo k is Ad(T_k) times that of the first one where T_k takes
bearings of the first to those of photo k, which is held.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from camera_models.pose import Pose, adjoint
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.kernels.hypothesis import LEAST_LIKENESS
from omnilines.matching.known_lines import REACH_PX, KnownLines, most_likely

REACHES_RAD = tuple(math.radians(angle) for angle in (2.0, 1.0, 0.5, 0.25, 0.12, 0.0))
"""Arcs are given to lines that lie so near, one after the other; in the end, to those as near as their noise allows."""
STEPS = 3
"""Refinements for each reach."""
REACH_SIGMAS = 3.0
"""A reach is so many standard deviations of what is left of the error of the pose."""
BEND = 2.0
"""Standard deviations at which a residual counts half (Cauchy loss)."""
LEAST_ARCS = 4
"""Three determine a pose in general, and nothing tells whether they are right."""


@dataclass(frozen=True)
class PlacedByLines:
    """A pose and the lines that it rests on."""

    pose: Pose
    """cam_from_world of each photo."""
    score: float
    """Sum over the arcs that lines explain of how much they look alike (at most 1 each)."""
    arc: Int[np.ndarray, " k"]
    line: Int[np.ndarray, " k"]
    """Of `KnownLines`."""


def refined_by_lines(arcs: ViewedArcs, known: KnownLines) -> PlacedByLines | None:
    """The pose of the photos of `arcs`, moved as one, near the one that they have; None where lines near it determine none."""
    # Where the photos stand to each other is always that of the start: rounding would add up.
    start = arcs
    for reach in np.repeat(REACHES_RAD, STEPS).tolist():
        first = _step(arcs, known, reach)
        if first is None:
            return None
        arcs = start.moved_to(first)
    return explained_by_lines(arcs, known)


def explained_by_lines(arcs: ViewedArcs, known: KnownLines) -> PlacedByLines:
    """The poses that the photos have, with the arcs that lines explain."""
    arc, line, alike, square = known.explaining(arcs)
    best = most_likely(arc, alike, square)
    return PlacedByLines(arcs.poses, float(alike[best].sum()), arc[best], line[best])


def _step(arcs: ViewedArcs, known: KnownLines, reach_rad: float) -> Pose | None:
    """The pose (1,) of the first photo after a step of iteratively reweighted least squares; None where it is not determined."""
    noise = arcs.packed[:, 12:]
    spread = np.sqrt(noise**2 + (reach_rad / REACH_SIGMAS) ** 2)
    arc, line = known.near(arcs, np.maximum(REACH_SIGMAS * spread.max(-1), REACH_PX * arcs.px_rad))
    alike = known.looks_like(arcs, arc, line)
    likely = alike >= LEAST_LIKENESS
    arc, line = arc[likely], line[likely]
    distance, _ = _linearised(arcs, known, arc, line)
    best = most_likely(arc, alike[likely], ((distance / spread[arc]) ** 2).sum(-1))
    arc, line = arc[best], line[best]
    if len(arc) < LEAST_ARCS:
        return None
    residual, jacobian = _linearised(arcs, known, arc, line)
    residual, jacobian = residual / spread[arc], jacobian / spread[arc][..., None]
    weight = 1.0 / (1.0 + (residual / BEND) ** 2)
    normal = np.einsum("nki,nk,nkj->ij", jacobian, weight, jacobian)
    unit = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(normal * unit[:, None] * unit)
    if not values[0] > 1e-9:
        return None
    right = -np.einsum("nki,nk,nk->i", jacobian, weight, residual) * unit
    step = unit * (vectors @ ((vectors.T @ right) / values))
    return Pose.exp(torch.as_tensor(step)[None]) @ arcs.poses[[0]]


def _linearised(
    arcs: ViewedArcs, known: KnownLines, arc: Int[np.ndarray, " k"], line: Int[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2 6"]]:
    """h of both ends of arcs from lines, and its derivative by the left perturbation of the pose of the first photo."""
    photo = arcs.image[arc]
    rotation, shift = arcs.poses.rotation.numpy()[photo], arcs.poses.translation.numpy()[photo]
    direction = (rotation @ known.direction[line, :, None])[..., 0]
    moment = (rotation @ known.moment[line, :, None])[..., 0] + np.cross(shift, direction)
    length = np.linalg.norm(moment, axis=-1, keepdims=True)
    normal = moment / length
    ends = arcs.bearings[arc]
    residual = (ends * normal[:, None]).sum(-1)
    across = (ends - residual[..., None] * normal[:, None]) / length[:, None]
    jacobian = np.concatenate([np.cross(moment[:, None], across), np.cross(direction[:, None], across)], -1)
    if arcs.images > 1:
        from_first = arcs.poses @ arcs.poses[0].inverse()
        jacobian = jacobian @ adjoint(from_first).numpy()[photo]
    return residual, jacobian
