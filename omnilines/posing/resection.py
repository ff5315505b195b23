"""The pose of one camera from bearings to known points, wherever on the sphere they lie and with many wrong ones among them.

1. Poses of random triples (p3p.py), scored by sum min(angle^2, limit^2) over all points, or many of them drawn at random (MSAC:
   P. Torr, A. Zisserman, MLESAC, CVIU 2000), until a better one is improbable.
2. The best few are refined (camera_models/pose_fit.py) with the loss log(1 + r^2 / b^2) of the residuals in standard
   deviations (bearing_residual.py), over all points; the one with the least cost is taken.
3. Its covariance is that of least squares over the inliers.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import GeometryError
from camera_models.pose import Pose
from camera_models.pose_fit import PoseFit, Residuals, by_pose, fit_pose
from omnilines.posing.bearing_residual import across, bearing_residual, placed
from omnilines.posing.options import ResectionOptions
from omnilines.posing.p3p import p3p

MIN_POINTS = 4
"""Three leave up to four poses."""
BATCH, MAX_BATCHES = 256, 40
CONFIDENCE = 1e-4
"""Probability of having missed a triple without a wrong point at which the search ends."""
SCORED = 1000
"""Points that triples are scored by: of one in fifty that agrees there are twenty, three times as many as by chance and noise."""
REFINED = 4
_STEPS, _LEAST_GAIN = 30, 1e-12


@dataclass(frozen=True)
class Resection:
    """A pose and what it rests on."""

    pose: Pose
    """cam_from_world."""
    inliers: Bool[np.ndarray, " n"]
    covariance: Float[np.ndarray, "6 6"]
    """Of the left perturbation (rotation_rad, translation_m), for the stated standard deviations."""


def resect(
    bearings: Float[np.ndarray, "n 3"],
    points: Float[np.ndarray, "n 3"],
    sigma_rad: float | Float[np.ndarray, " n"] = 1e-3,
    *,
    min_inliers: int = MIN_POINTS,
    seed: int = 0,
    options: ResectionOptions = ResectionOptions(),
) -> Resection:
    """The pose cam_from_world that sees world `points` along unit `bearings` (camera frame, any angle off axis).

    `sigma_rad` is the standard deviation of each bearing in either direction across it. Half of the points or more may be wrong.
    Raises GeometryError for fewer than four points, where fewer than `min_inliers` points agree on a pose, and where those that
    do leave it open (all on one line, all in one direction).
    """
    if len(bearings) < MIN_POINTS:
        raise GeometryError(f"At least {MIN_POINTS} points were expected for a pose, found {len(bearings)}; give more.")
    b, x = torch.as_tensor(bearings), torch.as_tensor(points)
    sigma = torch.as_tensor(np.broadcast_to(np.asarray(sigma_rad, dtype=np.float64), len(b)).copy())
    middle, size = x.median(0).values, float((x - x.median(0).values).norm(dim=-1).median().clamp_min(1e-12))
    local = (x - middle) / size
    starts = _best_of_triples(b, local, sigma, seed, options.inlier_sigmas)
    rows = across(b) / sigma[:, None, None]
    fits = [_refined(b, rows, local, starts[k], options.loss_scale) for k in range(len(starts))]
    pose = min(fits, key=lambda fit: fit.cost).pose
    residual, by_point = bearing_residual(b, rows, placed(pose, local))
    inliers = residual.norm(dim=-1) < options.inlier_sigmas
    if int(inliers.sum()) < max(min_inliers, MIN_POINTS):
        raise GeometryError(
            f"At least {max(min_inliers, MIN_POINTS)} points that agree on a pose were expected, found {int(inliers.sum())} "
            f"of {len(b)}; give more points or better ones."
        )
    jacobian = by_pose(by_point, placed(pose, local))[inliers]
    covariance = _inverse(torch.einsum("nki,nkj->ij", jacobian, jacobian))
    unit = torch.tensor([1.0, 1.0, 1.0, size, size, size], dtype=torch.float64)
    whole = Pose(pose.rotation, size * pose.translation - pose.rotation @ middle)
    return Resection(whole, inliers.numpy(), (covariance * unit[:, None] * unit).numpy())


def _best_of_triples(
    bearings: Float[Tensor, "n 3"], points: Float[Tensor, "n 3"], sigma: Float[Tensor, " n"], seed: int, inlier_sigmas: float
) -> Pose:
    """The poses of the best few triples; raises GeometryError where no triple has one."""
    rng = np.random.default_rng(seed)
    if len(bearings) > SCORED:
        some = torch.as_tensor(rng.choice(len(bearings), SCORED, replace=False))
        bearings, points, sigma = bearings[some], points[some], sigma[some]
    count = len(bearings)
    limit = (2.0 * torch.tan(0.5 * (inlier_sigmas * sigma).clamp_max(1.0))).square()
    best_cost, best = torch.zeros(0, dtype=torch.float64), Pose.identity(0)
    for batch in range(1, MAX_BATCHES + 1):
        triples = torch.as_tensor(_triples(rng, count))
        poses, found = p3p(bearings[triples], points[triples])
        poses = poses[found]
        if len(poses):
            seen = poses.transform(points)
            cosine = (seen * bearings).sum(-1) / seen.norm(dim=-1).clamp_min(1e-300)
            # 4 tan^2(angle / 2) of unit vectors.
            square = 4.0 * (1.0 - cosine) / (1.0 + cosine).clamp_min(1e-12)
            cost = torch.minimum(square / limit, torch.ones_like(square)).sum(-1)
            every = torch.cat([best_cost, cost])
            order = torch.argsort(every, stable=True)[:REFINED]
            together = Pose(torch.cat([best.rotation, poses.rotation]), torch.cat([best.translation, poses.translation]))
            best_cost, best = every[order], together[order]
        share = 1.0 - float(best_cost[0]) / count if len(best) else 0.0
        if share > 0 and BATCH * batch * -np.log1p(-min(share**3, 1 - 1e-12)) > -np.log(CONFIDENCE):
            break
    if not len(best):
        raise GeometryError(
            "Points that are not all on one line, in three directions or more, were expected for a pose, found none such three; "
            "give others."
        )
    return best


def _triples(rng: np.random.Generator, count: int) -> Int[np.ndarray, "k 3"]:
    """Three different numbers below `count`, a batch of times."""
    first, second, third = rng.integers(count - np.arange(3), size=(BATCH, 3)).T
    second = second + (second >= first)
    low, high = np.minimum(first, second), np.maximum(first, second)
    third = third + (third >= low)
    return np.stack([first, second, third + (third >= high)], 1)


def _refined(
    bearings: Float[Tensor, "n 3"], rows: Float[Tensor, "n 2 3"], points: Float[Tensor, "n 3"], start: Pose, loss_scale: float
) -> PoseFit:
    """The pose near a start with the least robust cost, and that cost."""

    def residuals_at(pose: Pose) -> Residuals:
        seen = placed(pose, points)
        residual, by_point = bearing_residual(bearings, rows, seen)
        return residual, by_pose(by_point, seen), None

    return fit_pose(start, residuals_at, loss_scale, steps=_STEPS, least_gain=_LEAST_GAIN)


def _inverse(normal: Float[Tensor, "6 6"]) -> Float[Tensor, "6 6"]:
    """Covariance of a normal matrix; raises GeometryError where it is singular."""
    unit = normal.diagonal().clamp_min(1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(normal * unit[:, None] * unit)
    if not float(values[0]) > 1e-12:
        raise GeometryError(
            "Points that determine a pose were expected, found points that leave a motion open (on one line, or all in one "
            "direction); give others."
        )
    inverse = (vectors / values) @ vectors.mT
    return inverse * unit[:, None] * unit
