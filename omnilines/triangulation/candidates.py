"""Lines of pairs of planes of a track, and how far all of its rows lie from them: where a search for its line may start."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.geometry.line import PARALLEL, PlueckerLines
from omnilines.triangulation.averaging import subsets
from omnilines.triangulation.compiled import PairTable
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.residuals import end_bearings

RESIDUALS_AT_ONCE = 1 << 20


def candidate_lines(
    observations: PlaneObservations, rows: Int[Tensor, "g k"], pairs: Int[Tensor, "p 2"]
) -> tuple[PlueckerLines, Float[Tensor, "g p k"]]:
    """The line of each pair of planes, world frame, and sum h^2 of every row from it; infinite where a row faces away or where
    the planes of a pair are parallel."""
    origin = observations.centre[rows].mean(1)
    normal, centre = observations.normal[rows], observations.centre[rows] - origin[:, None]
    s = -(normal * centre).sum(-1)
    first, second = pairs.unbind(-1)
    sine = torch.linalg.cross(normal[:, first], normal[:, second]).norm(dim=-1)
    lines = PlueckerLines.from_planes(normal[:, first], s[:, first], normal[:, second], s[:, second])
    moment = lines.moment[:, :, None] - torch.linalg.cross(centre[:, None], lines.direction[:, :, None])
    along = torch.einsum("gkea,gpka->gpke", end_bearings(observations)[rows], moment)
    if observations.noise is None:
        square = along.square() / moment.square().sum(-1, keepdim=True)
    else:
        square = along.square() / torch.einsum("gkeab,gpka->gpkeb", observations.noise[rows], moment).square().sum(-1)
    total = square.sum(-1)
    wrong = ~torch.isfinite(total) | (sine <= PARALLEL)[..., None]
    if observations.arcs is not None:
        towards = torch.linalg.cross(lines.direction[:, :, None].expand_as(moment), moment)
        wrong = wrong | (torch.einsum("gka,gpka->gpk", observations.arcs[rows].sum(2), towards) <= 0)
    return lines.shifted(-origin[:, None]), torch.where(wrong, torch.inf, total)


def candidate_batches(
    observations: PlaneObservations, rows: Int[Tensor, "g k"], budget: int, seed: int
) -> Iterator[tuple[Int[Tensor, "p 2"], Int[Tensor, "b k"], PlueckerLines, Float[Tensor, "b p k"]]]:
    """The candidates of all tracks, a few tracks at a time: (pairs, rows, lines, sum h^2)."""
    views = rows.shape[1]
    pairs = subsets(views, 2, budget, seed).to(rows.device)
    for some in rows.split(max(1, RESIDUALS_AT_ONCE // (len(pairs) * views))):
        yield (pairs, some, *candidate_lines(observations, some, pairs))


def pair_table(observations: PlaneObservations, budget: int, seed: int) -> PairTable:
    """The pairs of the candidates of all tracks, for the compiled passes."""
    counts = [count for count in observations.counts().unique().tolist() if count >= 2]
    own = [subsets(count, 2, budget, seed).numpy() for count in counts]
    start = np.zeros(max(counts, default=0) + 3, dtype=np.int64)
    start[[count + 1 for count in counts]] = [len(pairs) for pairs in own]
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *own]), np.cumsum(start)
