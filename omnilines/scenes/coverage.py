"""How much of a pixel each face covers: an A-buffer of 64 samples a pixel (L. Carpenter 1984).

In a pixel a side of a face is a straight line, and so is the line along which two faces change their order in depth; the samples
on one side of a line are the bits of one 64-bit number. What is seen of a face is what its sides leave and no nearer face
covers: a few operations on whole numbers, exact for the samples whatever the faces do.

The samples are a lattice whose projections on the image axes are 64 equidistant values, so that the place of an edge along
an axis is off by less than a hundredth of a pixel.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt64

from omnilines.scenes.viewpoint import Pairs, Viewpoint, in_front

SAMPLES = 64
_STEP = 19
"""Generator of the lattice: sample i lies at (i, 19 i mod 64) / 64."""
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_ROWS = 50_000
"""Lines whose samples are tried at a time."""

_index = np.arange(SAMPLES)
OFFSETS_PX: Float[np.ndarray, "64 2"] = np.stack([_index, _STEP * _index % SAMPLES], -1) / SAMPLES + 0.5 / SAMPLES - 0.5
"""(u, v) of the samples from the centre of the pixel."""
_LINES = np.concatenate([np.ones((1, SAMPLES)), OFFSETS_PX.T]).astype(np.float32)


@dataclass(frozen=True)
class Fragments:
    """What is seen of faces in pixels, one row for each pixel and face that is seen in it."""

    pairs: Pairs
    share: Float[np.ndarray, " m"]
    """Of the pixel's area."""
    offset_px: Float[np.ndarray, "m 2"]
    """Middle of the visible part from the centre of the pixel."""


def fragments(view: Viewpoint, pairs: Pairs, rays: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Fragments:
    """Visible parts of the paired faces in n pixels, whose rays are given at the centre and as changes right and down (n, 3)."""
    linear = np.stack(rays, -1)
    mask = np.full(len(pairs), _ALL)
    for side in range(4):
        mask &= _samples(view.sides[pairs.face, side], linear, pairs.cell)
        kept = mask != 0
        pairs, mask = pairs.keep(kept), mask[kept]
    seen = mask & ~_covered(view, pairs, mask, linear)
    kept = seen != 0
    pairs, seen = pairs.keep(kept), seen[kept]
    count = np.bitwise_count(seen).astype(np.float64)
    bits = np.unpackbits(seen.view(np.uint8).reshape(-1, 8), axis=1, bitorder="little").astype(np.float64)
    return Fragments(pairs, count / SAMPLES, (bits @ OFFSETS_PX) / count[:, None])


def _samples(
    functions: Float[np.ndarray, "m 3"], linear: Float[np.ndarray, "n 3 3"], cell: Int[np.ndarray, " m"]
) -> UInt64[np.ndarray, " m"]:
    """The samples at which linear functions of the ray are at least 0, as bits; the ray is centre + right x + down y."""
    line = np.einsum("mi,mij->mj", functions, linear[cell])
    reach = 0.5 * (np.abs(line[:, 1]) + np.abs(line[:, 2]))
    result = np.where(line[:, 0] >= 0, _ALL, np.uint64(0))
    # The others have the whole pixel on one side.
    cut = np.flatnonzero(np.abs(line[:, 0]) <= reach)
    for start in range(0, len(cut), _ROWS):
        rows = cut[start : start + _ROWS]
        above = line[rows].astype(np.float32) @ _LINES >= 0
        result[rows] = np.packbits(above, axis=1, bitorder="little").view(np.uint64)[:, 0]
    return result


def _covered(
    view: Viewpoint, pairs: Pairs, mask: UInt64[np.ndarray, " m"], linear: Float[np.ndarray, "n 3 3"]
) -> UInt64[np.ndarray, " m"]:
    """Samples of each face that a nearer face in the same pixel covers."""
    covered = np.zeros(len(pairs), dtype=np.uint64)
    counts = np.bincount(pairs.cell)
    # Partners 1, 2, ... rows further on, as long as they are of the same pixel.
    for step in range(1, int(counts.max(initial=0))):
        a = np.flatnonzero(pairs.cell[step:] == pairs.cell[:-step])
        b = a + step
        both = mask[a] & mask[b]
        a, b, both = a[both != 0], b[both != 0], both[both != 0]
        nearer, layers = in_front(view, pairs.face[a], pairs.face[b])
        a_first = _samples(nearer, linear, pairs.cell[a])
        a_first = np.where(layers > 0, _ALL, np.where(layers < 0, np.uint64(0), a_first))
        covered[b] |= both & a_first
        covered[a] |= both & ~a_first
    return covered
