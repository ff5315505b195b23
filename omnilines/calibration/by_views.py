"""How certain a camera is where its photos contradict each other by more than the noise of their corners.

A board that bends in the hand, a model that is not quite the lens, or blur moves all corners of a photo together: however many
they are, they do not average it out, and residuals show it as little as noise. What photos say by themselves of the camera shows
it (`least_squares.groups`). Where they differ by more than the noise explains, the covariance is what their differences bear out.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.wording import rounded
from omnilines.least_squares.groups import Groups
from omnilines.least_squares.variance import VarianceFactor, contradiction

LEAST_VIEWS = 4
"""Fewer do not tell whether they contradict each other."""


@dataclass(frozen=True, eq=False)
class StatedCovariance:
    """What is stated of the kept unknowns, and what it rests on."""

    covariance: Float[Tensor, "k k"]
    factor: VarianceFactor
    """Of the covariance for residuals of unit variance, before what leaving out views adds."""
    beyond_noise: float = 1.0
    """Standard deviations over those of the noise of corners alone, root mean square over all directions."""
    note: tuple[str, ...] = ()


def stated_covariance(
    groups: Groups, unit: Float[Tensor, "k k"], noise: VarianceFactor, squares: float, freedom: int, significance: float
) -> StatedCovariance:
    """`unit` is the covariance for residuals of unit variance, `noise` its factor by residuals that sum up to `squares`."""
    alone = unit * noise.value
    found = None
    if len(groups.matrix) >= LEAST_VIEWS:
        found = contradiction(noise, squares, freedom, groups, significance)
    if found is None:
        return StatedCovariance(alone, noise, note=_untold(len(groups.matrix)))
    covariance = unit * found.factor.value + groups.jackknife()
    beyond = math.sqrt(float(torch.linalg.solve(alone, covariance).diagonal().mean()))
    note = (
        f"Photos contradict each other about the camera {rounded(found.ratio)} times as much as the noise of their corners "
        "explains "
        f"({'chi-square' if noise.holds else 'F'} test): a board that bends or is not flat, a model that does not suit, or blur "
        f"moves all corners of a photo together. The standard deviations hold that: they are {rounded(beyond)} times those "
        "of the "
        "noise alone."
    )
    return StatedCovariance(covariance, found.factor, beyond, (note,))


def _untold(views: int) -> tuple[str, ...]:
    """What few views leave open."""
    if views >= LEAST_VIEWS:
        return ()
    return (
        f"Whether photos contradict each other about the camera is told from {LEAST_VIEWS} photos on, found {views}: standard "
        "deviations are those of the noise of their corners alone. Boards bend a little and models are not quite the lens: real "
        "cameras from three photos were 2 to 4 times as far off. Take more photos.",
    )
