"""How much earlier one video began than another that was taken at the same time: by how fast what they show moves.

A board that is moved, or cameras that are, make all cameras of a rig see faster and slower motion at the same time. The
correlation of these speeds is highest where the videos are shifted right. How high it becomes by chance is told by how many
independent values two signals with such memory hold (M. S. Bartlett, 1935) and by how many shifts are tried.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import norm

from omnilines.footage.options import FrameOptions


def lead_s(
    first_s: Float[np.ndarray, " n"],
    first_px: Float[np.ndarray, " n"],
    other_s: Float[np.ndarray, " m"],
    other_px: Float[np.ndarray, " m"],
    least_overlap: float,
    significance: float,
) -> float | None:
    """By how much the time in the other video is ahead of that in the first at one instant, from the speed of each frame; 0 where
    no shift by a frame or more is clearly better, None where even the best is no better than chance (`significance`).

    Videos overlap by at least the share `least_overlap` of the shorter.
    """
    step_s = min(_gap_s(first_s), _gap_s(other_s))
    one, two = _resampled(first_s, first_px, step_s), _resampled(other_s, other_px, step_s)
    least = max(4, math.ceil(least_overlap * min(len(one), len(two))))
    shifts = np.arange(least - len(one), len(two) - least + 1)
    found = np.array([_correlation(one, two, int(shift)) for shift in shifts])
    if not len(found) or not np.isfinite(found).any():
        return None
    free = _independent_share(one, two)
    overlap = np.minimum(len(one), len(two) - shifts) - np.maximum(0, -shifts)
    # Fisher's transform: correlations of unrelated signals have about this standard deviation.
    score = np.arctanh(np.clip(np.nan_to_num(found), -0.999999, 0.999999)) * np.sqrt(np.maximum(overlap * free - 3, 0.0))
    best = int(score.argmax())
    if len(shifts) * free * norm.sf(score[best]) > significance:
        return None
    still = np.flatnonzero(np.abs(shifts) <= 1)
    if len(still) and score[best] - score[still].max() < norm.isf(significance):
        return 0.0
    return float(shifts[best]) * step_s


def _gap_s(times_s: Float[np.ndarray, " n"]) -> float:
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else math.inf


def _resampled(times_s: Float[np.ndarray, " n"], speed_px: Float[np.ndarray, " n"], step_s: float) -> Float[np.ndarray, " k"]:
    """The logarithm of the speed in even steps from the beginning of the video: cameras differ by a factor. What is slower than
    the tenth of the median says nothing."""
    if not math.isfinite(step_s) or step_s <= 0:
        return np.zeros(0)
    steps = step_s * np.arange(int(times_s[-1] / step_s) + 1)
    return np.log(np.interp(steps, times_s, speed_px) + 0.1 * float(np.median(speed_px)) + 1e-6)


def _correlation(one: Float[np.ndarray, " n"], two: Float[np.ndarray, " m"], shift: int) -> float:
    """Of one with two moved back by so many steps, where both are."""
    low, high = max(0, -shift), min(len(one), len(two) - shift)
    a, b = one[low:high] - one[low:high].mean(), two[low + shift : high + shift] - two[low + shift : high + shift].mean()
    size = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / size if size > 0 else math.nan


def _independent_share(one: Float[np.ndarray, " n"], two: Float[np.ndarray, " m"]) -> float:
    """Of the values, as a share of all: 1 / (1 + 2 sum of the products of both autocorrelations)."""
    reach = min(len(one), len(two)) // 4
    products = [_correlation(one, one, k) * _correlation(two, two, k) for k in range(1, reach)]
    memory = np.nan_to_num(np.array(products))
    # Beyond the first change of sign it is noise.
    ended = np.flatnonzero(memory <= 0)
    return 1.0 / (1.0 + 2.0 * float(memory[: ended[0] if len(ended) else None].sum()))


def put_together(
    times_s: Sequence[Float[np.ndarray, " _"]], leads_s: Sequence[float], most_gap_share: float = FrameOptions.most_gap_share
) -> list[tuple[int, ...]]:
    """Each frame of the slowest video with the nearest of each other one by time, where that is ahead by so much; from where all
    have begun to where the first of them ends, but for those to which another has none near: it was not recorded."""
    half_s = [0.5 * (_gap_s(own) if len(own) > 1 else 0.0) for own in times_s]
    # No frame of the others then stands in two instants.
    slowest = int(np.argmax(half_s))
    by_first = times_s[slowest] - leads_s[slowest]
    nearest: list[Int[np.ndarray, " n"]] = []
    inside = np.ones(len(by_first), dtype=bool)
    for own, lead, most_s in zip(times_s, leads_s, half_s, strict=True):
        wanted = by_first + lead
        after = np.clip(np.searchsorted(own, wanted), 1, max(len(own) - 1, 1))
        before = after - 1
        later = np.minimum(after, len(own) - 1)
        nearest.append(np.where(np.abs(own[later] - wanted) < np.abs(own[before] - wanted), later, before))
        inside &= (wanted >= own[0] - most_s - 1e-9) & (wanted <= own[-1] + most_s + 1e-9)
        # Half a gap is as far as the phase of another camera goes; a frame that is missing leaves a whole one.
        inside &= np.abs(own[nearest[-1]] - wanted) <= 2 * most_gap_share * most_s + 1e-9
    return [tuple(int(own[k]) for own in nearest) for k in np.flatnonzero(inside)]
