"""Triangulation of tracks with wrong members: observations of other lines are named and left out.

A track whose members all agree within the noise is left as it is. Of the others the consensus is sought (`consensus.py`), which
takes a majority, three members at least: a track of three views with a wrong one, or one in which two lines are as likely, is
named `inconsistent`. Whether arcs overlap along the line is not judged: parts of one line seen apart from each other are common.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from camera_models.errors import InputError
from camera_models.repeatable import total
from omnilines.geometry.line import PlueckerLines
from omnilines.records import LINE_STATUSES
from omnilines.triangulation import triangulate
from omnilines.triangulation.consensus import find_consensus, judge_by_all, least_majority_square
from omnilines.triangulation.degeneracy import ROUNDING_RAD, faces_away, hidden
from omnilines.triangulation.dual import frames_and_lines
from omnilines.triangulation.likelihood import refine
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.options import ConsensusOptions, TriangulationOptions
from omnilines.triangulation.residuals import chi_square_limit, end_distances, freedom
from omnilines.triangulation.result import Triangulation

SAMPLED_TRACKS = 1000
"""Tracks that the noise is estimated from, drawn with the seed."""
MEDIAN_CHI_SQUARE_2 = 1.3863
NOISE_ROUNDS, NOISE_SETTLED = 6, 0.02


@dataclass(frozen=True)
class RobustTriangulation:
    """Lines found from the observations that agree, and which these are."""

    triangulation: Triangulation
    """Of all tracks, from the inliers; tracks without a consensus are `inconsistent`."""
    inlier: Bool[Tensor, " n"]
    """False for the observations that belong to another line. True for all members of a track that is inconsistent or has two
    views only: which of them is wrong cannot be said."""
    sigma: float
    """Noise level that residuals were judged by: in units of the stated noise of the end points, in px where only the shape of
    the noise is known, else in rad; NaN where no track has more than two views."""


def robust_triangulate(
    observations: PlaneObservations,
    *,
    method: str = "ml",
    sigma: float | None = None,
    seed: int = 0,
    budget: int = 128,
    options: TriangulationOptions = TriangulationOptions(),
    **of_method: Any,
) -> RobustTriangulation:
    """The lines of all tracks by the named method with its options `of_method`, from the observations that agree with each other.

    `sigma` is the noise level, in the unit of `RobustTriangulation.sigma`. Without it, it is the stated one, or `noise_level`
    where none is stated. Where the poses are off, residuals exceed the stated noise and hardly any track is consistent: pass
    `noise_level` then. `budget` bounds the pairs of planes that are tried in a track; beyond it they are drawn with the seed.
    Raises InputError on a wrong option.
    """
    if budget < 3 or (sigma is not None and not sigma > 0):
        raise InputError(
            f"Robust triangulation expects a sigma above 0 and a budget of at least 3 pairs, found {sigma} and {budget}; "
            "correct the option."
        )
    if sigma is not None:
        level = sigma
    elif observations.noise_stated:
        level = 1.0
    else:
        level = noise_level(observations, seed=seed, budget=budget, options=options.consensus)
    variance = max(level, _rounding_level(observations)) ** 2
    inlier = torch.ones(len(observations.track), dtype=torch.bool, device=observations.track.device)
    unsolved = torch.zeros(observations.tracks, dtype=torch.bool, device=inlier.device)
    suspects = torch.nonzero(_suspects(observations, variance, options.consensus)).squeeze(-1)
    some, kept = observations.of_tracks(suspects)
    found = find_consensus(some, variance, budget, seed, options.consensus)
    inlier[kept] = found.inlier | ~found.solved[some.track]
    unsolved[suspects] = ~found.solved
    result = triangulate(method, observations.rows(inlier), options=options, **of_method)
    status = torch.where(unsolved, LINE_STATUSES.index("inconsistent"), result.status)
    return RobustTriangulation(hidden(replace(result, status=status)), inlier, level)


def noise_level(
    observations: PlaneObservations, *, seed: int = 0, budget: int = 128, options: ConsensusOptions = ConsensusOptions()
) -> float:
    """Noise level that residuals show, in the unit of `RobustTriangulation.sigma`; NaN without a track of more than two views.

    It comes from the majorities of up to SAMPLED_TRACKS tracks, and is right if most tracks have one. Options as in
    `robust_triangulate`.
    """
    eligible = torch.nonzero(observations.counts() >= 3).squeeze(-1)
    if not len(eligible):
        return float("nan")
    order = torch.randperm(len(eligible), generator=torch.Generator().manual_seed(seed))[:SAMPLED_TRACKS]
    sample, _ = observations.of_tracks(eligible[order.to(eligible.device)])
    first = least_majority_square(sample, budget, seed)
    floor = _rounding_level(observations) ** 2
    # The least of many is rather below the noise than above: a level that is too low rises below, one that is too high may stay,
    # because it takes the members of neighbouring lines together.
    variance = max(0.5 * float(first.median().nan_to_num(posinf=0.0)), floor)
    for _ in range(NOISE_ROUNDS):
        found = find_consensus(sample, variance, budget, seed, options._replace(hypotheses=1))
        squares = found.squared[found.inlier & found.solved[sample.track]]
        if not len(squares):
            break
        previous, variance = variance, max(variance * float(squares.median()) / MEDIAN_CHI_SQUARE_2, floor)
        if abs(variance / previous - 1) < NOISE_SETTLED:
            break
    return float(variance**0.5)


def _rounding_level(observations: PlaneObservations) -> float:
    """ROUNDING_RAD in the unit of the residuals."""
    if observations.noise is None or not len(observations.track):
        return ROUNDING_RAD
    square = observations.noise.square().sum((-2, -1)) / 2
    return ROUNDING_RAD / math.sqrt(total(square) / square.numel())


def _suspects(observations: PlaneObservations, variance: float, options: ConsensusOptions) -> Bool[Tensor, " t"]:
    """Tracks of more than two views whose members do not all agree with the most likely line of all of them."""
    _, start, _ = frames_and_lines(observations)
    lines = refine(observations, start)
    square = judge_by_all(observations, lines, variance)
    away = faces_away(observations, lines)
    share = observations.sum_by_track(away.to(square.dtype)) / observations.counts().clamp_min(1)
    # A track seen from behind by most of its cameras is named so by the method itself.
    wrong = observations.sum_by_track(((square > options.row_chi_square) & ~away).to(square.dtype)) > 0
    distance = end_distances(observations, lines[observations.track].moment_about(observations.centre))
    total = observations.sum_by_track(distance.square().sum(-1)) / variance
    degrees = freedom(observations)
    found = wrong | ((share > 0) & (share < 0.5)) | (total > chi_square_limit(degrees))
    return found & (degrees > 0) & _determined(lines)


def _determined(lines: PlueckerLines) -> Bool[Tensor, " t"]:
    return torch.isfinite(lines.moment).all(-1)
