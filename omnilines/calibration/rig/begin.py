"""Where the joint adjustment of a rig begins: each camera alone, and where the poses that it finds say that the cameras stand."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import GeometryError, InputError
from camera_models.pose import Pose
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.numbering import Numbering
from omnilines.calibration.rig.alone import AloneCamera, CameraSetup, alone_camera
from omnilines.calibration.rig.clock_search import ClockSearch
from omnilines.calibration.rig.consensus import PosedViews, reflected
from omnilines.calibration.rig.graph import RigGraph, largest_rig
from omnilines.calibration.rig.path import Path
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.seen_alone import SeenAlone
from omnilines.calibration.rig.start import RigStart, ViewNumberings, faces, numberings_of, posed_views, rig_start
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.least_squares import Progress


@dataclass(frozen=True)
class Begun:
    """Each camera alone, and where its views say that the cameras stand."""

    alone: dict[int, AloneCamera]
    failures: dict[int, str]
    """Why cameras are not of the rig."""
    options: ViewNumberings
    posed: PosedViews
    numbers: Int[np.ndarray, " p"]
    """The view of each row of `posed`."""
    start: RigStart
    sign_sources: dict[int, str]
    clocks_s: Float[Tensor, " m"] | None
    """By how much the clocks of the start's cameras seem to be ahead of that of the first; None where no runs of frames tell."""
    clocks_differ: bool
    """Whether the start is of the instants that these tell, as more views agree at these than frame by frame."""

    def state(self, shape: BoardShape) -> RigState:
        """The start with a board of this shape."""
        start, path = self.start, None
        if self.clocks_s is not None:
            path = Path(torch.zeros(0, 0, 6, dtype=torch.float64), self.clocks_s, torch.zeros_like(self.clocks_s))
        return RigState(start.models, start.cam_from_rig, start.target_from_board, start.rig_from_target, shape, path=path)

    def seen_alone(self, views: RigViews) -> SeenAlone:
        """What the members see by themselves, of views whose numbering is beyond doubt."""
        start, members = self.start, self.start.cameras
        turned = [c for c, model in zip(members, start.models, strict=True) if model is not self.alone[c].model]
        poses = self.posed.seen_in_mirrors(turned).cam_from_board
        sure = (self.posed.allowed.sum(1) == 1).tolist()
        found = {}
        for place, v in enumerate(self.numbers.tolist()):
            if int(views.camera[v]) in members and (sure[place] or v in start.board_from_numbered):
                motion = start.board_from_numbered.get(v, Pose.identity())
                found[v] = poses[place] @ motion.inverse()
        kept = np.zeros(len(views.corners), dtype=bool)
        for c in members:
            kept[views.of_camera(c)[2]] = self.alone[c].kept
        return SeenAlone(found, kept & np.isin(views.corners.view, list(found)))


def begun_rig(
    views: RigViews,
    cameras: Mapping[str, CameraSetup],
    loss: str,
    numberings: Mapping[str, Numbering] | None,
    seen_from_front: bool,
    *,
    thresholds: CalibrationThresholds,
    callback: Callable[[str, Progress], None] | None,
) -> Begun:
    """From what a joint adjustment can start. Raises GeometryError where no two cameras hang together."""
    alone, failures = _alone(views, cameras, loss, thresholds, callback)
    sides = frozenset(c for c, own in alone.items() if cameras[views.cameras[c]].start is None and own.model.AXIS_SIGN_OPEN)
    options = ViewNumberings(views, numberings or numberings_of(views), sides)
    posed, numbers = posed_views(options, alone)
    by_tags: frozenset[int] = frozenset()
    if seen_from_front:
        by_tags = sides
        behind = [c for c in sides if not faces(posed, c)]
        posed, sides = posed.seen_in_mirrors(behind), frozenset()
        alone = {c: _turned(own) if c in behind else own for c, own in alone.items()}
    trusted = all(numbering.trusted for numbering in options.numberings.values())
    sizes = (len(views.cameras), views.blocks, views.parts)
    order = sorted(alone, key=lambda c: (c in sides, -int((posed.camera == c).sum())))

    def grown(of: PosedViews) -> RigGraph:
        return largest_rig(of, sizes, sides, views.tied, trusted, order=order, thresholds=thresholds.rig)

    graph, clocks = grown(posed), ClockSearch.of(views, posed, numbers, thresholds)
    placed, of_placed, differ = posed, numbers, False
    if clocks is not None:
        moved, of_moved = clocks.moved(clocks.ahead_s)
        other = grown(moved)
        if differ := other.size > graph.size:
            graph, placed, of_placed = other, moved, of_moved
    for c in alone:
        if not bool(graph.cameras[c]):
            failures[c] = _why_left_out(views, graph, c)
    models = {c: own.model for c, own in alone.items()}
    start = rig_start(graph, placed, of_placed, models, sides, tied=views.tied is not None)
    _require_rig(views, start, failures)
    signs = _sign_sources(alone, sides, by_tags, graph, cameras)
    clocks_s = None if clocks is None else clocks.clocks_s(start.cameras)
    return Begun(alone, failures, options, posed, numbers, start, signs, clocks_s, differ)


def _alone(
    views: RigViews,
    cameras: Mapping[str, CameraSetup],
    loss: str,
    thresholds: CalibrationThresholds,
    callback: Callable[[str, Progress], None] | None,
) -> tuple[dict[int, AloneCamera], dict[int, str]]:
    """Every camera alone, and why it could not be calibrated for those that could not."""
    found, failures = {}, {}
    for c, (name, setup) in enumerate(cameras.items()):
        corners, numbers, _ = views.of_camera(c)

        def tell(step: Progress, stage: str = f"calibrating {name} alone") -> None:
            if callback is not None:
                callback(stage, step)

        try:
            found[c] = alone_camera(corners, numbers, setup, loss, thresholds, callback=tell)
        except (InputError, GeometryError) as error:
            failures[c] = str(error).rstrip(".")
    if not found:
        raise GeometryError(f"No camera of the rig can be calibrated; the first: {next(iter(failures.values()))}.")
    return found, failures


def _turned(own: AloneCamera) -> AloneCamera:
    everything = torch.ones(len(own.cam_from_board), dtype=torch.bool)
    return replace(own, model=own.model.reversed(), cam_from_board=reflected(own.cam_from_board, everything))


def _sign_sources(
    alone: Mapping[int, AloneCamera],
    sides: frozenset[int],
    by_tags: frozenset[int],
    graph: RigGraph,
    cameras: Mapping[str, CameraSetup],
) -> dict[int, str]:
    """What decided the side of every camera for which it was open: tags, the rig, or what was assumed of its first camera."""
    members = [c for c in alone if bool(graph.cameras[c])]
    open_rig = sides.issuperset(members)
    found = dict.fromkeys(by_tags, "tags")
    for c in sides.intersection(members):
        by_rig = bool(graph.determined[c]) and (not open_rig or len(set(graph.turned[members].tolist())) > 1)
        found[c] = "rig" if by_rig else "mirror" if list(cameras.values())[c].mirror else "assumed"
    return found


def _why_left_out(views: RigViews, graph: RigGraph, camera: int) -> str:
    members = np.flatnonzero(graph.cameras.numpy())
    own = np.unique(views.block[views.camera == camera])
    common = np.intersect1d(own, np.unique(views.block[np.isin(views.camera, members)]))
    if not len(common):
        return "it sees the target in no frame in which another camera of the rig does"
    if camera in graph.open_cameras:
        return (
            f"its {len(common)} common frames with the others do not tell how the corners of the plain board are numbered; add "
            "frames with the board turned otherwise"
        )
    if not bool(graph.boards[torch.as_tensor(np.unique(views.part[views.camera == camera]))].any()):
        return (
            f"it sees no board that another camera sees, and its {len(common)} common frames with the others do not tell where "
            "it stands: that takes four or more in which the rig, or the boards, are turned by 5 degrees or more about two axes"
        )
    clocks = (
        "their times do not tell an offset of clocks either"
        if views.corners.times_s is not None
        else "of cameras that run freely give videos, or a table with a column time_s, by which their clocks are compared"
    )
    return (
        f"its {len(common)} common frames with the others do not agree on where it stands; check that frames are of the same "
        f"instant ({clocks}) and that boards are numbered alike"
    )


def _require_rig(views: RigViews, start: RigStart, failures: Mapping[int, str]) -> None:
    if len(start.cameras) < min(2, len(views.cameras)):
        name = views.cameras[next(iter(failures))]
        raise GeometryError(
            "Cameras that see the target at the same instants were expected, found no two of "
            f"{', '.join(views.cameras)} that hang together ({name}: {next(iter(failures.values()))}); add frames in which two "
            "cameras see it, or calibrate each alone."
        )
