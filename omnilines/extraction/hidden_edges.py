"""Edges so near to others that no chain of edge points follows them: what one more step in the profiles of an arc explains.

A strip from one to three pixels wide looks like one edge, or like one with a shoulder. Where one more step, at the same distance
all along the arc, explains much of what the known ones leave of the profiles, there is another edge.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models import CameraModel
from omnilines.extraction.arcs import Arcs
from omnilines.extraction.blocks import OFFSETS_PX, Blocks, Profiled, StepFit, fit_places, window_weights
from omnilines.extraction.kernels.circle import fit_circles
from omnilines.extraction.kernels.hidden import one_more_step
from omnilines.extraction.kernels.step_algebra import MOST_STEPS
from omnilines.extraction.kernels.tables import Places, Stepped, Window
from omnilines.extraction.neighbours import step_fit
from omnilines.extraction.options import HiddenEdgeOptions, NeighbourOptions
from omnilines.extraction.refit import floor_covariance, moved

CANDIDATES_PX = np.arange(-8, 9) * 0.5
"""Places at which a step is looked for."""
OTHER_BLURS = np.array([0.85, 1.5, 2.0]), np.array([1.15, 1.3, 1.75, 2.4])
"""Over the photo's, with which the known steps are tried instead; the latter where one of the former leaves nearly too little."""
_NEARLY = 2.0
"""Times as much as is too little: what is left changes by less from one blur to the next."""
_ROUNDS = 2
"""Of a fit with another blur, which begins where that with the photo's ended."""


@dataclass(frozen=True)
class Hidden:
    """Arcs found beside others."""

    arcs: Arcs
    beside: Int[np.ndarray, " m"]
    """The arc that each was found beside."""


def hidden_arcs(
    model: CameraModel,
    known: Profiled,
    rows: Int[np.ndarray, " k"],
    blur_px: float,
    noise: float,
    *,
    options: HiddenEdgeOptions,
    neighbours: NeighbourOptions,
) -> Hidden:
    """Edges beside some of the arcs that one more step in their profiles shows."""
    rows = rows[np.bincount(known.blocks.owner, known.blocks.whole, len(known.arcs))[rows] >= options.min_blocks]
    count = len(rows)
    base, blocks = known.arcs.keep(rows), known.crossed(model, rows, neighbours.min_cosine)
    fit = step_fit(neighbours, neighbours.wide_taper_px, blur_px)
    place, _, heights, rest = fit_places(blocks, blocks.place, fit)
    gain, square, left = one_more_step(
        Stepped(blocks.profile, place, blocks.count),
        blocks.starts,
        blocks.whole,
        window=Window(0, OFFSETS_PX, window_weights(fit.taper_px)),
        blur=blur_px,
        candidates=CANDIDATES_PX,
        min_apart_px=options.min_apart_px,
    )
    best = gain.argmax(-1)
    row = np.arange(count)
    height = np.sqrt(square[row, best])
    own = np.sqrt(blocks.mean((heights[:, 0] ** 2).sum(-1)))
    least = np.maximum(options.min_height_share * own, options.min_sigmas * noise)
    tried = (gain[row, best] > options.min_gain * left) & (height > least)
    tried &= np.maximum.reduceat(np.append(blocks.count, 0), blocks.starts[:-1]) < MOST_STEPS if count else tried
    kept = np.flatnonzero(tried)
    tried_blocks = replace(blocks, place=place).keep(kept)
    offset = CANDIDATES_PX[best[kept]]
    left = blocks.mean(rest)[kept]
    found, edge = _settled(base.keep(kept), tried_blocks, offset, left, fit, noise=noise, options=options, neighbours=neighbours)
    return Hidden(found.keep(edge), rows[kept[edge]])


def _settled(
    arcs: Arcs,
    blocks: Blocks,
    offset: Float[np.ndarray, " n"],
    left: Float[np.ndarray, " n"],
    fit: StepFit,
    *,
    noise: float,
    options: HiddenEdgeOptions,
    neighbours: NeighbourOptions,
) -> tuple[Arcs, Bool[np.ndarray, " n"]]:
    """Fit profiles with one more step begun at `offset` from their arc: the arcs of these steps, and whether they are edges. The
    known steps leave a mean square of `left` with the photo's blur."""
    start = np.concatenate([offset[blocks.owner, None], blocks.place[:, :-1]], -1)
    more = replace(blocks, count=blocks.count + 1)
    place, variance, heights, rest = fit_places(more, start, fit)
    shift = place[:, 0].copy()
    weight = 1.0 / (variance + neighbours.scatter_px**2)
    places = Places(blocks.angle, blocks.rate, shift, weight, blocks.whole)
    change, inverse, scatter, used, _ = fit_circles(blocks.starts, places, options.max_off_px)
    unsteady = np.sqrt(blocks.mean((shift - blocks.mean(shift)[blocks.owner]) ** 2))
    # Averaged with its sign, so that noise does not count.
    height = np.linalg.norm([blocks.mean(channel.copy()) for channel in heights[:, 0].T], axis=0)
    evidence = np.diff(blocks.starts) * height / noise / (unsteady + neighbours.scatter_px) ** 2
    own = np.linalg.norm([blocks.mean(channel.copy()) for channel in heights[:, 1].T], axis=0)
    edge = (used >= options.min_blocks) & (evidence > options.min_evidence) & (height > options.min_height_share * own)
    edge &= (unsteady < options.max_unsteady_px) & (np.sqrt(scatter) < options.max_scatter_px)
    close = np.abs(blocks.mean(shift - place[:, 1])) < options.close_blurs * fit.blur_px
    least = blocks.mean(rest) / np.where(close, options.max_left_close, options.max_left)
    edge &= left > least
    rows = np.flatnonzero(edge)
    edge[rows] = _left_by_other_blurs(blocks.keep(rows), least[rows], fit)
    floor = floor_covariance(arcs, blocks.owner, blocks.rate, neighbours.floor_px)
    return moved(arcs, change, inverse * scatter[:, None, None] + floor), edge


def _left_by_other_blurs(blocks: Blocks, least: Float[np.ndarray, " n"], fit: StepFit) -> Bool[np.ndarray, " n"]:
    """Whether the known steps leave a mean square of more than `least` of the profiles of each arc, whatever the blur."""
    rows, least_left = np.arange(blocks.arcs), np.full(blocks.arcs, np.inf)
    for factors in OTHER_BLURS:
        for factor in factors:
            left = blocks.mean(fit_places(blocks, blocks.place, replace(fit, blur_px=fit.blur_px * factor, rounds=_ROUNDS))[3])
            least_left[rows] = np.minimum(least_left[rows], left)
            more = np.flatnonzero(left > least[rows])
            rows, blocks = rows[more], blocks.keep(more)
        near = np.flatnonzero(least_left[rows] <= _NEARLY * least[rows])
        rows, blocks = rows[near], blocks.keep(near)
    result: Bool[np.ndarray, " n"] = least_left > least
    return result
