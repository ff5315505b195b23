"""Joint refinement of a rig: intrinsics of every camera, cameras in the rig, boards on the target, the target in every frame.

    X_cam = cam_from_rig[c] rig_from_target[f] target_from_board[b] X,   X = shape(drawn place)

The first camera is the rig frame and the first board that of the target (unless all boards are held in a frame of their own), so
that nothing is left open. The target's poses are the eliminated blocks (one for each frame), all else is kept. Residuals are in
standard deviations: pixels times the weights.

Where the board moves between the shutters of the cameras, each view has a small motion xi of its own (`rig/shutters.py`) that is
known beforehand to be zero within some standard deviations. It is eliminated within its view (`rig/own_motion.py`).

Where cameras have clocks of their own, the eliminated blocks are the paths of the board in runs of frames (`rig/path.py`), and
the offsets of the clocks are kept, last of all. Where rows are read one after the other (a rolling shutter), each corner sees the
board at an instant of its own on its path; the line delays stand before the offsets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose, adjoint
from omnilines.calibration.board_shape import AS_DRAWN, BoardShape
from omnilines.calibration.rig.local_columns import LocalColumns
from omnilines.calibration.rig.own_motion import Moved, motion_pose, without_motion
from omnilines.calibration.rig.path import Path, PathDerivatives, moved_run, path_derivatives, pose_along
from omnilines.calibration.rig.points import RigPoints
from omnilines.least_squares import CellLinearisation, KeptGroup, Structure


@dataclass(frozen=True)
class RigState:
    """What is estimated of a rig."""

    models: tuple[CameraModel, ...]
    cam_from_rig: Pose
    """Of every camera; the first is the identity."""
    target_from_board: Pose
    """Of every board; the first is the identity where boards are free."""
    rig_from_target: Pose
    """Of every frame."""
    shape: BoardShape = AS_DRAWN
    """How the board differs from its drawing."""
    moved: Float[Tensor, "v 6"] | None = None
    """Own motion of every view, where the points say what is known of it."""
    path: Path | None = None
    """How the target moves in each run, where the points have times; `rig_from_target` is then that of the middle of the run."""

    def target(self, points: RigPoints) -> Pose:
        """`rig_from_target` of every view."""
        base = self.rig_from_target[points.frame]
        if points.times is None or self.path is None:
            return base
        return pose_along(base, self.path.rates[points.frame], points.times.tau(self.path, points.camera), points.times.middle_m)

    def along(self, points: RigPoints) -> PathDerivatives | None:
        """How the target of every view follows the paths and clocks; None where cameras have one clock."""
        if points.times is None or self.path is None:
            return None
        base, rates = self.rig_from_target[points.frame], self.path.rates[points.frame]
        return path_derivatives(base, rates, points.times.tau(self.path, points.camera), points.times)

    def _shared(self, points: RigPoints) -> Pose:
        return self.cam_from_rig[points.camera] @ self.target(points) @ self.target_from_board[points.board]

    def cam_from_board(self, points: RigPoints) -> Pose:
        """Of every view."""
        if points.motion is None or self.moved is None:
            return self._shared(points)
        return self._shared(points) @ motion_pose(self.moved, points.motion)

    def cam_from_corner_board(self, points: RigPoints) -> Pose:
        """Of every corner: where its board is when it is seen."""
        if points.row_px is None:
            return self.cam_from_board(points)[points.view]
        shared = self._shared(points.by_corner)
        if points.motion is None or self.moved is None:
            return shared
        return shared @ motion_pose(self.moved, points.motion)[points.view]

    def residual_px(self, points: RigPoints) -> Float[Tensor, "n 2"]:
        """Projected minus observed pixel."""
        seen = _placed(self.cam_from_corner_board(points), points, self.shape)
        parts = [self.models[part.camera].project(seen[slice(*part.rows)])[0] for part in points.parts]
        return torch.cat(parts) - points.pixels


def _placed(cam_from_board: Pose, points: RigPoints, shape: BoardShape) -> Float[Tensor, "n 3"]:
    """Corners in the frames of their cameras."""
    return (cam_from_board.rotation @ shape.place(points.board_m)[..., None])[..., 0] + cam_from_board.translation


class RigProblem:
    """Kept are, in this order: the intrinsics of each camera along the columns of its basis (none: held), the poses of the
    cameras but the first, those of the boards that are free, the terms of the board's shape that are free, the line delays and
    the offsets of the clocks that are free."""

    def __init__(
        self,
        points: RigPoints,
        bases: Sequence[Float[Tensor, "_ _"]],
        boards: int,
        free_boards: bool,
        frames: int,
        shape: BoardShape = AS_DRAWN,
    ) -> None:
        self.points, self.bases, self.free_terms = points, tuple(bases), shape.free
        self.free_boards = boards - 1 if free_boards else 0
        self.estimated = [c for c, basis in enumerate(self.bases) if basis.shape[1]]
        none = torch.zeros(len(self.bases), dtype=torch.bool)
        self.delayed = torch.nonzero(none if points.times is None else points.times.delayed).flatten()
        self.free_clocks = torch.nonzero(none if points.times is None else points.times.free).flatten()
        groups = [KeptGroup(torch.where(points.camera == c, 0, -1), 1, self.bases[c].shape[1]) for c in self.estimated]
        if len(self.bases) > 1:
            groups.append(KeptGroup(points.camera - 1, len(self.bases) - 1, 6))
        if self.free_boards:
            groups.append(KeptGroup(points.board - 1, self.free_boards, 6))
        self._board_group = len(groups) - 1
        if not shape.plain:
            groups.append(KeptGroup(torch.zeros_like(points.board), 1, shape.free.shape[1]))
        self._shape_group = len(groups) - 1
        for members in (self.delayed, self.free_clocks):
            if len(members):
                place = torch.full((len(self.bases),), -1)
                place[members] = torch.arange(len(members))
                groups.append(KeptGroup(place[points.camera], len(members), 1))
        width = 6 if points.times is None else 6 * (1 + points.times.degree)
        self.structure = Structure(points.frame, frames, width, tuple(groups))
        self._last: tuple[RigState, CellLinearisation, tuple[Moved, ...]] | None = None

    def linearise(self, state: RigState) -> CellLinearisation:
        """Weighted reprojection error and its derivatives, without the views' own motion; see `linearise_corners`."""
        return self._at(state)[0]

    def of_corners(self, values: Float[Tensor, "n 2"]) -> Float[Tensor, "m 2"]:
        """Values of the corners as residuals of the problem: zero where those are of the views' own motion."""
        if self.points.motion is None:
            return values
        rows = [torch.cat([values[slice(*part.rows)], values.new_zeros(3 * (part.views[1] - part.views[0]), 2)])
                for part in self.points.parts]  # fmt: skip
        return torch.cat(rows)

    def _at(self, state: RigState) -> tuple[CellLinearisation, tuple[Moved, ...]]:
        # A solution begins where the one before ended.
        if self._last is None or self._last[0] is not state:
            at = self.linearise_corners(state)
            moved: tuple[Moved, ...] = ()
            if self.points.motion is not None and state.moved is not None:
                pose = state.cam_from_board(self.points)
                at, moved = without_motion(at, [part.views for part in self.points.parts], self.points.motion, state.moved, pose)
            self._last = state, at, moved
        return self._last[1:]

    def linearise_corners(self, state: RigState) -> CellLinearisation:
        """Weighted reprojection error by the pose of each view's board in its camera and by the intrinsics; how these follow.

        A left perturbation of the target's pose is one of the board's by the adjoint of cam_from_rig, and one of the board on the
        target by that of cam_from_rig rig_from_target.
        """
        points, each = self.points, self.points.row_px is not None
        posed = points.by_corner if each else points
        cam_from_target, along = state.cam_from_rig[posed.camera] @ state.target(posed), state.along(posed)
        cam_from_board = state.cam_from_corner_board(points)
        seen = _placed(cam_from_board, points, state.shape)
        on_rig, on_target = adjoint(state.cam_from_rig), adjoint(cam_from_target)
        delay_group, clock_group = self._time_groups
        residual, parts = [], []
        for part, cells in zip(points.parts, points.cells, strict=True):
            camera, rows = part.camera, slice(*part.rows)
            poses = rows if each else slice(*part.views)
            place, weight, basis = seen[rows], points.weight[rows, None, None], self.bases[camera]
            pixels, _, by_point, by_parameter = state.models[camera].project_with_jacobians(place)
            residual.append((pixels - points.pixels[rows]) * weight[..., 0])
            by_point = by_point * weight
            # Row by row, -J [X]x is the cross product of X and J.
            by_turn = torch.linalg.cross(place[:, None].expand_as(by_point), by_point)
            local = LocalColumns(cells, torch.cat([by_turn, by_point], -1))
            if basis.shape[1]:
                local.by_block(self.estimated.index(camera), (by_parameter @ basis) * weight)
            if camera:
                alike = torch.eye(6, dtype=torch.float64).expand(cells.count, -1, -1)
                local.through_pose(len(self.estimated), alike, each=False)
            if part.other_board and self.free_boards:
                local.through_pose(self._board_group, on_target[poses], each=each)
            if self.free_terms.shape[1]:
                bent = state.shape.by_terms(points.board_m[rows]) @ self.free_terms
                local.by_block(self._shape_group, by_point @ (cam_from_board.rotation[rows] @ bent))
            if along is None:
                local.through_pose(None, on_rig[camera].expand(cells.count, -1, -1), each=False)
            else:
                by_offset = on_rig[camera] @ along.by_offset[poses]
                if points.row_px is not None and bool((self.delayed == camera).any()):
                    local.through_pose(delay_group, -by_offset * points.row_px[rows, None, None], each=each)
                if bool((self.free_clocks == camera).any()):
                    local.through_pose(clock_group, by_offset, each=each)
                local.through_pose(None, on_rig[camera] @ along.by_run[poses], each=each)
            parts.append(local.part())
        return CellLinearisation(torch.cat(residual), tuple(parts))

    @property
    def _time_groups(self) -> tuple[int, int]:
        """Numbers of the groups of the line delays and of the offsets, where there are any."""
        last = len(self.structure.groups) - 1
        return (last - 1 if len(self.free_clocks) else last), last

    def retract(self, state: RigState, kept: Tensor, eliminated: Tensor) -> RigState:
        """Parameters move along their columns, poses by exp(delta) T."""
        sizes = [self.bases[c].shape[1] for c in self.estimated]
        terms, ticking = self.free_terms.shape[1], len(self.delayed) + len(self.free_clocks)
        *cameras, poses, boards, bent, ticks = kept.split(
            [*sizes, 6 * (len(self.bases) - 1), 6 * self.free_boards, terms, ticking]
        )
        models = list(state.models)
        for c, step in zip(self.estimated, cameras, strict=True):
            models[c] = models[c].with_parameters(models[c].parameters + self.bases[c] @ step)
        target, path = self._targets(state, eliminated, ticks)
        return RigState(
            tuple(models),
            _moved(state.cam_from_rig, poses),
            _moved(state.target_from_board, boards),
            target,
            state.shape.moved(self.free_terms @ bent),
            None if state.moved is None else state.moved + self._own_step(state, kept, eliminated),
            path,
        )

    def _targets(self, state: RigState, step: Tensor, ticks: Float[Tensor, " k"]) -> tuple[Pose, Path | None]:
        if self.points.times is None or state.path is None:
            return Pose.exp(step) @ state.rig_from_target, state.path
        target, path = moved_run(state.rig_from_target, state.path, step, self.points.times.middle_m)
        delays, offsets = ticks[: len(self.delayed)], ticks[len(self.delayed) :]
        offset_s = path.offset_s.index_add(0, self.free_clocks, offsets)
        return target, replace(path, offset_s=offset_s, line_delay_s=path.line_delay_s.index_add(0, self.delayed, delays))

    def _own_step(self, state: RigState, kept: Tensor, eliminated: Tensor) -> Float[Tensor, "v 6"]:
        """How each view's own motion follows a step of all else."""
        at, moved = self._at(state)
        steps = []
        for part, own, cells in zip(at.parts, moved, self.points.parts, strict=True):
            views = slice(*cells.views)
            local = (part.by_eliminated @ eliminated[self.points.frame[views], :, None])[..., 0]
            for number, by_block in part.by_kept:
                group, low = self.structure.groups[number], self.structure.offsets[number]
                blocks = kept[low : low + group.count * group.dim].view(group.count, group.dim)[group.index[views]]
                local = local + (by_block @ blocks[..., None])[..., 0]
            steps.append(own.step(local))
        return torch.cat(steps)

    def gauge(self, state: RigState) -> Float[Tensor, "k 0"]:
        """None: the first camera and the first board fix the frames, the boards the scale."""
        return torch.zeros(self.structure.kept_size, 0, dtype=torch.float64)


def _moved(poses: Pose, step: Float[Tensor, " k"]) -> Pose:
    """exp(delta) T of the last poses, as many as there are steps; those before are held."""
    held = len(poses) - len(step) // 6
    moved = Pose.exp(step.view(-1, 6)) @ poses[held:]
    return Pose(torch.cat([poses.rotation[:held], moved.rotation]), torch.cat([poses.translation[:held], moved.translation]))
