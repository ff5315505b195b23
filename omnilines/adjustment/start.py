"""Where an adjustment starts: every track triangulated from the given poses, or from ones that some of the lines refined."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import GeometryError
from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.lines import adjust_lines, drop_unknown
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.adjustment.state import LinesAndPoses
from omnilines.adjustment.weighting import weighting
from omnilines.costs import cost_function
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss
from omnilines.least_squares.devices import usable_device
from omnilines.triangulation.batches import triangulate_on
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation
from omnilines.triangulation.robust import noise_level, robust_triangulate

POSE_COST = "sector"
"""By which poses are refined before all tracks have a line."""


@dataclass(frozen=True)
class Method:
    """How tracks are triangulated."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the method's function."""
    robust: bool = False
    """Whether observations of other lines are found by consensus and left out."""
    device: str = "cpu"


def no_chart() -> LineChart:
    """The chart of no line, until there are some."""
    none = torch.zeros(0, 3, dtype=torch.float64)
    return LineChart(none, none[:, 0], none[..., None].expand(0, 3, 3), none[:, 0])


def started(
    arcs: MatchedArcs, state: LinesAndPoses, method: Method, rounds: int, options: AdjustmentOptions
) -> tuple[LinesAndPoses, Triangulation, Bool[Tensor, " n"]]:
    """Poses refined up to `rounds` times until every track has a line, the lines, and which arcs they rest on.

    Raises GeometryError where no track has one.
    """
    first, member = triangulated(arcs, state.cam_from_world, method)
    _require_lines(first)
    for _ in range(rounds):
        if bool(first.known.all()):
            break
        better = poses_by_lines(arcs.rows(member), first, state, loss="cauchy", options=options)
        again, member_again = triangulated(arcs, better.cam_from_world, method)
        if int(again.known.sum()) <= int(first.known.sum()):
            break
        state, first, member = better, again, member_again
    return state, first, member


def _require_lines(first: Triangulation) -> None:
    """Raises GeometryError where no track has a line, with the reasons."""
    if not bool(first.known.any()):
        reasons = ", ".join(f"{count} {status}" for status, count in Counter(first.status_names).most_common())
        raise GeometryError(
            f"At least one track that determines a line was expected, found none: {reasons}; check that poses, calibration and "
            "tracks are of the same photos, or give photos from more places."
        )


def poses_by_lines(
    arcs: MatchedArcs,
    first: Triangulation,
    state: LinesAndPoses,
    *,
    best_share: float = 1.0,
    loss: str = "none",
    options: AdjustmentOptions = AdjustmentOptions(),
) -> LinesAndPoses:
    """The state with its poses refined by the tracks that have a line, so that others can be triangulated too.

    Poses that are off leave some tracks without a line, or put it far off. With a `best_share` below 1 only so many of the lines
    of each photo take part, those that fit the poses best. Raises GeometryError where no track has a line.
    """
    inner, tracks = drop_unknown(arcs, first.known if best_share >= 1 else _best(arcs, first, best_share) & first.known)
    lines = first.lines[tracks]
    chart = LineChart.about_cameras(lines, state.cam_from_world.centre[inner.image], inner.track)
    scaled = scaled_loss(loss, POSE_COST, inner, replace(state, chart=chart), options)
    adjusted = adjust_lines(inner, lines, state.rig_from_world, cost=POSE_COST, rig=state.rig, loss=scaled, options=options)
    return replace(state, rig_from_world=adjusted.state.rig_from_world)


def _best(arcs: MatchedArcs, first: Triangulation, share: float) -> Bool[Tensor, " t"]:
    """The tracks that are among this share of the lines of some photo, those with the least residuals."""
    residual = torch.where(first.known, torch.nan_to_num(first.residual_rad, nan=math.inf), math.inf)
    # Photo by photo, the best lines first; a photo that sees few lines keeps its own share of them.
    order = residual[arcs.track].argsort(stable=True)
    order = order[arcs.image[order].argsort(stable=True)]
    count = torch.bincount(arcs.image, minlength=arcs.images)
    rank = torch.arange(len(arcs)) - (count.cumsum(0) - count)[arcs.image[order]]
    best = torch.zeros_like(first.known)
    best[arcs.track[order[rank < share * count[arcs.image[order]]]]] = True
    return best


def triangulated(arcs: MatchedArcs, cam_from_world: Pose, method: Method) -> tuple[Triangulation, Bool[Tensor, " n"]]:
    """Lines of all tracks, and which arcs they rest on."""
    covariance = arcs.covariance_px2 if arcs.sigma_known else None
    poses = cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(
        arcs.bearings, poses, arcs.track, arcs.tracks, by_pixel=arcs.by_pixel, covariance_px2=covariance
    )
    if not method.robust:
        every = torch.ones(len(arcs), dtype=torch.bool)
        return triangulate_on(usable_device(method.device), method.name, planes, **method.options), every
    # Poses that are off enlarge residuals beyond the stated noise.
    level = noise_level(planes)
    if arcs.sigma_known and math.isfinite(level):
        level = max(level, 1.0)
    sigma = level if math.isfinite(level) and level > 0 else None
    found = robust_triangulate(planes, method=method.name, sigma=sigma, **method.options)
    return found.triangulation, found.inlier


def scaled_loss(name: str, cost: str, arcs: MatchedArcs, start: LinesAndPoses, options: AdjustmentOptions) -> Loss:
    """The loss at the scale of the stated noise or, where none is stated, of the median residual of the start, which pose errors
    and outliers leave finite."""
    if name == "none":
        return Loss()
    if arcs.sigma_known:
        return Loss(name, options.loss_scale * residual_sigma(cost, arcs, start))
    size: Float[Tensor, ""] = cost_function(cost, arcs)(arcs.bearings, start.normals(arcs))[0].norm(dim=-1).median()
    return Loss(name, max(options.loss_scale * float(size), 1e-12))


def residual_sigma(cost: str, arcs: MatchedArcs, state: LinesAndPoses) -> float:
    """Standard deviation of a residual of the cost for the stated noise, or for 1 px; two residuals an arc."""
    seen = arcs.seen_by(state.models) if state.models else arcs
    return math.sqrt(weighting(cost, seen, state.normals(arcs), Loss(), 1.0).expected / (2 * len(arcs)))
