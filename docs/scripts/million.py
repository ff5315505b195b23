"""What photos up to a million would take: a simulation on paper, from costs that the benchmarks measured.

`docs/scripts/tables.py` writes its table into docs/scaling.md, and a test compares. Nothing here ran at a million photos. What is
measured says where; what is assumed says so.
"""

import math
from dataclasses import dataclass

PHOTOS = (1_000, 10_000, 100_000, 1_000_000)


@dataclass(frozen=True)
class Measured:
    """Costs on one core."""

    extraction_s_a_mpx: float = 0.33
    """docs/scaling.md, arcs: 101 ms for 640x480."""
    lines_s_a_photo: float = 0.033
    """docs/scaling.md, from arcs on at 1,000 photos, each round."""
    parts_s_a_photo: float = 0.00019
    """2,000 photos along a street with 110 arcs each in lines, in parts of 500, each iteration on a busy machine."""
    arcs_a_photo: float = 110.0
    """docs/scaling.md, flats."""
    lines_a_photo: float = 8.4
    """docs/scaling.md, flats."""
    separators_s: tuple[tuple[int, float], ...] = ((3_520, 0.21), (7_112, 0.82))
    """tests/bench/bench_parts.py, photos of a grid of streets, and seconds of the factor of the separators, each iteration."""
    separator_covariances_s: tuple[tuple[int, float], ...] = ((3_520, 3.3), (7_112, 20.6))
    """The same of its covariances, once."""
    sent_bytes_a_photo: float = 6_000.0
    """tests/bench/bench_parts.py, information matrices of all parts, each iteration."""
    arc_bytes: int = 432
    """omnilines/adjustment/memory.py, of an observation in the process that adjusts."""
    found_arc_bytes: int = 150
    """docs/scaling.md, of an arc that a worker sends back."""


@dataclass(frozen=True)
class Assumed:
    """What depends on who does it."""

    megapixels: float = 2.0
    photo_bytes: float = 1e6
    rounds: int = 2
    """Times that arcs are matched and adjusted."""
    iterations: int = 10
    """Of each adjustment."""
    cores: int = 100
    euro_a_core_hour: float = 0.04


def state_bytes(measured: Measured) -> float:
    """Poses (12 numbers) and charts of lines (14) of a photo, sent for both tasks of an iteration, and the charts back once."""
    return 2 * 8 * (12 + 14 * measured.lines_a_photo) + 8 * 14 * measured.lines_a_photo


def row(photos: int, measured: Measured, assumed: Assumed) -> tuple[str, ...]:
    """Of the table."""
    turns = assumed.rounds * assumed.iterations
    extraction = photos * assumed.megapixels * measured.extraction_s_a_mpx / 3600
    lines = photos * assumed.rounds * measured.lines_s_a_photo / 3600
    parts = photos * turns * measured.parts_s_a_photo / 3600
    joined = (turns * _at(photos, measured.separators_s) + _at(photos, measured.separator_covariances_s)) / 3600
    divided = extraction + parts
    read = photos * assumed.photo_bytes
    each_turn = state_bytes(measured) + measured.sent_bytes_a_photo
    sent = photos * (measured.arcs_a_photo * measured.found_arc_bytes + turns * each_turn)
    memory = photos * measured.arcs_a_photo * measured.arc_bytes
    hours = divided / assumed.cores + lines + joined
    euro = assumed.euro_a_core_hour * assumed.cores * hours
    figures = (extraction, lines, parts, joined, read / 1e9, sent / 1e9, memory / 1e9, hours, euro)
    return (f"{photos:,}", *(f"{figure:,.2g}" if figure < 10 else f"{figure:,.0f}" for figure in figures))


def _at(photos: int, found: tuple[tuple[int, float], ...]) -> float:
    """Seconds at so many photos, by the power of the photos that two measurements show."""
    (few, few_s), (many, many_s) = found
    return many_s * (photos / many) ** (math.log(many_s / few_s) / math.log(many / few))


HEADER = (
    "photos", "arcs, core h", "matching and lines, h on one machine", "parts, core h", "separators, h on one core",
    "GB of photos read", "GB sent", "GB of memory where it is adjusted", "hours in all", "euro",
)  # fmt: skip


def rows(measured: Measured = Measured(), assumed: Assumed = Assumed()) -> list[tuple[str, ...]]:
    """Of the table."""
    return [row(photos, measured, assumed) for photos in PHOTOS]
