"""Lines that take the planes of those beside them into account, as far as they are less certain, and how likely they lie in one.

That a line lies in the plane of a neighbour is a measurement of it, with the variance of the neighbour as it was measured, and of
how far lines of this scene lie from the planes of their neighbours (`structure.planes`, `structure.gaps`): one normal after the
other. Which neighbour it is, if any, is not known: the covariance holds that.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from omnilines.adjustment.lines import motion_across
from omnilines.pipelines.parallel_lines import local_charts, stepped_lines
from omnilines.records import Lines
from omnilines.structure.directions import line_directions
from omnilines.structure.families import Families
from omnilines.structure.gaps import learned
from omnilines.structure.options import StructureOptions
from omnilines.structure.planes import PlaneGaps, lines_beside, nearest, plane_normals


def coplanar_lines(
    lines: Lines, track: Int[np.ndarray, " n"], families: Families, options: StructureOptions = StructureOptions()
) -> Lines:
    """The lines after the planes of their neighbours were taken into account; those along no plane as they are. Ends move across
    their line only.

    `families` span the planes. The stretches of one line have the same `track`, and move as one.
    """
    known, of = np.unique(track, return_inverse=True)
    # All before any line moves: what neighbours learn is left out, so that nothing counts twice.
    every = list(_along_planes(lines, track, families, np.ones(len(lines), dtype=bool), options))
    for own in every:
        rows = np.flatnonzero(own.neighbour[:, 0] >= 0)
        share = own.gaps(rows, own.place_m[rows], own.variance_m2[rows]).shares()
        place, by_line, variance = _places(lines, own.line[rows], own.normal)
        seen = own.gaps(rows, place, variance)
        weight, spread = seen.weights(share), seen.spread_m2
        gap = np.broadcast_to(seen.gap_m[..., None], weight.shape)
        assert lines.covariance is not None
        flat = (values.reshape(len(rows), -1) for values in (gap, spread, weight))
        step, covariance = learned(lines.covariance[own.line[rows]], by_line, *flat)
        at = np.full(len(known), -1)
        at[of[own.line[rows]]] = np.arange(len(rows))
        stretches = np.flatnonzero(at[of] >= 0)
        at = at[of[stretches]]
        lines = stepped_lines(lines, stretches, torch.as_tensor(step[at]), torch.as_tensor(covariance[at]))
    return lines


def lying(
    lines: Lines,
    track: Int[np.ndarray, " n"],
    families: Families,
    sure: Bool[np.ndarray, " n"],
    options: StructureOptions = StructureOptions(),
) -> Float[np.ndarray, " n"]:
    """With which probability each line lies in the plane of a `sure` one beside it, of any normal; 0 for those themselves.

    The shares of gaps are those of these lines alone: lines that are less sure lie in planes less often.
    """
    in_plane = np.array(options.planes.gaps) <= options.planes.lying_gap
    known, of = np.unique(track, return_inverse=True)
    nowhere = np.ones(len(known))
    for own in _along_planes(lines, track, families, sure, options):
        rows = np.flatnonzero(~sure[own.line] & (own.neighbour[:, 0] >= 0))
        if len(rows):
            seen = own.gaps(rows, own.place_m[rows], own.variance_m2[rows])
            nowhere[of[own.line[rows]]] *= 1.0 - seen.weights(seen.shares())[..., in_plane].sum((1, 2))
    return np.where(sure, 0.0, 1.0 - nowhere[of])


@dataclass(frozen=True)
class _Along:
    """k lines along the planes of one normal."""

    normal: Float[np.ndarray, "3"]
    line: Int[np.ndarray, " k"]
    """The first stretch of each."""
    place_m: Float[np.ndarray, " k"]
    """Of the middle of each, by the normal."""
    variance_m2: Float[np.ndarray, " k"]
    neighbour: Int[np.ndarray, "k m"]
    """Which of these lines are nearest, -1 where there are fewer."""
    gaps_m: Float[np.ndarray, " c"]

    def gaps(
        self, rows: Int[np.ndarray, " r"], place_m: Float[np.ndarray, " r"], variance_m2: Float[np.ndarray, " r"]
    ) -> PlaneGaps:
        """Of some of them, at the places that are given, to the planes of their neighbours."""
        beside = self.neighbour[rows]
        gap, variance = place_m[:, None] - self.place_m[beside], variance_m2[:, None] + self.variance_m2[beside]
        return PlaneGaps(gap, variance, beside >= 0, self.gaps_m)


def _along_planes(
    lines: Lines, track: Int[np.ndarray, " n"], families: Families, asked: Bool[np.ndarray, " n"], options: StructureOptions
) -> Iterator[_Along]:
    """For each normal the lines along its planes, if they are not too few; neighbours are among the `asked`."""
    own = options.planes
    assert lines.chart_scale_m is not None and lines.covariance is not None
    gaps_m = float(np.median(lines.chart_scale_m)) * np.array(own.gaps)
    _, first = np.unique(track, return_index=True)
    direction, noise = (values.numpy()[first] for values in line_directions(lines))
    for normal in plane_normals(families.direction, options.families.separation_rad, own):
        variance = np.einsum("i,kij,j->k", normal, noise, normal)
        along = np.square(direction @ normal) <= own.along_sigmas**2 * (variance + options.families.tolerance_rad**2)
        along &= variance <= options.families.max_sigma_rad**2
        line = first[along]
        if len(line) < own.min_lines:
            continue
        one, other = lines_beside(lines.ends_m[line], asked[line], own)
        apart = ~_perhaps_one(lines, line, normal, one, other, options)
        place, _, spread = _places(lines, line, normal)
        yield _Along(normal, line, place, spread, nearest(one[apart], other[apart], len(line), own), gaps_m)


def _places(
    lines: Lines, rows: Int[np.ndarray, " k"], normal: Float[np.ndarray, "*k 3"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 4"], Float[np.ndarray, " k"]]:
    """Where the middle of each line lies in a direction, the derivative of that by the line's chart, and its variance."""
    assert lines.chart_centre_m is not None and lines.covariance is not None
    middle = lines.ends_m[rows].mean(1)
    motion = motion_across(local_charts(lines, rows), torch.as_tensor(middle - lines.chart_centre_m[rows])[:, None])
    by_line = (normal[..., None, :] @ motion[:, 0].numpy())[:, 0]
    return (middle * normal).sum(-1), by_line, np.einsum("ki,kij,kj->k", by_line, lines.covariance[rows], by_line)


def _perhaps_one(
    lines: Lines,
    line: Int[np.ndarray, " k"],
    normal: Float[np.ndarray, "3"],
    one: Int[np.ndarray, " n"],
    other: Int[np.ndarray, " n"],
    options: StructureOptions,
) -> Bool[np.ndarray, " n"]:
    """Which pairs are nearly parallel and no farther apart within the plane than is known of them."""
    along = lines.ends_m[line, 1] - lines.ends_m[line, 0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.cross(normal, along)
    _, _, variance = _places(lines, line, across)
    middle = lines.ends_m[line].mean(1)
    gap2 = np.square(((middle[other] - middle[one]) * across[one]).sum(-1))
    parallel = np.linalg.norm(np.cross(along[one], along[other]), axis=-1) <= options.corners.min_sine
    near: Bool[np.ndarray, " n"] = gap2 <= options.planes.same_sigmas**2 * (variance[one] + variance[other])
    return parallel & near
