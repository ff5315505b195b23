"""What decides a calibration from straight lines, and a check of one, beside the camera model."""

from dataclasses import dataclass

from camera_models.typed import Options
from omnilines.calibration.thresholds import LineStartThresholds


@dataclass(frozen=True, repr=False)
class LineOptions(Options):
    """Of the adjustment of a camera to chains of edge points."""

    most_chains: int = 200
    """Of one photo, those with the most points."""
    block_px: float = 8.0
    """Length of a chain over which edge points are averaged: neighbours share their smoothing."""
    edge_sigma_px: float = 0.03
    """Standard deviation of such a mean across the edge that no number of points lowers: edges are not ideal."""
    freedom: float = 3.0
    """Of Student's t by which chains that are less straight than others, and lines that stray farther from their direction, lose
    weight: the smaller, the sooner."""
    least_weight: float = 0.05
    """A chain with less of the weight of a straight one is of a curve of the world, or of several edges: it is left out."""
    least_stray_rad: float = 2e-4
    """Lines of a family stray by this at least."""
    prior_share: float = 0.1
    """Standard deviation, as a share of half the image's longer side, by which the start camera may be off in each direction of
    its parameters: it counts where lines say nothing."""
    aspect_sigma: float = 0.005
    """Standard deviation by which pixels are not square."""
    centre_share: float = 0.06
    """Standard deviation of the centre about that of the start, as a share of half the image's longer side."""
    open_share: float = 0.3
    """A direction of the parameters that remains uncertain by more than this share of that is named as not seen."""
    right_angles: bool = True
    """Whether directions may be taken to be at right angles."""
    rounds: int = 12
    """Times at most that families and weights are found anew with the camera that they lead to."""
    settled_sigmas: float = 0.1
    """Rounds end where the camera moves by less than this share of its standard deviation."""
    most_starts: int = 3
    """Start cameras that are adjusted."""
    searches: int = 1
    """Times that arcs are looked for in the photos with the camera found, 1 or more."""
    board_margin_squares: float = 2.0
    """With boards beside, edges on a board do not count again; it reaches beyond its outermost corners by so many squares."""
    start: LineStartThresholds = LineStartThresholds()
    """Where it starts."""
