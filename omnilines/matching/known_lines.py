"""Lines that are known, and which arcs of photos with poses could show them."""

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.asked import AskedLines
from omnilines.matching.kernels.hypothesis import likenesses
from omnilines.matching.kernels.track import near_lines
from omnilines.matching.options import LikenessOptions, MatchingOptions
from omnilines.progress import in_shares, on_all_cores, silent, threads_for
from omnilines.triangulation.residuals import linearise
from omnilines.triangulation.result import Triangulation

PAIRS_AT_ONCE = 1 << 14
"""Of an arc and a line, that a core compares at a time: each takes a kilobyte or two."""


@dataclass(frozen=True)
class KnownLines:
    """l lines of tracks, with what their arcs say of them."""

    track: Int[np.ndarray, " l"]
    """The track of each: those that have a line."""
    chart: LineChart
    covariance: Float[torch.Tensor, "l 4 4"]
    """In the chart."""
    direction: Float[np.ndarray, "l 3"]
    moment: Float[np.ndarray, "l 3"]
    spans: Float[np.ndarray, "l 2"]
    """Positions (m) along each between which its arcs lie."""
    colours: Float[np.ndarray, "l 2 3"]
    """Mean colours on both sides, sides as an arc along the direction has them; NaN where no arc knows."""

    def __len__(self) -> int:
        return len(self.track)

    def rows(self, chosen: Bool[np.ndarray, " l"]) -> "KnownLines":
        """Some of them."""
        table = (self.direction, self.moment, self.spans, self.colours)
        index = torch.as_tensor(chosen)
        return KnownLines(self.track[chosen], self.chart[index], self.covariance[index], *(part[chosen] for part in table))

    def longest(self, most: int) -> "KnownLines":
        """The lines that are known over the longest stretches, `most` of them at most."""
        length = np.where(np.isfinite(self.spans).all(-1), self.spans[:, 1] - self.spans[:, 0], 0.0)
        kept = np.zeros(len(self), dtype=bool)
        kept[np.argsort(-length, kind="stable")[:most]] = True
        return self.rows(kept)

    def and_also(self, more: "KnownLines") -> "KnownLines":
        """These lines, and others after them."""
        chart = LineChart(*(torch.cat([getattr(one.chart, f.name) for one in (self, more)]) for f in fields(LineChart)))
        names = ("direction", "moment", "spans", "colours")
        table = (np.concatenate([getattr(self, name), getattr(more, name)]) for name in names)
        track = np.concatenate([self.track, more.track])
        return KnownLines(track, chart, torch.cat([self.covariance, more.covariance]), *table)

    def shown_near(self, arcs: ViewedArcs, track: Int[np.ndarray, " n"], neighbours: Bool[np.ndarray, "m m"]) -> AskedLines:
        """Of each photo the lines that it or one of its neighbours shows; `track` is that of every arc, -1 for none."""
        place = np.full(max(int(self.track.max(initial=-1)), int(track.max(initial=-1))) + 2, -1)
        place[self.track] = np.arange(len(self))
        return AskedLines.near(neighbours, arcs.image, place[track], len(self))

    def looks_like(
        self, arcs: ViewedArcs, arc: Int[np.ndarray, " k"], line: Int[np.ndarray, " k"], options: LikenessOptions
    ) -> Float[np.ndarray, " k"]:
        """Likeness of the colours beside arcs and lines, in (0, 1]."""
        along = arcs.packed[:, 3:6] - arcs.packed[:, :3]
        return likenesses(self.colours, arcs.colours, line, arc, (along[arc] * self.direction[line]).sum(-1) < 0, options)

    def near(
        self, arcs: ViewedArcs, reach_rad: Float[np.ndarray, " n"], asked: AskedLines | None = None
    ) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """Arcs both ends of which lie within their reach of a line, where the line is known, and the line; of the lines that each
        photo is asked for, or all."""
        of_photos = AskedLines.every(arcs.images, len(self)) if asked is None else asked
        lines = (self.direction, self.moment, self.spans)
        every = np.arange(len(arcs))

        def near(share: int, low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
            """Of the arcs of a share."""
            some, reach = every[low:high], reach_rad[low:high]
            return near_lines(some, arcs.image, arcs.packed, *lines, reach, of_photos.starts, of_photos.lines)

        pairs = np.cumsum(np.diff(of_photos.starts)[arcs.image])
        inner = np.searchsorted(pairs, pairs[-1:] * np.linspace(0.0, 1.0, threads_for(len(arcs)) + 1)[1:-1])
        arc, line = zip(*in_shares(near, [0, *inner.tolist(), len(arcs)]), strict=True)
        return np.concatenate(arc), np.concatenate(line)

    def chi_square(self, arcs: ViewedArcs, arc: Int[np.ndarray, " k"], line: Int[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """h' (1 + J S J')^-1 h of both ends of each arc from a line of covariance S."""
        at = linearise(arcs.tracks(arc, line, len(self)), self.chart)
        covariance = self.covariance[torch.as_tensor(line)]
        spread = torch.eye(2, dtype=torch.float64) + at.jacobian @ covariance @ at.jacobian.mT
        square = (at.residual * torch.linalg.solve(spread, at.residual)).sum(-1)
        return torch.nan_to_num(square, nan=torch.inf).numpy()

    def explaining(
        self, arcs: ViewedArcs, options: MatchingOptions, asked: AskedLines | None = None
    ) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Arcs, lines that explain them to their noise and look like them, how much alike they are, and chi-square; `asked` as in
        `near`."""
        every, its = self.near(arcs, options.explained.reach_px * arcs.px_rad + 5.0 * arcs.packed[:, 12:].max(-1), asked)

        def fitting(at: int) -> tuple[np.ndarray, ...]:
            """Of the pairs from there on."""
            arc, line = every[at : at + PAIRS_AT_ONCE], its[at : at + PAIRS_AT_ONCE]
            square, alike = self.chi_square(arcs, arc, line), self.looks_like(arcs, arc, line, options.likeness)
            fits = (square <= options.explained.max_chi_square) & (alike >= options.likeness.min_likeness)
            return arc[fits], line[fits], alike[fits], square[fits]

        # Few pairs are not worth a thread: photos are placed by some lines each.
        parts = range(0, max(len(every), 1), PAIRS_AT_ONCE)
        found = on_all_cores(fitting, parts, "", silent) if len(parts) > 1 else [fitting(0)]
        arc, line, alike, square = (np.concatenate(column) for column in zip(*found, strict=True))
        return arc, line, alike, square


def most_likely(
    arc: Int[np.ndarray, " k"], alike: Float[np.ndarray, " k"], square: Float[np.ndarray, " k"]
) -> Int[np.ndarray, " m"]:
    """The row with the most likely line of every arc that has any."""
    order = np.lexsort((square - 2.0 * np.log(alike), arc))
    _, first = np.unique(arc[order], return_index=True)
    return order[first]


def known_lines(arcs: ViewedArcs, track: Int[np.ndarray, " n"], lines: Triangulation) -> KnownLines:
    """The lines of those tracks that have one; `track` is that of every arc, -1 for none."""
    known = np.flatnonzero(lines.known.numpy())
    place = np.full(len(lines) + 1, -1)
    place[known] = np.arange(len(known))
    member = np.flatnonzero(place[track] >= 0)
    own = place[track[member]]
    index = torch.as_tensor(known)
    chosen = lines.lines[index]
    direction, moment = chosen.direction.numpy(), chosen.moment.numpy()
    along = arcs.packed[member, 3:6] - arcs.packed[member, :3]
    colours = mean_colours(arcs, member, own, (along * direction[own]).sum(-1) < 0, len(known))
    spans = _spans(chosen, arcs, member, own)
    return KnownLines(known, lines.chart[index], lines.covariance[index], direction, moment, spans, colours)


def _spans(
    lines: PlueckerLines, arcs: ViewedArcs, rows: Int[np.ndarray, " m"], line: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "l 2"]:
    positions, in_front = arcs.positions(lines, rows, line)
    low, high = np.full(len(lines), np.inf), np.full(len(lines), -np.inf)
    np.minimum.at(low, line[in_front], positions[in_front, 0])
    np.maximum.at(high, line[in_front], positions[in_front, 1])
    return np.stack([low, high], -1)


def mean_colours(
    arcs: ViewedArcs, rows: Int[np.ndarray, " m"], line: Int[np.ndarray, " m"], against: Bool[np.ndarray, " m"], count: int
) -> Float[np.ndarray, "l 2 3"]:
    """Colours on both sides of `count` lines: the means of their arcs `rows`, of which some run against their lines."""
    colours = np.where(against[:, None, None], arcs.colours[rows][:, ::-1], arcs.colours[rows])
    there = ~np.isnan(colours)
    total, seen = np.zeros((count, 2, 3)), np.zeros((count, 2, 3))
    np.add.at(total, line, np.where(there, colours, 0.0))
    np.add.at(seen, line, there)
    return np.where(seen > 0, total / np.maximum(seen, 1.0), np.nan)
