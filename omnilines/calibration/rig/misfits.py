"""Whether the model of each camera of a rig follows its lens, by its own corners, as of one camera
(`calibration/model_misfit.py`)."""

from omnilines.calibration.model_misfit import ModelMisfit, model_misfit
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.own_fit import own_fit
from omnilines.least_squares import Outcome


def rig_misfits(outcome: RigOutcome) -> tuple[ModelMisfit | None, ...]:
    """Of each member, at the significance of one camera for all of them together. Frames of one run count once."""
    found: list[ModelMisfit | None] = []
    significance = outcome.thresholds.degeneracy.misfit_significance / len(outcome.data.cameras)
    for c in outcome.data.cameras:
        own = own_fit(outcome, c)
        if own.solution.outcome is Outcome.DEGENERATE:
            found.append(None)
            continue
        state = own.solution.state
        residual = state.residual_px(own.points)
        limit_px = float(residual[own.kept].norm(dim=-1).max())
        centre_px = state.model.centre_px.detach().numpy()
        pixels = own.points.pixels.numpy()
        found.append(model_misfit(own.photo, pixels, residual.numpy(), centre_px, limit_px, significance))
    return tuple(found)
