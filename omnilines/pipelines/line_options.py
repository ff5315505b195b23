"""All that decides what becomes of the straight lines of photos: in a calibration from them, and a check by them."""

from dataclasses import dataclass, field

from camera_models.typed import Options
from omnilines.calibration.lines.options import LineOptions
from omnilines.extraction import ExtractionOptions
from omnilines.extraction.options import SmoothChainOptions
from omnilines.structure.options import DirectionsOptions, RightAngleOptions


@dataclass(frozen=True, repr=False)
class LinesOptions(Options):
    """Options of the stages."""

    chains: SmoothChainOptions = SmoothChainOptions()
    """Edges that are followed without a camera."""
    extraction: ExtractionOptions = ExtractionOptions()
    """Arcs that a camera finds."""
    directions: DirectionsOptions = DirectionsOptions()
    """Directions in which the lines of a photo meet."""
    right_angles: RightAngleOptions = RightAngleOptions()
    """The scale of a start camera."""
    adjustment: LineOptions = field(default_factory=LineOptions)
    """The camera that makes them straight."""
