"""Smooth curves that go on in each other across a gap, joined."""

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from omnilines.extraction.kernels.partner import PartnerLimits, partners
from omnilines.extraction.kernels.smooth import SmoothLimits, smooth_pieces

TIP, BACK = 3, 20
"""Edge points whose mean is an end, and how far back its direction is taken from."""


def joined_pieces(
    points: Float32[np.ndarray, "n 4"],
    pieces: list[Int[np.ndarray, " _"]],
    light: Float[np.ndarray, " k"],
    *,
    smooth: SmoothLimits,
    partner: PartnerLimits,
    rounds: int,
) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, " k1"]]:
    """Pieces, each the numbers of its points in their order along it, where two of them are one smooth curve as one: all points
    one after another, and where each begins (one more than pieces).

    `light` of each: 1 where the brighter side is left of the way along it, else -1.
    """
    for _ in range(rounds):
        if len(pieces) < 2:
            break
        pairs = _pairs(points, pieces, light, partner)
        whole = [np.concatenate([_outwards(pieces, i), _outwards(pieces, j)[::-1]]) for i, j in pairs]
        smooth_ones = _smooth(points, whole, smooth)
        if not smooth_ones.any():
            break
        taken = np.zeros(len(pieces), dtype=bool)
        more, its_light = list[np.ndarray](), list[float]()
        for (i, j), one, good in zip(pairs, whole, smooth_ones, strict=True):
            if good and not taken[i // 2] and not taken[j // 2]:
                taken[[i // 2, j // 2]] = True
                more.append(one)
                its_light.append(float(light[i // 2]) * (1.0 if i % 2 else -1.0))
        pieces = [piece for piece, gone in zip(pieces, taken, strict=True) if not gone] + more
        light = np.concatenate([light[~taken], its_light])
    return _one_after_another(pieces)


def _one_after_another(pieces: list[Int[np.ndarray, " _"]]) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, " k1"]]:
    return np.concatenate([np.zeros(0, dtype=np.int32), *pieces]), np.cumsum([0, *map(len, pieces)])


def _outwards(pieces: list[Int[np.ndarray, " _"]], end: int) -> Int[np.ndarray, " m"]:
    """The points of the piece of an end (its first or its last) in the order that leads out of there."""
    return pieces[end // 2] if end % 2 else pieces[end // 2][::-1]


def _pairs(
    points: Float32[np.ndarray, "n 4"], pieces: list[Int[np.ndarray, " _"]], light: Float[np.ndarray, " k"], limits: PartnerLimits
) -> list[tuple[int, int]]:
    """Ends that go on in each other."""
    place, way, length = [], [], []
    for piece in pieces:
        pixels = points[piece, :2].astype(np.float64)
        back = min(BACK, len(piece) - TIP)
        tips = np.stack([pixels[:TIP].mean(0), pixels[-TIP:].mean(0)])
        inner = np.stack([pixels[back : back + TIP].mean(0), pixels[::-1][back : back + TIP].mean(0)])
        place.append(tips)
        way.append((tips - inner) / np.linalg.norm(tips - inner, axis=-1, keepdims=True))
        length.append(float(np.linalg.norm(tips[1] - tips[0])))
    of_ends = np.stack([-light, light], -1).ravel()
    best = partners(np.concatenate(place), np.concatenate(way), np.array(length), of_ends, limits)
    return [(i, int(j)) for i, j in enumerate(best) if j > i]


def _smooth(
    points: Float32[np.ndarray, "n 4"], whole: list[Int[np.ndarray, " _"]], limits: SmoothLimits
) -> Bool[np.ndarray, " k"]:
    """Which curves stay one piece."""
    order, starts = _one_after_another(whole)
    pieces, _, _ = smooth_pieces(points, order, starts, limits)
    found = {(int(a), int(b)) for a, b in pieces}
    return np.array([(int(a), int(b)) in found for a, b in pairwise(starts)], dtype=bool)
