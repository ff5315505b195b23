"""How a cost and a loss weigh the arcs, and what the noise of their end points does to the gradient that is made zero.

With w the two whitened residuals of an arc (standard deviations of its ends across the line) and J their derivative, the
residuals of any cost are r = A w to first order, and the equations that an estimate solves are sum omega(|r|^2) J'A'r = 0,
omega the weight of the loss. For Gaussian noise of `level` times what is stated they have, arc by arc, the derivative and the
covariance

    H = J' D J,   D = A'A E[omega w w'] / level^2,      K = J' C J,   C = A'A E[omega^2 w w'] A'A

(the first by Stein's lemma), so that the estimate has the covariance H^-1 K H^-1 (P. Huber, Robust statistics, 1981, chapter 6).
Without a loss D = W and C = level^2 W^2 with W = A'A: the sandwich (J'WJ)^-1 J'W S W J (J'WJ)^-1 in whitened coordinates.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.repeatable import total
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.costs import cost_function, cost_named
from omnilines.costs._cost import by_bearings
from omnilines.least_squares import Loss

NODES = 9
"""Of the Gauss-Hermite rule in each of two directions: expectations of Cauchy's weight to 1e-3 for noise at which it bends."""
ALIKE = 1e-9
"""Relative difference of scatter up to which all arcs count as weighted by their own noise."""


@dataclass(frozen=True)
class Weighting:
    """What n arcs weigh in the normal equations at one state, in coordinates y = sqrt(D) w."""

    mix: Float[Tensor, "n 2 2"] | None
    """y from the distances V . Mh; None for the whitened cost without a loss, of which y are the residuals."""
    scatter: Float[Tensor, "n 2 2"] | None
    """D^-1/2 C D^-1/2; None where it is `unit` times the identity for all, and H^-1 K H^-1 is `unit` H^-1."""
    unit: float
    """What one unit of a prior weighs: tr C over tr D of all arcs. The squared residual of a prior, which is in standard
    deviations, enters the cost times this."""
    expected: float
    """Sum of the squared residuals of the cost that noise of the level gives at the truth."""
    share: float = 1.0
    """Degrees of freedom of that sum over the number of residuals (F. Satterthwaite 1946)."""
    excess: float = 1.0
    """Variance of the estimate with the loss over that without it, both for Gaussian noise."""


def cost_weights(cost: str, arcs: MatchedArcs, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 2"]:
    """W = A'A of every arc, from the derivative of the cost by the end bearings: column e of A is dr / dV_e . Mh sigma_e."""
    if cost_named(cost).is_whitened:
        return torch.eye(2, dtype=normal.dtype).expand(len(normal), 2, 2)
    unit = normal / normal.norm(dim=-1, keepdim=True)
    across = by_bearings(cost_function(cost, arcs), arcs.bearings, normal) @ unit[:, None, :, None]
    response = across[..., 0] * end_sigma_rad(arcs, unit)[:, None, :]
    return response.mT @ response


def end_sigma_rad(arcs: MatchedArcs, unit_normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """Standard deviation of both ends of every arc across the plane with this normal, as stated (or for 1 px)."""
    across = arcs.by_pixel.mT @ unit_normal[:, None, :, None]
    return (across.mT @ arcs.covariance_px2 @ across)[..., 0, 0].sqrt()


def weighting(
    cost: str,
    arcs: MatchedArcs,
    normal: Float[Tensor, "n 3"],
    loss: Loss,
    level: float,
    *,
    fitting: Bool[Tensor, " n"] | None = None,
) -> Weighting:
    """The weights at a state with these plane normals. Arcs that are not `fitting` weigh what the loss gives them where they
    lie."""
    if cost_named(cost).is_whitened and loss.name == "none":
        return Weighting(None, None, level**2, 2 * len(arcs) * level**2)
    values, vectors = torch.linalg.eigh(cost_weights(cost, arcs, normal))
    values = values.clamp_min(0)
    first, second = _expectations(values, loss, level)
    response, scatter = values * first, level**2 * values * second / first
    if fitting is None:
        fitting = torch.ones(len(arcs), dtype=torch.bool)
    else:
        square = cost_function(cost, arcs)(arcs.bearings, normal)[0].square().sum(-1)
        response = torch.where(fitting[:, None], response, values * loss(square)[1][:, None])
    unit = level**2
    if bool(fitting.any()):
        unit = total((response * scatter)[fitting]) / total(response[fitting])
    scatter = torch.where(fitting[:, None], scatter, unit)
    alike = bool(((scatter - unit).abs() <= ALIKE * unit).all())
    spread = None if alike else vectors @ torch.diag_embed(scatter) @ vectors.mT
    unit_normal = normal / normal.norm(dim=-1, keepdim=True)
    mix = vectors @ torch.diag_embed(response.sqrt()) @ vectors.mT / end_sigma_rad(arcs, unit_normal)[:, None, :]
    share = total(values) ** 2 / (values.numel() * total(values.square()))
    excess = first[fitting].numel() * total(second[fitting]) / total(first[fitting]) ** 2
    return Weighting(mix=mix, scatter=spread, unit=unit, expected=level**2 * total(values), share=share, excess=excess)


def _expectations(weights: Float[Tensor, "n 2"], loss: Loss, level: float) -> tuple[Tensor, Tensor]:
    """E[omega x^2] and E[omega^2 x^2] of both standard normal coordinates x, |r|^2 = level^2 sum weights x^2."""
    if loss.name == "none":
        return torch.ones_like(weights), torch.ones_like(weights)
    nodes, mass = np.polynomial.hermite_e.hermegauss(NODES)
    first, second = torch.zeros_like(weights), torch.zeros_like(weights)
    for x, share_x in zip(nodes, mass / mass.sum(), strict=True):
        for y, share_y in zip(nodes, mass / mass.sum(), strict=True):
            square = torch.tensor([x * x, y * y], dtype=weights.dtype)
            omega = loss(level**2 * (weights @ square))[1][:, None]
            first += share_x * share_y * omega * square
            second += share_x * share_y * omega**2 * square
    return first, second
