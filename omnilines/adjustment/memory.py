"""How much memory an adjustment takes, so that one that does not fit is refused before it is built.

For n observations of t lines, F free frames, p pairs of frames with a common line and a band of w sub-diagonals, where the pieces
that the lines are summed in have q blocks together,

    400 MB + n (224 + 230) + t 900 + 288 (3 p + q) + 16 (6 F) (w + 1)   bytes

with the compiled engine: the interpreter with its libraries; arcs, and the engine's copies of them for the cost and for the
whitened equations; charts, factors and covariances of lines; blocks of pairs; the band and its inverse. Arcs that know their
pixels and their images take 208 bytes more. The general path takes its Jacobians and a dense system of k columns,

    400 MB + n (224 + 1700) + t 900 + 48 k^2.
"""

from camera_models import InputError
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.engine_layout import Layout, layout
from omnilines.adjustment.parts import Division, divided
from omnilines.adjustment.problem import LineProblem
from omnilines.least_squares.band import band_width
from omnilines.least_squares.devices import free_bytes
from omnilines.machine import available_bytes

BASE = 400_000_000
ARC, ARC_WITH_PIXELS = 224, 432
ENGINE_ROW, GENERAL_ROW, LINE, PAIR = 230, 1700, 900, 288
MOST_SHARE = 0.9
"""Of the available memory that a problem may take."""
AUTOMATIC = 500
"""Photos of a part where memory asks for parts."""


def arcs_bytes(observations: int, with_pixels: bool) -> int:
    """Of arcs alone."""
    return observations * (ARC_WITH_PIXELS if with_pixels else ARC)


def engine_bytes(*, observations: int, lines: int, free: int, pairs: int, width: int, summed: int) -> int:
    """What the compiled engine adds to the interpreter and the arcs; `summed` blocks are those of all pieces."""
    return observations * ENGINE_ROW + lines * LINE + PAIR * (3 * pairs + summed) + 16 * 6 * free * (width + 1)


def general_bytes(observations: int, lines: int, kept: int) -> int:
    """What the general path adds to the interpreter and the arcs."""
    return observations * GENERAL_ROW + lines * LINE + 48 * kept**2


def require_memory(needed: int, observations: int, lines: int, photos: int, available: int | None = None) -> None:
    """Raise InputError where a problem that still takes `needed` bytes does not fit into what is available, by default here."""
    available = available_bytes() if available is None else available
    if available is None or needed <= MOST_SHARE * available:
        return
    raise InputError(
        f"Memory for {observations:,} observations of {lines:,} lines in {photos:,} photos was expected, about "
        f"{needed / 1e9:.1f} GB, found {available / 1e9:.1f} GB available; adjust parts of the scene one after another or use a "
        "machine with more memory."
    )


def require_for_arcs(observations: int, lines: int, photos: int) -> None:
    """Raise InputError where not even arcs and lines would fit, whatever the photos see together."""
    require_memory(arcs_bytes(observations, with_pixels=True) + lines * LINE, observations, lines, photos)


def laid_out_to_fit(problem: LineProblem, partition: int, divisible: bool) -> tuple[Layout, Division | None]:
    """The layout of the compiled engine, which is small, and the division of the scene into parts of so many photos.

    With a `partition` of 0 there is none, unless the whole does not fit into memory and the problem is `divisible`. Raises
    InputError where what follows does not fit.
    """
    found, arcs = layout(problem), problem.arcs
    pattern = found.pattern
    needed = engine_bytes(
        observations=len(arcs),
        lines=arcs.tracks,
        free=pattern.kept,
        pairs=len(pattern.row),
        width=band_width(pattern, 6),
        summed=sum(last - first for first, last in found.blocks_of_shares),
    )
    division = None
    if partition or (divisible and not _fits(needed)):
        division = divided(problem, found, partition or AUTOMATIC)
    if division is not None:
        needed = arcs.tracks * LINE + max(
            part_bytes(len(part.rows), len(part.tracks), len(part.frames), len(part.shared)) for part in division.parts
        )
    require_memory(needed, len(arcs), arcs.tracks, arcs.images)
    return found, division


def part_bytes(observations: int, lines: int, photos: int, shared: int) -> int:
    """What one part takes at most while it is worked on: as if all its photos were tied to each other."""
    pairs = photos * (photos + 1) // 2
    alone = engine_bytes(observations=observations, lines=lines, free=photos, pairs=pairs, width=6 * photos, summed=pairs)
    return alone + 4 * 8 * 36 * photos * shared


def _fits(needed: int) -> bool:
    available = available_bytes()
    return available is None or needed <= MOST_SHARE * available


def require_for_general(arcs: MatchedArcs, kept: int) -> None:
    """Raise InputError where the general path would not fit."""
    needed, free = general_bytes(len(arcs), arcs.tracks, kept), free_bytes(arcs.bearings.device)
    require_memory(needed, len(arcs), arcs.tracks, arcs.images, free)
