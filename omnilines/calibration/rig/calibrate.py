"""Several cameras that are mounted together, in one joint adjustment: each alone, then where they stand, then all at once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Int

from camera_models import GeometryError, InputError
from camera_models.pose import Pose
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.numbering import Numbering
from omnilines.calibration.options import AUTO
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.agreeing_views import fit_agreeing_views, rig_data
from omnilines.calibration.rig.alone import AloneCamera, CameraSetup, alone_camera
from omnilines.calibration.rig.clock_search import ClockSearch
from omnilines.calibration.rig.clocks import with_clocks
from omnilines.calibration.rig.consensus import PosedViews, reflected
from omnilines.calibration.rig.fewer import state_of
from omnilines.calibration.rig.finish import rig_result
from omnilines.calibration.rig.graph import RigGraph, largest_rig
from omnilines.calibration.rig.joint import least_squares_rig
from omnilines.calibration.rig.loose import loosened
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.rolling import with_line_delays
from omnilines.calibration.rig.seen_alone import SeenAlone
from omnilines.calibration.rig.start import RigStart, ViewNumberings, faces, numberings_of, posed_views, rig_start
from omnilines.calibration.rig.terms import without_unsupported_terms
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.select import select_model
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.least_squares import Progress
from omnilines.records import Corners


def calibrate_rig(
    corners: Corners,
    cameras: Mapping[str, CameraSetup],
    *,
    relation: str = "fixed",
    loss: str = "cauchy",
    numberings: Mapping[str, Numbering] | None = None,
    seen_from_front: bool = False,
    refine_board: tuple[str, ...] = (),
    time_offsets: bool = False,
    rolling_shutter: bool = False,
    thresholds: CalibrationThresholds = CalibrationThresholds(),
    callback: Callable[[str, Progress], None] | None = None,
) -> RigCalibration:
    """Calibrate a rig from corners that name camera, frame and board of every view.

    `relation` says how several boards stand to one another (one of rig_views.BOARDS), `numberings` what is known of the numbering
    of each board (by default that its coordinates may form a lattice), `seen_from_front` that the coordinates are those of the
    printed side, so that they tell a mirror from a lens. `refine_board` names what is estimated of the board
    (`options.REFINABLE`), which is one board then. Of views with times the clocks of the cameras are compared where the cameras
    contradict each other, with `time_offsets` always. Rolling shutters are recognised in views with times; with `rolling_shutter`
    the line delays are estimated. `callback` is told the stage and its progress.

    Raises InputError for a malformed table, or with `rolling_shutter` for one without frames that follow one another closely, and
    GeometryError where no two cameras hang together or the data leave the rig open.
    """
    views = RigViews.of(corners, tuple(cameras), relation)
    if refine_board and len(views.boards) > 1:
        raise InputError(f"One board was expected with `refine_board`, found {len(views.boards)}; calibrate with one of them.")
    begun = _begun(views, cameras, loss, numberings, seen_from_front, thresholds=thresholds, callback=callback)
    start, alone, failures = begun.start, begun.alone, begun.failures
    data = rig_data(views, start, alone)
    data = replace(data, shape=BoardShape.to_refine(refine_board, torch.as_tensor(data.board_m)))
    state = RigState(start.models, start.cam_from_rig, start.target_from_board, start.rig_from_target, data.shape)

    def joint(step: Progress) -> None:
        if callback is not None:
            callback("refining the rig", step)

    data, fit, reasons = fit_agreeing_views(data, start, state, begun.options, loss, thresholds=thresholds, callback=joint)
    data, fit, solution, notes = least_squares_rig(data, fit, loss, joint)
    singles = _single_results(views, cameras, failures, alone, loss, thresholds=thresholds)
    outcome = RigOutcome(
        data=data,
        fit=fit,
        solution=solution,
        setups=cameras,
        alone=alone,
        failures=failures,
        reasons=reasons,
        sign_sources=begun.sign_sources,
        singles=singles,
        rejects=loss != "none",
        notes=notes,
        thresholds=thresholds,
    )
    seen = _seen_alone(outcome, start, begun.posed, begun.numbers)
    outcome = with_clocks(outcome, state, seen, begun.ahead_s, asked=time_offsets)
    if len(outcome.data.cameras) < len(start.cameras):
        # Cameras whose clocks are not told are of the rig no more.
        failures |= outcome.failures
        singles = _single_results(views, cameras, failures, alone, loss, thresholds=thresholds)
        outcome = replace(outcome, failures=failures, singles=singles)
        state = state_of(state, [k for k, c in enumerate(start.cameras) if c in outcome.data.cameras])
    outcome = with_line_delays(outcome, state, seen, asked=rolling_shutter)
    outcome = loosened(outcome, state, seen)
    return rig_result(without_unsupported_terms(outcome))


@dataclass(frozen=True)
class _Begun:
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
    ahead_s: dict[int, float] | None
    """By how much cameras' clocks seem to be ahead of that of the first, beyond what frames are put together by; None where there
    are no runs of frames that tell."""


def _begun(
    views: RigViews,
    cameras: Mapping[str, CameraSetup],
    loss: str,
    numberings: Mapping[str, Numbering] | None,
    seen_from_front: bool,
    *,
    thresholds: CalibrationThresholds,
    callback: Callable[[str, Progress], None] | None,
) -> _Begun:
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
    graph = largest_rig(posed, sizes, sides, views.tied, trusted, order=order, thresholds=thresholds.rig)
    clocks, of_start, numbers_of_start = ClockSearch.of(views, posed, numbers, thresholds), posed, numbers
    ahead_s = None if clocks is None else clocks.offsets_s()
    if clocks is not None and ahead_s is not None:
        moved, moved_numbers = clocks.moved(ahead_s)
        other = largest_rig(moved, sizes, sides, views.tied, trusted, order=order, thresholds=thresholds.rig)
        if other.size > graph.size:
            graph, of_start, numbers_of_start = other, moved, moved_numbers
    for c in alone:
        if not bool(graph.cameras[c]):
            failures[c] = _why_left_out(views, graph, c)
    start = rig_start(graph, of_start, numbers_of_start, {c: own.model for c, own in alone.items()}, sides, tied=views.tied is not None)
    _require_rig(views, start, failures)
    signs = _sign_sources(alone, sides, by_tags, graph, cameras)
    return _Begun(alone, failures, options, posed, numbers, start, signs, ahead_s)


def _seen_alone(outcome: RigOutcome, start: RigStart, posed: PosedViews, numbers: Int[np.ndarray, " p"]) -> SeenAlone:
    """What the members see by themselves, of views whose numbering is beyond doubt."""
    members, alone, views = outcome.data.cameras, outcome.alone, outcome.data.views
    turned = [c for c, model in zip(start.cameras, start.models, strict=True) if model is not alone[c].model]
    poses = posed.seen_in_mirrors(turned).cam_from_board
    sure = (posed.allowed.sum(1) == 1).tolist()
    found = {}
    for place, v in enumerate(numbers.tolist()):
        if int(views.camera[v]) in members and (sure[place] or v in start.board_from_numbered):
            motion = start.board_from_numbered.get(v, Pose.identity())
            found[v] = poses[place] @ motion.inverse()
    kept = np.zeros(len(views.corners), dtype=bool)
    for c in members:
        kept[views.of_camera(c)[2]] = alone[c].kept
    return SeenAlone(found, kept & np.isin(views.corners.view, list(found)))


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
    return (
        f"its {len(common)} common frames with the others do not agree on where it stands; check that frames are of the same "
        "instant and see more of the board in both cameras"
    )


def _single_results(
    views: RigViews,
    cameras: Mapping[str, CameraSetup],
    failures: dict[int, str],
    alone: Mapping[int, AloneCamera],
    loss: str,
    *,
    thresholds: CalibrationThresholds,
) -> dict[str, CameraCalibration]:
    """Calibrations of the cameras that are not of the rig, can be calibrated by themselves and were not given."""
    found = {}
    for c in [c for c in failures if c in alone and cameras[views.cameras[c]].start is None]:
        name, setup = views.cameras[c], cameras[views.cameras[c]]
        corners, _, _ = views.of_camera(c)
        common: dict[str, Any] = {"loss": loss, "mirror": setup.mirror, "thresholds": thresholds}
        try:
            if setup.model == AUTO:
                found[name] = select_model(corners, setup.image_size, **common).result
            else:
                found[name] = calibrate_camera(corners, setup.image_size, setup.model, options=setup.options, **common)
        except (InputError, GeometryError) as error:
            failures[c] += f"; by itself it cannot be calibrated either: {str(error).rstrip('.')}"
    return found


def _require_rig(views: RigViews, start: RigStart, failures: Mapping[int, str]) -> None:
    if len(start.cameras) < min(2, len(views.cameras)):
        name = views.cameras[next(iter(failures))]
        raise GeometryError(
            "Cameras that see the target at the same instants were expected, found no two of "
            f"{', '.join(views.cameras)} that hang together ({name}: {next(iter(failures.values()))}); add frames in which two "
            "cameras see it, or calibrate each alone."
        )
