"""Lines in planes against rooms drawn with known walls: which lines are beside each other, what planes say, how certain it is."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_lines import drawn_lines, square_error

from omnilines.geometry.line_chart import LineChart
from omnilines.pipelines.coplanar_lines import coplanar_lines, lying
from omnilines.records import Lines
from omnilines.structure.families import line_families
from omnilines.structure.gaps import learned, log_density
from omnilines.structure.options import PlaneOptions, StructureOptions
from omnilines.structure.planes import lines_beside, nearest, plane_normals

WALLS, EACH = 12, 24
"""Of each of three normals, and lines on each."""


def drawn_walls(
    off_m: float, share: float, sigma_rad: tuple[float, float], seed: int
) -> tuple[Lines, LineChart, np.ndarray, np.ndarray]:
    """Lines on walls of 3 m, upright and level ones in turn; of each wall one in three is known to `sigma_rad[0]` and `share` of
    these lie off it (normal, `off_m`); the true charts, which are uncertain, and which lie on their wall."""
    rng, count = np.random.default_rng(seed), 3 * WALLS * EACH
    wall = np.repeat(np.arange(3 * WALLS), EACH)
    across, turn = wall % 3, np.arange(count) % 2
    along = (across + 1 + turn) % 3
    place = rng.uniform(0, 3, (count, 3)) + 1000.0 + 20.0 * rng.integers(0, 4, (3 * WALLS, 3))[wall]
    uncertain = np.arange(count) % 3 == 0
    on_wall = ~uncertain | (rng.random(count) >= share)
    walls = 1000.0 + rng.uniform(-40, 40, 3 * WALLS)
    place[np.arange(count), across] = walls[wall] + np.where(on_wall, 0.0, off_m * rng.standard_normal(count))
    sigma, length = np.where(uncertain, *sigma_rad), rng.uniform(0.5, 1.5, count)
    lines, chart = drawn_lines(np.eye(3)[along], place, length, sigma, rng)
    return lines, chart, uncertain, on_wall


def test_what_a_gap_tells_are_the_moments_of_the_mixture() -> None:
    """Against the posterior of one parameter by numerical integration; the other parameters follow by the covariance."""
    rng = np.random.default_rng(3)
    mix = rng.normal(size=(1, 4, 4))
    covariance, h = mix @ mix.transpose(0, 2, 1), rng.normal(size=(1, 4))
    variance = float(h[0] @ covariance[0] @ h[0])
    place, other, share = np.array([0.3, -2.0, 1.1]), np.array([0.05, 0.4, 2.0]), np.array([0.5, 0.3, 0.2])
    spread = variance + other
    weight = share * np.exp(log_density(-place, spread[:, None]))[:, 0]
    weight /= weight.sum()
    step, after = learned(covariance, h, -place[None], spread[None], weight[None])
    x = np.linspace(-30, 30, 200_001)
    posterior = np.exp(-0.5 * x**2 / variance) * sum(
        a / np.sqrt(v) * np.exp(-0.5 * (x - p) ** 2 / v) for a, p, v in zip(share, place, other, strict=True)
    )
    posterior /= posterior.sum()
    mean = (posterior * x).sum()
    assert float(h[0] @ step[0]) == pytest.approx(mean, abs=1e-6)
    assert float(h[0] @ after[0] @ h[0]) == pytest.approx((posterior * (x - mean) ** 2).sum(), rel=1e-6)
    # What is not correlated with the gap stays as it was.
    free = np.linalg.svd((covariance[0] @ h[0])[None])[2][1:]
    np.testing.assert_allclose(free @ step[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(free @ after[0] @ free.T, free @ covariance[0] @ free.T, atol=1e-12)


def test_families_span_the_planes_of_their_pairs() -> None:
    """Three at right angles, one between two of them, one only a degree from another: that spans no plane with it."""
    lines, _, _, _ = drawn_walls(0.0, 0.0, (1e-4, 1e-4), 0)
    families = line_families(lines)
    assert len(families) == 3
    normals = plane_normals(families.direction, np.radians(2))
    np.testing.assert_allclose(np.sort(np.abs(normals @ families.direction.T), 0), [[0, 0, 0], [0, 0, 0], [1, 1, 1]], atol=1e-3)
    axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [np.cos(0.5), np.sin(0.5), 0], [np.cos(0.01), 0, np.sin(0.01)]])
    assert len(plane_normals(axes, np.radians(2))) == len(plane_normals(axes[:4], np.radians(2))) == 4
    assert len(plane_normals(axes, np.radians(2), PlaneOptions(most_families=2))) == 1
    assert len(plane_normals(axes[:4], np.radians(2), PlaneOptions(min_angle_rad=np.radians(89.9)))) == 4
    assert plane_normals(axes[:1], np.radians(2)).shape == (0, 3)


def test_neighbours_are_the_nearest_lines_that_are_asked() -> None:
    rng = np.random.default_rng(2)
    start = rng.uniform(0, 4, (60, 3))
    ends = np.stack([start, start + rng.normal(size=(60, 3))], 1)
    asked = rng.random(60) < 0.7
    points = ends[:, :1] + np.linspace(0, 1, 5)[:, None] * (ends[:, 1:] - ends[:, :1])
    distance = np.linalg.norm(points[:, None, :, None] - points[None, :, None], axis=-1).min((2, 3))
    distance[:, ~asked] = np.inf
    np.fill_diagonal(distance, np.inf)
    one, other = lines_beside(ends, asked)
    table = nearest(one, other, 60)
    np.testing.assert_array_equal(table, np.argsort(distance, 1)[:, :8])
    # Fewer than are looked for, and none at all.
    few = np.arange(60) < 3
    table = nearest(*lines_beside(ends, few), 60)
    assert ((table >= 0).sum(1) == 3 - few).all() and table.max() == 2
    assert (nearest(*lines_beside(ends, np.zeros(60, dtype=bool)), 60) == -1).all()


@pytest.mark.parametrize(("off_m", "share"), [(0.0, 0.0), (0.05, 0.4), (0.5, 0.4)])
def test_coplanar_lines_are_as_far_off_as_stated(off_m: float, share: float) -> None:
    """Two thirds of the lines are known to 0.5 mm or so, the others to 2 cm, some of which lie off their wall."""
    lines, true, uncertain, on_wall = drawn_walls(off_m, share, (1e-2, 3e-4), 7)
    found = coplanar_lines(lines, np.arange(len(lines)), line_families(lines))
    before, after = (square_error(one, true) for one in (lines, found))
    # Chi-square of 4 degrees of freedom has mean 4; 288 of them scatter by 0.17.
    assert np.mean(before[uncertain]) == pytest.approx(4, abs=0.6)
    assert np.mean(after[uncertain]) == pytest.approx(4, abs=0.7) and np.mean(after[~uncertain]) == pytest.approx(4, abs=0.5)
    assert np.mean(after[uncertain] < 9.49) == pytest.approx(0.95, abs=0.04)
    volume = (np.linalg.slogdet(found.covariance)[1] - np.linalg.slogdet(lines.covariance)[1])[uncertain & on_wall]
    assert np.median(volume) < 2 * np.log(0.6)


def test_lines_lie_in_planes_as_often_as_stated() -> None:
    """Half of the lines that may not be there lie on their wall, the others anywhere within half a metre or so."""
    lines, _, unsure, on_wall = drawn_walls(0.5, 0.5, (5e-4, 1e-4), 11)
    stated = lying(lines, np.arange(len(lines)), line_families(lines), ~unsure)
    assert not stated[~unsure].any()
    assert stated[unsure & on_wall].mean() > 0.85 and stated[unsure & ~on_wall].mean() < 0.15
    assert on_wall[unsure & (stated > 0.8)].mean() > 0.95
    # Nothing is beside them that is sure, and no plane where there is but one family.
    assert not lying(lines, np.arange(len(lines)), line_families(lines), np.zeros(len(lines), dtype=bool)).any()
    strict = StructureOptions(planes=PlaneOptions(min_angle_rad=np.radians(90.0)))
    assert not lying(lines, np.arange(len(lines)), line_families(lines), ~unsure, strict).any()
    assert coplanar_lines(lines, np.arange(len(lines)), line_families(lines), strict) is lines


def test_stretches_move_as_one_and_twins_tell_nothing() -> None:
    """What is a stretch of a line moves with it. A line drawn twice is not told by its twin that it is known better."""
    lines, _, uncertain, _ = drawn_walls(0.0, 0.0, (1e-2, 3e-4), 5)
    twins = np.repeat(np.arange(len(lines)), 2)
    columns = ("ends_m", "views", "rms_px", "sigma_m", "covariance", "chart_centre_m", "chart_scale_m")
    twice = replace(
        lines,
        tracks=tuple(map(str, range(2 * len(lines)))),
        status=("ok",) * 2 * len(lines),
        **{name: getattr(lines, name)[twins] for name in columns},
    )
    families = line_families(lines)
    found = coplanar_lines(lines, np.arange(len(lines)), families)
    both = coplanar_lines(twice, twins, families)
    np.testing.assert_allclose(both.ends_m, found.ends_m[twins], rtol=0, atol=1e-12)
    np.testing.assert_allclose(both.covariance, found.covariance[twins], rtol=0, atol=1e-15)
    apart = coplanar_lines(twice, np.arange(len(twice)), line_families(twice))
    assert np.median(apart.sigma_m[::2][uncertain] / found.sigma_m[uncertain]) == pytest.approx(1.0, abs=0.03)
