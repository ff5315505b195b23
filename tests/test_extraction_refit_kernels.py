"""The compiled refit of arcs against a plain one: what supports them, profiles across them, their circle, how far they go."""

import functools
import math

import cv2
import numpy as np
import pytest
from scipy.special import ndtr
from test_extraction_kernels import FISHEYE, drawn, some_points

from omnilines.extraction.arcs import Arcs, arcs_of_ends
from omnilines.extraction.curves import samples
from omnilines.extraction.edgels import seen_chains
from omnilines.extraction.kernels.bend import bend_of
from omnilines.extraction.kernels.chain import chains, circles, links
from omnilines.extraction.kernels.circle import (
    EVERY,
    LEAST_SCALE_PX,
    OFF,
    ROUNDS,
    SHARE,
    WEIGHT,
    X,
    Y,
    fill_ways,
    fit_circle,
    own_places,
    scatter_of,
)
from omnilines.extraction.kernels.profile import (
    BLURS_PX,
    OFFSETS_PX,
    along_weights,
    profiles,
    side_weights,
    smoothed,
    step_filters,
    supported,
)
from omnilines.extraction.kernels.reach import CORNER_SAMPLES, last_sample, reach, trim
from omnilines.extraction.kernels.refit import FIGURES, LAGS, LEAST_PART, LEAST_SAMPLES, Filters, Limits, refit_arcs
from omnilines.extraction.kernels.tables import Edgels, Picture, Places, Samples
from omnilines.extraction.options import ExtractionOptions

OPTIONS = ExtractionOptions()
LIMITS = Limits(13.0, OPTIONS.pieces.min_px, OPTIONS.support, OPTIONS.refit)
BLIND = OPTIONS.support.max_blind_px
NONE = np.zeros((0, 1), dtype=np.float32)


def plain_supported(edgels: Edgels, pixel: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Whether one of the edge points at the pixels up to 1 px across is parallel and near enough."""
    height, width = edgels.number.shape
    result = np.zeros(len(pixel), dtype=bool)
    for offset in (0.0, 0.5, -0.5, 1.0, -1.0):
        column, row = np.rint(pixel + offset * across).astype(int).T
        column = column % width if edgels.closed else column
        there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        number = np.where(there, edgels.number[row.clip(0, height - 1), column.clip(0, width - 1)], -1)
        points = edgels.points[number].astype(float)
        apart = points[:, :2] - pixel
        if edgels.closed:
            apart[:, 0] -= width * np.round(apart[:, 0] / width)
        near = np.abs((apart * across).sum(-1)) <= OPTIONS.support.within_px
        result |= (number >= 0) & near & (np.abs((points[:, 2:] * across).sum(-1)) >= OPTIONS.support.min_cosine)
    return result


def plain_smoothed(difference: np.ndarray, usable: np.ndarray) -> np.ndarray:
    weight = along_weights(OPTIONS.refit.along_px).astype(float)
    middle = len(weight) // 2

    def sums(values: np.ndarray) -> np.ndarray:
        return np.convolve(values, weight)[middle : middle + len(values)]

    return np.stack([sums(column * usable) for column in difference.T], -1) / (sums(usable.astype(float)) + 1e-9)[:, None]


def beside(values: np.ndarray, begin: int, step: int, count: int) -> np.ndarray:
    """So many values from one on in a direction, those that there are."""
    return values[[n for n in range(begin, begin + step * count, step) if 0 <= n < len(values)]]


def plain_last(inside: np.ndarray, support: np.ndarray, steady: np.ndarray, seed: int, step: int) -> int:
    """Sample by sample: whether each carries the arc on, and whether the arc may end there."""
    last, gap, core = seed, 0, seed
    for n in range(seed + step, len(inside) if step > 0 else -1, step):
        core = n if inside[n] else core
        within = steady[min(max(core - 4 * step, 0), len(steady) - 1)] if len(steady) else None
        alike = inside[n] or within is None or steady[n] @ within >= 0.4 * within @ within
        if support[n] and alike:
            carries = beside(support, n, -step, 5).sum() >= 3
            last = n if carries else last
        else:
            carries = inside[n] and beside(support, n + step, step, 10).sum() >= 5
        gap = 0 if carries else gap + 1
        if gap > BLIND:
            break
    return last


def plain_ends(inside: np.ndarray, support: np.ndarray, difference: np.ndarray, steady: np.ndarray) -> tuple[float, float]:
    """Where the contrast falls to half at either end, (0, -1) where no sample is supported."""
    rows = np.flatnonzero(inside & support)
    if not len(rows):
        return 0.0, -1.0
    found = []
    for step in (-1, 1):
        last = plain_last(inside, support, steady, rows[(len(rows) - 1) // 2], step)
        inner = min(max(last - 6 * step, 0), len(inside) - 1)
        reference = steady[inner].astype(float)
        half_way = 0.5 * (difference[1:] + difference[:-1]) @ reference / (reference @ reference + 1e-9)
        numbers = [n for n in range(inner + step, last + 4 * step, step) if 0 <= n < len(inside)]
        contrast = [1.0, *(half_way[min(n, n - step)] for n in numbers)]
        low = next((k for k, value in enumerate(contrast) if value < 0.5), None)
        if low is None:
            found.append(inner + step * (len(numbers) + 0.5))
        else:
            share = np.clip((contrast[low - 1] - 0.5) / max(contrast[low - 1] - contrast[low], 1e-9), 0.0, 1.0)
            found.append(numbers[low - 1] - step * (1.5 - share))
    return found[0], found[1]


def plain_trim(residual: np.ndarray, off: np.ndarray, scale: float) -> tuple[int, int]:
    """By means over the samples that are left at an end."""
    tip_px, ends = max(OPTIONS.refit.max_tip_px, math.sqrt(2.0) * scale), [0, len(off) - 1]
    for side, step in ((0, 1), (1, -1)):
        inwards = np.arange(ends[side], ends[1 - side] + step, step)
        first = 0
        while len(inwards) - 1 - first > 5:
            next_five = residual[inwards[first:]][~np.isnan(residual[inwards[first:]])][:5]
            if not len(next_five) or abs(next_five.sum()) <= OPTIONS.refit.max_end_px * len(next_five):
                break
            first += 1
        tips = [k for k in range(first, first + CORNER_SAMPLES) if len(inwards) - 1 - k > 5]
        good = [k for k in tips if abs(off[inwards[k : k + 2]].sum()) <= 2.0 * tip_px]
        ends[side] = int(inwards[good[0] if good else first])
    return ends[0], ends[1]


def runs(rng: np.random.Generator, count: int, length: float) -> np.ndarray:
    """True and false in runs."""
    return np.cumsum(rng.random(count) < 1.0 / length) % 2 == 0


def test_arcs_go_as_far_as_their_edge() -> None:
    """Random runs of support; differences that change along the arc, or turn over."""
    rng = np.random.default_rng(12)
    lost = clipped = 0
    for _ in range(600):
        count = int(rng.integers(20, 90))
        support, inside = runs(rng, count, 8.0) | (rng.random(count) < 0.5), np.zeros(count, dtype=bool)
        inside[slice(*np.sort(rng.integers(0, count, 2)))] = True
        level = np.where(runs(rng, count, 25.0), 1.0, rng.uniform(-1.0, 0.6))[:, None] * rng.normal(0.0, 30.0, 3)
        difference = (level + 4.0 * rng.standard_normal((count, 3))).astype(np.float32)
        steady = smoothed(difference, support, along_weights(OPTIONS.refit.along_px))
        np.testing.assert_allclose(steady, plain_smoothed(difference, support), rtol=1e-4, atol=1e-4)
        for values in (NONE, steady):
            for step in (-1, 1):
                seed = int(rng.integers(0, count))
                assert last_sample(inside, support, values, seed, step, BLIND) == plain_last(inside, support, values, seed, step)
        found, expected = reach(inside, support, difference, steady, BLIND), plain_ends(inside, support, difference, steady)
        np.testing.assert_allclose(found, expected, atol=1e-4)
        lost += found[1] <= found[0] + 1.0
        clipped += found[1] < count - 1.0
    assert 10 < lost < 300 and clipped > 300


def test_arcs_end_where_the_edge_lies_on_their_circle() -> None:
    rng = np.random.default_rng(13)
    trimmed = 0
    for _ in range(600):
        count = int(rng.integers(8, 60))
        off = 0.15 * rng.standard_normal(count)
        off[: rng.integers(0, 9)] += rng.uniform(0.0, 1.0)
        off[count - rng.integers(0, 9) :] += rng.uniform(-1.0, 0.0)
        residual = np.where(rng.random(count) < 0.8, off, np.nan)
        scale = rng.uniform(0.05, 0.4)
        found = trim(residual, off, scale, OPTIONS.refit)
        assert found == plain_trim(residual, off, scale)
        trimmed += found != (0, count - 1)
    assert 200 < trimmed < 600


def lower_median(values: np.ndarray) -> float:
    """Of an even number of values the smaller one of the middle two."""
    return float(np.sort(values)[(len(values) - 1) // 2])


def plain_circle(places: Places, rounds: int, start: tuple[float, float, float] | None = None) -> dict:
    """Iterated least squares by NumPy, with exact medians: change, scale, matrix, variance, places used and what is left."""
    chosen = np.flatnonzero(places.usable & (np.abs(places.shift) < OPTIONS.refit.max_shift_px))
    angle, rate, shift = (column[chosen] for column in (places.angle, places.rate, places.shift))
    design = -rate[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    strength = places.strength[chosen]
    share = strength / (strength + lower_median(strength))
    change, scale = (np.zeros(2), EVERY) if start is None else (np.array(start[:2]), start[2])
    for _ in range(rounds):
        weight = share * np.maximum(1.0 - ((shift - design @ change) / (4.7 * scale)) ** 2, 0.0) ** 2
        change = np.linalg.lstsq(design * np.sqrt(weight)[:, None], shift * np.sqrt(weight), rcond=None)[0]
        left = shift - design @ change
        scale = max(1.4826 * lower_median(np.abs(left)), LEAST_SCALE_PX)
    used = int((weight > 0).sum())
    variance = ((weight * left) ** 2).sum() / weight.sum() * used / max(used - 2, 1)
    matrix = (design * weight[:, None]).T @ design
    return {
        "chosen": chosen, "change": change, "scale": scale, "matrix": matrix, "variance": variance, "used": used, "left": left,
        "weight": weight, "share": share, "design": design, "shift": shift,
    }  # fmt: skip


def some_places(rng: np.random.Generator) -> Places:
    """Places of an edge on an arc, a tenth of them on another edge, some not usable."""
    count = int(rng.integers(20, 120))
    angle = np.linspace(-0.1, 0.1, count)
    shift = 0.3 * rng.standard_normal() + 2.0 * rng.standard_normal() * angle + 0.1 * rng.standard_normal(count)
    shift[rng.random(count) < 0.1] += rng.uniform(0.5, 2.0)
    return Places(angle, rng.uniform(300.0, 500.0, count), shift, rng.uniform(50.0, 400.0, count), rng.random(count) < 0.9)


def test_the_circle_is_that_of_iterated_least_squares() -> None:
    rng = np.random.default_rng(14)
    for _ in range(100):
        places = some_places(rng)
        count = len(places.shift)
        room, ways, chosen = np.empty((6, count)), np.empty((2, count)), np.empty(count, dtype=np.int64)
        fill_ways(places.angle, places.rate, ways)
        used = own_places(places, ways, 0, count, OPTIONS.refit.max_shift_px, room, chosen)
        a, b, scale, *matrix = fit_circle(room, used, 0.0, 0.0, EVERY, ROUNDS)
        plain = plain_circle(places, ROUNDS)
        np.testing.assert_array_equal(chosen[:used], plain["chosen"])
        np.testing.assert_allclose(room[[X, Y], :used].T, plain["design"], rtol=1e-12)
        # The kernel's medians are good to 1e-4 of the largest value.
        np.testing.assert_allclose(room[SHARE, :used], plain["share"], atol=1e-3)
        sigma = np.sqrt(np.diag(np.linalg.inv(plain["matrix"])) * plain["variance"])
        assert (np.abs(np.array([a, b]) - plain["change"]) < 0.02 * sigma).all()
        np.testing.assert_allclose(scale, plain["scale"], rtol=5e-3)
        np.testing.assert_allclose(matrix, plain["matrix"][[0, 0, 1], [0, 1, 1]], rtol=2e-2, atol=1e-3 * np.abs(matrix).max())
        variance, kept = scatter_of(room, used)
        np.testing.assert_allclose(variance, plain["variance"], rtol=2e-2)
        assert abs(kept - plain["used"]) <= 1
        assert ((room[WEIGHT, :used] > 0) == (plain["weight"] > 0)).mean() > 0.98


def plain_bend(places: dict) -> tuple[int, float, float]:
    """Two circles for every part, each by NumPy's least squares."""
    design, shift, root = places["design"], places["shift"], np.sqrt(places["share"])

    def left(rows: slice) -> tuple[np.ndarray, float]:
        change = np.linalg.lstsq(design[rows] * root[rows, None], shift[rows] * root[rows], rcond=None)[0]
        return change, float((places["share"][rows] * (shift[rows] - design[rows] @ change) ** 2).sum())

    count = len(shift)
    parts = {k: left(slice(0, k))[1] + left(slice(k, count))[1] for k in range(LEAST_PART, count - LEAST_PART + 1)}
    best = min(parts, key=lambda k: parts[k])
    ratio = 0.5 * (left(slice(0, count))[1] - parts[best]) * (count - 4) / max(parts[best], 1e-9)
    turn = left(slice(best, count))[0] - left(slice(0, best))[0]
    return best, ratio, abs(float(design[0 if best < count - best else -1] @ turn))


def test_a_bend_is_where_two_circles_leave_least() -> None:
    rng = np.random.default_rng(15)
    for _ in range(40):
        places = some_places(rng)
        third = len(places.shift) // 3
        places.shift[third:] += 8.0 * (places.angle[third:] - places.angle[third])
        plain = plain_circle(places, 1)
        count = len(plain["shift"])
        if count < 2 * LEAST_PART:
            continue
        room = np.empty((6, count))
        room[[X, Y]], room[OFF], room[SHARE] = plain["design"].T, plain["shift"], plain["share"]
        found = bend_of(room, count, LEAST_PART, np.empty((count + 1, 6)))
        np.testing.assert_allclose(found, plain_bend(plain), rtol=1e-5)


def step_left(profile: np.ndarray, blur_px: float) -> float:
    """Weighted squares of a profile that a level, a blurred step and its slope leave, by NumPy's least squares."""
    weight = np.exp(-0.25 * (OFFSETS_PX / OPTIONS.refit.taper_px) ** 2)
    slope = np.exp(-0.5 * (OFFSETS_PX / blur_px) ** 2)
    design = np.stack([np.ones_like(slope), ndtr(OFFSETS_PX / blur_px), slope], -1) * weight[:, None]
    explained = design @ np.linalg.lstsq(design, weight * profile, rcond=None)[0]
    return float(((weight * profile - explained) ** 2).sum())


def plain_refit(picture: Picture, edgels: Edgels, at: Samples, arc: int, low: float, high: float) -> dict | None:
    """The figures of one arc; None where it is lost."""
    rows = slice(at.starts[arc], at.starts[arc + 1])
    angle, rate = at.angle[rows], at.rate[rows]
    grey, imaged = profiles(picture, at.pixel[rows], at.across[rows], OFFSETS_PX)
    support = plain_supported(edgels, at.pixel[rows], at.across[rows]) & at.valid[rows]
    inside = (angle >= low) & (angle <= high)
    known = np.flatnonzero(inside & support)
    if not len(known):
        return None
    middle = known[(len(known) - 1) // 2]
    first, last = (plain_last(inside, support, NONE, middle, step) for step in (-1, 1))
    some = slice(max(first - 3, 0), last + 4)
    grey, inside, support, angle = grey[some], inside[some], (support & imaged)[some], angle[some]
    rates = rate[some]
    difference = grey @ side_weights()
    begin, end = plain_ends(inside, support, difference, plain_smoothed(difference, support))
    if end <= begin + 1.0:
        return None
    here = slice(math.ceil(begin), math.floor(end) + 1)
    grey, support, angle, rate = grey[here], support[here], angle[here], rates[here]
    steady = plain_smoothed(difference[here], support)
    step, strength = np.einsum("nc,nck->nk", steady, grey), (steady**2).sum(-1) + 1e-6
    filters = [step_filters(taper) for taper in (OPTIONS.refit.taper_px, OPTIONS.refit.wide_taper_px)]
    mean = step[support].sum(0)
    blur = int(np.argmin([step_left(mean, blur_px) for blur_px in BLURS_PX]))
    narrow, wide = (Places(angle, rate, step @ one[blur, 0] / strength, strength, support) for one in filters)
    if (support & (np.abs(narrow.shift) < OPTIONS.refit.max_shift_px)).sum() < LEAST_SAMPLES:
        return None
    fit = plain_circle(narrow, ROUNDS)
    residual = np.full(len(angle), np.nan)
    residual[fit["chosen"]] = fit["left"]
    off = narrow.shift + rate * (fit["change"][0] * np.cos(angle) + fit["change"][1] * np.sin(angle))
    ends = plain_trim(residual, off, fit["scale"])
    if fit["used"] < LEAST_SAMPLES or ends[1] - ends[0] + 1 < LIMITS.min_px:
        return None
    place = np.array([begin - here.start if ends[0] == 0 else ends[0] - 0.5, end - here.start])
    place[1] = place[1] if ends[1] == len(angle) - 1 else ends[1] + 0.5
    numbers = np.arange(len(angle))
    # Half a sample beyond the outermost ones at most.
    place = place.clip(-0.5, numbers[-1] + 0.5)
    steps = np.diff(angle)
    angles = (
        np.interp(place, numbers, angle) + np.minimum(place, 0.0) * steps[0] + np.maximum(place - numbers[-1], 0.0) * steps[-1]
    )
    return {
        "used": fit["used"], "length_px": ends[1] - ends[0] + 1, "support": support[ends[0] : ends[1] + 1].mean(),
        "blur_px": BLURS_PX[blur],
        "contrast": math.sqrt(strength[support].sum() / fit["used"]), "rate": rates.mean(), "low": angles[0], "high": angles[1],
        "a": fit["change"][0], "b": fit["change"][1], "variance": fit["variance"], "matrix": fit["matrix"],
        "wide": plain_circle(wide, 2, (*fit["change"], fit["scale"]))["change"], "residual": residual,
    }  # fmt: skip


@functools.cache
def pieces() -> tuple[Picture, Edgels, Arcs]:
    """A photo, its edge points and the pieces of circles along their chains."""
    edgels, cells = some_points("photo", False)
    seen = seen_chains(FISHEYE, edgels.points, *chains(links(edgels, cells, OPTIONS.chains.min_cosine)), 9)
    arcs = arcs_of_ends(*circles(seen, OPTIONS.support.within_px, OPTIONS.chains))
    return Picture(drawn(), 1.0, False), edgels, arcs


def test_samples_are_supported_by_the_edge_points_beside_them() -> None:
    _, edgels, arcs = pieces()
    at = samples(FISHEYE, arcs, 12.0)
    found = supported(edgels, at.pixel, at.across, OPTIONS.support)
    np.testing.assert_array_equal(found, plain_supported(edgels, at.pixel, at.across))
    assert 0.3 < found.mean() < 0.9


@pytest.mark.parametrize("blurred", [False, True])
def test_arcs_of_a_photo_are_refitted_as_plainly(blurred: bool) -> None:
    """Those of a photo, also of one that is more blurred than the one that they were found in."""
    picture, edgels, arcs = pieces()
    if blurred:
        picture = Picture(cv2.GaussianBlur(picture.image, (0, 0), 1.0), 1.0, False)
    at = samples(FISHEYE, arcs, 4.0)
    windows = np.stack([step_filters(taper) for taper in (OPTIONS.refit.taper_px, OPTIONS.refit.wide_taper_px)])
    table, products = np.zeros(len(arcs), dtype=FIGURES), np.zeros((LAGS, 2))
    filters = Filters(windows, along_weights(OPTIONS.refit.along_px))
    refit_arcs(picture, edgels, at, np.stack([arcs.low, arcs.high], -1), LIMITS, filters, table, products)
    plain = [plain_refit(picture, edgels, at, arc, arcs.low[arc], arcs.high[arc]) for arc in range(len(arcs))]
    kept = np.array([one is not None for one in plain])
    assert kept.sum() > 80 and (~kept).sum() > 5
    # Medians and single precision decide a threshold here and there otherwise.
    assert ((table["used"] > 0) != kept).mean() < 0.02
    both = [(table[k], one) for k, one in enumerate(plain) if one is not None and table[k]["used"] > 0]
    same = [(row, one) for row, one in both if row["length_px"] == one["length_px"] and row["blur_px"] == one["blur_px"]]
    assert len(same) > 0.95 * len(both)
    sums = np.zeros((LAGS, 2))
    for row, one in same:
        sigma = np.sqrt(np.diag(np.linalg.inv(one["matrix"])) * one["variance"])
        assert (np.abs([row["a"] - one["a"], row["b"] - one["b"]]) < 0.05 * sigma).all()
        assert (np.abs(np.array([row["wide_a"], row["wide_b"]]) - one["wide"]) < 0.1 * sigma).all()
        assert abs(row["used"] - one["used"]) <= 1 and abs(row["variance"] / one["variance"] - 1.0) < 0.05
        np.testing.assert_allclose([row[name] for name in ("low", "high")], [one["low"], one["high"]], atol=1e-5)
        for name in ("support", "contrast", "rate"):
            np.testing.assert_allclose(row[name], one[name], rtol=2e-2 if name == "contrast" else 1e-6)
        left = one["residual"]
        for lag in range(min(LAGS, len(left))):
            product = left[: len(left) - lag] * left[lag:]
            sums[lag] += np.nansum(product), (~np.isnan(product)).sum()
    np.testing.assert_allclose(products, sums, rtol=0.05, atol=0.05 * sums[0, 0])
