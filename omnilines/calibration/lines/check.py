"""Whether lines bear out a camera that is given: a score test (C. R. Rao, 1948) with the noise that the right camera leaves.

Camera, circles and directions are fitted. Where that moves the camera by e, the score of the given one, the derivative of half
the sum of squares, is s = -S e with the information S; it has the mean 0 if that camera is right. Its covariance V is that of
chains that err as they like, raised by what photos have in common (`scores.py`), plus S C S where the camera has a covariance C
of its own. With q parameters

    s' V^-1 s

is Hotelling's T^2 with q degrees of freedom, and those n by which chains tell V: (n - q + 1) / (n q) of it is F-distributed with
q and n - q + 1. V, the weights of chains and the strays of lines are those of the fitted camera (as in the test of A. Wald,
1943): under a wrong one lines are neither straight nor meet, and if that counted as noise it would hide what is wrong. What
lines ask for moves the image by a field of drift. A camera is refused where chance makes such a score too seldom, and the drift
is more than nobody minds; or even the least drift that chance leaves open (`least_drift.py`) is.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.lines.camera import LineAdjustment, counted
from omnilines.calibration.lines.least_drift import least_drift
from omnilines.calibration.lines.scores import pseudo_inverse
from omnilines.calibration.uncertainty import projection_jacobian, supported_grid

COLUMNS, ROWS = ("left", "middle", "right"), ("top", "middle", "bottom")


@dataclass(frozen=True)
class RegionDrift:
    """What lines say of a ninth of the image."""

    name: str
    edges: int
    """Pieces of edges in it."""
    rms_px: float
    """Their distances from lines; NaN where there are none."""
    drift_px: float
    """Root mean square motion that lines ask for, after a common rotation; NaN where the camera is not supported."""
    sigma_px: float
    """Of which so much is noise."""
    least_px: float
    """The least such motion, here, of a camera that lines do not contradict; NaN where the camera is not supported."""


@dataclass(frozen=True)
class LineCheck:
    """The verdict of lines on a camera."""

    model: CameraModel
    statistic: float
    freedom: int
    samples: float
    """Of normal samples, which would tell the covariance of the score as well as the chains do."""
    probability: float
    """Of so large a statistic where the camera is right."""
    drift_px: float
    """Root mean square motion over the image that lines ask for, less what noise makes, after a common rotation."""
    least_drift_px: float
    """The least such motion of a camera that lines do not contradict; 0 where they bear this one out."""
    sigma_px: float
    """Root mean square noise of that motion."""
    change: Float[np.ndarray, " p"]
    """Of the parameters, that lines ask for, to first order."""
    change_sigma: Float[np.ndarray, " p"]
    regions: tuple[RegionDrift, ...]
    edges: int
    members: int
    frames: int

    def refused(self, significance: float, tolerance_px: float) -> bool:
        """Whether lines contradict the camera."""
        return self.probability < significance and max(self.drift_px, self.least_drift_px) > tolerance_px


def line_check(
    model: CameraModel, asked: LineAdjustment, known: Float[Tensor, "p p"] | None, *, significance: float
) -> LineCheck:
    """Of `model` by the camera `asked` for, which was adjusted from it; `known` is the covariance of `model`, where it has one.
    Chance leaves open what it makes more often than `significance`."""
    basis, chains, scores = asked.problem.basis, asked.chains, asked.scores
    information, variance = scores.information_of_lines, scores.covariance_of_lines
    inverse = pseudo_inverse(information)
    total = scores.total - scores.camera_information @ basis.mT @ (asked.model.parameters - model.parameters)
    if known is not None:
        pulled = information @ torch.linalg.pinv(basis)
        variance = variance + pulled @ known @ pulled.mT
    precision = pseudo_inverse(variance)
    statistic = float(total @ precision @ total)
    freedom = int(torch.linalg.matrix_rank(_scaled(variance), hermitian=True))
    change, covariance = -basis @ inverse @ total, basis @ inverse @ variance @ inverse @ basis.mT
    own = counted(chains)
    pixels = chains.blocks.pixels[own]
    grid = supported_grid(model, float(angles_off_axis(model, pixels).max()))
    jacobian, valid = projection_jacobian(model, grid, grid)
    motion, spread = jacobian @ change, torch.einsum("nip,pq,niq->n", jacobian, covariance, jacobian)
    squares = torch.where(valid, motion.square().sum(-1), 0.0)
    noise = float(spread[valid].mean())
    moving = jacobian[valid] @ basis
    samples = max(scores.freedom_of_lines(precision), float(freedom))
    # Of Hotelling's T^2 over that of F.
    scale, rest = samples * freedom / (samples - freedom + 1.0), samples - freedom + 1.0
    limit = float(stats.f.isf(significance, freedom, rest)) * scale

    def least(part: Float[Tensor, "k 2 q"]) -> float:
        """Over pixels that move so with the parameters; NaN of none."""
        moved = torch.einsum("niq,nir->qr", part, part) / len(part) if len(part) else None
        return math.nan if moved is None else least_drift(total, precision, information, moved, limit)

    return LineCheck(
        model=model,
        statistic=statistic,
        freedom=freedom,
        samples=samples,
        probability=float(stats.f.sf(statistic / scale, freedom, rest)),
        drift_px=math.sqrt(max(float(squares[valid].mean()) - noise, 0.0)),
        least_drift_px=least(moving),
        sigma_px=math.sqrt(max(noise, 0.0)),
        change=change.numpy(),
        change_sigma=covariance.diagonal().clamp_min(0).sqrt().numpy(),
        regions=_regions(model, grid[valid], torch.stack([squares, spread], -1)[valid], pixels, chains.at.px[own], moving, least),
        edges=int((chains.weight > 0).sum()),
        members=int((asked.families.of_chain >= 0).sum()),
        frames=asked.families.frames,
    )


def _scaled(matrix: Float[Tensor, "q q"]) -> Float[Tensor, "q q"]:
    unit = matrix.diagonal().clamp_min(1e-300).rsqrt()
    return matrix * unit[:, None] * unit


def _regions(
    model: CameraModel,
    grid: Float[Tensor, "n 2"],
    squares: Float[Tensor, "n 2"],
    pixels: Float[Tensor, "m 2"],
    distance: Float[Tensor, " m"],
    moving: Float[Tensor, "n 2 q"],
    least: Callable[[Float[Tensor, "k 2 q"]], float],
) -> tuple[RegionDrift, ...]:
    """Ninths of the image: `squares` of the motion and of its noise at the grid, distances of edges at `pixels`, and the `least`
    motion of the part of the grid that moves so with the parameters."""
    size = torch.tensor(model.image_size, dtype=torch.float64)
    of_grid, of_edge = (((at + 0.5) / size * 3).floor().clamp(0, 2).long() @ torch.tensor([1, 3]) for at in (grid, pixels))
    found = []
    for k in range(9):
        rows, own = of_grid == k, distance[of_edge == k]
        drift, sigma = squares[rows].mean(0).clamp_min(0).sqrt().tolist()
        name = f"{ROWS[k // 3]} {COLUMNS[k % 3]}"
        found.append(RegionDrift(name, len(own), float(own.square().mean().sqrt()), drift, sigma, least(moving[rows])))
    return tuple(found)
