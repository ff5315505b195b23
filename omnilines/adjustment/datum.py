"""The frame of an adjusted scene, where nothing else gives it one: that of the poses it starts from, each photo weighed by how
well its arcs tell its pose (`least_squares/datum.py`). One with few arcs neither takes others along nor makes them uncertain.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose, vector_from_rotation
from omnilines.adjustment.information import pose_information
from omnilines.adjustment.problem import LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares.datum import pose_weights, weighed

MOST_ROUNDS, AT_REST = 50, 1e-12
"""Of the search of the similarity, and its size that ends it."""
PACE = 0.5
"""Turn (rad) and growth that a round makes at most."""


def known_of_poses(problem: LineProblem, state: LinesAndPoses) -> Float[Tensor, "blocks 6 6"] | None:
    """How much every free frame, and every camera of a rig that moves, counts; None where nothing is open."""
    if not problem.gauge(state).shape[1]:
        return None
    arcs = problem.arcs
    frames, cameras = pose_information(arcs, state)
    information = torch.cat([frames[problem.free], cameras[problem.rig_cameras]])
    distance_m = float(state.chart.lines()[arcs.track].distance_to(state.cam_from_world.centre[arcs.image]).nanmedian())
    return torch.from_numpy(pose_weights(information.numpy(), distance_m))


def constraint(problem: LineProblem, state: LinesAndPoses, known: Float[Tensor, "blocks 6 6"] | None) -> Float[Tensor, "k g"]:
    """C: C' dk is how much of each similarity that is open is in a step of the kept parameters."""
    if known is None:
        return problem.gauge(state)
    motions = problem.motions(state)
    found, poses = torch.zeros_like(motions), 6 * len(known)
    found[:poses] = torch.from_numpy(weighed(motions[:poses].numpy(), known.numpy()))
    return found


def framed(problem: LineProblem, state: LinesAndPoses, start: LinesAndPoses) -> LinesAndPoses:
    """The state in the frame of its start. It stays as it is where photos do not tell that frame, or ended so far from where they
    started that none is nearest."""
    known, moved = known_of_poses(problem, state), state
    if known is None:
        return state
    for _ in range(MOST_ROUNDS):
        in_step = constraint(problem, moved, known)[: 6 * len(known)]
        # Not by BLAS, whose sums depend on the number of its threads.
        much = -torch.from_numpy(np.einsum("kg,k->g", in_step.numpy(), _step(problem, start, moved).numpy()))
        if not bool(torch.isfinite(much).all()):
            return state
        similarities = problem.similarities(moved)
        turn_rad, _, growth = (similarities.columns @ much).split([3, 3, 1])
        much = much * min(1.0, PACE / max(float(turn_rad.norm()), abs(float(growth)), PACE))
        scale, motion = similarities.after(much)
        moved = _moved(problem, moved, scale, motion)
        if float(much.abs().max()) < AT_REST:
            return moved
        # A scene that has grown leaves shifts as much less certain.
        sizes = torch.tensor([1.0] * 3 + [scale] * 3, dtype=torch.float64)
        known = known / (sizes[:, None] * sizes)
    return state


def _step(problem: LineProblem, start: LinesAndPoses, end: LinesAndPoses) -> Float[Tensor, " b6"]:
    """By how much frames and rig cameras that move are turned, and their centres moved, as left perturbations have it."""
    steps = _between(start.rig_from_world[problem.free], end.rig_from_world[problem.free])
    if start.rig is not None and end.rig is not None and len(problem.rig_cameras):
        here, there = (rig.cam_from_rig[problem.rig_cameras] for rig in (start.rig, end.rig))
        steps = torch.cat([steps, _between(here, there)])
    return steps.flatten()


def _between(start: Pose, end: Pose) -> Float[Tensor, "n 6"]:
    turn = vector_from_rotation(end.rotation @ start.rotation.mT)
    return torch.cat([turn, -(end.rotation @ (end.centre - start.centre)[..., None])[..., 0]], -1)


def _moved(problem: LineProblem, state: LinesAndPoses, scale: float, motion: Pose) -> LinesAndPoses:
    """The scene after a similarity; what is held stays."""
    rotation, translation = state.rig_from_world.rotation.clone(), state.rig_from_world.translation.clone()
    own = state.rig_from_world[problem.free].after_similarity(scale, motion)
    rotation[problem.free], translation[problem.free] = own.rotation, own.translation
    moved = replace(state, rig_from_world=Pose(rotation, translation), chart=_moved_lines(problem, state.chart, scale, motion))
    if state.rig is None or not len(problem.rig_cameras):
        return moved
    mounts = state.rig.cam_from_rig
    grown = mounts.translation.clone()
    grown[problem.rig_cameras] *= scale
    return replace(moved, rig=replace(state.rig, cam_from_rig=replace(mounts, translation=grown)))


def _moved_lines(problem: LineProblem, chart: LineChart, scale: float, motion: Pose) -> LineChart:
    moved, held = chart.after_similarity(scale, motion), problem.freedom.held_lines
    if held is None:
        return moved
    return LineChart(
        torch.where(held[:, None], chart.centre, moved.centre),
        torch.where(held, chart.scale, moved.scale),
        torch.where(held[:, None, None], chart.S, moved.S),
        chart.phi,
    )
