"""The line that most observations of a track agree on, where some belong to other lines.

Candidates are the lines of pairs of planes, ranked by the truncated sum of squared residuals (MSAC; Torr and Zisserman 2000). The
best one and the best of those that it does not explain are refined by maximum likelihood on the rows that agree with them, and
all rows are judged again, until none changes (Chum, Matas and Kittler 2003). A row is judged by the residual that it has when the
line is found without it, over the standard deviation of that: with h, J of the row and C the covariance of the line,

    s = h' (I - J C J')^-1 h for a row that the line was found from,    s = h' (I + J C J')^-1 h for another,

both are chi-square with two degrees of freedom, to first order. A row whose arc faces away from the line does not belong to it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from omnilines.geometry.line import PARALLEL, PlueckerLines
from omnilines.geometry.line_chart import PHI_MAX_RAD, PHI_MIN_RAD
from omnilines.triangulation.candidates import candidate_batches, pair_table
from omnilines.triangulation.compiled import consensus, judged, least_majority, on_processor
from omnilines.triangulation.degeneracy import faces_away
from omnilines.triangulation.kernels.consensus import ConsensusRules
from omnilines.triangulation.likelihood import refine
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.options import ConsensusOptions
from omnilines.triangulation.residuals import chart_of, end_distances, inverse, linearise

ROUNDS, STEPS = 10, 20
"""Of judging, and of refining in each: hypotheses that need more are wrong ones."""
FREE_ROUNDS = 5
"""After these, rows may only leave: two rows that throw out each other would do so in turn."""
ROWS_AT_ONCE = 1 << 16
"""Rows that are held in memory at the same time, with all their candidates, where nothing is compiled."""


@dataclass(frozen=True)
class Consensus:
    """Of t tracks of n rows in all, in the order of the observations."""

    inlier: Bool[Tensor, " n"]
    solved: Bool[Tensor, " t"]
    """A majority of at least three rows agrees on one line, and no other line is nearly as likely."""
    squared: Float[Tensor, " n"]
    """s of every row, in units of the noise."""


def majority(views: int) -> int:
    """Rows that have to agree: more than half, and three at least, since two planes always meet in a line."""
    return max(3, views // 2 + 1)


def least_majority_square(observations: PlaneObservations, budget: int, seed: int) -> Float[Tensor, " t"]:
    """Least over the candidates of a track of the sum h^2 that a majority stays within (Rousseeuw 1984)."""
    if observations.arcs is not None and on_processor(observations.normal):
        return least_majority(observations.by_track, observations.noise, pair_table(observations, budget, seed), PARALLEL)
    least = torch.full((observations.tracks,), torch.inf, dtype=torch.float64, device=observations.normal.device)
    for tracks, rows in observations.by_count():
        need = majority(rows.shape[1])
        batches = candidate_batches(observations, rows, budget, seed)
        least[tracks] = torch.cat([square.kthvalue(need, dim=-1).values.amin(-1) for _, _, _, square in batches])
    return least


def find_consensus(
    observations: PlaneObservations, variance: float, budget: int, seed: int, options: ConsensusOptions = ConsensusOptions()
) -> Consensus:
    """The consensus of tracks with three rows or more; `variance` is that of a residual. Pairs as in `candidate_batches`."""
    if observations.arcs is not None and on_processor(observations.normal):
        rules = ConsensusRules(
            variance, options.row_chi_square, options.candidate_chi_square, options.clearly_wrong_chi_square, options.decisive,
            options.hypotheses, ROUNDS, STEPS, FREE_ROUNDS, PARALLEL, PHI_MIN_RAD, PHI_MAX_RAD,
        )  # fmt: skip
        return Consensus(*consensus(observations.by_track, observations.noise, pair_table(observations, budget, seed), rules))
    device = observations.normal.device
    inlier = torch.zeros(len(observations.track), dtype=torch.bool, device=device)
    solved = torch.zeros(observations.tracks, dtype=torch.bool, device=device)
    squared = torch.full((len(observations.track),), torch.inf, dtype=torch.float64, device=device)
    for portion in _portions(observations):
        found = _find_in_groups(observations, [rows for _, rows in portion], variance, budget, seed, options)
        for (tracks, rows), (own, sound, square) in zip(portion, found, strict=True):
            inlier[rows], solved[tracks], squared[rows] = own, sound, square
    return Consensus(inlier, solved, squared)


def _portions(observations: PlaneObservations) -> Iterator[list[tuple[Tensor, Tensor]]]:
    """The groups of tracks with equally many rows, large ones cut, put together to at most ROWS_AT_ONCE rows."""
    portion: list[tuple[Tensor, Tensor]] = []
    held = 0
    for tracks, rows in observations.by_count():
        at_once = max(1, ROWS_AT_ONCE // rows.shape[1])
        for own, part in zip(tracks.split(at_once), rows.split(at_once), strict=True):
            if portion and held + part.numel() > ROWS_AT_ONCE:
                yield portion
                portion, held = [], 0
            portion.append((own, part))
            held += part.numel()
    if portion:
        yield portion


GroupConsensus = tuple[Bool[Tensor, "g k"], Bool[Tensor, " g"], Float[Tensor, "g k"]]
"""The fields of `Consensus` for g tracks of k rows each."""


def _find_in_groups(
    observations: PlaneObservations,
    groups: Sequence[Int[Tensor, "_ _"]],
    variance: float,
    budget: int,
    seed: int,
    options: ConsensusOptions,
) -> list[GroupConsensus]:
    """The consensus of each group of tracks with equally many rows. All groups are refined together."""
    hypotheses, limit = options.hypotheses, options.row_chi_square
    starts = [_first_lines(observations, rows, variance, budget, seed, options) for rows in groups]
    repeated = [rows[:, None].expand(-1, hypotheses, -1) for rows in groups]
    views = torch.cat([torch.full((len(rows) * hypotheses,), rows.shape[1], device=rows.device) for rows in groups])
    each = torch.arange(len(views), device=views.device).repeat_interleave(views)
    table = observations.take(torch.cat([rows.flatten() for rows in repeated]), each, len(views))
    lines = PlueckerLines(torch.cat([at.direction for at, _ in starts]), torch.cat([at.moment for at, _ in starts]))
    lines, inlier, judged = _settle(table, lines, torch.cat([members for _, members in starts]), variance, limit)
    plain = end_distances(table, lines[each].moment_about(table.centre)).square().sum(-1) / variance
    truncated = torch.where(inlier, plain.nan_to_num(nan=torch.inf), torch.inf).clamp(max=limit)
    sizes = [rows.numel() for rows in repeated]
    found = zip(repeated, truncated.split(sizes), inlier.split(sizes), judged.split(sizes), strict=True)
    return [_resolve(cost.view(r.shape).sum(-1), own.view(r.shape), s.view(r.shape), options) for r, cost, own, s in found]


def _first_lines(
    observations: PlaneObservations,
    rows: Int[Tensor, "g k"],
    variance: float,
    budget: int,
    seed: int,
    options: ConsensusOptions,
) -> tuple[PlueckerLines, Bool[Tensor, " n"]]:
    """The best candidates of each track, one after the other, and which rows of each they rest on."""
    parts = [
        _best_candidates(pairs, lines, square / variance, options)
        for pairs, _, lines, square in candidate_batches(observations, rows, budget, seed)
    ]
    direction, moment = (torch.cat([getattr(at, name) for at, _ in parts]).flatten(0, 1) for name in ("direction", "moment"))
    return PlueckerLines(direction, moment), torch.cat([members for _, members in parts]).flatten()


def _best_candidates(
    pairs: Int[Tensor, "p 2"], lines: PlueckerLines, square: Float[Tensor, "b p k"], options: ConsensusOptions
) -> tuple[PlueckerLines, Bool[Tensor, "b h k"]]:
    """The best candidates of each track with their pairs; after each, pairs that both support it are out of the running."""
    support = square <= options.candidate_chi_square
    cost = square.clamp(max=options.candidate_chi_square).sum(-1)
    track = torch.arange(len(square), device=square.device)
    chosen = []
    for _ in range(options.hypotheses):
        best = cost.argmin(-1)
        chosen.append(best)
        explained = support[track, best][:, pairs].all(-1)
        explained[track, best] = True
        cost = torch.where(explained, torch.inf, cost)
    index = torch.stack(chosen, -1)
    members = torch.zeros(len(pairs), square.shape[2], dtype=torch.bool, device=square.device).scatter(1, pairs, True)
    return lines[track[:, None], index], members[index]


def judge(
    observations: PlaneObservations, lines: PlueckerLines, inlier: Bool[Tensor, " n"], variance: float
) -> Float[Tensor, " n"]:
    """s of every row, see the head of this file; infinite where a row faces away and where its inliers determine no line."""
    at = linearise(observations, chart_of(observations, lines))
    weight = inlier.to(at.residual.dtype)[:, None, None]
    # A row whose camera lies on the line has a derivative of NaN, which no factor of zero would hide.
    used = torch.where(inlier[:, None, None], at.jacobian, 0.0)
    covariance = inverse(observations.sum_by_track(used.mT @ used))
    spread = at.jacobian @ covariance[observations.track] @ at.jacobian.mT
    spread = torch.eye(2, dtype=spread.dtype, device=spread.device) + (1 - 2 * weight) * spread
    (a, b), (_, d) = (row.unbind(-1) for row in spread.unbind(-2))
    h1, h2 = at.residual.unbind(-1)
    # A row that alone fixes a direction of the line has no residual there: 0 over 0 is 0.
    determinant = (a * d - b * b).clamp_min(1e-12)
    square = (d * h1.square() - 2 * b * h1 * h2 + a * h2.square()) / determinant
    wrong = ~torch.isfinite(square) | faces_away(observations, lines)
    return torch.where(wrong, torch.inf, square / (variance + at.rounding))


def judge_by_all(observations: PlaneObservations, lines: PlueckerLines, variance: float) -> Float[Tensor, " n"]:
    """As `judge`, where every line was found from all rows of its track."""
    if observations.arcs is not None and on_processor(observations.normal):
        return judged(observations.by_track, observations.noise, lines, variance)
    return judge(
        observations, lines, torch.ones(len(observations.track), dtype=torch.bool, device=observations.track.device), variance
    )


def _settle(
    table: PlaneObservations, lines: PlueckerLines, inlier: Bool[Tensor, " n"], variance: float, limit: float
) -> tuple[PlueckerLines, Bool[Tensor, " n"], Float[Tensor, " n"]]:
    """Lines refined on their inliers and rows judged by them, in turn until no row changes or ROUNDS are over."""
    direction, moment = lines.direction.clone(), lines.moment.clone()
    inlier, judged = inlier.clone(), torch.full_like(table.centre[:, 0], torch.inf)
    active = torch.arange(table.tracks, device=inlier.device)
    for turn in range(ROUNDS):
        own, rows = table.of_tracks(active)
        found = refine(own.rows(inlier[rows]), PlueckerLines(direction[active], moment[active]), STEPS)
        direction[active], moment[active] = found.direction, found.moment
        judged[rows] = judge(own, found, inlier[rows], variance)
        now = (judged[rows] <= limit) & (inlier[rows] | (turn < FREE_ROUNDS))
        changed = own.sum_by_track((now != inlier[rows]).to(moment.dtype)) > 0
        inlier[rows] = now
        active = active[changed]
        if not len(active):
            break
    return PlueckerLines(direction, moment), inlier, judged


def _resolve(
    cost: Float[Tensor, "g h"], inlier: Bool[Tensor, "g h k"], judged: Float[Tensor, "g h k"], options: ConsensusOptions
) -> GroupConsensus:
    """The hypothesis of the least truncated cost, unless too few rows agree with it or another contradicts it."""
    track = torch.arange(len(cost), device=cost.device)
    best = cost.argmin(-1)
    own, square = inlier[track, best], judged[track, best]
    enough = own.sum(-1) >= majority(inlier.shape[2])
    # Each of the two has a member that is far off the other's line.
    wrong = options.clearly_wrong_chi_square
    contradicts = (inlier & (square > wrong)[:, None]).any(-1) & (own[:, None] & (judged > wrong)).any(-1)
    ambiguous = (contradicts & (cost < cost[track, best][:, None] + options.decisive)).any(-1)
    return own, enough & ~ambiguous, square
