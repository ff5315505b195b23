"""The options of an adjustment of lines and poses."""

from dataclasses import dataclass

from camera_models.typed import Options


@dataclass(frozen=True, repr=False)
class AdjustmentOptions(Options):
    """What decides how lines are started, weighed and judged."""

    loss_scale: float = 2.0
    """Scale of a robust loss, in standard deviations of the stated noise; where none is stated, in median residuals of the start
    first, and then in the noise that the residuals show."""
    start_rounds: int = 3
    """Times that poses are refined by the tracks that have a line before those that have none are triangulated again."""
    significance: float = 1e-3
    """The stated noise does not hold where residuals as large, or as small, have a smaller probability than this; an arc stands
    out from its line where its own residuals do."""
    weak_share: float = 0.1
    """A line whose ends are uncertain by more than this share of its distance from the cameras is called weak. A photo whose pose
    its lines tell no better (rad, and of its distance from them) has no part in where the others were taken."""
    most_turned_deg: float = 20.0
    """Photos of one frame whose poses are turned by more than this from what the rig says are not of that rig."""
