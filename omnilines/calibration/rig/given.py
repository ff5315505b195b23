"""Whether a calibration that is held is that of the camera, by the camera's own views.

Poses of boards make up for most of another focal length: residuals hardly grow and have nothing in common, but where two cameras
see one board they seem to see it at two places, as if it moved between their shutters. Refined by its views alone, with a pose of
the board in each, the camera says itself whether it is the one that was given.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from scipy.stats import chi2

from camera_models import CameraModel
from camera_models.wording import rounded
from omnilines.calibration.by_views import stated_covariance
from omnilines.calibration.diagnose import supported_angles_deg
from omnilines.calibration.lines.camera import focal_length
from omnilines.calibration.refine import BoardProblem
from omnilines.calibration.rig.own_fit import OwnFit
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.calibration.unmodelled import moved_and_stated_px
from omnilines.least_squares import Outcome
from omnilines.least_squares.variance import variance_factor


@dataclass(frozen=True)
class OtherThanGiven:
    """What a camera's views say of the calibration that is held."""

    focal_share: float
    """By what share its focal length at the centre is longer, refined by these views alone."""
    moved_px: float
    """By how much the projection moves then, and how certain that is: root mean squares where corners lie."""
    sigma_px: float
    chance: float
    """Of as much where the given calibration is right."""

    @property
    def limit(self) -> str:
        """One sentence without its full stop."""
        way = "longer" if self.focal_share > 0 else "shorter"
        return (
            "The given calibration is not that of these photos: by them alone the focal length is "
            f"{rounded(100 * abs(self.focal_share))} percent {way}, and the projection moves by {rounded(self.moved_px)} px "
            f"(± {rounded(self.sigma_px)}; root mean squares where corners lie)"
        )

    @property
    def note(self) -> str:
        """That, with what it rests on and what follows."""
        return (
            f"{self.limit}; chi-square test, p = {self.chance:.1g}. Held, it bends where the cameras stand, and the board "
            "seems to move between them, which residuals hardly show."
        )


def other_than_given(
    fits: Sequence[OwnFit], held: Collection[int], thresholds: CalibrationThresholds
) -> tuple[OtherThanGiven | None, ...]:
    """Of each member whose calibration is held, by its own fit, at the significance of one camera for all of them together; None
    where it is that of the photos up to what they tell, or up to the noise of a corner."""
    significance = thresholds.degeneracy.misfit_significance / max(1, len(held))
    return tuple(_other(own, significance, thresholds) if k in held else None for k, own in enumerate(fits))


def _other(own: OwnFit, significance: float, thresholds: CalibrationThresholds) -> OtherThanGiven | None:
    given, good = own.solution.state.model, own.good
    basis = given.calibration_basis()
    problem = BoardProblem(good, basis, own.weight)
    found = problem.solve(own.solution.state)
    freedom = 2 * len(good.view) - 6 * good.views - basis.shape[1]
    if found.outcome is Outcome.DEGENERATE or freedom <= 0:
        return None
    photo = torch.zeros(good.views, dtype=torch.long)
    photo[own.points.view] = torch.as_tensor(own.photo)
    groups = problem.by_views(found.state).joined(photo)
    noise = variance_factor(found.cost, freedom, None, thresholds.noise.significance)
    unit = found.kept_covariance()
    covariance = stated_covariance(groups, unit, noise, found.cost, freedom, thresholds.noise.significance).covariance
    change = found.state.model.parameters - given.parameters
    off = torch.linalg.pinv(basis) @ change
    chance = float(chi2.sf(float(off @ torch.linalg.solve(covariance, off)), len(off)))
    low, high = supported_angles_deg(given, good.pixels)
    reach_rad = math.radians(low), math.radians(high)
    moved_px, sigma_px = moved_and_stated_px(given, change, basis @ covariance @ basis.mT, reach_rad)
    noise_px = math.sqrt(noise.value) / float(own.weight.square().mean().sqrt())
    if not chance < significance or moved_px <= max(sigma_px, noise_px):
        return None
    return OtherThanGiven(_focal_px(found.state.model) / _focal_px(given) - 1, moved_px, sigma_px, chance)


def _focal_px(model: CameraModel) -> float:
    return focal_length(model)[0]
