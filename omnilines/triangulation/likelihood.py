"""Maximum likelihood on the sphere: the line that minimises the squared distances of all arc ends, each over its noise.

The residual and its derivative are those of `residuals.py`; the start is the dual-space solution. Levenberg-Marquardt in the
chart of each line (Madsen, Nielsen, Tingleff 2004), all tracks at once, each with a damping of its own until it is done.
It attains the Cramer-Rao bound with the noise stated, and without where all end points are equally certain in pixels or angle.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.errors import InputError
from omnilines.geometry.line import PARALLEL, PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.triangulation.candidates import candidate_batches, pair_table
from omnilines.triangulation.compiled import nearest_pairs, on_processor, refined
from omnilines.triangulation.degeneracy import assess
from omnilines.triangulation.dual import frames_and_lines
from omnilines.triangulation.kernels.likelihood import FIRST_DAMPING, MAX_DAMPING, MIN_DAMPING, TOLERANCE
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.options import TriangulationOptions
from omnilines.triangulation.residuals import (
    NormalEquations,
    chart_of,
    chi_square_limit,
    end_distances,
    freedom,
    noise_variance,
    normal_equations,
)
from omnilines.triangulation.result import Triangulation

PAIRS = 128
"""Of planes, that are tried where the first search has failed."""


def triangulate(
    observations: PlaneObservations,
    *,
    iterations: int = 50,
    sigma_rad: float | None = None,
    options: TriangulationOptions = TriangulationOptions(),
) -> Triangulation:
    """The lines of all tracks. `iterations` bounds the steps of each; `sigma_rad` and `options` as in `degeneracy.assess`."""
    if iterations < 0:
        raise InputError(f"Maximum likelihood expects iterations of at least 0, found {iterations}; correct the option.")
    frames, start, unsolved = frames_and_lines(observations)
    far = options.consensus.candidate_chi_square
    lines = _restarted(observations, refine(observations, start, iterations), iterations, far)
    return assess(observations, frames, lines, sigma_rad, unsolved, options=options.degeneracy)


def _restarted(observations: PlaneObservations, lines: PlueckerLines, iterations: int, far: float) -> PlueckerLines:
    """Lines that their rows do not fit found anew from pairs of planes, where one ends nearer.

    A row farther off than `far`, over the variance, is as good as any.

    The dual space knows nothing of noise: of arcs that are known very differently well it may give a start from which the search
    ends in another minimum.
    """
    square = _total_square(observations, lines)
    degrees = freedom(observations)
    variance = noise_variance(square, degrees)
    tracks = torch.nonzero((degrees > 0) & (square > chi_square_limit(degrees) * variance)).squeeze(-1)
    if not len(tracks) or not iterations:
        return lines
    own, _ = observations.of_tracks(tracks)
    direction, moment, least = lines.direction.clone(), lines.moment.clone(), square[tracks]
    for most in (far * variance, math.inf):
        again = refine(own, _best_pairs(own, most), iterations)
        total = _total_square(own, again)
        nearer = total < least
        direction[tracks[nearer]], moment[tracks[nearer]] = again.direction[nearer], again.moment[nearer]
        least = torch.where(nearer, total, least)
    return PlueckerLines(direction, moment)


def _best_pairs(observations: PlaneObservations, most: float) -> PlueckerLines:
    """The line of the two planes of each track from which all of its rows have the least sum of squares, each at most `most`."""
    if observations.arcs is not None and on_processor(observations.normal):
        return nearest_pairs(observations.by_track, observations.noise, pair_table(observations, PAIRS, 0), PARALLEL, most)
    direction = torch.full((observations.tracks, 3), torch.nan, dtype=torch.float64, device=observations.normal.device)
    moment = direction.clone()
    for tracks, rows in observations.by_count():
        found = []
        for _, some, candidates, square in candidate_batches(observations, rows, PAIRS, 0):
            best = square.clamp(max=most).sum(-1).argmin(-1)
            found.append(candidates[torch.arange(len(some), device=best.device), best])
        direction[tracks] = torch.cat([lines.direction for lines in found])
        moment[tracks] = torch.cat([lines.moment for lines in found])
    return PlueckerLines(direction, moment)


def _total_square(observations: PlaneObservations, lines: PlueckerLines) -> Float[Tensor, " t"]:
    """Sum of the squared distances of the ends of each track, over their noise where it is stated; NaN without a line."""
    moment = lines[observations.track].moment_about(observations.centre)
    return observations.sum_by_track(end_distances(observations, moment).square().sum(-1))


def refine(observations: PlaneObservations, start: PlueckerLines, iterations: int = 50) -> PlueckerLines:
    """The most likely line of every track, from a start in the world frame; NaN where the start is."""
    world = chart_of(observations, start)
    if observations.arcs is not None and on_processor(observations.normal):
        found = refined(observations.by_track, observations.noise, world, iterations)
        kept = torch.isfinite(found.moment).all(-1)[:, None]
        return PlueckerLines(torch.where(kept, found.direction, start.direction), torch.where(kept, found.moment, start.moment))
    finite = torch.isfinite(world.centre).all(-1) & torch.isfinite(world.phi)
    tracks = torch.nonzero(finite).squeeze(-1)
    inner, _ = observations.of_tracks(tracks)
    # Coordinates from the centre of each chart, so that nothing is lost far from the world origin.
    origin = world.centre[tracks]
    local = PlaneObservations(
        inner.normal, inner.centre - origin[inner.track], inner.track, inner.tracks, inner.arcs, inner.noise, inner.noise_stated
    )
    begin = world[tracks]
    lines = _minimise(local, LineChart(torch.zeros_like(origin), begin.scale, begin.S, begin.phi), iterations).lines()
    lines = lines.shifted(-origin)
    direction, moment = start.direction.clone(), start.moment.clone()
    direction[tracks], moment[tracks] = lines.direction, lines.moment
    return PlueckerLines(direction, moment)


def _minimise(observations: PlaneObservations, start: LineChart, iterations: int) -> LineChart:
    chart = LineChart(start.centre.clone(), start.scale, start.S.clone(), start.phi.clone())
    at = normal_equations(observations, chart)
    damping = torch.full_like(at.cost, FIRST_DAMPING)
    growth = torch.full_like(at.cost, 2.0)
    active = torch.nonzero(at.cost > at.rounding).squeeze(-1)
    for _ in range(iterations):
        if not len(active):
            break
        step, promised = _step(at, active, damping[active])
        trial = chart[active].retract(step).recentred()
        then = normal_equations(observations.of_tracks(active)[0], trial)
        decrease = at.cost[active] - then.cost
        settled = promised <= TOLERANCE * at.cost[active] + at.rounding[active]
        # The last step is still good where rounding hides what it gains.
        better = decrease > torch.where(settled, -TOLERANCE * at.cost[active] - at.rounding[active], 0.0)
        # Nielsen's rule: the damping follows how well the linear model foretold the decrease.
        gain = (1 - (2 * decrease / promised.clamp_min(1e-300) - 1) ** 3).clamp(0.1, 2.0)
        damping[active] *= torch.where(better, gain, growth[active])
        growth[active] = torch.where(better, 2.0, 2 * growth[active])
        damping.clamp_(min=MIN_DAMPING)
        _accept(chart, at, active[better], trial[better], then, better)
        active = active[~settled & (damping[active] < MAX_DAMPING)]
    return chart


def _accept(
    chart: LineChart, at: NormalEquations, tracks: Int[Tensor, " k"], trial: LineChart, then: NormalEquations, better: Tensor
) -> None:
    """The new state of some tracks, in place."""
    chart.centre[tracks], chart.S[tracks], chart.phi[tracks] = trial.centre, trial.S, trial.phi
    at.cost[tracks], at.gradient[tracks] = then.cost[better], then.gradient[better]
    at.matrix[tracks], at.rounding[tracks] = then.matrix[better], then.rounding[better]


def _step(
    at: NormalEquations, tracks: Int[Tensor, " k"], damping: Float[Tensor, " k"]
) -> tuple[Float[Tensor, "k 4"], Float[Tensor, " k"]]:
    """-(J'J + damping D)^-1 J'h with D the diagonal of J'J, and the decrease that the linear model promises.

    Where the matrix is not positive definite the step is zero and the promise infinite, so that the damping grows.
    """
    matrix, gradient = at.matrix[tracks], at.gradient[tracks]
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    eye = torch.eye(4, dtype=matrix.dtype, device=matrix.device)
    scaled = matrix * scale[:, :, None] * scale[:, None] + damping[:, None, None] * eye
    slope = gradient * scale
    factor, info = torch.linalg.cholesky_ex(scaled)
    sound = info == 0
    factor = torch.where(sound[:, None, None], factor, eye)
    step = -torch.cholesky_solve(slope[..., None], factor).squeeze(-1)
    promised = -(slope * step).sum(-1) + damping * step.square().sum(-1)
    step = torch.where(sound[:, None], step * scale, 0.0)
    return step, torch.where(sound, promised, torch.inf)
