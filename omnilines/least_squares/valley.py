"""Where the linear covariance does not hold: the floor of the valley around a minimum is walked until the cost has risen by what
an interval allows, and the interval of a quantity is what lies within that on the way.

At every stop the direction d of the least eigenvalue of the reduced system (scaled to a unit diagonal) is held and all else is
optimal. With c the cost above the least and C the covariance of a quantity x across the floor, both for residuals of unit
variance, x reaches from there

    x +- sqrt(z^2 - c) sqrt(C)

For a quadratic cost the union over the floor is x +- z sigma exactly; for a valley that bends, or has several lowest places, it
is the interval of the profile likelihood (D. M. Bates, D. G. Watts, Nonlinear regression analysis, 1988, chapter 6) as far as one
direction bends. A quantity that turns back along the floor has two freedoms at its turn, the floor and across it: its z is that
of chi-square with two.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float
from scipy import stats
from torch import Tensor

from omnilines.least_squares.dense import LEAST_EIGENVALUE, DenseEngine, Problem, Solution, constrained_inverse, constrained_solve
from omnilines.least_squares.levenberg_marquardt import minimise
from omnilines.least_squares.losses import Loss
from omnilines.least_squares.schur import CellLinearisation, Linearisation, Reduced, back_substitute, reduce

S = TypeVar("S")

CURVED_SHARE = 0.15
"""Of the half width of an interval: so much an end may be off before the valley counts as curved."""
PACE = 0.5
"""By so much the root of the cost, in standard deviations, is to rise from stop to stop."""
STRIDE = 0.1
"""A quantity moves by at most this share of itself (of 1, where it is less) from stop to stop."""
MOST_STOPS = 60
MOST_ITERATIONS = 20
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Quantities(Generic[S]):
    """What intervals are asked of: p numbers of a state, and their derivatives by its k kept parameters."""

    of: Callable[[S], Float[Tensor, " p"]]
    by_kept: Float[Tensor, "p k"]


class _Across(Generic[S]):
    """A problem with one direction of its kept parameters held."""

    def __init__(self, problem: Problem[S], held: Float[Tensor, " k"]) -> None:
        self.problem, self.structure, self.held = problem, problem.structure, held

    def linearise(self, state: S) -> Linearisation | CellLinearisation:
        """That of the problem."""
        return self.problem.linearise(state)

    def retract(self, state: S, kept: Float[Tensor, " k"], eliminated: Float[Tensor, "count e"]) -> S:
        """That of the problem."""
        return self.problem.retract(state, kept, eliminated)

    def gauge(self, state: S) -> Float[Tensor, "k 1"]:
        """The direction that is held."""
        return self.held[:, None]


@dataclass(frozen=True)
class _Stop(Generic[S]):
    """A place on the floor: its cost, and the direction of the floor there, along which the cost rises by slope h +
    curvature h^2."""

    state: S
    cost: float
    reduced: Reduced
    direction: Float[Tensor, " k"]
    held: Float[Tensor, " k"]
    slope: float
    curvature: float

    @staticmethod
    def at(state: S, cost: float, reduced: Reduced, before: Float[Tensor, " k"]) -> "_Stop[S]":
        """Its direction is the one nearer to that of the stop before."""
        scale = torch.diagonal(reduced.matrix).clamp_min(1e-300).rsqrt()
        values, vectors = torch.linalg.eigh(reduced.matrix * scale[:, None] * scale)
        way = vectors[:, 0] * (1.0 if float(vectors[:, 0] / scale @ before) >= 0 else -1.0)
        slope = -2 * float(scale * way @ reduced.right_side)
        return _Stop(
            state=state,
            cost=cost,
            reduced=reduced,
            direction=scale * way,
            held=way / scale,
            slope=slope,
            curvature=max(float(values[0]), 0.0),
        )

    def length(self, rise: float) -> float:
        """The h at which the cost has risen by so much."""
        return 2 * rise / max(self.slope + math.sqrt(self.slope**2 + 4 * self.curvature * rise), 1e-300)

    def across(self, rows: Float[Tensor, "p k"]) -> Float[Tensor, " p"]:
        """Standard deviation of quantities across the floor, for residuals of unit variance."""
        covariance = constrained_inverse(self.reduced.matrix, self.held[:, None])
        return torch.einsum("pi,ij,pj->p", rows, covariance, rows).clamp_min(0).sqrt()

    def expected(self, problem: Problem[S], length: float) -> tuple[S, float] | None:
        """The lowest place across the floor and its cost as one Gauss-Newton step promises them; None where there is no step."""
        step = length * self.direction
        start = problem.retract(self.state, step, back_substitute(self.reduced, step))
        engine = DenseEngine(_Across(problem, self.held), start, Loss())
        equations = engine.equations(start)
        reduced = reduce(equations, 0.0)
        kept = constrained_solve(reduced.matrix, self.held[:, None], reduced.right_side) if reduced.sound else None
        if kept is None:
            return None
        eliminated = back_substitute(reduced, kept)
        return problem.retract(start, kept, eliminated), engine.cost(start) - equations.promised_decrease(kept, eliminated, 0.0)

    def moved(self, problem: Problem[S], length: float) -> "_Stop[S] | None":
        """Along the floor, then to the lowest place across it; None where the problem has no sound equations there."""
        step = length * self.direction
        start = problem.retract(self.state, step, back_substitute(self.reduced, step))
        engine = DenseEngine(_Across(problem, self.held), start, Loss())
        found = minimise(engine, start, MOST_ITERATIONS, tolerance=TOLERANCE, damping=1e-8)
        reduced = reduce(engine.equations(found.state), 0.0)
        if not (reduced.sound and math.isfinite(found.cost) and bool(torch.isfinite(reduced.matrix).all())):
            return None
        return _Stop.at(found.state, found.cost, reduced, math.copysign(1.0, length) * self.direction)


def curved_intervals(
    problem: Problem[S],
    chosen: Solution[S],
    others: Sequence[Solution[S]],
    quantities: Quantities[S],
    *,
    variance: float,
    sigmas: float,
) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]] | None:
    """Lowest and highest value of each quantity that fits as well as `sigmas` standard deviations allow; None where the linear
    covariance around the `chosen` minimum says the same. `others` are further minima, good or bad.

    Infinite on a side where the floor does not end within MOST_STOPS.
    """
    limit = sigmas**2 * variance
    solutions = sorted([chosen, *others], key=lambda solution: solution.cost)
    tied = [solution for solution in solutions if solution.cost <= solutions[0].cost + limit]
    curved = _is_curved(problem, chosen, quantities, limit)
    half = _half(chosen, quantities, limit)
    place = quantities.of(chosen.state)
    apart = [bool(((quantities.of(solution.state) - place).abs() > half).any()) for solution in tied]
    if not curved and not any(apart):
        return None
    return _profile(problem, tied, quantities, math.sqrt(variance), sigmas)


def _half(solution: Solution[S], quantities: Quantities[S], limit: float) -> Float[Tensor, " p"]:
    """Half width of the linear intervals."""
    rows = quantities.by_kept
    return math.sqrt(limit) * torch.einsum("pi,ij,pj->p", rows, solution.kept_covariance(), rows).clamp_min(0).sqrt()


def _is_curved(problem: Problem[S], solution: Solution[S], quantities: Quantities[S], limit: float) -> bool:
    """Whether the ends of the floor lie elsewhere than the linear covariance says, by more than CURVED_SHARE of an interval; they
    are sought by one Gauss-Newton step each."""
    stop = _Stop.at(solution.state, solution.cost, solution.reduced, solution.weakest_direction)
    if stop.curvature < LEAST_EIGENVALUE:
        return True
    length = stop.length(limit)
    along = length * quantities.by_kept @ stop.direction
    half = torch.hypot(along, math.sqrt(limit) * stop.across(quantities.by_kept))
    for side in (1.0, -1.0):
        end = stop.expected(problem, side * length)
        if end is None:
            return True
        rise = math.sqrt(max(end[1] - solution.cost, 0.0) / limit)
        off = quantities.of(end[0]) - quantities.of(solution.state) - side * along
        if not abs(rise - 1) <= CURVED_SHARE or bool((off.abs() > CURVED_SHARE * half).any()):
            return True
    return False


def _profile(
    problem: Problem[S], tied: Sequence[Solution[S]], quantities: Quantities[S], unit: float, sigmas: float
) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
    """The interval over the floors around minima, the best first; one that an earlier floor has passed is not walked again."""
    wide = math.sqrt(float(stats.chi2.ppf(math.erf(sigmas / math.sqrt(2)), 2)))
    least = tied[0].cost
    floors: list[_Floor[S]] = []
    low = high = torch.full_like(quantities.of(tied[0].state), torch.nan)
    for solution in tied:
        place = quantities.of(solution.state)
        if bool(((place >= low) & (place <= high)).all()):
            continue
        back, forth = (
            _walk(
                problem,
                _Stop.at(solution.state, solution.cost, solution.reduced, way),
                quantities,
                least=least,
                unit=unit,
                sigmas=wide,
            )
            for way in (-solution.weakest_direction, solution.weakest_direction)
        )
        floors.append(_Floor([*back[:0:-1], *forth], len(back) == MOST_STOPS, len(forth) == MOST_STOPS))
        # Beyond a ridge there may be a lower place than any that was known.
        least = min(least, *(stop.cost for stop in floors[-1].stops))
        found = [floor.reach(quantities, least, unit, sigmas=sigmas, wide=wide) for floor in floors]
        low, high = torch.stack([ends[0] for ends in found]).amin(0), torch.stack([ends[1] for ends in found]).amax(0)
    return low, high


def _walk(
    problem: Problem[S], first: _Stop[S], quantities: Quantities[S], *, least: float, unit: float, sigmas: float
) -> list[_Stop[S]]:
    """The stops in the direction of the first one as far as the cost allows, and the one beyond, where there is one."""
    stops, pace = [first], PACE
    while len(stops) < MOST_STOPS and pace > PACE / 16:
        stop = stops[-1]
        height = math.sqrt(max(stop.cost - least, 0.0)) / unit
        value, way = quantities.of(stop.state), quantities.by_kept @ stop.direction
        most = float((STRIDE * value.abs().clamp_min(1.0) / way.abs().clamp_min(1e-300)).min())
        length = min(stop.length(((height + pace) ** 2 - height**2) * unit**2), most * pace / PACE)
        onwards = stop.moved(problem, length)
        now = math.inf if onwards is None else math.sqrt(max(onwards.cost - least, 0.0)) / unit
        if onwards is None or now > max(height, sigmas) + 2 * PACE:
            # Too far, or off the floor.
            pace *= 0.5
            continue
        stops.append(onwards)
        if now > sigmas:
            break
        pace = PACE
    return stops


@dataclass(frozen=True)
class _Floor(Generic[S]):
    """The stops from one end to the other, and whether either end is only where the walk was given up."""

    stops: Sequence[_Stop[S]]
    open_back: bool
    open_forth: bool

    def reach(
        self, quantities: Quantities[S], least: float, unit: float, *, sigmas: float, wide: float
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        """Lowest and highest values, of quantities that turn back by the `wide` limit."""
        values = torch.stack([quantities.of(stop.state) for stop in self.stops])
        across = unit * torch.stack([stop.across(quantities.by_kept) for stop in self.stops])
        height = torch.tensor([max(stop.cost - least, 0.0) for stop in self.stops], dtype=values.dtype).sqrt() / unit
        narrow = self._within(quantities, values, across, height, sigmas)
        broad = self._within(quantities, values, across, height, wide)
        turns = _turns_back(values, across)
        return torch.where(turns, broad[0], narrow[0]), torch.where(turns, broad[1], narrow[1])

    def _within(
        self,
        quantities: Quantities[S],
        values: Float[Tensor, "n p"],
        across: Float[Tensor, "n p"],
        height: Float[Tensor, " n"],
        limit: float,
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        inside = height <= limit
        reach = (limit**2 - height[inside] ** 2).sqrt()[:, None] * across[inside]
        found = [values[inside] - reach, values[inside] + reach]
        for k in torch.nonzero(inside[1:] != inside[:-1]).flatten().tolist():
            share = (limit - float(height[k])) / float(height[k + 1] - height[k])
            found.append(torch.lerp(values[k], values[k + 1], share)[None])
        low, high = torch.cat(found).amin(0), torch.cat(found).amax(0)
        for end, is_open in ((0, self.open_back), (-1, self.open_forth)):
            if is_open and bool(inside[end]):
                # Only what the floor carries along goes on with it.
                carried = values.amax(0) - values.amin(0) > limit * across.amax(0)
                onwards = torch.where(carried, quantities.by_kept @ self.stops[end].direction, 0.0)
                low, high = torch.where(onwards < 0, -torch.inf, low), torch.where(onwards > 0, torch.inf, high)
        return low, high


def _turns_back(values: Float[Tensor, "n p"], across: Float[Tensor, "n p"]) -> Bool[Tensor, " p"]:
    """Quantities that go a way back along the floor that shows beside their spread across it."""
    extent, net = values.amax(0) - values.amin(0), (values[-1] - values[0]).abs()
    return extent - net > CURVED_SHARE * across.median(0).values
