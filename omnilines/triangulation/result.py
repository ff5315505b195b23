"""The result of every triangulation."""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.geometry.line import PlueckerLines, segment_ends
from omnilines.geometry.line_chart import LineChart
from omnilines.records import LINE_STATUSES
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.residuals import chart_of, line_covariance


@dataclass(frozen=True)
class Triangulation:
    """Lines of t tracks, in the world frame. Charts, covariances and end points are computed when first asked for."""

    lines: PlueckerLines
    """(t,) lines; NaN where the status is neither `ok` nor `weak`."""
    status: Int[Tensor, " t"]
    """Index into `records.LINE_STATUSES`."""
    views: Int[Tensor, " t"]
    """Places that each is seen from: pieces in one photo, and photos of one place, count once."""
    plane_angle_rad: Float[Tensor, " t"]
    """Spread of the planes about the line: 2 asin(sigma_2 / sqrt(k)), sigma_2 the second singular value of the k unit normals.
    It is the angle between the planes of two views; the errors of a line grow with its inverse. NaN below two views."""
    residual_rad: Float[Tensor, " t"]
    """Standard deviation of an observation across the fitted line, from the residuals of more than two views; NaN otherwise."""
    observations: PlaneObservations = field(repr=False)
    """What the lines were found from."""
    rests_on_one: Bool[Tensor, " t"] = field(repr=False)
    """Tracks that are `weak` for nothing but this: without one camera the planes of the others coincide."""

    def __len__(self) -> int:
        return self.tracks

    @property
    def tracks(self) -> int:
        """Number of tracks."""
        return self.status.shape[0]

    @property
    def status_names(self) -> tuple[str, ...]:
        """Status of each track by name."""
        return tuple(LINE_STATUSES[code] for code in self.status.tolist())

    @property
    def known(self) -> Bool[Tensor, " t"]:
        """Tracks that have a line."""
        return (self.status == LINE_STATUSES.index("ok")) | (self.status == LINE_STATUSES.index("weak"))

    @property
    def two_views(self) -> Bool[Tensor, " t"]:
        """Lines of two views, which nothing confirms; their status is `weak`, so that they keep their end points."""
        return self.known & (self.views == 2)

    @cached_property
    def chart(self) -> LineChart:
        """The chart of each line about its cameras, with its centre and scale (m); NaN for tracks without a line."""
        return chart_of(self.observations, self.lines)

    @cached_property
    def _covariance_and_factor(self) -> tuple[Float[Tensor, "t 4 4"], float]:
        return line_covariance(self.observations, self.chart)

    @property
    def covariance(self) -> Float[Tensor, "t 4 4"]:
        """Of each line in `chart` (rad^2): the inverse of the information that its end points hold, at the line found.

        It is exact to first order for `ml`, and slightly too small for the other methods, which do not attain it. NaN for tracks
        without a line, and everywhere when the noise is not stated and no track has more than two views to show it.
        """
        return self._covariance_and_factor[0]

    @property
    def variance_factor(self) -> float:
        """Variance of a residual that `covariance` holds: 1 where the noise of the end points is stated, else estimated from the
        residuals of all tracks, in px^2 where `observations.noise` is known and in rad^2 where not."""
        return self._covariance_and_factor[1]

    @cached_property
    def ends_m(self) -> Float[Tensor, "t 2 3"]:
        """End points: weighted medians of the observed ends, see `segment_ends`. NaN without a line, and without arcs."""
        observations = self.observations
        if observations.arcs is None:
            return torch.full((self.tracks, 2, 3), torch.nan, dtype=self.lines.moment.dtype, device=self.status.device)
        eye = torch.eye(3, dtype=observations.arcs.dtype, device=self.status.device)
        upright = Pose(eye.expand(len(observations.centre), 3, 3), -observations.centre)
        return segment_ends(self.lines, upright, observations.arcs, observations.track)[0]
