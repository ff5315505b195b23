"""Families of parallel lines against lines drawn with known noise: none in noise, the true ones otherwise, honest uncertainty."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
import torch

from camera_models.errors import InputError
from camera_models.pose import rotation_from_vector
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.pipelines.parallel_lines import guided_lines
from omnilines.records import Lines
from omnilines.structure.directions import across, common_direction, line_directions, squared_distance
from omnilines.structure.families import Families, line_families
from omnilines.structure.options import FamilyOptions

DEGREE = math.pi / 180


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return rotation_from_vector(torch.from_numpy(rng.normal(size=3) * 2)).numpy()


def strayed(directions: np.ndarray, sigma_rad: float, rng: np.random.Generator) -> np.ndarray:
    """Directions turned by a rotation vector across them with this standard deviation in each of its two components."""
    turn = sigma_rad * rng.normal(size=directions.shape)
    turn -= (turn * directions).sum(-1, keepdims=True) * directions
    return np.einsum("nij,nj->ni", rotation_from_vector(torch.from_numpy(turn)).numpy(), directions)


def noisy_lines(directions: np.ndarray, sigma_rad: float, rng: np.random.Generator) -> Lines:
    """Lines of these true directions (either sign) somewhere in a room, each drawn from a covariance of its own in its chart.

    The standard deviations of their chart spread by a factor of three about `sigma_rad`, and are correlated.
    """
    n = len(directions)
    d = torch.from_numpy(directions * rng.choice([-1.0, 1.0], (n, 1)))
    point = torch.from_numpy(rng.uniform(-3, 3, (n, 3)) + 1000.0)
    centre = point + torch.from_numpy(rng.normal(size=(n, 3)) * 2)
    true = PlueckerLines(d, torch.linalg.cross(point, d))
    chart = LineChart.from_lines(true, centre, torch.from_numpy(rng.uniform(1, 4, n)))
    mix = rng.normal(size=(n, 4, 4)) * np.exp(rng.uniform(-1.1, 1.1, (n, 1, 1))) * sigma_rad / 2
    delta = torch.from_numpy((mix @ rng.normal(size=(n, 4, 1)))[..., 0])
    seen = chart.retract(delta).lines()
    middle = seen.closest_point(point)
    half = seen.direction * torch.from_numpy(rng.uniform(0.1, 2, (n, 1)))
    ends = torch.stack([middle - half, middle + half], 1).numpy()
    names, whole = tuple(map(str, range(n))), np.full(n, 5)
    covariance = mix @ mix.transpose(0, 2, 1)
    one = np.ones(n)
    return Lines(names, ends, whole, one, one, ("ok",) * n, covariance, centre.numpy(), chart.scale.numpy())


def test_covariance_of_a_direction_is_that_of_drawn_lines() -> None:
    """Many draws about one line: the scatter of their directions in a fixed frame against what each draw states."""
    rng = np.random.default_rng(3)
    one = noisy_lines(np.array([[0.6, -0.48, 0.64]]), 1e-3, rng)
    # The chart of the one line, from which all are drawn.
    ends, centre, scale = (torch.from_numpy(a) for a in (one.ends_m, one.chart_centre_m, one.chart_scale_m))
    d = torch.nn.functional.normalize(ends[:, 1] - ends[:, 0], dim=-1)
    chart = LineChart.from_lines(PlueckerLines(d, torch.linalg.cross(ends[:, 0], d)), centre, scale)
    root = np.linalg.cholesky(one.covariance[0] + 1e-12 * np.eye(4))
    delta = torch.from_numpy(rng.normal(size=(40_000, 4)) @ root.T)
    drawn = LineChart(*(torch.cat([getattr(chart, name)] * len(delta)) for name in ("centre", "scale", "S", "phi")))
    scatter = np.cov(drawn.retract(delta).lines().direction.numpy().T)
    direction, covariance = line_directions(one)
    np.testing.assert_allclose(direction, d, atol=1e-12)
    np.testing.assert_allclose(covariance[0], scatter, atol=0.03 * np.trace(scatter))
    # The other sign of the direction is another chart with another covariance of the same directions.
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned = replace(one, ends_m=one.ends_m[:, ::-1].copy(), covariance=flip @ one.covariance @ flip)
    np.testing.assert_allclose(line_directions(turned)[1], covariance, atol=1e-9 * np.trace(scatter))


@pytest.mark.parametrize(("count", "sigma_deg"), [(30, 0.2), (150, 0.5), (400, 0.2)])
def test_random_directions_give_no_family(count: int, sigma_deg: float) -> None:
    rng = np.random.default_rng(count)
    scenes = 40
    found = sum(
        len(line_families(noisy_lines(unit(rng.normal(size=(count, 3))), sigma_deg * DEGREE, rng))) for _ in range(scenes)
    )
    assert scenes == 40 and found == 0


@pytest.mark.slow
def test_the_number_of_false_families_is_bounded_as_stated() -> None:
    """With a bound of one false family in each scene of random directions there are some, and not more than that."""
    rng = np.random.default_rng(0)
    counts = []
    for _ in range(100):
        lines = noisy_lines(unit(rng.normal(size=(120, 3))), 0.6 * DEGREE, rng)
        counts.append(len(line_families(lines, FamilyOptions(false_families=1.0, min_members=2))))
    assert 0.02 <= np.mean(counts) <= 1.0


def true_scene(
    rng: np.random.Generator, members: int, alone: int, stray_rad: float, noise_rad: float
) -> tuple[Lines, np.ndarray]:
    """Three families at right angles and lines of random directions, in random order, turned at random; and their true axes."""
    axes = random_rotation(rng).T
    directions = np.concatenate([strayed(np.repeat(axes, members, 0), stray_rad, rng), unit(rng.normal(size=(alone, 3)))])
    return noisy_lines(directions, noise_rad, rng), axes


def matched(families: Families, axes: np.ndarray) -> np.ndarray:
    """The axis of each family."""
    return np.abs(families.direction @ axes.T).argmax(1)


@pytest.mark.parametrize(("tolerance_deg", "noise_deg"), [(0.0, 0.5), (0.3, 0.3), (0.3, 0.05)])
@pytest.mark.slow
def test_three_families_and_their_uncertainty(tolerance_deg: float, noise_deg: float) -> None:
    """Chi-square of the true axes in the stated covariances, and of the angles, against their distributions."""
    rng = np.random.default_rng(int(100 * tolerance_deg + 10 * noise_deg))
    members, alone, trials = 12, 15, 50
    off2, angles, probability, taken = [], [], [], []
    for _ in range(trials):
        lines, axes = true_scene(rng, members, alone, tolerance_deg * DEGREE, noise_deg * DEGREE)
        families = line_families(lines, FamilyOptions(tolerance_rad=tolerance_deg * DEGREE))
        assert len(families) == 3 and sorted(matched(families, axes)) == [0, 1, 2]
        for k, axis in enumerate(matched(families, axes)):
            side = np.sign(families.direction[k] @ axes[axis])
            error = side * axes[axis] - families.direction[k]
            off2.append(error @ np.linalg.pinv(families.covariance[k], rcond=1e-9, hermitian=True) @ error)
            own = np.flatnonzero(families.family == k)
            assert len(own) == families.members[k]
            taken.append([(own // members == axis).sum(), (own >= 3 * members).sum()])
            largest = np.linalg.eigvalsh(families.covariance[k])[-1]
            assert families.sigma_rad[k] == pytest.approx(math.sqrt(largest), rel=1e-9)
        probability += families.probability.tolist()
        angles += [*((math.pi / 2 - families.angle_rad) / families.angle_sigma_rad)]
    assert len(off2) == 3 * trials and len(angles) > 0.97 * 3 * trials
    # chi-square with 2 degrees of freedom has the standard deviation 2.
    assert np.mean(off2) == pytest.approx(2, abs=4 * 2 / math.sqrt(len(off2)))
    assert np.mean(np.array(off2) < -2 * math.log(0.05)) == pytest.approx(0.95, abs=0.06)
    assert np.mean(np.square(angles)) == pytest.approx(1, abs=0.4)
    own, strangers = np.mean(taken, axis=0)
    assert own > 0.99 * members and strangers < 0.1
    if tolerance_deg == 0:
        assert scipy.stats.kstest(probability, "uniform").pvalue > 1e-3
    else:
        assert np.mean(np.array(probability) < 0.01) > (0.9 if noise_deg < 0.1 else 0.2)


def test_families_a_few_degrees_from_a_right_angle_are_not_named_so() -> None:
    rng = np.random.default_rng(1)
    turn = random_rotation(rng)
    axes = np.array([[1.0, 0, 0], [math.sin(0.05), math.cos(0.05), 0], [0, 0, 1.0]]) @ turn.T
    families = line_families(noisy_lines(np.repeat(axes, [20, 15, 10], 0), 0.2 * DEGREE, rng))
    assert families.members.tolist() == [20, 15, 10] and matched(families, axes).tolist() == [0, 1, 2]
    assert families.right_angles.tolist() == [[0, 2], [1, 2]]
    assert families.family.tolist() == [0] * 20 + [1] * 15 + [2] * 10
    np.testing.assert_allclose(families.angle_rad, math.pi / 2, atol=0.01)
    assert families.considered == 45 and families.tolerance_rad == pytest.approx(0.3 * DEGREE)
    assert (families.direction[range(3), np.abs(families.direction).argmax(1)] > 0).all()


def test_lines_beside_a_family_make_no_second_one() -> None:
    rng = np.random.default_rng(2)
    axis = np.array([[0.0, 0.0, 1.0]])
    near = unit(np.array([[0.0, 0.026, 1.0]]))
    directions = np.concatenate([np.repeat(axis, 30, 0), np.repeat(near, 6, 0), unit(rng.normal(size=(20, 3)))])
    lines = noisy_lines(directions, 0.05 * DEGREE, rng)
    assert line_families(lines).members.tolist() == [30]
    split = line_families(lines, FamilyOptions(separation_rad=1 * DEGREE))
    assert split.members.tolist() == [30, 6] and len(split.right_angles) == 0


def test_exact_lines_and_lines_that_cannot_have_a_family() -> None:
    rng = np.random.default_rng(4)
    lines = noisy_lines(np.repeat(np.eye(3), 8, 0), 0.0, rng)
    families = line_families(lines, FamilyOptions(tolerance_rad=0.0))
    assert families.members.tolist() == [8, 8, 8] and len(families.right_angles) == 3
    np.testing.assert_allclose(families.angle_rad, math.pi / 2, atol=1e-9)
    assert (families.probability > 0.5).all()
    # Some without a line, some with a direction that could be any.
    ends, covariance = lines.ends_m.copy(), lines.covariance.copy()
    ends[:3], covariance[8:11] = np.nan, 0.1**2 * np.eye(4)
    covariance[:3] = np.nan
    status = ("behind",) * 3 + ("ok",) * 21
    fewer = line_families(replace(lines, ends_m=ends, covariance=covariance, status=status))
    assert fewer.members.tolist() == [8, 5, 5] and fewer.considered == 18
    assert (fewer.family[:3] == -1).all() and (fewer.family[8:11] == -1).all()
    none = line_families(replace(lines, ends_m=np.full_like(ends, np.nan), covariance=np.full_like(covariance, np.nan)))
    assert len(none) == 0 and none.considered == 0 and (none.family == -1).all() and none.direction.shape == (0, 3)


def test_what_cannot_be_asked_for() -> None:
    lines = noisy_lines(np.eye(3), 0.01, np.random.default_rng(0))
    with pytest.raises(InputError, match="adjust the lines first"):
        line_families(replace(lines, covariance=None))
    with pytest.raises(InputError, match="tolerance of parallel lines from 0 to 10 degrees was expected, found 20"):
        line_families(lines, FamilyOptions(tolerance_rad=20 * DEGREE))
    with pytest.raises(InputError, match="separation of families"):
        line_families(lines, FamilyOptions(separation_rad=2.0))
    with pytest.raises(InputError, match="at least 2 members"):
        line_families(lines, FamilyOptions(min_members=1))
    with pytest.raises(InputError, match="above 0"):
        line_families(lines, FamilyOptions(false_families=0.0))


def test_lines_are_guided_by_the_other_lines_of_their_family() -> None:
    """Each is the most probable line between what was measured of it and the direction of the others, found by another search."""
    rng = np.random.default_rng(11)
    lines = noisy_lines(np.repeat(np.eye(3), [5, 6, 7], 0), 0.05 * DEGREE, rng)
    options = FamilyOptions(tolerance_rad=0.05 * DEGREE)
    families = line_families(lines, options)
    assert families.members.tolist() == [7, 6, 5]
    guided = guided_lines(lines, families)
    d, noise = line_directions(lines)
    for row in (0, 7, 17):
        own = families.family == families.family[row]
        others = torch.from_numpy(np.flatnonzero(own & (np.arange(len(lines)) != row)))
        start = torch.from_numpy(families.direction[families.family[row]])
        u, spread = common_direction(d[others], noise[others], start, options.tolerance_rad)
        line = [torch.from_numpy(a[row][None]) for a in (lines.ends_m, lines.chart_centre_m, lines.chart_scale_m)]
        chart = LineChart.from_lines(PlueckerLines.from_points(line[0][:, 0], line[0][:, 1]), line[1], line[2])
        precision = np.linalg.inv(lines.covariance[row] + 1e-16 * np.eye(4))

        def cost(step: np.ndarray, chart=chart, u=u, spread=spread, precision=precision) -> float:
            moved = chart.retract(torch.from_numpy(step[None])).lines().direction
            e, s, _ = across(moved, spread[None], u, options.tolerance_rad)
            return float(step @ precision @ step + squared_distance(e, s)[0])

        best = scipy.optimize.minimize(
            cost, np.zeros(4), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-9, "maxiter": 4000}
        )
        expected = chart.retract(torch.from_numpy(best.x[None])).lines()
        moved = np.linalg.norm(guided.ends_m[row] - lines.ends_m[row], axis=-1).max()
        off = expected.distance_to(torch.from_numpy(guided.ends_m[row])).max()
        assert float(off) < 0.02 * moved, (row, off, moved)


def test_guided_lines_are_as_far_off_as_stated_and_certain_ones_stay() -> None:
    """Directions that stray by 0.3 degrees, known to about 1 degree, or to a thousandth of one; lines of no family stay too."""
    rng, stray = np.random.default_rng(12), 0.3 * DEGREE
    true = strayed(np.repeat(np.eye(3), 60, 0), stray, rng)
    lines = noisy_lines(true, 0.7 * DEGREE, rng)
    families = line_families(lines)
    guided = guided_lines(lines, families)
    member = families.family >= 0
    assert member.mean() > 0.9
    d, noise = line_directions(guided)
    before, _ = line_directions(lines)
    at = torch.from_numpy(true)
    square = squared_distance(*across(d, noise, at, 0.0)[:2])[member]
    # Chi-square of 2 degrees of freedom has mean 2; 160 of them scatter by 0.16.
    assert 1.4 < float(square.mean()) < 2.6, square.mean()
    error, was = (across(x, noise, at, 0.0)[0][member].square().mean().sqrt() for x in (d, before))
    assert float(error) < 0.6 * float(was) and (guided.sigma_m <= lines.sigma_m * (1 + 1e-9))[member].all()
    np.testing.assert_array_equal(guided.ends_m[~member], lines.ends_m[~member])
    certain = noisy_lines(true, 1e-3 * DEGREE, rng)
    same = guided_lines(certain, line_families(certain))
    assert np.abs(same.ends_m - certain.ends_m).max() < 2e-5
