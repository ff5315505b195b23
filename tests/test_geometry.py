"""Sphere, lines and charts against closed forms, high-precision arithmetic, scipy and autograd."""

import math

import numpy as np
import pytest
import scipy.optimize
import torch

from camera_models.pose import Pose
from omnilines.geometry import sphere
from omnilines.geometry.line import PlueckerLines, segment_ends, weighted_median_by_group
from omnilines.geometry.line_chart import LineChart


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(*shape: int, seed: int) -> torch.Tensor:
    v = normal(*shape, 3, seed=seed)
    return v / v.norm(dim=-1, keepdim=True)


def random_lines(n: int, seed: int) -> tuple[torch.Tensor, PlueckerLines]:
    ends = normal(n, 2, 3, seed=seed)
    return ends, PlueckerLines.from_points(ends[:, 0], ends[:, 1])


# --- sphere


@pytest.mark.parametrize("angle", [1e-12, 1e-7, 0.3, math.pi / 2, 2.5, math.pi - 1e-7])
def test_angle_and_normal_of_an_arc_keep_their_accuracy_at_every_length(angle: float) -> None:
    v1 = np.array([1.0, 0.0, 0.0])
    v2 = np.array([math.cos(angle), 0.0, math.sin(angle)])
    assert sphere.angle_between(v1, v2) == pytest.approx(angle, rel=1e-9)
    np.testing.assert_allclose(sphere.arc_normal(v1, v2), [0, -1, 0], atol=1e-15)


def test_equal_bearings_have_a_zero_normal_and_a_finite_arc() -> None:
    v = unit(4, seed=0)
    assert torch.equal(sphere.arc_normal(v, v), torch.zeros_like(v))
    points = sphere.points_on_arc(v, v, torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64))
    torch.testing.assert_close(points, v[:, None].expand(-1, 3, -1))


def test_points_on_an_arc_lie_on_it_at_equal_angles() -> None:
    v1, v2 = unit(50, seed=1), unit(50, seed=2)
    points = sphere.points_on_arc(v1, v2, torch.linspace(0, 1, 5, dtype=torch.float64))
    torch.testing.assert_close(points[:, 0], v1)
    torch.testing.assert_close(points[:, -1], v2)
    steps = sphere.angle_between(points[:, 1:], points[:, :-1])
    torch.testing.assert_close(steps, sphere.angle_between(v1, v2)[:, None].expand(-1, 4) / 4)
    distance = sphere.distance_to_great_circle(points, sphere.arc_normal(v1, v2)[:, None])
    assert distance.abs().max() < 1e-14


def test_distance_to_a_great_circle_is_the_latitude() -> None:
    latitude = torch.tensor([-1.5, -1e-9, 0.0, 0.2, 1.57], dtype=torch.float64)
    bearings = torch.stack([latitude.cos(), torch.zeros_like(latitude), latitude.sin()], -1)
    pole = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(sphere.distance_to_great_circle(bearings, pole), latitude, rtol=1e-12, atol=0)


# --- lines


def test_a_line_knows_its_points_its_distance_and_its_foot() -> None:
    ends, lines = random_lines(50, seed=5)
    torch.testing.assert_close(lines.direction.norm(dim=-1), torch.ones(50, dtype=torch.float64))
    assert (lines.distance_to(ends[:, 0]) < 1e-13).all() and (lines.distance_to(ends[:, 1]) < 1e-13).all()
    torch.testing.assert_close(lines.moment.norm(dim=-1), lines.foot.norm(dim=-1))
    # The distance from the triangle's area, which uses no Pluecker coordinates.
    a, b = ends[:, 0], ends[:, 1]
    area = ((a * a).sum(-1) * ((b - a) ** 2).sum(-1) - (a * (b - a)).sum(-1) ** 2).sqrt()
    torch.testing.assert_close(lines.moment.norm(dim=-1), area / (b - a).norm(dim=-1))
    along = ((a - lines.foot) * lines.direction).sum(-1)
    torch.testing.assert_close(lines.point_at(along), a)
    torch.testing.assert_close(lines.closest_point(a), a)


def test_two_planes_meet_in_the_line_they_were_put_through() -> None:
    ends, lines = random_lines(40, seed=6)
    camera = normal(2, 40, 3, seed=7)
    n = torch.linalg.cross(ends[:, 0] - camera, ends[:, 1] - camera)
    s = -(n * camera).sum(-1)
    met = PlueckerLines.from_planes(n[0], s[0], n[1], s[1])
    sign = (met.direction * lines.direction).sum(-1, keepdim=True).sign()
    torch.testing.assert_close(met.direction * sign, lines.direction, rtol=0, atol=1e-11)
    torch.testing.assert_close(met.moment * sign, lines.moment, rtol=0, atol=1e-11)


def test_distance_between_lines_is_the_minimum_over_both() -> None:
    _, first = random_lines(6, seed=8)
    _, second = random_lines(6, seed=9)
    checked = 0
    for i in range(6):

        def gap(t: np.ndarray, i: int = i) -> float:
            difference = first[i].point_at(torch.tensor(t[0])) - second[i].point_at(torch.tensor(t[1]))
            return float(difference @ difference)

        best = scipy.optimize.minimize(gap, [0.0, 0.0], tol=1e-14).fun
        assert float(first.distance_between(second)[i]) ** 2 == pytest.approx(best, rel=1e-5, abs=1e-9)
        checked += 1
    assert checked == 6
    offset = torch.linalg.cross(first.direction, unit(6, seed=10))
    parallel = PlueckerLines.through(first.foot + offset + 5 * first.direction, -first.direction)
    torch.testing.assert_close(first.distance_between(parallel), offset.norm(dim=-1))
    torch.testing.assert_close(first.angle_to(parallel), torch.zeros(6, dtype=torch.float64), rtol=0, atol=1e-12)


def test_moving_the_frame_moves_the_points_of_a_line() -> None:
    ends, lines = random_lines(20, seed=11)
    pose = Pose.exp(normal(20, 6, seed=12))
    moved, points = lines.transform(pose), pose.transform(ends)
    assert (moved.distance_to(points[:, 0]) < 1e-13).all() and (moved.distance_to(points[:, 1]) < 1e-13).all()
    torch.testing.assert_close(moved.moment, lines.projection_normal(pose), rtol=0, atol=1e-13)
    expected = torch.linalg.cross(points[:, 0], points[:, 1])
    torch.testing.assert_close(
        expected / expected.norm(dim=-1, keepdim=True), moved.moment / moved.moment.norm(dim=-1, keepdim=True)
    )
    origin = normal(20, 3, seed=13)
    assert (lines.shifted(origin).distance_to(ends[:, 0] - origin) < 1e-13).all()


def test_a_bearing_finds_the_point_it_was_taken_of_and_how_fast_it_moves() -> None:
    ends, lines = random_lines(100, seed=14)
    centre = 2 * normal(100, 3, seed=15)
    bearing = ends[:, 1] - centre
    bearing = bearing / bearing.norm(dim=-1, keepdim=True)
    position, in_front, leverage = lines.position_seen(centre, bearing)
    assert in_front.all()
    torch.testing.assert_close(lines.point_at(position), ends[:, 1], rtol=0, atol=1e-9)
    tangent = torch.linalg.cross(torch.linalg.cross(ends[:, 0] - centre, bearing), bearing)
    tangent = tangent / tangent.norm(dim=-1, keepdim=True)
    step = 1e-7
    forward, _, _ = lines.position_seen(centre, bearing * math.cos(step) + tangent * math.sin(step))
    torch.testing.assert_close((forward - position).abs() / step, leverage, rtol=1e-4, atol=0)
    assert not lines.position_seen(centre, -bearing)[1].any()


def test_end_points_ignore_stray_ends() -> None:
    ends, lines = random_lines(30, seed=16)
    track = torch.arange(30).repeat_interleave(7)
    poses = Pose.exp(2 * normal(210, 6, seed=17))
    # Both orders of the ends; three of seven arcs of every track end somewhere else on the line.
    observed = ends[track].clone()
    wrong = torch.arange(210) % 7 < 3
    observed[wrong, 1] = observed[wrong, 1] + 3 * (observed[wrong, 1] - observed[wrong, 0]) * torch.rand(
        90, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    observed[::2] = observed[::2].flip(1)
    bearings = poses.transform(observed)
    bearings = bearings / bearings.norm(dim=-1, keepdim=True)
    found, positions = segment_ends(lines, poses, bearings, track)
    assert torch.isfinite(positions).all()
    exact = (found - ends).norm(dim=-1).amax(-1) < 1e-8
    # The weight of three of seven arcs exceeds a half in some tracks, where the near cameras are the wrong ones.
    assert exact.sum() >= 20
    behind, positions = segment_ends(lines, poses, -bearings, track)
    assert torch.isnan(behind).all() and torch.isnan(positions).all()


def test_weighted_medians_of_groups_are_those_of_each_group() -> None:
    values, group = normal(300, seed=18), torch.randint(0, 40, (300,), generator=torch.Generator().manual_seed(2))
    group[group == 7] = 8
    found = weighted_median_by_group(values, torch.ones(300, dtype=torch.float64), group, 40)
    expected = [np.median(values[group == g].numpy()) if (group == g).any() else math.nan for g in range(40)]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-15)
    heavy = weighted_median_by_group(
        *torch.tensor([[1.0, 2.0, 9.0], [1.0, 1.0, 3.0]], dtype=torch.float64), torch.zeros(3).long(), 1
    )
    assert heavy.item() == 9.0


# --- the chart


def chart_of(n: int, seed: int) -> tuple[PlueckerLines, LineChart]:
    _, lines = random_lines(n, seed)
    cameras = 3 * normal(n * 5, 3, seed=seed + 1)
    return lines, LineChart.about_cameras(lines, cameras, torch.arange(n).repeat(5))


def test_a_chart_starts_at_45_degrees_with_the_stated_singular_values_and_gives_its_line_back() -> None:
    lines, chart = chart_of(30, seed=20)
    torch.testing.assert_close(chart.phi, torch.full((30,), math.pi / 4, dtype=torch.float64))
    back = chart.lines()
    torch.testing.assert_close(back.direction, lines.direction, rtol=0, atol=1e-13)
    torch.testing.assert_close(back.moment, lines.moment, rtol=0, atol=1e-12)
    distance = lines[torch.arange(30).repeat(5)].distance_to(3 * normal(150, 3, seed=21)).reshape(5, 30)
    torch.testing.assert_close(chart.scale, distance.median(0).values)

    def coordinates(step: torch.Tensor) -> torch.Tensor:
        moved = chart[:1].retract(step)
        return torch.cat(
            [torch.cos(moved.phi)[:, None] * moved.S[:, :, 0], torch.sin(moved.phi)[:, None] * moved.S[:, :, 1]], -1
        )[0]

    singular = torch.linalg.svdvals(torch.func.jacrev(coordinates)(torch.zeros(1, 4, dtype=torch.float64))[:, 0])
    np.testing.assert_allclose(singular.numpy(), [1, 1, 2**-0.5, 2**-0.5], atol=1e-12)


def test_of_two_cameras_equally_far_from_a_line_the_last_one_is_that_of_its_chart() -> None:
    """On any number of threads: torch writes to one place twice in whatever order its threads come there."""
    n = 20_000
    x = torch.arange(n, dtype=torch.float64)
    zero = torch.zeros_like(x)
    lines = PlueckerLines.through(
        torch.stack([x, zero, zero], -1), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(n, 3)
    )
    cameras = torch.cat([torch.stack([x + side, zero, zero], -1) for side in (1.0, -1.0)])
    threads = torch.get_num_threads()
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            chart = LineChart.about_cameras(lines, cameras, torch.arange(n).repeat(2))
            assert torch.equal(chart.centre, cameras[n:])
    finally:
        torch.set_num_threads(threads)


def test_rounding_does_not_choose_the_camera_of_a_chart() -> None:
    """Two cameras beside the median are equally far from it: the last digits of a pose would choose, and with them the chart."""
    n = 200
    lines = PlueckerLines.through(normal(n, 3, seed=31), normal(n, 3, seed=32))
    cameras = normal(2 * n, 3, seed=33)
    chart = LineChart.about_cameras(lines, cameras, torch.arange(n).repeat(2))
    far = lines.distance_to(cameras[:n]) > lines.distance_to(cameras[n:])
    farther = torch.where(far[:, None], cameras[:n], cameras[n:])
    foot = lines.closest_point(farther)
    towards = torch.nn.functional.normalize(farther - foot, dim=-1)
    torch.testing.assert_close(torch.nn.functional.normalize(chart.centre - foot, dim=-1), towards, rtol=0, atol=1e-9)


def test_chart_jacobian_is_that_of_autograd() -> None:
    _, chart = chart_of(10, seed=22)
    chart = chart.retract(0.2 * normal(10, 4, seed=23))

    def coordinates(step: torch.Tensor) -> torch.Tensor:
        lines = chart.retract(step).lines()
        return torch.cat([lines.direction, lines.moment], -1).sum(0)

    expected = torch.func.jacrev(coordinates)(torch.zeros(10, 4, dtype=torch.float64)).transpose(0, 1)
    torch.testing.assert_close(chart.jacobian(), expected, rtol=0, atol=1e-10)


def test_recentring_keeps_the_lines_and_brings_phi_back() -> None:
    _, chart = chart_of(40, seed=24)
    turned = chart.retract(torch.cat([normal(40, 3, seed=25), torch.linspace(-0.78, 0.75, 40, dtype=torch.float64)[:, None]], -1))
    assert turned.needs_recentring.any() and not turned.needs_recentring.all()
    again = turned.recentred()
    assert not again.needs_recentring.any()
    kept = ~turned.needs_recentring
    assert torch.equal(again.centre[kept], turned.centre[kept])
    torch.testing.assert_close(again.phi[~kept], torch.full_like(again.phi[~kept], math.pi / 4))
    torch.testing.assert_close(again.lines().direction, turned.lines().direction, rtol=0, atol=1e-12)
    torch.testing.assert_close(again.lines().moment, turned.lines().moment, rtol=0, atol=1e-10)


def test_a_line_through_the_centre_of_its_chart_stays_finite() -> None:
    _, lines = random_lines(3, seed=26)
    chart = LineChart.from_lines(
        PlueckerLines(lines.direction, torch.zeros(3, 3, dtype=torch.float64)), torch.zeros(3, 3).double(), torch.ones(3).double()
    )
    torch.testing.assert_close(chart.S.mT @ chart.S, torch.eye(3, dtype=torch.float64).expand(3, 3, 3))
    assert torch.equal(chart.phi, torch.zeros(3, dtype=torch.float64))
