"""What decides whether a calibration is still right."""

from dataclasses import dataclass, field

from camera_models.typed import Options
from omnilines.pipelines.line_options import LinesOptions


@dataclass(frozen=True, repr=False)
class CheckOptions(Options):
    """Of `check`."""

    significance: float = 0.001
    """Calibrations that are right are refused so often, at most."""
    tolerance_px: float = 0.1
    """Drift (root mean square over the image) that nobody minds, however sure it is."""
    most_sigma_share: float = 0.01
    """Of the diagonal of the image: lines that leave the projection open by more tell nothing."""
    lines: LinesOptions = field(default_factory=LinesOptions)
    """The lines by which it is checked."""
