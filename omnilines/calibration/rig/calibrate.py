"""Several cameras that are mounted together, in one joint adjustment: each alone, then where they stand, then all at once."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from camera_models import GeometryError, InputError
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.numbering import Numbering
from omnilines.calibration.options import AUTO
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.agreeing_views import fit_agreeing_views, rig_data
from omnilines.calibration.rig.alone import AloneCamera, CameraSetup
from omnilines.calibration.rig.begin import begun_rig
from omnilines.calibration.rig.clocks import with_clocks
from omnilines.calibration.rig.fewer import state_of
from omnilines.calibration.rig.finish import rig_result
from omnilines.calibration.rig.joint import least_squares_rig, not_fitted
from omnilines.calibration.rig.loose import loosened
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.rolling import with_line_delays
from omnilines.calibration.rig.terms import without_unsupported_terms
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.select import select_model
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.least_squares import Progress
from omnilines.records import Corners

CLOCKS = "comparing the clocks of the cameras"


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

    Raises InputError for a malformed table, or with `rolling_shutter` for a table without frames that follow one another closely,
    and GeometryError where no two cameras hang together or the data leave the rig open.
    """
    views = RigViews.of(corners, tuple(cameras), relation)
    if refine_board and len(views.boards) > 1:
        raise InputError(f"One board was expected with `refine_board`, found {len(views.boards)}; calibrate with one of them.")
    begun = begun_rig(views, cameras, loss, numberings, seen_from_front, thresholds=thresholds, callback=callback)
    data = rig_data(views, begun.start, begun.alone)
    data = replace(data, shape=BoardShape.to_refine(refine_board, torch.as_tensor(data.board_m)))
    state, seen = begun.state(data.shape), begun.seen_alone(views)

    def joint(step: Progress) -> None:
        if callback is not None:
            callback("refining the rig", step)

    def begin(stage: str) -> None:
        # What follows takes as long as the fit itself, and tells of no steps.
        if callback is not None:
            callback(stage, Progress(0, math.nan, math.nan, accepted=True))

    fit, solution = not_fitted(data, np.array(sorted(begun.start.board_from_numbered)), state)
    outcome = RigOutcome(
        data=data,
        fit=fit,
        solution=solution,
        setups=cameras,
        alone=begun.alone,
        failures=begun.failures,
        reasons={},
        sign_sources=begun.sign_sources,
        singles={},
        rejects=loss != "none",
        notes=(),
        thresholds=thresholds,
    )
    if begun.clocks_differ:
        begin(CLOCKS)
        outcome = with_clocks(outcome, state, seen, asked=True)
    if outcome.data.runs is None:
        data, fit, reasons = fit_agreeing_views(
            data, begun.start, replace(state, path=None), begun.options, loss, thresholds=thresholds, callback=joint
        )
        data, fit, solution, notes = least_squares_rig(data, fit, loss, joint)
        outcome = replace(outcome, data=data, fit=fit, solution=solution, reasons=reasons, notes=notes)
        begin(CLOCKS)
        outcome = with_clocks(outcome, state, seen, asked=time_offsets and not begun.clocks_differ)
    if len(outcome.data.cameras) < len(begun.start.cameras):
        # Cameras whose clocks are not told are of the rig no more.
        state = state_of(state, [k for k, c in enumerate(begun.start.cameras) if c in outcome.data.cameras])
    failures = dict(outcome.failures)
    singles = _single_results(views, cameras, failures, begun.alone, loss, thresholds=thresholds)
    outcome = replace(outcome, failures=failures, singles=singles)
    begin("looking for rolling shutters")
    outcome = with_line_delays(outcome, state, seen, asked=rolling_shutter)
    begin("following the board between the shutters")
    outcome = loosened(outcome, state, seen)
    begin("judging the rig")
    return rig_result(without_unsupported_terms(outcome))


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
