"""Estimates against a known truth, with the freedoms that the data leave open taken out first.

Bearings: a common rotation. Parameters: a rotation about the axis. Lines from bearings alone: a similarity.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.stats
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel, GeometryError
from camera_models._arrays import as_tensor
from camera_models.pose import hat
from camera_models.rotations import common_rotation
from omnilines.adjustment.accuracy import AlignedLines, align_lines
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.lines import motion_across
from omnilines.geometry.sphere import angle_between

GRID_POINTS = 160
"""Pixels along the longer side of the image at which bearings are compared."""
PROBABILITY = 0.999
"""Quantile of the limits: noise alone exceeds each of them once in a thousand times."""
HELD_TOLERANCE = 1e-9
"""Relative difference up to which a parameter that is not estimated counts as equal to the true one."""


@dataclass(frozen=True)
class BearingErrors:
    """Angles between the bearings of two cameras over a uniform grid of pixels, after the best common rotation."""

    pixels: Float[Tensor, "n 2"]
    theta_rad: Float[Tensor, " n"]
    """True angle off the bearing of the centre pixel."""
    error_rad: Float[Tensor, " n"]
    """pi where the estimate has no bearing."""
    rotation: Float[Tensor, "3 3"]
    """Takes bearings of the estimate to true ones."""

    @property
    def rms_deg(self) -> float:
        """Root mean square over the pixels."""
        return math.degrees(float(self.error_rad.square().mean().sqrt()))

    @property
    def max_deg(self) -> float:
        """The largest."""
        return math.degrees(float(self.error_rad.max()))


def bearing_errors(estimated: CameraModel, truth: CameraModel, max_angle_rad: float) -> BearingErrors:
    """Compare two cameras of one image at every pixel of a grid whose true bearing is up to `max_angle_rad` off the axis.

    The common rotation is free because board poses or line scenes absorb it. Raises GeometryError where fewer than three pixels
    are seen by both cameras.
    """
    width, height = truth.image_size
    step = max(width, height) / GRID_POINTS
    u, v = (torch.arange(0.5 * min(step, size), size, step, dtype=torch.float64) - 0.5 for size in (width, height))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)
    with torch.no_grad():
        true, seen = truth.unproject(pixels)
        found, known = estimated.unproject(pixels)
        axis, _ = truth.unproject(truth.centre_px)
    theta = angle_between(true, axis)
    inside = seen & (theta <= max_angle_rad)
    both = inside & known
    if int(both.sum()) < 3:
        raise GeometryError(
            f"Pixels seen by both cameras within {math.degrees(max_angle_rad):.1f} degrees of the axis were expected, found "
            f"{int(both.sum())}; check that both files are of the same camera."
        )
    rotation = common_rotation(found[both], true[both])
    error = angle_between(found @ rotation.mT, true)
    error = torch.where(known, error, torch.full_like(error, math.pi))
    return BearingErrors(pixels[inside], theta[inside], error[inside], rotation)


def bearing_error_deg(estimated: CameraModel, truth: CameraModel, max_angle_rad: float) -> tuple[float, float]:
    """(RMS, largest) of `bearing_errors`, degrees."""
    errors = bearing_errors(estimated, truth, max_angle_rad)
    return errors.rms_deg, errors.max_deg


@dataclass(frozen=True)
class ParameterErrors:
    """Estimated minus true parameters in units of their standard deviations, over the directions that are estimated."""

    names: tuple[str, ...]
    """Of the parameter that leads each direction."""
    error: Float[np.ndarray, " q"]
    sigma: Float[np.ndarray, " q"]
    statistic: float
    """Squared Mahalanobis length of the error."""
    limit: float
    """Its PROBABILITY quantile: chi-square of q degrees of freedom, or q F(q, freedom) where the variance of the noise was itself
    estimated with that freedom."""

    @property
    def z(self) -> Float[np.ndarray, " q"]:
        """Each error over its standard deviation."""
        return self.error / self.sigma

    @property
    def worst_z(self) -> float:
        """The largest of them in size."""
        return float(np.abs(self.z).max())


def parameter_errors(
    estimated: CameraModel, covariance: Float[np.ndarray, "p p"], truth: CameraModel, freedom: float | int = math.inf
) -> ParameterErrors:
    """Errors of a calibrated camera against its covariance, along `calibration_basis()`, the truth in its `calibrated_form()`.

    Where the calibration took a higher degree than the truth has, the true coefficients are zero there. `freedom` is that of the
    residuals which scaled the covariance. Raises GeometryError where the models differ in kind, or the truth in a parameter that
    the calibration held, or where a direction has no variance.
    """
    if estimated.NAME == truth.NAME and len(estimated.parameters) > len(truth.parameters):
        truth = truth.of_variant(estimated.variant, torch.zeros(0, dtype=torch.float64))
    if estimated.PARAMETER_NAMES != truth.PARAMETER_NAMES or estimated.NAME != truth.NAME:
        raise GeometryError(
            f"Parameters of one model were expected, found those of {estimated.NAME} ({' '.join(estimated.PARAMETER_NAMES)}) and "
            f"{truth.NAME} ({' '.join(truth.PARAMETER_NAMES)}); compare their bearings instead."
        )
    truth = truth.calibrated_form()
    basis = estimated.calibration_basis().numpy()
    into = np.linalg.pinv(basis)
    true, found = truth.parameters.detach().numpy(), estimated.parameters.detach().numpy()
    held = (found - true) - basis @ (into @ (found - true))
    if (np.abs(held) > HELD_TOLERANCE * (1.0 + np.abs(true))).any():
        name = truth.PARAMETER_NAMES[int(np.argmax(np.abs(held)))]
        raise GeometryError(
            f"The true camera was expected to agree in what the calibration holds, found another {name}; compare bearings."
        )
    error, spread = into @ (found - true), into @ covariance @ into.T
    sigma = np.sqrt(np.diag(spread))
    if not (sigma > 0).all():
        raise GeometryError("A standard deviation of every estimated parameter was expected, found one that is zero; calibrate.")
    # In units of sigma the matrix is one of correlations: parameters of very different size do no harm.
    unit = error / sigma
    statistic = float(unit @ np.linalg.solve(spread / np.outer(sigma, sigma), unit))
    lead = tuple(estimated.PARAMETER_NAMES[int(np.flatnonzero(column)[0])] for column in basis.T)
    return ParameterErrors(lead, error, sigma, statistic, _quantile(basis.shape[1], freedom))


def _quantile(size: int, freedom: float | int) -> float:
    if math.isinf(freedom):
        return float(scipy.stats.chi2.ppf(PROBABILITY, size))
    return size * float(scipy.stats.f.ppf(PROBABILITY, size, freedom))


@dataclass(frozen=True)
class LineErrors:
    """Adjusted lines against the true ones after the similarity that brings them closest."""

    aligned: AlignedLines
    angle_rad: Float[Tensor, " t"]
    """Between the directions of each line and its true one."""
    distance_m: Float[Tensor, "t 2"]
    """Of both true ends from the line."""
    predicted_rms_m: float
    """RMS of these distances that the stated noise predicts, before any of it is absorbed by the similarity."""
    statistic: float
    """Squared Mahalanobis length of the error of all lines for the stated noise, least over the similarities."""
    limit: float
    """Its PROBABILITY quantile: chi-square of 4 t - 7 degrees of freedom."""


def line_errors(
    adjusted: Adjusted,
    ends_m: Float[Tensor, "t 2 3"] | Float[np.ndarray, "t 2 3"],
    true_ends_m: Float[Tensor, "t 2 3"] | Float[np.ndarray, "t 2 3"],
) -> LineErrors:
    """Compare the t lines of an adjustment that held its poses with the true segments, in the same order.

    `ends_m` are the found ends, in either order, in a frame turned by less than a right angle from that of the truth; they
    start the alignment. The covariance is that of the noise stated for the end points of the arcs, not scaled by the residuals:
    lines that are wrong do not widen it.

    With held poses the lines are independent of each other. Where these poses and the camera were fitted to the corners that the
    lines are made of, the residuals that reach the lines are (I - H) n, H the projection of the noise n onto what the fit can
    follow, with the covariance S - H S <= S. So the camera and the poses add nothing, the covariance of the lines is at most the
    stated one, and the limit is on the safe side. Raises GeometryError where all points lie on one line.
    """
    lines, true = adjusted.state.chart.lines(), as_tensor(true_ends_m)
    aligned = align_lines(lines, _in_order(as_tensor(ends_m), true), true)
    direction = true[:, 1] - true[:, 0]
    angle = angle_between(aligned.lines.direction, direction / direction.norm(dim=-1, keepdim=True))
    # Across both points of a line, per step in its chart; in the frame of the truth.
    by_chart = (aligned.scale * aligned.pose.rotation @ motion_across(adjusted.state.chart, aligned.unaligned_points_m)).flatten(
        1, 2
    )
    covariance = adjusted.whitened.eliminated_covariance()
    predicted = (by_chart @ covariance @ by_chart.mT).diagonal(dim1=-2, dim2=-1).sum() / (2 * len(lines))
    free = torch.cat(
        [-hat(aligned.points_m), torch.eye(3, dtype=true.dtype).expand(len(lines), 2, 3, 3), aligned.points_m[..., None]], -1
    )
    into = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), torch.linalg.pinv(by_chart), upper=False)
    error = (into @ aligned.error_m.flatten(1)[..., None]).flatten()
    by_similarity = (into @ free.flatten(1, 2)).flatten(0, 1)
    left = error - by_similarity @ (torch.linalg.pinv(by_similarity) @ error)
    return LineErrors(
        aligned,
        torch.minimum(angle, math.pi - angle),
        aligned.error_m.norm(dim=-1),
        math.sqrt(float(predicted)),
        float(left @ left),
        _quantile(4 * len(lines) - 7, math.inf),
    )


def _in_order(ends: Float[Tensor, "t 2 3"], true: Float[Tensor, "t 2 3"]) -> Float[Tensor, "t 2 3"]:
    """The found ends in the order of the true ones."""
    flipped: Bool[Tensor, " t"] = ((ends[:, 1] - ends[:, 0]) * (true[:, 1] - true[:, 0])).sum(-1) < 0
    return torch.where(flipped[:, None, None], ends.flip(1), ends)
