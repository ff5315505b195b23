"""What neither the drawing of the board nor a camera's model holds, and all frames of a rig agree on.

As of one camera (`calibration/unmodelled.py`), but the board is the same for all cameras, so that its bend and its print are told
once, by all of them together; pupil and decentering are those of each camera.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import CameraAndBoards
from omnilines.calibration.rig.joint import RigData
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.places import places
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.unmodelled import (
    OF_LENS,
    Freed,
    Kind,
    LensProblem,
    Unmodelled,
    beyond_chance,
    moved_and_stated_px,
    size_of,
)
from omnilines.least_squares.groups import Groups


def rig_unmodelled(
    outcome: RigOutcome, covariance: Float[Tensor, "k k"], reach_rad: list[tuple[float, float]]
) -> Unmodelled | None:
    """Of the camera whose projection that moves most, in what is stated of it; None where nothing is significant or moves any by
    more than that, and of several boards or one whose shape is estimated.

    `covariance` is that of the parameters of all members, one after the other, and what follows them; `reach_rad` are the angles
    off axis between which corners of each lie.
    """
    data, state = outcome.data, outcome.solution.state
    if len(data.views.boards) > 1 or not state.shape.plain:
        return None
    points = outcome.fit.points.chosen(outcome.fit.kept)
    some = [k for k, basis in enumerate(data.bases) if basis.shape[1]]
    place = _places(outcome, points)
    tried: dict[tuple[Kind, int | None], Freed | None] = {
        (kind, None): _of_board(kind, data, points, state, place) for kind in BOARD
    }
    tried |= {(kind, k): _of_lens(kind, k, data, points, state, place) for kind in OF_LENS for k in some}
    found = beyond_chance(tried, outcome.thresholds.degeneracy.misfit_significance)
    if found is None:
        return None
    (kind, member), freed = found
    low = np.cumsum([0, *(basis.shape[1] for basis in data.bases)])
    first = np.cumsum([0, *(len(model.parameters) for model in state.models)])
    moved: dict[int, tuple[float, float]] = {}
    for k in some if member is None else [member]:
        step = freed.step[low[k] : low[k + 1]] if member is None else freed.step
        own = covariance[first[k] : first[k + 1], first[k] : first[k + 1]]
        decentering = freed.terms if kind == "decentering" else None
        moved[k] = moved_and_stated_px(state.models[k], data.bases[k] @ step, own, reach_rad[k], decentering)
    worst = max(moved, key=lambda k: moved[k][0] / moved[k][1], default=None)
    if worst is None or moved[worst][0] <= moved[worst][1]:
        return None
    reach = reach_rad[worst][1]
    size, chance = size_of(kind, freed, points.board_m, reach), len(tried) * freed.chance
    return Unmodelled(kind, size, math.degrees(reach), *moved[worst], chance, data.views.cameras[data.cameras[worst]])


BOARD: tuple[Kind, ...] = ("flatness", "aspect")


def _places(outcome: RigOutcome, points: RigPoints) -> Int[Tensor, " f"]:
    """Of every block: frames, or runs of frames, that show the board at one place are wrong alike and count once."""
    state, blocks = outcome.solution.state, torch.unique(points.frame[points.view])
    found = torch.zeros(len(state.rig_from_target.translation), dtype=torch.long)
    if outcome.data.runs is None:
        found[blocks] = places(state.rig_from_target[blocks], points.board_m, outcome.thresholds.rig.one_place_squares)
    else:
        found[blocks] = torch.arange(len(blocks))
    return found


def _of_board(kind: Kind, data: RigData, points: RigPoints, state: RigState, at_place: Int[Tensor, " f"]) -> Freed | None:
    shape = BoardShape.to_refine((kind,), points.board_m)
    problem = replace(data, shape=shape).problem(points)
    at = problem.linearise(replace(state, shape=shape))
    blocks = torch.unique(points.frame[points.view])
    each = Groups.of_blocks(problem.structure, at, blocks).joined(at_place[blocks])
    first = problem.structure.kept_size - data.ticking - shape.free.shape[1]
    return Freed.of(each, slice(first, first + shape.free.shape[1]))


def _of_lens(
    kind: Kind, member: int, data: RigData, points: RigPoints, state: RigState, at_place: Int[Tensor, " f"]
) -> Freed | None:
    """By the views of one camera, each with a pose of its own; those that show the board at one place count once."""
    own = points.camera[points.view] == member
    views, place = torch.unique(points.view[own], return_inverse=True)
    board = BoardPoints(place, len(views), points.board_m[own], points.pixels[own])
    problem = LensProblem(OF_LENS[kind], board, data.bases[member], points.weight[own])
    poses = state.cam_from_board(points)[views]
    each = problem.by_views(CameraAndBoards(state.models[member], poses))
    return Freed.of(each.joined(at_place[points.frame[views]]), slice(data.bases[member].shape[1], None))
