"""A calibrated camera: what the estimate, its report and its files consist of."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from camera_models import CameraModel
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.model_misfit import ModelMisfit
from omnilines.calibration.photo_changes import PhotoChange
from omnilines.calibration.unmodelled import Unmodelled
from omnilines.records import ViewResult


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera with everything that the report and the files need."""

    model: CameraModel
    covariance: Float[np.ndarray, "p p"]
    """Of the parameters in their order, scaled by the stated noise of the corners where the residuals bear it out, else by the
    residuals, or by how much photos contradict each other."""
    rms_px_per_axis: float
    rms_px_per_point: float
    residual_px: Float[np.ndarray, "n 2"]
    """Projected minus observed pixel of every corner; NaN for corners of views that were not used."""
    kept: Bool[np.ndarray, " n"]
    """Corners that the estimate rests on."""
    views: tuple[ViewResult, ...]
    min_angle_deg: float
    max_angle_deg: float
    """How far from the bearing of the centre pixel the data reach."""
    iterations: int
    notes: tuple[str, ...]
    board: BoardShape
    board_sigma: Mapping[str, float]
    """One standard deviation of each board term that was estimated."""
    interval_95: Float[np.ndarray, "p 2"]
    """Lowest and highest value of each parameter, which hold it in 95 of 100 cases."""
    corner_sigma_px: float
    """Standard deviation of a corner per axis (root mean square) by noise."""
    beyond_noise: float = 1.0
    """Standard deviations of the parameters over those of that noise alone: more than 1 where photos contradict each other."""
    curved: bool = False
    """Whether the covariance does not hold so far from the estimate, so that intervals are those of the profile likelihood."""
    misfit: ModelMisfit | None = None
    """What residuals have in common in all photos, where the model does not follow the lens."""
    unmodelled: Unmodelled | None = None
    """What neither board nor model hold in all photos alike, where that moves the projection by more than is stated."""
    change: PhotoChange | None = None
    """What differs from photo to photo, where that explains why they contradict each other."""
    line_delay: LineDelay | None = None
    """Of a rolling shutter that was recognised or estimated."""

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """`interval_95` by name."""
        return {name: (low, high) for name, (low, high) in zip(self.sigma, self.interval_95.tolist(), strict=True)}

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation of each parameter."""
        return dict(zip(self.model.PARAMETER_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def board_terms(self) -> dict[str, float]:
        """The estimated board terms."""
        terms = dict(zip(self.board.names, self.board.terms.tolist(), strict=True))
        return {name: terms[name] for name in self.board_sigma}


def with_remarks(result: CameraCalibration, remarks: Mapping[str, tuple[str, ...]]) -> CameraCalibration:
    """The result with more remarks on its views, by view name."""
    views = tuple(replace(view, remarks=view.remarks + remarks.get(view.name, ())) for view in result.views)
    return replace(result, views=views)
