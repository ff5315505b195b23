"""A rig whose board moves between the shutters: fitted with a small motion of the board in every view.

Every view that its own camera fits takes part, with the corners that this keeps. How far the board moves, and all else, are
estimated in turn.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from camera_models.wording import listed, rounded
from omnilines.calibration.board_shape import AS_DRAWN
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.rig.excess import excess_note
from omnilines.calibration.rig.followed import NOT_FOLLOWED
from omnilines.calibration.rig.joint import RigData, RigFit, least_squares_rig
from omnilines.calibration.rig.near import Scales
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.own_motion import OwnMotion, alone
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigProblem, RigState
from omnilines.calibration.rig.seen_alone import SeenAlone
from omnilines.calibration.rig.shutters import SeenPoses, Shutters, elsewhere, estimated
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.least_squares import Solution

ROUNDS = 8
SAME = 0.02
"""Relative change of the standard deviations below which the rounds end."""
START = 2e-3, 1e-3
"""Standard deviations (rad, m) from which they begin."""

OTHER_INSTANT = (
    "its board is {} times as far from where the other cameras see it as a board that moves between the shutters (wrong frame, "
    "detection or numbering)"
)


@dataclass(frozen=True, eq=False)
class LooseFit:
    """A rig and how far its board moved."""

    data: RigData
    fit: RigFit
    solution: Solution[RigState]
    shutters: Shutters
    notes: tuple[str, ...]
    reasons: Mapping[int, str]
    """Views whose board no such motion takes to where the others see it, and how far off it is."""


def loosened(outcome: RigOutcome, start: RigState, seen: SeenAlone) -> RigOutcome:
    """The outcome with a motion of each view, where cameras fit the rig worse than alone, not by what is held of them, and the
    poses of the one board that it sees differ between them by more than chance; else as it is. `start` has the models of the
    cameras alone."""
    if not outcome.worse or outcome.data.views.parts > 1 or outcome.worse_as_held:
        return outcome
    thresholds = outcome.thresholds
    found = loose_fit(outcome.data, outcome.fit, start, seen, list(outcome.reasons), thresholds)
    if found is None:
        return outcome
    cause = excess_note(outcome.data, outcome.fit, outcome.solution, outcome.held, thresholds.rig)
    notes = (*(() if cause is None else (cause,)), motion_note(found.shutters), *found.notes)
    reasons = {**outcome.reasons, **found.reasons}
    lost = [v for v in sorted(reasons) if v not in found.fit.views and reasons[v] != NOT_FOLLOWED]
    names = [outcome.data.views.corners.view_names[v] for v in lost]
    if names:
        notes = (f"Left out, as the board is not where the other cameras of the frame see it: {listed(names)}.", *notes)
    one_pose = outcome.solution.state.residual_px(outcome.fit.points.chosen(outcome.fit.kept))
    return replace(
        outcome,
        data=found.data,
        fit=found.fit,
        solution=found.solution,
        shutters=found.shutters,
        one_pose_rms_px=float(one_pose.square().sum(-1).mean().sqrt()),
        notes=notes,
        reasons=reasons,
    )


def motion_note(shutters: Shutters) -> str:
    """How far the board moved, one sentence."""
    return (
        f"The board moved between the shutters of the cameras by {rounded(1e3 * shutters.shift_m)} mm along and "
        f"{rounded(math.degrees(shutters.turn_rad))} degrees about each axis (one standard deviation of a camera from the "
        "mean): each view has a small motion of its own, and the standard deviations hold it."
    )


def loose_fit(
    data: RigData, fit: RigFit, start: RigState, seen: SeenAlone, doubted: list[int], thresholds: CalibrationThresholds
) -> LooseFit | None:
    """The fit with a motion of each view; None where the poses of the board differ by no more than chance.

    `fit` has one pose for each frame, `start` the models of the cameras alone. Of views that do not agree with one pose for each
    frame (`doubted`) those take part that are no farther off than a board that moves.
    """
    state, placed = _placed(data, fit, start, seen)
    chosen, good = _taking_part(data, fit, seen, placed)
    sigma = np.tile(np.repeat(START, 3), (len(data.views.camera), 1))
    middle = torch.as_tensor(np.unique(data.board_m, axis=0).mean(0))
    found: LooseFit | None = None
    reasons: dict[int, str] = {}
    for _ in range(ROUNDS):
        loose = replace(data, motion=OwnMotion(torch.as_tensor(sigma), middle))
        points, views, rows = loose.points(chosen)
        kept = torch.as_tensor(good[rows])
        some = points.chosen(kept)
        if state.moved is None:
            state = replace(state, moved=_motion_alone(some, views, state, seen))
        shared = _shared(some, views, seen)
        if len(shared) < 2:
            return None
        poses, before = _seen_poses(loose.problem(some), state, shared), None if found is None else found.shutters
        # Not before a first fit: cameras as they stand where the board is at one pose in each frame are no measure.
        far = {} if before is None else _elsewhere(poses, views[shared], doubted, before, thresholds.noise.significance)
        if far:
            reasons, chosen, state = reasons | far, np.setdiff1d(chosen, list(far)), replace(state, moved=None)
            continue
        shutters = estimated(poses, START if before is None else before.sigmas, 6.0 * (len(data.cameras) - 1))
        if not shutters.clear(thresholds.noise.significance):
            return None
        sigma = _sigma(sigma, views, points, shared, shutters)
        loose = replace(data, motion=OwnMotion(torch.as_tensor(sigma), middle))
        points, views, rows = loose.points(chosen)
        start_fit = RigFit(points, loose.problem(points), views, rows, state, kept, Scales.alone(loose.noise))
        loose, whole, solution, notes = least_squares_rig(loose, start_fit, "cauchy")
        state, found = solution.state, LooseFit(loose, whole, solution, shutters, notes, reasons)
        if before is not None and shutters.change(before) < SAME:
            break
    return found


def _taking_part(
    data: RigData, fit: RigFit, seen: SeenAlone, placed: Bool[np.ndarray, " b"]
) -> tuple[Int[np.ndarray, " v"], Bool[np.ndarray, " n"]]:
    """The views that the rig or their own camera fits, in frames that are placed, and their good corners."""
    chosen = np.array([v for v in range(len(data.views.camera)) if v in fit.views or v in seen.cam_from_board])
    good = seen.kept.copy()
    # Views too small for a pose of their own keep what fits the rig.
    small = ~np.isin(data.views.corners.view[fit.rows], list(seen.cam_from_board))
    good[fit.rows[small]] = fit.kept.numpy()[small]
    return chosen[(data.block[chosen] >= 0) & placed[data.block[chosen]]], good


def _placed(data: RigData, fit: RigFit, start: RigState, seen: SeenAlone) -> tuple[RigState, Bool[np.ndarray, " b"]]:
    """The rig with the cameras' own models and the poses of all frames that any camera sees, and which these are."""
    placed = np.zeros(data.blocks, dtype=bool)
    placed[fit.points.frame[fit.points.view[fit.kept]].numpy()] = True
    target = fit.state.rig_from_target
    rotation, translation = target.rotation.clone(), target.translation.clone()
    for view, pose in seen.cam_from_board.items():
        block = int(data.block[view])
        if data.runs is None and not placed[block]:
            own = fit.state.cam_from_rig[data.cameras.index(int(data.views.camera[view]))].inverse() @ pose
            rotation[block], translation[block], placed[block] = own.rotation, own.translation, True
    return replace(fit.state, models=start.models, rig_from_target=Pose(rotation, translation)), placed


def _motion_alone(points: RigPoints, views: Int[np.ndarray, " v"], state: RigState, seen: SeenAlone) -> Float[Tensor, "v 6"]:
    """Of every view from the pose that its corners alone give with the cameras as they are; zero for views too small for one."""
    shared = state.cam_from_board(points)
    found = torch.zeros(len(shared), 6, dtype=torch.float64)
    assert points.motion is not None
    frame = points.motion.board_from_middle
    has = torch.tensor([int(v) in seen.cam_from_board for v in views])
    for camera, model in enumerate(state.models):
        rows = (points.camera[points.view] == camera) & has[points.view]
        if not bool(rows.any()):
            continue
        own, place = torch.unique(points.view[rows], return_inverse=True)
        board = BoardPoints(place, len(own), state.shape.place(points.board_m[rows]), points.pixels[rows])
        begin = Pose.stack([seen.cam_from_board[int(views[v])] for v in own.tolist()])
        held = model.calibration_basis()[:, :0]
        fitted = BoardProblem(board, held, points.weight[rows], AS_DRAWN).solve(CameraAndBoards(model, begin), max_iterations=50)
        found[own] = (frame.inverse() @ shared[own].inverse() @ fitted.state.cam_from_board @ frame).log()
    return found


def _shared(points: RigPoints, views: Int[np.ndarray, " v"], seen: SeenAlone) -> Int[Tensor, " s"]:
    """Views with a pose of their own whose frame another camera with one sees too."""
    has = torch.tensor([int(v) in seen.cam_from_board for v in views])
    has &= torch.bincount(points.view, minlength=len(points.camera)) > 0
    counts = torch.bincount(points.instant[has], minlength=int(points.instant.max()) + 1)
    return torch.nonzero(has & (counts[points.instant] > 1)).flatten()


def _elsewhere(
    poses: SeenPoses, views: Int[np.ndarray, " s"], doubted: list[int], moved: Shutters, significance: float
) -> dict[int, str]:
    """Views of another instant, which would make the board seem to move everywhere, and why they are left out."""
    far = elsewhere(poses, torch.as_tensor(np.isin(views, doubted)), moved.sigmas, significance).tolist()
    return {int(v): OTHER_INSTANT.format(rounded(sigma)) for v, sigma in zip(views, far, strict=True) if sigma > 0}


def _seen_poses(problem: RigProblem, state: RigState, shared: Int[Tensor, " s"]) -> SeenPoses:
    """Where each view alone sees the board, around a state with a motion of each."""
    points = problem.points
    assert points.motion is not None and state.moved is not None
    at, pose = problem.linearise_corners(state), state.cam_from_board(points)
    more, information = torch.zeros_like(state.moved), torch.zeros(len(pose), 6, 6, dtype=torch.float64)
    for part, own in zip(at.parts, points.parts, strict=True):
        views = slice(*own.views)
        more[views], information[views] = alone(part, at.residual[slice(*own.rows)], pose[views], points.motion)
    _, frame = torch.unique(points.instant[shared], return_inverse=True)
    covariance = torch.linalg.inv(information[shared])
    return SeenPoses(frame, (state.moved + more)[shared], 0.5 * (covariance + covariance.mT))


def _sigma(
    sigma: Float[np.ndarray, "a 6"],
    views: Int[np.ndarray, " v"],
    points: RigPoints,
    shared: Int[Tensor, " s"],
    shutters: Shutters,
) -> Float[np.ndarray, "a 6"]:
    """Standard deviations of the own motion of all views of the table."""
    scale = torch.ones(int(points.instant.max()) + 1, dtype=torch.float64)
    scale[torch.unique(points.instant[shared])] = shutters.frame_scale
    axes = np.repeat([shutters.turn_rad, shutters.shift_m], 3)
    found = sigma.copy()
    found[views] = scale[points.instant].sqrt().numpy()[:, None] * axes
    return found
