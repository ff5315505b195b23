"""Trials of every triangulation and every cost on a scene with known truth, with the poses known and with disturbed poses."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs, arcs_from_segments
from omnilines.adjustment.lines import adjust_lines, drop_unknown
from omnilines.adjustment.start import no_chart, poses_by_lines
from omnilines.adjustment.state import LinesAndPoses
from omnilines.costs import COSTS
from omnilines.geometry.line import PlueckerLines
from omnilines.least_squares import Outcome
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check
from omnilines.studies.line_errors import Bound, aligned_rms_m, cramer_rao_bound
from omnilines.synthetic.lines import LineWorld
from omnilines.synthetic.poses import perturbed_poses
from omnilines.triangulation import TRIANGULATIONS, triangulate
from omnilines.triangulation.observations import PlaneObservations

KNOWN, ESTIMATED = "known", "estimated"
"""The poses are the true ones and stay; or they are disturbed, and adjusted together with the lines."""
POSES = (KNOWN, ESTIMATED)
SETTING = {KNOWN: "poses known", ESTIMATED: "poses disturbed, then estimated"}
TRIANGULATION, ADJUSTMENT = "triangulation", "adjustment"
EFFICIENT = "whitened"
"""The cost that is expected to attain the bound."""
COMPLETE_SHARE = 0.98
"""Of the trials, those that have to end with every line."""
MAX_ITERATIONS = 300
"""A line that 3 px of noise barely determine may need more than the usual 100."""
START_SHARE = 0.5
"""Of the lines of each photo, those that fit disturbed poses best refine the poses first: a line that they put behind its
cameras, or far off, would else be lost or lead the adjustment astray."""


@dataclass(frozen=True)
class MethodFigures:
    """One method at one noise, one figure for each of T trials; NaN where a trial has none."""

    poses: str
    noise_px: float
    stage: str
    method: str
    found: Float[Tensor, " T"]
    """Share of the lines that the method has; after an adjustment 0 where it did not converge."""
    rms_2d_px: Float[Tensor, " T"]
    """Orthogonal distance of the observed end points from the projected lines that were found."""
    rms_3d_m: Float[Tensor, " T"]
    """Distance of the true end points from the lines after the best similarity."""
    rms_3d_euclidean_m: Float[Tensor, " T"]
    """The same after the best turn and shift."""

    @property
    def complete(self) -> Bool[Tensor, " T"]:
        """Trials that have every line, and a figure in 3D."""
        return (self.found == 1) & torch.isfinite(self.rms_3d_m)


@dataclass(frozen=True)
class Study:
    """All trials on one scene, and the bound in both settings."""

    world: LineWorld
    noise_px: tuple[float, ...]
    trials: int
    bounds: dict[str, Bound]
    figures: tuple[MethodFigures, ...]

    def of(self, poses: str, stage: str, method: str | None = None) -> tuple[MethodFigures, ...]:
        """The figures of one stage in one setting, of all methods or of one, in the order of the noise."""
        return tuple(f for f in self.figures if (f.poses, f.stage) == (poses, stage) and method in (None, f.method))

    def over_bound(self, *figures: MethodFigures) -> tuple[float, float]:
        """(RMS 3D error over the Cramer-Rao bound, its standard error), pooled over the trials that have every line.

        With q = e^2 / bound^2 of a trial it is sqrt(mean q), and its standard error std(q) / (2 sqrt(n mean q)). NaN without
        noise or for fewer than two such trials.
        """
        ratios = [
            (f.rms_3d_m[f.complete] / (f.noise_px * self.bounds[f.poses].rms_m)).square() for f in figures if f.noise_px > 0
        ]
        squares = torch.cat([torch.zeros(0, dtype=torch.float64), *ratios])
        if len(squares) < 2:
            return math.nan, math.nan
        ratio = float(squares.mean().sqrt())
        return ratio, float(squares.std()) / (2 * math.sqrt(len(squares)) * ratio)


def run_study(
    world: LineWorld,
    noise_px: tuple[float, ...],
    trials: int,
    *,
    perturb_deg: float,
    perturb_m: float,
    seed: int,
    triangulations: Sequence[str] = tuple(dict(TRIANGULATIONS)),
    costs: Sequence[str] = tuple(dict(COSTS)),
    averaging: Mapping[str, Any] = MappingProxyType({}),
    progress: ProgressCallback = silent,
) -> Study:
    """Every method at every noise in every trial; trials differ in their noise and in how their poses are disturbed.

    Raises GeometryError where the scene does not determine its lines, InputError for a noise that is none.
    """
    bounds = {poses: cramer_rao_bound(world, poses == ESTIMATED) for poses in POSES}
    true = world.poses(trials)
    disturbed = perturbed_poses(true.cam_from_world, perturb_deg, perturb_m, seed)
    figures: list[MethodFigures] = []
    for done, noise in enumerate(noise_px):
        arcs = arcs_from_segments(world.segments(noise, seed, trials), true, {"cam0": world.camera}).arcs
        level = _Level(world, arcs, noise, trials, tuple(triangulations), tuple(costs), averaging)
        for half, (poses, start) in enumerate(((KNOWN, true.cam_from_world), (ESTIMATED, disturbed))):
            figures += level.triangulations(poses, start)

            def tell(trial: int, before: int = (2 * done + half) * trials) -> None:
                progress("trials", before + trial, 2 * len(noise_px) * trials)

            if costs:
                figures += level.adjustments(poses, start, tell)
    return Study(world, noise_px, trials, bounds, tuple(figures))


def study_checks(study: Study, allowance: float) -> tuple[Check, ...]:
    """The efficient cost is at the bound, by `allowance` or two standard errors, and the adjustment ends with every line."""
    checks = []
    for poses in POSES:
        figures = study.of(poses, ADJUSTMENT, EFFICIENT)
        ratio, error = study.over_bound(*figures)
        if math.isfinite(ratio):
            limit = 1 + max(allowance, 2 * error)
            checks.append(Check(f"3D error over the bound, {EFFICIENT} cost, {SETTING[poses]}", ratio, limit, "", ratio <= limit))
        share = float(np.mean([float(f.complete.double().mean()) for f in figures]))
        name = f"share of trials that end with every line, {SETTING[poses]}"
        checks.append(Check(name, share, COMPLETE_SHARE, "", share >= COMPLETE_SHARE))
    return tuple(checks)


@dataclass(frozen=True)
class _Level:
    """All trials at one noise. Their arcs stand in one table, photos and tracks of trial k after those of trial k - 1."""

    world: LineWorld
    arcs: MatchedArcs
    noise_px: float
    trials: int
    methods: tuple[str, ...]
    costs: tuple[str, ...]
    averaging: Mapping[str, Any]

    def triangulations(self, poses: str, cam_from_world: Pose) -> Iterator[MethodFigures]:
        """Every method, all trials at once."""
        for method in self.methods:
            options = self.averaging if method == "averaging" else {}
            found = triangulate(method, _planes(self.arcs, cam_from_world), **options)
            yield self._measured(found.lines, found.known, cam_from_world, (poses, TRIANGULATION, method))

    def adjustments(self, poses: str, cam_from_world: Pose, tell: Callable[[int], None]) -> Iterator[MethodFigures]:
        """Lines, and poses where they are estimated, of each trial adjusted with every cost, from one start for all costs."""
        adjusted: dict[str, list[tuple[PlueckerLines, Tensor, Pose]]] = {cost: [] for cost in self.costs}
        for trial, (arcs, given) in enumerate(self._each(cam_from_world)):
            tell(trial)
            start = refined_start(arcs, given) if poses == ESTIMATED else given
            first = triangulate(TRIANGULATIONS[0][0], _planes(arcs, start))
            inner, tracks = drop_unknown(arcs, first.known)
            for cost, kept in adjusted.items():
                done = adjust_lines(
                    inner,
                    first.lines[tracks],
                    start,
                    cost=cost,
                    refine_poses=poses == ESTIMATED,
                    max_iterations=MAX_ITERATIONS,
                )
                lines = _in_place(first.lines, tracks, done.state.chart.lines())
                kept.append((lines, first.known & _reached(done), done.state.cam_from_world))
        for cost, kept in adjusted.items():
            every, known, found = zip(*kept, strict=True)
            lines = PlueckerLines(torch.cat([k.direction for k in every]), torch.cat([k.moment for k in every]))
            reached = Pose(torch.cat([pose.rotation for pose in found]), torch.cat([pose.translation for pose in found]))
            yield self._measured(lines, torch.cat(known), reached, (poses, ADJUSTMENT, cost))

    def _each(self, cam_from_world: Pose) -> Iterator[tuple[MatchedArcs, Pose]]:
        """Arcs and poses of each trial, photos and tracks numbered from 0."""
        images, tracks = self.world.images, self.world.lines
        for k in range(self.trials):
            own = self.arcs.rows(self.arcs.track // tracks == k)
            own = replace(own, image=own.image % images, track=own.track % tracks, images=images, tracks=tracks)
            yield own, cam_from_world[k * images : (k + 1) * images]

    def _measured(
        self, lines: PlueckerLines, known: Bool[Tensor, " n"], cam_from_world: Pose, what: tuple[str, str, str]
    ) -> MethodFigures:
        """The figures of all trials, over the lines that are known; `what` is (poses, stage, method)."""
        arcs, ends = self.arcs, self.world.ends_m
        distance = arcs.orthogonal_px(lines[arcs.track].projection_normal(cam_from_world[arcs.image]))
        rows = known[arcs.track].to(distance.dtype)
        squares = torch.where(known[arcs.track], distance.square().sum(-1), 0.0)
        trial, zeros = arcs.track // self.world.lines, torch.zeros(self.trials, dtype=distance.dtype)
        mean = zeros.index_add(0, trial, squares) / (2 * zeros.index_add(0, trial, rows))
        by_trial = PlueckerLines(lines.direction.unflatten(0, (self.trials, -1)), lines.moment.unflatten(0, (self.trials, -1)))
        mask = known.unflatten(0, (self.trials, -1))
        poses, stage, method = what
        return MethodFigures(
            poses,
            self.noise_px,
            stage,
            method,
            mask.to(distance.dtype).mean(-1),
            mean.sqrt(),
            aligned_rms_m(by_trial, mask, ends, with_scale=True),
            aligned_rms_m(by_trial, mask, ends, with_scale=False),
        )


def _planes(arcs: MatchedArcs, cam_from_world: Pose) -> PlaneObservations:
    return PlaneObservations.from_arcs(arcs.bearings, cam_from_world[arcs.image], arcs.track, arcs.tracks)


def _in_place(every: PlueckerLines, tracks: Int[Tensor, " k"], some: PlueckerLines) -> PlueckerLines:
    """All lines, with some of them replaced."""
    lines = PlueckerLines(every.direction.clone(), every.moment.clone())
    lines.direction[tracks], lines.moment[tracks] = some.direction, some.moment
    return lines


def _reached(done: Adjusted) -> bool:
    """Whether an adjustment ended at a minimum."""
    return done.outcome in (Outcome.CONVERGED, Outcome.STALLED)


def refined_start(arcs: MatchedArcs, disturbed: Pose) -> Pose:
    """Disturbed poses refined by START_SHARE of the lines of each photo. Raises GeometryError where they determine no line."""
    first = triangulate(TRIANGULATIONS[0][0], _planes(arcs, disturbed))
    return poses_by_lines(arcs, first, LinesAndPoses(disturbed, no_chart()), best_share=START_SHARE).cam_from_world
