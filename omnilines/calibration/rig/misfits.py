"""Whether the model of each camera of a rig follows its lens, by its own corners, as of one camera
(`calibration/model_misfit.py`)."""

from collections.abc import Sequence

from omnilines.calibration.model_misfit import ModelMisfit, model_misfit
from omnilines.calibration.rig.own_fit import OwnFit
from omnilines.least_squares import Outcome


def rig_misfits(fits: Sequence[OwnFit], significance: float) -> tuple[ModelMisfit | None, ...]:
    """Of each member by its own fit, at a significance for all of them together. Frames of one run count once."""
    found: list[ModelMisfit | None] = []
    for own in fits:
        if own.solution.outcome is Outcome.DEGENERATE:
            found.append(None)
            continue
        state = own.solution.state
        residual = state.residual_px(own.points)
        limit_px = float(residual[own.kept].norm(dim=-1).max())
        centre_px = state.model.centre_px.detach().numpy()
        pixels = own.points.pixels.numpy()
        found.append(model_misfit(own.photo, pixels, residual.numpy(), centre_px, limit_px, significance / len(fits)))
    return tuple(found)
