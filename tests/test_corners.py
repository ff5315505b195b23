"""Lines that end together against scenes drawn with known gaps: corners where they are, their shares, honest uncertainty."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import torch
from drawn_lines import drawn_lines, square_error, unit

from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.pipelines.cornered_lines import cornered_lines, meeting
from omnilines.records import Lines
from omnilines.structure.corners import Corners, corners_seen, gap_shares
from omnilines.structure.options import CornerOptions

PX_RAD = 1e-3


def seen_from(centres: np.ndarray, segments: np.ndarray) -> tuple[np.ndarray, ...]:
    """Photo, line, end bearings, normal and pixel of the arcs that photos at `centres` show of segments (n 2 3)."""
    image, line = (index.ravel() for index in np.mgrid[: len(centres), : len(segments)])
    ends = unit(segments[line] - centres[image, None])
    return image, line, ends, unit(np.cross(ends[:, 0], ends[:, 1])), np.full(len(line), PX_RAD)


def test_lines_that_end_at_one_point_are_corners_in_the_photos_that_show_it() -> None:
    """A corner of three edges; an edge that goes on beyond it, one that ends 20 px before it, and one that starts in line."""
    corner = np.array([0.0, 0.0, 0.0])
    edges = [[corner, axis] for axis in np.eye(3)]
    beyond = [[-0.7, 0.7, 0.1], [0.7, -0.7, -0.1]]
    before = [[-0.05, -0.05, 0.02], [-0.8, -0.8, 0.32]]
    in_line = [corner, [-1.0, 0.0, 0.0]]
    segments = np.array([*edges, beyond, before, in_line])
    centres = np.array([[2.0, 2.1, 1.0], [2.5, 1.0, 1.5], [1.1, 2.4, 1.9]])
    found = corners_seen(*seen_from(centres, segments))
    assert found.line.tolist() == [[0, 1], [0, 2], [1, 2], [1, 5], [2, 5]] and found.photos.tolist() == [3] * 5
    assert len(corners_seen(*seen_from(centres[:1], segments))) == 0
    assert len(corners_seen(*seen_from(centres, segments), options=CornerOptions(min_photos=4))) == 0
    # One of them ends three pixels, seen from 3 m, elsewhere.
    segments[0, 0] = [0.012, 0.0, 0.0]
    assert found.line[3:].tolist() == corners_seen(*seen_from(centres, segments)).line[1:].tolist()


def test_shares_of_gaps_are_those_that_were_drawn() -> None:
    """Of corners of two photos half meet, of those of three 80 percent; the others pass each other by 3 cm; noise of 2 mm."""
    rng, count = np.random.default_rng(0), 4000
    photos = rng.choice([2, 3, 5], count)
    meet = rng.random(count) < np.where(photos == 2, 0.5, 0.8)
    sigma = rng.uniform(1e-3, 3e-3, count)
    gap = np.where(meet, 0.0, 0.03 * rng.standard_normal(count)) + sigma * rng.standard_normal(count)
    found = gap_shares(gap, sigma**2, photos, 1.0, CornerOptions(most_photos=3))
    assert found.share.shape == (2, 9) and np.unique(found.group[photos == 5]).tolist() == [1]
    np.testing.assert_allclose(found.share.sum(-1), 1.0)
    np.testing.assert_allclose(found.share[:, found.gaps_m <= 1e-3].sum(-1), [0.5, 0.8], atol=0.04)
    np.testing.assert_allclose(found.share[:, found.gaps_m == 0.03].sum(-1), [0.5, 0.2], atol=0.06)
    # A single corner says nearly nothing of others: any gap is nearly as likely as before.
    alone = gap_shares(np.zeros(1), np.full(1, 1e-6), np.full(1, 2), 1.0)
    assert alone.share.max() < 0.6 and alone.share.min() > 0.05


def drawn_pairs(
    gap_m: np.ndarray, sigma_rad: tuple[float, float], rng: np.random.Generator
) -> tuple[Lines, LineChart, np.ndarray]:
    """Pairs of lines (2 k and 2 k + 1) that pass each other by `gap_m` near their ends, each drawn from a covariance of its own,
    of one size for the first and another for the second; the true charts, and the pairs."""
    count = 2 * len(gap_m)
    first, second = unit(rng.normal(size=(2, len(gap_m), 3)))
    second = unit(second - 0.5 * (first * second).sum(-1, keepdims=True) * first)
    corner, side = rng.uniform(-3, 3, (len(gap_m), 3)) + 1000.0, unit(np.cross(first, second))
    d = np.stack([first, second], 1).reshape(-1, 3)
    point = np.stack([corner, corner + gap_m[:, None] * side], 1).reshape(-1, 3)
    sigma, length = np.tile(sigma_rad, len(gap_m)), rng.uniform(0.3, 2, count)
    return *drawn_lines(d, point, length, sigma, rng), np.arange(count).reshape(-1, 2)


@pytest.mark.slow
def test_a_line_goes_to_where_it_is_most_likely_to_meet_the_other() -> None:
    """With one gap that corners may have, against the least sum of squares found by another search."""
    lines, _, pair = drawn_pairs(np.zeros(3), (3e-3, 1e-3), np.random.default_rng(5))
    options = CornerOptions(gaps=(1e-3,))
    found = cornered_lines(lines, np.arange(len(lines)), Corners(pair, np.full(3, 2)), options)
    for row, other in ((0, 1), (3, 2)):
        line, fixed = (
            [torch.as_tensor(a[[k]]) for a in (lines.ends_m, lines.chart_centre_m, lines.chart_scale_m)] for k in (row, other)
        )
        chart, still = (LineChart.from_lines(PlueckerLines.from_points(e[:, 0], e[:, 1]), c, s) for e, c, s in (line, fixed))
        precision = [np.linalg.inv(lines.covariance[k]) for k in (row, other)]

        def cost(step: np.ndarray, chart=chart, still=still, precision=precision) -> float:
            one, two = (c.retract(torch.as_tensor(s[None])).lines() for c, s in ((chart, step[:4]), (still, step[4:])))
            gap = float(one.distance_between(two)[0])
            return sum(s @ p @ s for s, p in zip((step[:4], step[4:]), precision, strict=True)) + (gap / 2e-3) ** 2

        best = scipy.optimize.minimize(
            cost, np.zeros(8), method="Powell", options={"xtol": 1e-6, "ftol": 1e-9, "maxiter": 10_000}
        )
        expected = chart.retract(torch.as_tensor(best.x[None, :4])).lines()
        moved = np.linalg.norm(found.ends_m[row] - lines.ends_m[row], axis=-1).max()
        assert float(expected.distance_to(torch.as_tensor(found.ends_m[row])).max()) < 0.03 * moved
        assert found.sigma_m[row] < lines.sigma_m[row]


@pytest.mark.parametrize(("meeting", "gap_m"), [(1.0, 0.0), (0.75, 0.04), (0.5, 0.3)])
def test_cornered_lines_are_as_far_off_as_stated(meeting: float, gap_m: float) -> None:
    """Lines known to 3 cm or so that end where well known ones do, some of which they only seem to meet."""
    rng, count = np.random.default_rng(7), 400
    meet = rng.random(count) < meeting
    gaps = np.where(meet, 0.0, gap_m * rng.standard_normal(count))
    lines, true, pair = drawn_pairs(gaps, (1e-2, 3e-4), rng)
    found = cornered_lines(lines, np.arange(len(lines)), Corners(pair, np.full(count, 3)))
    before, after = (square_error(one, true) for one in (lines, found))
    # Chi-square of 4 degrees of freedom has mean 4; 800 of them scatter by 0.1, and what is linear is so to a percent or two.
    assert np.mean(before) == pytest.approx(4, abs=0.5) and np.mean(after) == pytest.approx(4, abs=0.5)
    assert np.mean(after[::2] < 9.49) == pytest.approx(0.95, abs=0.03)
    volume = np.linalg.slogdet(found.covariance[::2])[1] - np.linalg.slogdet(lines.covariance[::2])[1]
    assert np.median(volume[meet]) < 2 * math.log(0.5)


def test_lines_meet_others_as_often_as_stated() -> None:
    """The first of each pair may not be there: 60 percent meet the second, the others pass it by 30 cm."""
    rng, count = np.random.default_rng(11), 600
    meet = rng.random(count) < 0.6
    lines, _, pair = drawn_pairs(np.where(meet, 0.0, 0.3 * rng.standard_normal(count)), (5e-4, 1e-4), rng)
    track, sure = np.arange(len(lines)), np.arange(len(lines)) % 2 == 1
    stated = meeting(lines, track, Corners(pair, np.full(count, 2)), sure, CornerOptions())
    assert not stated[sure].any() and stated[::2].mean() == pytest.approx(meet.mean(), abs=0.06)
    likely = stated[::2] > 0.8
    assert likely.sum() > 0.2 * count and meet[likely].mean() > stated[::2][likely].mean() - 0.03
    assert meet[stated[::2] < 0.2].mean() < 0.15
    # Pairs of which both are sure, or neither, say nothing, and what is not in a corner meets nothing.
    assert not meeting(lines, track, Corners(pair, np.full(count, 2)), np.zeros(len(lines), dtype=bool), CornerOptions()).any()
    few = meeting(lines, track, Corners(pair[:50], np.full(50, 2)), sure, CornerOptions())
    assert few[:100:2].any() and not few[100:].any()


def test_lines_without_a_corner_stay_and_parallel_ones_have_none() -> None:
    lines, _, pair = drawn_pairs(np.zeros(20), (1e-2, 1e-3), np.random.default_rng(9))
    found = cornered_lines(lines, np.arange(len(lines)), Corners(pair[:15], np.full(15, 2)))
    np.testing.assert_array_equal(found.ends_m[30:], lines.ends_m[30:])
    np.testing.assert_array_equal(found.covariance[30:], lines.covariance[30:])
    assert not np.array_equal(found.ends_m[:30], lines.ends_m[:30])
    assert (
        cornered_lines(lines, np.arange(len(lines)), Corners(np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)))
        is lines
    )
    # What is a stretch of one of them moves with it: nothing counts twice.
    twins = np.repeat(np.arange(len(lines)), 2)
    twice = replace(
        lines,
        tracks=tuple(map(str, range(2 * len(lines)))),
        status=("ok",) * 2 * len(lines),
        **{
            name: getattr(lines, name)[twins]
            for name in ("ends_m", "views", "rms_px", "sigma_m", "covariance", "chart_centre_m", "chart_scale_m")
        },
    )
    both = cornered_lines(twice, twins, Corners(pair[:15], np.full(15, 2)))
    np.testing.assert_allclose(both.ends_m, found.ends_m[twins], rtol=0, atol=1e-12)
    np.testing.assert_allclose(both.covariance, found.covariance[twins], rtol=0, atol=1e-15)
    ends = lines.ends_m.copy()
    ends[1] = ends[0] + 0.1
    beside = replace(lines, ends_m=ends)
    assert cornered_lines(beside, np.arange(len(beside)), Corners(pair[:1], np.full(1, 2))) is beside
