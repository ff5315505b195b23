"""From cameras calibrated alone to the start of a rig: poses with the ways they may be numbered, sides, one frame for all."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.calibration.numbering import Lattice, Numbering
from omnilines.calibration.rig.alone import AloneCamera
from omnilines.calibration.rig.consensus import PosedViews, reflected
from omnilines.calibration.rig.graph import RigGraph
from omnilines.calibration.rig.views import RigViews


def numberings_of(views: RigViews) -> dict[str, Numbering]:
    """What a table of corners tells of the numbering of each board: whether it forms a lattice."""
    board = views.board[views.corners.view]
    return {name: Numbering(Lattice.of(views.corners.board_m[board == b])) for b, name in enumerate(views.boards)}


class ViewNumberings:
    """The ways in which the corners of every view may be numbered; `sides` are the cameras that may look into a mirror."""

    def __init__(self, views: RigViews, numberings: Mapping[str, Numbering], sides: frozenset[int]) -> None:
        self.views, self.numberings, self.sides = views, numberings, sides
        self.patch_m, self._low, self._high = _patches(views, numberings)
        self._slack = _slack(views, numberings, self._low, self._high)
        self._known: dict[tuple[int, ...], Pose] = {}
        self.pitch_m = tuple(_pitch(numberings[name], views, b) for b, name in enumerate(views.boards))

    def of(self, view: int) -> Pose:
        """`board_from_numbered` (k,) of a view, the numbering as it is first."""
        board, mirrored = int(self.views.board[view]), int(self.views.camera[view]) in self.sides
        low, high, slack = self._low[view], self._high[view], self._slack[view]
        key = (board, int(mirrored), *low.tolist(), *high.tolist(), *slack.tolist())
        if key not in self._known:
            self._known[key] = self.numberings[self.views.boards[board]].placements(low, high, slack, mirrored)
        return self._known[key]


def posed_views(options: ViewNumberings, alone: Mapping[int, AloneCamera]) -> tuple[PosedViews, Int[np.ndarray, " p"]]:
    """The views that cameras posed alone, with every way in which each may be numbered; and their numbers in the table."""
    views = options.views
    numbers = np.concatenate([camera.views for camera in alone.values()])
    poses = [camera.cam_from_board for camera in alone.values()]
    motions = [options.of(v) for v in numbers.tolist()]
    most = max(len(motion) for motion in motions)
    place = torch.arange(most)
    found = PosedViews(
        camera=torch.as_tensor(views.camera[numbers]),
        frame=torch.as_tensor(views.block[numbers]),
        board=torch.as_tensor(views.part[numbers]),
        corners=torch.as_tensor(np.bincount(views.corners.view, minlength=len(views.camera))[numbers]),
        cam_from_board=Pose(torch.cat([pose.rotation for pose in poses]), torch.cat([pose.translation for pose in poses])),
        patch_m=torch.as_tensor(options.patch_m[numbers]),
        pitch_m=torch.tensor(options.pitch_m, dtype=torch.float64)[torch.as_tensor(views.board[numbers])],
        board_from_numbered=Pose.stack([motion[place.clamp_max(len(motion) - 1)] for motion in motions]),
        allowed=torch.stack([place < len(motion) for motion in motions]),
    )
    return found, numbers


def _patches(
    views: RigViews, numberings: Mapping[str, Numbering]
) -> tuple[Float[np.ndarray, "v 5 3"], Int[np.ndarray, "v 2"], Int[np.ndarray, "v 2"]]:
    """Ends and middle of what each view shows of its board, and the smallest and largest indices on its lattice."""
    corners = views.corners
    count = len(corners.view_names)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, corners.view, corners.board_m[:, :2])
    np.maximum.at(high, corners.view, corners.board_m[:, :2])
    low[~np.isfinite(low)], high[~np.isfinite(high)] = 0.0, 0.0
    middle = 0.5 * (low + high)
    ends = [low, np.stack([high[:, 0], low[:, 1]], -1), high, np.stack([low[:, 0], high[:, 1]], -1), middle]
    patch = np.concatenate([np.stack(ends, 1), np.zeros((count, 5, 1))], -1)
    first, last = np.zeros((2, count, 2), dtype=np.int64)
    for b, name in enumerate(views.boards):
        lattice = numberings[name].lattice
        if lattice is not None:
            own = views.board == b
            first[own], last[own] = (np.rint((part[own] - lattice.first_m) / lattice.pitch_m) for part in (low, high))
    return patch, first, last


def _slack(
    views: RigViews, numberings: Mapping[str, Numbering], low: Int[np.ndarray, "v 2"], high: Int[np.ndarray, "v 2"]
) -> Int[np.ndarray, "v 2"]:
    """How far a patch may lie beyond its board because no view of its frame shows the whole: what the largest one lacks."""
    key = views.frame * len(views.boards) + views.board
    most = np.zeros((len(views.frames) * len(views.boards), 2), dtype=np.int64)
    np.maximum.at(most, key, high - low)
    slack = np.zeros_like(low)
    for b, name in enumerate(views.boards):
        lattice = numberings[name].lattice
        if lattice is not None:
            own = views.board == b
            slack[own] = np.maximum(lattice.last - most[key[own]], 0)
    return slack


def _pitch(numbering: Numbering, views: RigViews, board: int) -> float:
    """Typical distance of neighbouring corners of a board (m)."""
    if numbering.lattice is not None:
        return float(numbering.lattice.pitch_m.mean())
    rows = views.board[views.corners.view] == board
    points = np.unique(np.round(views.corners.board_m[rows, :2], 9), axis=0)
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(1)))


def faces(posed: PosedViews, camera: int) -> bool:
    """Whether a camera sees its boards from the front in most of its views (z of the board away from the camera)."""
    own = torch.nonzero(posed.camera == camera).flatten()
    pose = posed.cam_from_board[own]
    middle = pose.transform(posed.patch_m[own, 4:])[:, 0]
    return bool(((pose.rotation[..., 2] * middle).sum(-1) > 0).to(torch.float64).mean() > 0.5)


@dataclass(frozen=True, eq=False)
class RigStart:
    """A rig as it hangs together: members in their order, the first camera being the rig frame and, unless the places of boards
    are known, the first board the frame of the target."""

    cameras: tuple[int, ...]
    boards: tuple[int, ...]
    models: tuple[CameraModel, ...]
    cam_from_rig: Pose
    target_from_board: Pose
    rig_from_target: Pose
    """Of every block of the table; the identity where it is not known."""
    placed: Bool[Tensor, " f"]
    board_from_numbered: dict[int, Pose]
    """Of every view that agrees with the rig."""


def rig_start(
    graph: RigGraph,
    posed: PosedViews,
    numbers: Int[np.ndarray, " p"],
    models: Mapping[int, CameraModel],
    sides: frozenset[int],
    *,
    tied: bool,
) -> RigStart:
    """The grown rig seen from its first camera and first board; where all `sides` are open, most cameras keep theirs."""
    cameras = torch.nonzero(graph.cameras).flatten().tolist()
    boards = torch.nonzero(graph.boards).flatten().tolist()
    own = [models[c].reversed() if graph.turned[c] else models[c] for c in cameras]
    in_rig, on_target, target = graph.cam_from_rig[cameras], graph.target_from_board[boards], graph.rig_from_target
    # All sides open: the whole rig may as well be mirrored.
    if sides.issuperset(cameras) and 2 * int(graph.turned.sum()) > len(cameras):
        everything = torch.ones(1, dtype=torch.bool)
        in_rig, on_target, target = (reflected(pose, everything.expand(len(pose))) for pose in (in_rig, on_target, target))
        own = [model.reversed() for model in own]
    # Boards with known places keep their common frame; else the first board is the frame of the target.
    first, board = in_rig[0], Pose.identity() if tied else on_target[0]
    chosen = torch.nonzero(graph.numbering >= 0).flatten()
    motions = posed.board_from_numbered[chosen, graph.numbering[chosen]]
    return RigStart(
        cameras=tuple(cameras),
        boards=tuple(boards),
        models=tuple(own),
        cam_from_rig=in_rig @ first.inverse(),
        target_from_board=board.inverse() @ on_target,
        rig_from_target=first @ target @ board,
        placed=graph.frames,
        board_from_numbered={int(numbers[v]): motions[k] for k, v in enumerate(chosen.tolist())},
    )
