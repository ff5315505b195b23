"""What the calibration of a rig came to, before its result is written."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.alone import AloneCamera, CameraSetup
from omnilines.calibration.rig.by_frames import groups_of_frames, spread_of_frames, spread_of_runs
from omnilines.calibration.rig.excess import apart
from omnilines.calibration.rig.joint import RigData, RigFit
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.redundancy import beside_alone
from omnilines.calibration.rig.refined import refined_rig
from omnilines.calibration.rig.shutters import Shutters
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.least_squares import Solution
from omnilines.least_squares.variance import Contradiction, VarianceFactor, contradiction, variance_factor


@dataclass(frozen=True, eq=False)
class RigOutcome:
    """All that the calibration of a rig came to, from which its result is written."""

    data: RigData
    fit: RigFit
    """Its kept corners are those of the last fit."""
    solution: Solution[RigState]
    setups: Mapping[str, CameraSetup]
    alone: Mapping[int, AloneCamera]
    failures: Mapping[int, str]
    """Cameras that are not of the rig, and why."""
    reasons: Mapping[int, str]
    """Views of the rig's cameras that were left out, and why."""
    sign_sources: Mapping[int, str]
    """What decided the side of a camera, where that was open."""
    singles: Mapping[str, CameraCalibration]
    """Calibrations of the cameras that are not of the rig."""
    rejects: bool
    """Whether corners far off were rejected."""
    notes: tuple[str, ...]
    thresholds: CalibrationThresholds
    shutters: Shutters | None = None
    """How far the board moves between the shutters of the cameras, where that was estimated."""
    one_pose_rms_px: float | None = None
    """Per point, with one pose of the board in each frame, where each view has a motion of its own."""
    clock_notes: tuple[str, ...] = ()
    """What else is said of the cameras' clocks, where they were compared."""
    moving_share: Float[Tensor, " k"] | None = None
    """Of what is known of each line delay and offset of a clock that is estimated, the share that the board's motion tells: as if
    by chance the rest is told by the noise of its poses, which makes boards at rest seem to move."""
    clock_rms_px: tuple[float, float] = (math.nan, math.nan)
    """Per point, with the clocks as frames are put together and as estimated."""
    line_delays: tuple[LineDelay, ...] = ()
    """Rolling shutters that were recognised or estimated."""
    line_notes: tuple[str, ...] = ()
    """What else is said of them."""

    @property
    def freedom(self) -> int:
        """Observations less unknowns."""
        frames = len(np.unique(self.fit.points.frame[self.fit.points.view[self.fit.kept]].numpy()))
        structure = self.solution.reduced.equations.structure
        return 2 * int(self.fit.kept.sum()) - structure.kept_size - structure.dim * frames

    @property
    def offset_sigma_s(self) -> Float[np.ndarray, " m"]:
        """Standard deviation of the offset of each member's clock; 0 where it is not estimated."""
        runs = self.data.runs
        found = np.zeros(len(self.data.cameras))
        if runs is not None and runs.free.any():
            variance = self.kept_covariance.diagonal()
            if self.frame_spread is not None:
                variance = variance + self.frame_spread.diagonal()
            found[runs.free] = variance[-int(runs.free.sum()) :].sqrt().numpy()
        return found

    @cached_property
    def factor(self) -> VarianceFactor:
        """Of the whitened residuals; corners with a stated accuracy are never taken to be better than that."""
        stated = None if self.data.views.corners.sigma_px is None else 1.0
        return variance_factor(self.solution.cost, self.freedom, stated, self.thresholds.noise.significance)

    @cached_property
    def contradiction(self) -> Contradiction | None:
        """Frames that contradict each other by more than the noise of their corners, although each camera fits the rig as well as
        alone; None where they do not, or where that is told by other means (motions of the board, runs of frames)."""
        data = self.data
        if self.worse or self.shutters is not None or data.readout is not None or data.runs is not None:
            return None
        points = self.fit.points.chosen(self.fit.kept)
        groups = groups_of_frames(data, points, self.solution.state, self.thresholds.rig.one_place_squares)
        if groups is None:
            return None
        return contradiction(self.factor, self.solution.cost, self.freedom, groups, self.thresholds.noise.significance)

    @property
    def certain_factor(self) -> VarianceFactor:
        """That of the covariance: of the noise, or of the differences between frames."""
        return self.factor if self.contradiction is None else self.contradiction.factor

    @cached_property
    def alone_rms_px(self) -> tuple[float, ...]:
        """How well each member alone fits its corners, per point. Alone the board was taken to be as drawn: where its shape is
        estimated, it is fitted once more, on the board as the rig has it, to the corners that are kept."""
        if self.data.shape.plain:
            return tuple(self.alone[c].rms_px_per_point for c in self.data.cameras)
        return apart(self.data, self.fit.points.chosen(self.fit.kept), self.solution.state, hold=False).rms_px

    @cached_property
    def worse(self) -> tuple[int, ...]:
        """Members whose corners fit the rig worse than their camera alone."""
        return self._worse_than(self.data, self.solution.state, self.alone_rms_px)

    def _worse_than(self, data: RigData, state: RigState, alone_px: tuple[float, ...]) -> tuple[int, ...]:
        points, limit = self.fit.points.chosen(self.fit.kept), self.thresholds.rig.worse_than_alone_factor
        squares, camera = state.residual_px(points).square().sum(-1), points.camera[points.view]
        pairs = enumerate(zip(alone_px, beside_alone(data, points, state), strict=True))
        return tuple(k for k, (px, by_chance) in pairs if float(squares[camera == k].mean().sqrt()) > limit * by_chance * px)

    @property
    def held(self) -> tuple[int, ...]:
        """Members whose calibration is given and held."""
        setups = [self.setups[self.data.views.cameras[c]] for c in self.data.cameras]
        return tuple(k for k, setup in enumerate(setups) if setup.start is not None and setup.hold)

    @cached_property
    def worse_as_held(self) -> bool:
        """Whether cameras fit the rig worse than alone by what is held of them: with that refined, each would fit it as well as
        by views alone, with one pose of the board in each frame."""
        found = refined_rig(self.data, self.fit, self.solution.state, self.held) if self.worse else None
        if found is None:
            return False
        data, solution = found
        alone = apart(data, self.fit.points.chosen(self.fit.kept), solution.state, hold=False)
        return not self._worse_than(data, solution.state, alone.rms_px)

    @cached_property
    def kept_covariance(self) -> Float[Tensor, "q q"]:
        """Of the kept columns of the problem by the noise of the corners, as the residuals show it, and the motion of the board
        where that is estimated. That knows of the spread of frames; what else makes them differ (a board that bends) shows in the
        jackknife: a column that is less certain by it is taken to be so."""
        covariance, ticking = self.solution.kept_covariance() * self.certain_factor.value, self.data.ticking
        if ticking and self.moving_share is not None:
            surer = torch.ones(len(covariance), dtype=torch.float64)
            surer[-ticking:] = self.moving_share
            covariance = covariance / (surer[:, None] * surer).sqrt()
        points = self.fit.points.chosen(self.fit.kept)
        if self.shutters is not None:
            frames = spread_of_frames(self.data, points, self.solution.state, self.thresholds.rig.one_place_squares)
            spread = None if frames is None else frames.diagonal()
        elif self.data.readout is not None:
            spread = spread_of_runs(self.data, points, self.solution.state)
        else:
            return covariance
        if spread is None:
            return covariance
        wider = (spread / covariance.diagonal().clamp_min(1e-300)).clamp_min(1.0).sqrt()
        if self.shutters is None:
            # What runs contradict each other in is how the board moves within a frame.
            wider[:-ticking] = 1.0
        return wider[:, None] * covariance * wider

    @cached_property
    def frame_spread(self) -> Float[Tensor, "q q"] | None:
        """Covariance of the kept columns by how much frames contradict each other, where the rig fits worse than its cameras or
        that is more than noise."""
        if not self.worse and self.contradiction is None:
            return None
        points = self.fit.points.chosen(self.fit.kept)
        return spread_of_frames(self.data, points, self.solution.state, self.thresholds.rig.one_place_squares)

    @property
    def frame_factors(self) -> Float[Tensor, " q"] | None:
        """By how much that makes the standard deviation of each kept column larger."""
        if self.frame_spread is None:
            return None
        return (1 + self.frame_spread.diagonal() / self.kept_covariance.diagonal().clamp_min(1e-300)).sqrt()
