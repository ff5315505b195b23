"""Edges so near to others that no chain of edge points follows them: what one more step in the profiles of an arc explains.

A strip from one to three pixels wide looks like one edge, or like one with a shoulder. Where one more step, at the same distance
all along the arc, explains much of what the known ones leave of the profiles, there is another edge.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models import CameraModel
from omnilines.extraction.arcs import Arcs
from omnilines.extraction.blocks import OFFSETS_PX, Blocks, Profiled, fit_places
from omnilines.extraction.kernels.circle import fit_circles
from omnilines.extraction.kernels.hidden import one_more_step
from omnilines.extraction.kernels.step_edge import MOST_STEPS
from omnilines.extraction.neighbours import FLOOR_PX, SCATTER_PX, WIDE_TAPER_PX
from omnilines.extraction.refit import floor_covariance, moved

CANDIDATES_PX = np.arange(-8, 9) * 0.5
LEAST_APART_PX = 0.7
LEAST_GAIN = 0.4
"""Share of what is unexplained that one more step must explain for an attempt."""
LEAST_RATIO, LEAST_SIGMAS = 0.15, 2.5
"""Its height over that of the arc's own step, and over the noise. Sharpening in the camera leaves fainter steps beside strong
ones, which are no edges."""
LEAST_EVIDENCE = 1000.0
"""Its mean height over the noise, times the information (1/px^2) that its places give on its distance from the arc."""
MOST_UNSTEADY_PX, MOST_SCATTER_PX = 0.7, 0.35
"""Scatter of its places about a constant distance, and about a great circle."""
CLOSE_BLURS = 1.3
"""Steps nearer to each other, in units of the blur, look like one step of another shape: pixels undersample an edge that runs
along them, and blur changes over a photo."""
OTHER_BLURS = np.array([0.85, 1.0, 1.15, 1.3, 1.5, 1.75, 2.0, 2.4])
"""Over the photo's, with which the known steps are tried instead."""
MOST_LEFT, MOST_LEFT_CLOSE = 0.6, 0.35
"""Share of what the known steps leave of the profiles, with the blur that suits them best, that one more step may leave."""
MOST_HIDDEN_PX = 5.0
LEAST_HIDDEN_BLOCKS = 7


@dataclass(frozen=True)
class Hidden:
    """Arcs found beside others."""

    arcs: Arcs
    beside: Int[np.ndarray, " m"]
    """The arc that each was found beside."""


def hidden_arcs(model: CameraModel, known: Profiled, rows: Int[np.ndarray, " k"], blur_px: float, noise: float) -> Hidden:
    """Edges beside some of the arcs that one more step in their profiles shows."""
    rows = rows[np.bincount(known.blocks.owner, known.blocks.whole, len(known.arcs))[rows] >= LEAST_HIDDEN_BLOCKS]
    count = len(rows)
    base, blocks = known.arcs.keep(rows), known.crossed(model, rows)
    place, _, heights, _ = fit_places(blocks, blocks.place, WIDE_TAPER_PX, blur_px)
    weight = np.exp(-0.25 * (OFFSETS_PX / WIDE_TAPER_PX) ** 2)
    gain, square, left = one_more_step(
        blocks.profile,
        OFFSETS_PX,
        weight,
        place,
        blocks.count,
        blocks.starts,
        blocks.whole,
        blur_px,
        CANDIDATES_PX,
        LEAST_APART_PX,
    )
    best = gain.argmax(-1)
    row = np.arange(count)
    height = np.sqrt(square[row, best])
    own = np.sqrt(blocks.mean((heights[:, 0] ** 2).sum(-1)))
    tried = (gain[row, best] > LEAST_GAIN * left) & (height > np.maximum(LEAST_RATIO * own, LEAST_SIGMAS * noise))
    tried &= np.maximum.reduceat(np.append(blocks.count, 0), blocks.starts[:-1]) < MOST_STEPS if count else tried
    kept = np.flatnonzero(tried)
    tried_blocks = replace(blocks, place=place).keep(kept)
    found, edge = _settled(base.keep(kept), tried_blocks, CANDIDATES_PX[best[kept]], blur_px, noise)
    return Hidden(found.keep(edge), rows[kept[edge]])


def _settled(
    arcs: Arcs, blocks: Blocks, offset: Float[np.ndarray, " n"], blur_px: float, noise: float
) -> tuple[Arcs, Bool[np.ndarray, " n"]]:
    """Fit profiles with one more step begun at `offset` from their arc: the arcs of these steps, and whether they are edges."""
    start = np.concatenate([offset[blocks.owner, None], blocks.place[:, :-1]], -1)
    more = replace(blocks, count=blocks.count + 1)
    place, variance, heights, rest = fit_places(more, start, WIDE_TAPER_PX, blur_px)
    shift = place[:, 0].copy()
    weight = 1.0 / (variance + SCATTER_PX**2)
    change, inverse, scatter, used, _ = fit_circles(
        blocks.starts, blocks.angle, blocks.rate, shift, weight, blocks.whole, MOST_HIDDEN_PX
    )
    unsteady = np.sqrt(blocks.mean((shift - blocks.mean(shift)[blocks.owner]) ** 2))
    # Averaged with its sign, so that noise does not count.
    height = np.linalg.norm([blocks.mean(channel.copy()) for channel in heights[:, 0].T], axis=0)
    evidence = np.diff(blocks.starts) * height / noise / (unsteady + SCATTER_PX) ** 2
    own = np.linalg.norm([blocks.mean(channel.copy()) for channel in heights[:, 1].T], axis=0)
    edge = (used >= LEAST_HIDDEN_BLOCKS) & (evidence > LEAST_EVIDENCE) & (height > LEAST_RATIO * own)
    edge &= (unsteady < MOST_UNSTEADY_PX) & (np.sqrt(scatter) < MOST_SCATTER_PX)
    close = np.abs(blocks.mean(shift - place[:, 1])) < CLOSE_BLURS * blur_px
    rows = np.flatnonzero(edge)
    edge[rows] = blocks.mean(rest)[rows] < np.where(close, MOST_LEFT_CLOSE, MOST_LEFT)[rows] * _left_by_other_blurs(
        blocks.keep(rows), blur_px
    )
    floor = floor_covariance(arcs, blocks.owner, blocks.rate, FLOOR_PX)
    return moved(arcs, change, inverse * scatter[:, None, None] + floor), edge


def _left_by_other_blurs(blocks: Blocks, blur_px: float) -> Float[np.ndarray, " n"]:
    """The mean square that the known steps leave of the profiles of each arc, with the blur that suits it best."""
    tried = [blocks.mean(fit_places(blocks, blocks.place, WIDE_TAPER_PX, blur_px * factor, 3)[3]) for factor in OTHER_BLURS]
    return np.min(tried, axis=0)
