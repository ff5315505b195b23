"""Intervals that hold the parameters of a camera in 95 of 100 cases, and what is said of the noise they rest on."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.wording import rounded
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.thresholds import NoiseThresholds
from omnilines.least_squares import Solution
from omnilines.least_squares.valley import Quantities, curved_intervals
from omnilines.least_squares.variance import VarianceFactor
from omnilines.records import Corners

SHARE = 0.95
"""Of the cases, those in which an interval holds the truth."""


def stated_variance_px2(corners: Corners, rows: Bool[np.ndarray, " n"], corner_floor_px: float) -> float | None:
    """Mean square of the stated standard deviations of corners, that of the weighted residuals, at least that of the floor;
    None where none are stated."""
    if corners.sigma_px is None:
        return None
    return max(float(np.mean(corners.sigma_px[rows] ** 2)), corner_floor_px**2)


def noise_notes(factor: VarianceFactor, stated_px2: float | None, thresholds: NoiseThresholds) -> tuple[str, ...]:
    """Whether the residuals bear out what is stated of the corners, or that there are few."""
    if stated_px2 is None:
        return few_notes(factor, thresholds.large_freedom)
    stated = f"as far from where the camera sees them as their stated {math.sqrt(stated_px2):.3g} px explain"
    if not factor.holds:
        return (
            f"Corners lie {factor.ratio:.3g} times {stated} (chi-square test, {factor.freedom:g} degrees of freedom): the "
            "standard deviations follow the residuals.",
        )
    if factor.ratio is not None and factor.ratio < thresholds.well_below_share:
        return (
            f"Corners lie only {rounded(factor.ratio)} times {stated}: the standard deviations rest on what is stated and are "
            "on the safe side.",
        )
    return ()


def few_notes(factor: VarianceFactor, large_freedom: int) -> tuple[str, ...]:
    """That the noise was estimated from few residuals."""
    if factor.freedom >= large_freedom:
        return ()
    return (
        f"The noise of the corners was estimated with {factor.freedom:g} degrees of freedom: 95 percent intervals are "
        f"{factor.sigmas(SHARE):.2f} standard deviations on either side (Student's t).",
    )


def linear_intervals(model_values: Float[Tensor, " p"], covariance: Float[Tensor, "p p"], sigmas: float) -> Float[Tensor, "p 2"]:
    """value +- sigmas times its standard deviation."""
    half = sigmas * covariance.diagonal().clamp_min(0).sqrt()
    return torch.stack([model_values - half, model_values + half], -1)


def reaching_to(intervals: Float[Tensor, "p 2"], values: Float[Tensor, " p"]) -> Float[Tensor, "p 2"]:
    """The intervals, longer to one side where they would not hold these values."""
    return torch.stack([torch.minimum(intervals[:, 0], values), torch.maximum(intervals[:, 1], values)], -1)


def camera_intervals(
    problem: BoardProblem,
    chosen: Solution[CameraAndBoards],
    others: Sequence[Solution[CameraAndBoards]],
    factor: VarianceFactor,
) -> Float[Tensor, "p 2"] | None:
    """Intervals of the camera's parameters where its valley is curved or several minima fit; None where the linear ones hold."""
    basis = problem.basis
    by_kept = torch.cat([basis, basis.new_zeros(len(basis), problem.structure.kept_size - basis.shape[1])], -1)
    quantities = Quantities[CameraAndBoards](lambda state: state.model.parameters, by_kept)
    found = curved_intervals(problem, chosen, others, quantities, variance=factor.value, sigmas=factor.sigmas(SHARE))
    return None if found is None else torch.stack(found, -1)
