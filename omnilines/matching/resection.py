"""The pose of a photo, or of photos that move as one (of a rig at one instant), from lines that are known.

Its arcs are given to the lines that pass near them and look like them, the pose is refined, and so in turn with a reach that
narrows. With M = R m + t x R d the normal of the plane of a line (camera frame) the residual of an end V of an arc is the sine of
its angle to the plane,

    h = V . M / |M|,    dh = w . (M x U) + v . (d x U),    U = (V - h M / |M|) / |M|,

for the left perturbation (w, v) of the pose of its photo. That of photo k is Ad(T_k) times that of the first one where T_k takes
bearings of the first to those of photo k, which is held.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from camera_models.pose import Pose, adjoint
from camera_models.rotations import nearest_rotation
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.known_lines import KnownLines, most_likely
from omnilines.matching.options import MatchingOptions

STEPS = 3
"""Refinements for each reach."""
MIN_ARCS = 4
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


def refined_by_lines(arcs: ViewedArcs, known: KnownLines, options: MatchingOptions = MatchingOptions()) -> PlacedByLines | None:
    """The pose of the photos of `arcs`, moved as one, near the one that they have; None where lines near it determine none."""
    # Where the photos stand to each other is always that of the start: rounding would add up.
    start = arcs
    for reach in np.repeat(options.resection.reaches_rad, STEPS).tolist():
        first = _step(arcs, known, reach, options)
        if first is None:
            return None
        arcs = start.moved_to(first)
    return explained_by_lines(arcs, known, options)


def explained_by_lines(arcs: ViewedArcs, known: KnownLines, options: MatchingOptions = MatchingOptions()) -> PlacedByLines:
    """The poses that the photos have, with the arcs that lines explain."""
    arc, line, alike, square = known.explaining(arcs, options)
    best = most_likely(arc, alike, square)
    return PlacedByLines(arcs.poses, float(alike[best].sum()), arc[best], line[best])


def _step(arcs: ViewedArcs, known: KnownLines, reach_rad: float, options: MatchingOptions) -> Pose | None:
    """The pose (1,) of the first photo after a step of iteratively reweighted least squares; None where it is not determined."""
    noise, sigmas = arcs.packed[:, 12:], options.resection.reach_sigmas
    spread = np.sqrt(noise**2 + (reach_rad / sigmas) ** 2)
    arc, line = known.near(arcs, np.maximum(sigmas * spread.max(-1), options.explained.reach_px * arcs.px_rad))
    alike = known.looks_like(arcs, arc, line, options.likeness)
    likely = alike >= options.likeness.min_likeness
    arc, line = arc[likely], line[likely]
    distance, _ = _linearised(arcs, known, arc, line)
    best = most_likely(arc, alike[likely], ((distance / spread[arc]) ** 2).sum(-1))
    arc, line = arc[best], line[best]
    if len(arc) < MIN_ARCS:
        return None
    residual, jacobian = _linearised(arcs, known, arc, line)
    residual, jacobian = residual / spread[arc], jacobian / spread[arc][..., None]
    weight = 1.0 / (1.0 + (residual / options.resection.loss_scale) ** 2)
    normal = np.einsum("nki,nk,nkj->ij", jacobian, weight, jacobian)
    unit = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(normal * unit[:, None] * unit)
    if not values[0] > 1e-9:
        return None
    right = -np.einsum("nki,nk,nk->i", jacobian, weight, residual) * unit
    step = unit * (vectors @ ((vectors.T @ right) / values))
    moved = Pose.exp(torch.as_tensor(step)[None]) @ arcs.poses[[0]]
    # Where a photo is moved again and again, rounding would double with every step, until its rotation is none.
    return Pose(nearest_rotation(moved.rotation), moved.translation)


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
