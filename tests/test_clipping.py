"""Where lines begin and end: supported stretches, agreed ends, gaps, and how often a stated end lies beyond the true one."""

import itertools
import math

import numpy as np
import pytest
import torch
from matching_scenes import VIEWS, room

from omnilines.geometry.line import PlueckerLines
from omnilines.structure.clipping import supported_stretches
from omnilines.structure.kernels.clip import SETTLING, agreed, clipped, covered
from omnilines.structure.options import ClippingOptions

SIGMA = 0.01
OPTIONS = ClippingOptions()
AGREE_SIGMA, DRAWN_IN, GAP_SIGMA = OPTIONS.agree_sigmas, OPTIONS.drawn_in_sigmas, OPTIONS.gap_sigmas


def stretches(
    pieces: list[tuple[float, float]], image: list[int] | None = None, least: int = 2, views: int = 2, sigma: float = SIGMA
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and numbers of photos of the stretches of one line; by default every piece is of a photo of its own."""
    low, high = np.ascontiguousarray(np.array(pieces, dtype=np.float64).reshape(-1, 2).T)
    photos = np.arange(len(low)) if image is None else np.array(image)
    found, line, seen = clipped(
        np.array([0, len(low)]),
        low,
        high,
        np.full((len(low), 2), sigma),
        photos,
        np.array([views]),
        ClippingOptions(min_photos_everywhere=least),
    )
    assert bool((line == 0).all())
    return found, seen


def plain_cover(low: np.ndarray, high: np.ndarray, image: np.ndarray, least: int, gap: float) -> list[list[float]]:
    """Between neighbouring ends: how many photos show the middle, and how many show a gap there."""
    cuts = np.unique(np.concatenate([low, high]))
    found: list[list[float]] = []
    for begin, end in itertools.pairwise(cuts):
        middle = 0.5 * (begin + end)
        shown = set(image[(low < middle) & (high > middle)].tolist())
        around = set(image[high < middle].tolist()) & set(image[low > middle].tolist())
        if len(shown) >= max(least, len(around - shown)):
            if found and begin - found[-1][1] <= gap:
                found[-1][1] = end
            else:
                found.append([begin, end])
    return found


@pytest.mark.parametrize("least", [1, 2, 3])
def test_covered_stretches_are_those_of_a_plain_count(least: int) -> None:
    rng = np.random.default_rng(least)
    several = 0
    for _ in range(300):
        count = int(rng.integers(1, 14))
        low = rng.uniform(0.0, 10.0, count)
        high = low + rng.uniform(0.1, 4.0, count)
        image, sigma = rng.integers(0, 6, count), rng.uniform(0.001, 0.2, 2 * count)
        found = covered(low, high, sigma, image, ClippingOptions(min_photos_everywhere=least))
        expected = plain_cover(low, high, image, least, GAP_SIGMA * float(np.median(sigma)))
        np.testing.assert_array_equal(found, np.array(expected).reshape(-1, 2))
        several += len(found) > 1
    assert several > 20


def test_a_gap_that_most_photos_show_is_one() -> None:
    """Doors of a cupboard side by side: five photos see two edges, two have an arc of something else across the gap."""
    across = [(0.0, 1.0), (0.1, 1.1)]
    pieces = [(0.0, 0.4), (0.6, 1.0)] * 5 + across
    image = [k // 2 for k in range(10)] + [5, 6]
    found, views = stretches(pieces, image)
    assert len(found) == 2 and views.tolist() == [7, 7]
    np.testing.assert_allclose(found, [[0.0, 0.4], [0.6, 1.0]], atol=0.03)
    # Hidden in two photos only, it goes on.
    found, views = stretches([(0.0, 0.4), (0.6, 1.0)] * 2 + [(0.0, 1.0)] * 3, [0, 0, 1, 1, 2, 3, 4])
    assert len(found) == 1 and views.tolist() == [5]


def test_ends_agree_where_photos_do() -> None:
    """A weighted mean with its standard deviation; what is hidden or drawn too long does not count."""
    ends, sigma = np.array([1.0, 1.004, 0.998, 0.4, 0.7, 1.3]), np.array([0.01, 0.02, 0.005, 0.01, 0.01, 0.01])
    place, spread = agreed(ends, sigma, np.arange(6), AGREE_SIGMA)
    weight = 1 / sigma[:3] ** 2
    assert place == pytest.approx((ends[:3] * weight).sum() / weight.sum(), rel=1e-12)
    assert spread == pytest.approx(weight.sum() ** -0.5, rel=1e-12)
    assert all(map(math.isnan, agreed(np.array([1.0, 0.5, 0.2]), np.full(3, 0.01), np.arange(3), AGREE_SIGMA)))
    assert math.isnan(agreed(np.array([1.0, 1.0]), np.full(2, 0.01), np.array([4, 4]), AGREE_SIGMA)[0])
    # Two alone farther out are too few where ten agree, and enough where three do.
    for many, expected in ((10, 1.0), (3, 1.5)):
        ends = np.concatenate([np.full(many, 1.0), [1.5, 1.5]])
        assert agreed(ends, np.full(len(ends), 0.01), np.arange(len(ends)), AGREE_SIGMA)[0] == expected
    near, far = 1.0 - 0.9 * AGREE_SIGMA * 0.01 * math.sqrt(2), 1.0 - 1.1 * AGREE_SIGMA * 0.01 * math.sqrt(2)
    assert agreed(np.array([1.0, near]), np.full(2, 0.01), np.arange(2), AGREE_SIGMA)[0] == pytest.approx(0.5 * (1.0 + near))
    assert math.isnan(agreed(np.array([1.0, far]), np.full(2, 0.01), np.arange(2), AGREE_SIGMA)[0])


def plain_agreed(ends: np.ndarray, sigma: np.ndarray, image: np.ndarray) -> tuple[float, float]:
    """From the tables of who agrees with whom."""
    rows = [np.flatnonzero(image == k)[ends[image == k].argmax()] for k in np.unique(image)]
    ends, sigma = ends[rows], sigma[rows]
    apart = np.abs(ends - ends[:, None])
    agree = apart <= AGREE_SIGMA * np.sqrt(sigma[:, None] ** 2 + np.minimum(sigma, sigma[:, None]) ** 2)
    voters = agree.sum(1)
    enough = np.flatnonzero(voters >= max(2, (voters.max() + 1) // 2))
    if not len(enough):
        return math.nan, math.nan
    member = agree[enough[ends[enough].argmax()]]
    for _ in range(SETTLING + 1):
        weight = 1.0 / sigma[member] ** 2
        place, spread = float((weight * ends[member]).sum() / weight.sum()), float(weight.sum() ** -0.5)
        member = np.abs(ends - place) <= AGREE_SIGMA * np.hypot(sigma, spread)
        if member.sum() < 2:
            break
    return place, spread


def test_agreed_ends_are_those_of_a_plain_count() -> None:
    rng = np.random.default_rng(11)
    nowhere = 0
    for _ in range(400):
        count = int(rng.integers(1, 20))
        ends = np.where(rng.random(count) < 0.6, 1.0 + 0.02 * rng.standard_normal(count), rng.uniform(0.0, 1.2, count))
        sigma, image = rng.uniform(0.002, 0.05, count), rng.integers(0, 9, count)
        found, expected = agreed(ends, sigma, image, AGREE_SIGMA), plain_agreed(ends, sigma, image)
        assert found == pytest.approx(expected, rel=1e-12, nan_ok=True)
        nowhere += math.isnan(expected[0])
    assert 20 < nowhere < 200


def test_true_ends_beat_hidden_and_overshooting_ones() -> None:
    found, seen = stretches([(0.0, 1.0), (0.0, 1.0), (0.0, 1.0), (0.3, 0.8), (-0.4, 1.6), (-0.2, 1.3)])
    assert seen.tolist() == [6]
    inward = DRAWN_IN * SIGMA / math.sqrt(3)
    np.testing.assert_allclose(found, [[inward, 1.0 - inward]], atol=1e-12)


def test_ends_of_nobody_are_those_that_enough_photos_show() -> None:
    found, _ = stretches([(0.0, 1.0), (0.2, 1.5), (0.4, 2.0)])
    np.testing.assert_array_equal(found, [[0.2, 1.5]])
    found, _ = stretches([(0.0, 1.0), (0.2, 1.5), (0.4, 2.0)], least=3)
    np.testing.assert_array_equal(found, [[0.4, 1.0]])


def test_gaps_split_and_short_ones_do_not() -> None:
    inward = DRAWN_IN * SIGMA / math.sqrt(3)
    whole = [(0.0, 1.0)] * 3
    found, seen = stretches([*whole, *[(1.5, 2.0)] * 3])
    np.testing.assert_allclose(found, [[inward, 1.0 - inward], [1.5 + inward, 2.0 - inward]], atol=1e-12)
    assert seen.tolist() == [3, 3]
    short = 1.0 + 0.9 * GAP_SIGMA * SIGMA
    found, seen = stretches([*whole, *[(short, 2.0)] * 3])
    np.testing.assert_allclose(found, [[inward, 2.0 - inward]], atol=1e-12)
    assert seen.tolist() == [6]


def test_arcs_broken_by_all_photos_at_one_place_go_on_behind_it() -> None:
    """Nine photos see a line to 1 m; four of them go on to 2 m behind the break, so that the end there is that of five."""
    image = [*range(9), *range(4)]
    found, seen = stretches([*[(0.0, 1.0)] * 9, *[(1.01, 2.0)] * 4], image)
    assert seen.tolist() == [9]
    np.testing.assert_allclose(found, [[2 * SIGMA / math.sqrt(9), 2.0 - 2 * SIGMA / 2]], atol=1e-12)


def test_a_stretch_needs_photos_not_arcs() -> None:
    assert not len(stretches([(0.0, 1.0)] * 4, [3, 3, 3, 3])[0])
    three = [(0.0, 1.0)] * 3
    assert not len(stretches(three, views=4)[0]) and len(stretches(three, views=3)[0]) == 1
    # Four see some of it, two at a time.
    found, seen = stretches([(0.0, 1.0), (0.0, 2.0), (1.0, 3.0), (2.0, 3.0)], views=4)
    assert len(found) == 1 and seen.tolist() == [4]
    assert not len(stretches([(0.0, 1.0), (0.99, 2.0)], least=2, views=3)[0])
    # So short that its ends are not known apart.
    assert not len(stretches([(0.0, 0.02)] * 3)[0])


@pytest.mark.parametrize("hidden", [0.0, 0.4])
@pytest.mark.parametrize("views", [4, 8, 20, 60])
def test_ends_rarely_lie_beyond_the_true_ones(views: int, hidden: float) -> None:
    """Drawn in by two standard deviations, an end is too long in 2.3 percent of cases if its ends are all told from others."""
    rng, trials = np.random.default_rng(views), 1500
    beyond, drawn = 0, []
    for _ in range(trials):
        sigma = rng.uniform(0.5, 2.0, (views, 2)) * 0.005
        low, high = np.ascontiguousarray((np.array([0.0, 1.0]) + sigma * rng.standard_normal((views, 2))).T)
        occluded = rng.random(views) < hidden
        high[occluded] = rng.uniform(0.3, 0.95, int(occluded.sum()))
        found, _, _ = clipped(np.array([0, views]), low, high, sigma, np.arange(views), np.array([2]), OPTIONS)
        assert len(found) == 1
        beyond += int(found[0, 1] > 1.0) + int(found[0, 0] < 0.0)
        drawn.append(found[0, 0])
    assert beyond / (2 * trials) < 0.055
    # What is lost: about two standard deviations of a mean of all ends.
    assert float(np.median(drawn)) < 1.3 * DRAWN_IN * math.sqrt(0.005**2 / views)


def test_lines_keep_their_numbers_and_empty_ones_have_no_stretch() -> None:
    rng = np.random.default_rng(2)
    first = torch.as_tensor(rng.uniform(-1.0, 1.0, (5, 3)))
    lines = PlueckerLines.from_points(first, torch.as_tensor(rng.uniform(-1.0, 1.0, (5, 3))))
    line, image = np.array([3, 1, 3, 1, 3, 1, 4]), np.array([0, 0, 1, 1, 2, 2, 0])
    positions = np.array([[0.0, 1.0], [2.0, 3.0]] * 3 + [[0.0, 1.0]])
    found = supported_stretches(
        lines, line=line, positions_m=positions, sigma_m=np.full((7, 2), SIGMA), image=image, enough_views=np.full(5, 3)
    )
    inward = 2 * SIGMA / math.sqrt(3)
    assert found.line.tolist() == [1, 3] and found.views.tolist() == [3, 3]
    np.testing.assert_allclose(found.positions_m, [[2.0 + inward, 3.0 - inward], [inward, 1.0 - inward]], atol=1e-12)
    ends = torch.as_tensor(found.ends_m)
    for k, own in enumerate(found.line.tolist()):
        assert float(lines[own : own + 1].distance_to(ends[k]).max()) < 1e-12
        at = (ends[k] - lines.foot[own]) @ lines.direction[own]
        np.testing.assert_allclose(at.numpy(), found.positions_m[k], atol=1e-12)
    order = rng.permutation(7)
    shuffled = supported_stretches(
        lines,
        line=line[order],
        positions_m=positions[order],
        sigma_m=np.full((7, 2), SIGMA),
        image=image[order],
        enough_views=np.full(5, 3),
    )
    np.testing.assert_allclose(shuffled.positions_m, found.positions_m, atol=1e-12)
    for lines_of, rows in ((lines, 0), (lines[:0], 0)):
        nothing = supported_stretches(
            lines_of,
            line=np.zeros(rows, dtype=np.int64),
            positions_m=np.zeros((rows, 2)),
            sigma_m=np.zeros((rows, 2)),
            image=np.zeros(rows, dtype=np.int64),
            enough_views=np.full(len(lines_of), 3),
        )
        assert len(nothing.line) == len(nothing.views) == 0 and nothing.ends_m.shape == (0, 2, 3)


@pytest.mark.parametrize("name", list(VIEWS))
def test_arcs_of_a_room_give_its_lines_from_end_to_end(name: str) -> None:
    """The true lines, clipped by noisy arcs: ends within the true ones but for the noise, and most of the length is kept."""
    scene = room(name)
    arcs, truth = scene.arcs(0.3, 1), scene.truth()
    places, sigma, usable = arcs.places(truth, np.arange(len(arcs)), scene.line)
    assert float(usable.mean()) > 0.99
    rows = np.flatnonzero(usable)
    found = supported_stretches(
        truth,
        line=scene.line[rows],
        positions_m=places[rows],
        sigma_m=sigma[rows],
        image=arcs.image[rows],
        enough_views=np.full(len(truth), 4),
    )
    from_foot = torch.einsum("tkx,tx->tk", scene.ends_m - truth.foot[:, None], truth.direction).sort(-1).values.numpy()
    low, high = from_foot[found.line].T
    over = np.maximum(np.maximum(low - found.positions_m[:, 0], found.positions_m[:, 1] - high), 0.0)
    assert float((over > 0).mean()) < 0.2 and float(over.max()) < 0.03
    length = np.bincount(found.line, found.positions_m[:, 1] - found.positions_m[:, 0], len(from_foot))
    seen = np.bincount(np.unique(scene.line * 100 + scene.image) // 100, minlength=len(from_foot)) >= 6
    whole = length[seen] / (from_foot[seen, 1] - from_foot[seen, 0])
    assert float(np.median(whole)) > 0.95 and float((whole > 0.8).mean()) > 0.8
