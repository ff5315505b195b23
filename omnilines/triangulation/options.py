"""Options of triangulation that all of its methods share: who belongs to a line, and when a line is determined.

Options of one method are the keywords of its function (`method_options`).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple


class ConsensusOptions(NamedTuple):
    """Which observations of a track agree on one line. Chi-square has two degrees of freedom: both ends of an arc."""

    row_chi_square: float = 13.816
    """Up to which an arc belongs to a line; true ones exceed it once in a thousand."""
    candidate_factor: float = 4.0
    """Times as much for candidates, which rest on two planes only, so that residuals are larger."""
    clearly_wrong_factor: float = 3.0
    """Times as much from which on an arc contradicts a line."""
    decisive: float = 6.0
    """Difference of two truncated costs at which the lesser is 20 times as likely."""
    hypotheses: int = 3
    """Candidates of a track that are refined."""

    @property
    def candidate_chi_square(self) -> float:
        """Up to which an arc supports a candidate."""
        return self.candidate_factor * self.row_chi_square

    @property
    def clearly_wrong_chi_square(self) -> float:
        """From which on an arc contradicts a line."""
        return self.clearly_wrong_factor * self.row_chi_square


class DegeneracyOptions(NamedTuple):
    """When a track determines a line."""

    arc_sigma_rad: float = 5e-4
    """Noise of a bearing that is assumed for two views, which cannot show it, about half a pixel of an ordinary camera; and the
    most that residuals are taken to show: what exceeds it comes from poses, and adjusting poses needs the lines."""
    inconsistent_rad: float = 0.25
    """Residuals above this are beyond any error of poses: the arcs are not of one line."""
    undetermined_sigmas: float = 3.0
    """Planes whose angle is below so many standard deviations determine no line."""
    weak_sigmas: float = 10.0
    """Planes whose angle is below so many standard deviations determine a line weakly."""
    weak_angle_rad: float = math.radians(0.1)
    """Planes at a smaller angle determine a line weakly."""
    far_spreads: float = 30.0
    """Spreads of the cameras: a line that is farther is far away, whatever the baseline."""


@dataclass(frozen=True)
class TriangulationOptions:
    """All options that methods of triangulation share."""

    consensus: ConsensusOptions = ConsensusOptions()
    """Which observations agree."""
    degeneracy: DegeneracyOptions = DegeneracyOptions()
    """When a track determines a line."""
