"""The result of every triangulation."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from omnilines.geometry.line import PlueckerLines
from omnilines.records import LINE_STATUSES


@dataclass(frozen=True)
class Triangulation:
    """Lines of t tracks, in the world frame."""

    lines: PlueckerLines
    """(t,) lines; NaN where the status is neither `ok` nor `weak`."""
    status: Int[Tensor, " t"]
    """Index into `records.LINE_STATUSES`."""
    views: Int[Tensor, " t"]
    plane_angle_rad: Float[Tensor, " t"]
    """Spread of the planes about the line: 2 asin(sigma_2 / sqrt(k)), sigma_2 the second singular value of the k unit normals.
    It is the angle between the planes of two views; the errors of a line grow with its inverse. NaN below two views."""
    residual_rad: Float[Tensor, " t"]
    """Standard deviation of an observation across the fitted line, from the residuals of more than two views; NaN otherwise."""

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
