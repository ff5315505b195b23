"""Maximum likelihood and end points: exactness, derivatives and the Cramer-Rao bound."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from triangulation_scenes import (
    METHODS,
    SCENES,
    LineSet,
    circle,
    deviations,
    generator,
    normal,
    observe,
    room,
    square_error,
    unit,
    upright,
)

from camera_models.errors import InputError
from camera_models.pose import Pose, hat
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Outcome
from omnilines.pipelines.adjust import adjust, segments_of_arrays
from omnilines.pipelines.options import OF_TABLES
from omnilines.triangulation import triangulate
from omnilines.triangulation.dual import frames_and_lines
from omnilines.triangulation.likelihood import refine
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.residuals import chart_of, end_distances, line_covariance, linearise

# --- exact data


@pytest.mark.parametrize("shift_m", [0.0, 1e4])
@pytest.mark.parametrize("method", METHODS)
def test_noise_free_lines_are_exact_wherever_the_world_origin_is(method: str, shift_m: float) -> None:
    """Lines anywhere, through the origin, and in the axes; direction to 1e-9, distance to 1e-9 of the scene's size of 5 m."""
    ends = 3 * normal(50, 2, 3, seed=41)
    ends[:10, 1] = -0.6 * ends[:10, 0]
    ends[10:13] = torch.eye(3, dtype=torch.float64)[:, None] * torch.tensor([-1.0, 2.0], dtype=torch.float64)[:, None]
    counts = torch.tensor([2, 3, 4, 8, 11]).repeat(10)
    track = torch.arange(50).repeat_interleave(counts)
    centres = 5 * normal(len(track), 3, seed=42)
    shift = shift_m * torch.tensor([1.0, -0.4, 0.3], dtype=torch.float64)
    # The arcs are those of the scene in place: rounding of shifted points is no concern of the triangulation.
    observations = replace(observe(ends, centres, track), centre=centres + shift)
    result = triangulate(method, observations)
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    assert bool(result.known.all()), result.status_names
    assert float(truth.angle_to(result.lines).max()) < 1e-9
    assert float(square_error(result, ends + shift).max().sqrt()) < 5e-9
    error = result.ends_m - shift
    nearest = torch.minimum((error - ends).norm(dim=-1).amax(-1), (error - ends.flip(1)).norm(dim=-1).amax(-1))
    assert float(nearest.max()) < 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_a_line_a_million_metres_away_keeps_its_direction_and_is_named(method: str) -> None:
    centres = 4 * normal(8, 3, seed=8)
    ends = torch.tensor([[[1e6, 0.0, 0.0], [1e6, 2e5, 3e5]]], dtype=torch.float64)
    observations = observe(ends, centres, torch.zeros(8, dtype=torch.int64))
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    result = triangulate(method, observations)
    assert result.status_names == ("weak",) and float(truth.angle_to(result.lines)) < 1e-9
    # The covariance says the same: nothing about the distance that half a pixel would leave.
    assert float(result.covariance[0, 3, 3].sqrt()) < 1e-3
    assert triangulate(method, observations, sigma_rad=3e-4).status_names == ("at_infinity",)


def test_a_track_that_stalls_or_degenerates_does_not_touch_the_others() -> None:
    ends = 3 * normal(6, 2, 3, seed=43)
    track = torch.arange(6).repeat_interleave(8)
    centres = 5 * normal(48, 3, seed=44)
    # Track 0 has a camera on its line, track 1 cameras in one plane with it.
    centres[0] = 0.3 * ends[0, 0] + 0.7 * ends[0, 1]
    weights = torch.rand(8, 2, generator=generator(45), dtype=torch.float64)
    centres[8:16] = ends[1, 0] + weights[:, :1] * (ends[1, 1] - ends[1, 0]) + 4 * weights[:, 1:] * normal(1, 3, seed=46)
    arcs = unit(ends[track] - centres[:, None])
    arcs[0] = unit(torch.stack([ends[0, 1] - centres[0], ends[0, 1] - centres[0] + 0.1]))
    noisy = unit(arcs + 3e-4 * normal(*arcs.shape, seed=47))
    observations = PlaneObservations.from_arcs(noisy, upright(centres), track, 6)
    joint = triangulate("ml", observations)
    assert joint.status_names[1] == "epipolar" and set(joint.status_names[2:]) == {"ok"}
    alone = triangulate("ml", observations.of_tracks(torch.arange(2, 6))[0])
    torch.testing.assert_close(joint.lines[2:].moment, alone.lines.moment, rtol=0, atol=1e-9)


# --- derivatives


def noisy_rows(seed: int, with_noise: bool) -> tuple[PlaneObservations, LineChart]:
    ends, track = normal(5, 2, 3, seed=seed), torch.arange(5).repeat_interleave(4)
    centres = 4 * normal(20, 3, seed=seed + 1)
    poses = Pose.exp(torch.cat([normal(20, 3, seed=seed + 2), centres], -1))
    rays = unit(poses.transform(ends[track]) + 0.1 * normal(20, 2, 3, seed=seed + 3))
    by_pixel = covariance = None
    if with_noise:
        by_pixel = hat(rays) @ normal(20, 2, 3, 2, seed=seed + 4)
        root = normal(20, 2, 2, 2, seed=seed + 5)
        covariance = root @ root.mT + 0.1 * torch.eye(2, dtype=torch.float64)
    observations = PlaneObservations.from_arcs(rays, poses, track, 5, by_pixel, covariance_px2=covariance)
    return observations, chart_of(observations, PlueckerLines.from_points(ends[:, 0], ends[:, 1]))


@pytest.mark.parametrize("with_noise", [False, True])
def test_the_derivative_holds_that_of_the_denominator(with_noise: bool) -> None:
    observations, chart = noisy_rows(50, with_noise)

    def residual(delta: torch.Tensor) -> torch.Tensor:
        lines = chart.retract(delta).lines()[observations.track]
        return end_distances(observations, lines.moment_about(observations.centre))

    automatic = torch.autograd.functional.jacobian(residual, torch.zeros(5, 4, dtype=torch.float64))
    own = automatic[torch.arange(20), :, observations.track]
    at = linearise(observations, chart)
    assert float(at.residual.abs().max()) > 0.05
    torch.testing.assert_close(at.jacobian, own, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(at.residual, residual(torch.zeros(5, 4, dtype=torch.float64)), rtol=1e-12, atol=1e-12)


def test_residuals_are_distances_in_standard_deviations_of_pixels() -> None:
    """h^2 is the Mahalanobis distance of the end point from the projected line, to first order in the noise."""
    scene = circle(1)
    pixels = scene.noisy(0.5, seed=51)
    root = normal(len(scene.track), 2, 2, 2, seed=52)
    covariance = 0.2 * root @ root.mT + 0.1 * torch.eye(2, dtype=torch.float64)
    flat = pixels.flatten(0, 1)
    rays, _ = scene.camera.unproject(flat)
    poses = scene.poses[torch.arange(8).repeat(40)]
    given = PlaneObservations.from_arcs(
        rays, poses, scene.track, 40, scene.camera.unproject_jacobian(flat), covariance_px2=covariance
    )
    truth = PlueckerLines.from_points(scene.ends[:, 0], scene.ends[:, 1])
    h = end_distances(given, truth[scene.track].moment_about(given.centre))
    # The line in the image, from its exact end points.
    first, second = scene.pixels.flatten(0, 1).unbind(1)
    across = unit((second - first) @ torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64))
    distance = ((flat - first[:, None]) * across[:, None]).sum(-1)
    expected = distance / (across[:, None, None] @ covariance @ across[:, None, :, None])[..., 0, 0].sqrt()
    torch.testing.assert_close(h.abs(), expected.abs(), rtol=2e-3, atol=2e-3)


# --- the bound


def bound(scene: LineSet, sigma_px: float) -> torch.Tensor:
    """Cramer-Rao bound (m^2) of `square_error` with poses fixed, by track: the covariance at the truth, moved to the ends."""
    truth = PlueckerLines.from_points(scene.ends[:, 0], scene.ends[:, 1])
    observations = scene.observe(scene.pixels, sigma_px)
    chart = chart_of(observations, truth)
    covariance, factor = line_covariance(observations, chart)
    assert factor == 1.0
    by_direction, by_moment = chart.jacobian()[:, None].split(3, dim=-2)
    across = hat(chart.S[:, :, 0])[:, None] @ (by_moment - hat(scene.ends) @ by_direction)
    return torch.einsum("teij,tjk,teik->t", across, covariance, across) / 2


def ratio_to_bound(name: str, method: str, trials: int) -> tuple[float, float]:
    """RMS error over the square root of the bound, and the standard error of that, over the scatter between trials."""
    scene = SCENES[name](trials)
    limit = bound(scene, 0.5)
    result = triangulate(method, scene.observe(scene.noisy(0.5, seed=60), 0.5))
    assert bool(result.known.all())
    share = (square_error(result, scene.ends).view(trials, -1).mean(-1)) / limit.mean()
    expected = limit.view(trials, -1).mean(-1) / limit.mean()
    excess = share - expected
    return math.sqrt(1 + float(excess.mean())), float(excess.std()) / math.sqrt(trials) / 2


@pytest.mark.parametrize("trials", [20, pytest.param(200, marks=pytest.mark.full)])
@pytest.mark.parametrize("name", SCENES)
def test_maximum_likelihood_attains_the_bound_with_poses_fixed(name: str, trials: int) -> None:
    ratio, error = ratio_to_bound(name, "ml", trials)
    print(f"{name}: RMS error over the bound {ratio:.4f} +- {error:.4f}, {trials} trials")
    assert ratio < max(1.02, 1 + 2 * error)
    assert ratio > 1 - 3 * error


def test_ends_of_unequal_noise_are_weighed_by_it() -> None:
    """Standard deviations from 0.1 to 3 px, another for each end point: at the bound, and far better than without weights."""
    scene = circle(20)
    sigma = 0.1 * 30 ** torch.rand(len(scene.track), 2, generator=generator(67), dtype=torch.float64)
    pixels = scene.pixels + sigma.view(-1, 8, 2, 1) * normal(*scene.pixels.shape, seed=68)
    covariance = sigma[..., None, None] ** 2 * torch.eye(2, dtype=torch.float64)
    flat = pixels.flatten(0, 1)
    rays, _ = scene.camera.unproject(flat)
    poses = scene.poses[torch.arange(8).repeat(len(scene.ends))]
    by_pixel = scene.camera.unproject_jacobian(flat)
    result = triangulate(
        "ml", PlaneObservations.from_arcs(rays, poses, scene.track, len(scene.ends), by_pixel, covariance_px2=covariance)
    )
    delta = deviations(result, scene.ends)
    distance = (delta * torch.linalg.solve(result.covariance, delta)).sum(-1)
    # Chi-square of four degrees of freedom: the estimate attains the covariance that it states, which is the bound.
    assert float(distance.mean()) == pytest.approx(4.0, rel=4 * math.sqrt(2 / 4 / len(delta)))
    without = triangulate("ml", scene.observe(pixels))
    errors = [float(square_error(r, scene.ends).mean().sqrt()) for r in (result, without)]
    assert 1.5 * errors[0] < errors[1]


def pieces_of_all_kinds(scene: LineSet, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The ends (px) of pieces of the arcs, down to a fiftieth, known to between 0.05 and 20 px, and their covariances."""
    rng, count = np.random.default_rng(seed), len(scene.track)
    sigma_px = torch.as_tensor(np.exp(rng.uniform(math.log(0.05), math.log(20.0), (count, 2))))
    share = torch.as_tensor(rng.uniform(0.02, 1.0, (count, 1)))
    first = torch.as_tensor(rng.uniform(0.0, 1.0, (count, 1))) * (1 - share)
    whole, _ = scene.camera.unproject(scene.pixels.flatten(0, 1))
    ends = torch.stack([whole[:, 0] * (1 - at) + whole[:, 1] * at for at in (first, first + share)], 1)
    pixels = scene.camera.project(ends)[0] + sigma_px[..., None] * torch.as_tensor(rng.standard_normal((count, 2, 2)))
    return pixels, sigma_px[..., None, None] ** 2 * torch.eye(2, dtype=torch.float64)


def arcs_of_all_kinds(scene: LineSet, seed: int) -> PlaneObservations:
    """The same as planes."""
    pixels, covariance = pieces_of_all_kinds(scene, seed)
    bearings, seen = scene.camera.unproject(pixels)
    assert bool(seen.all())
    poses = scene.poses[torch.arange(len(scene.poses)).repeat(len(scene.ends))]
    return PlaneObservations.from_arcs(
        bearings, poses, scene.track, len(scene.ends), scene.camera.unproject_jacobian(pixels), covariance_px2=covariance
    )


def test_the_least_minimum_is_found_where_arcs_are_known_very_differently_well() -> None:
    """Against the minimum that is reached from the true lines; the dual space alone leads elsewhere."""

    def square(lines: PlueckerLines) -> torch.Tensor:
        distance = end_distances(observations, lines[observations.track].moment_about(observations.centre))
        return observations.sum_by_track(distance.square().sum(-1))

    scene = room(20)
    observations = arcs_of_all_kinds(scene, 1)
    least = square(refine(observations, PlueckerLines.from_points(scene.ends[:, 0], scene.ends[:, 1])))
    dual = square(refine(observations, frames_and_lines(observations)[1]))
    result = triangulate("ml", observations)
    found = square(result.lines)[result.known]
    assert int((dual > 1.01 * least + 1.0).sum()) >= 20
    assert int((found > 1.01 * least[result.known] + 1.0).sum()) <= 2 and bool((found < 100.0).all())
    assert len(found) > 0.8 * len(scene.ends)


@pytest.mark.full
def test_an_adjustment_by_default_starts_where_arcs_known_very_differently_well_fit() -> None:
    scene = room(20)
    pixels, covariance = pieces_of_all_kinds(scene, 1)
    image = torch.arange(len(scene.poses)).repeat(len(scene.ends))
    size_px = torch.as_tensor(scene.camera.image_size, dtype=torch.float64)
    inside = ((pixels >= 0) & (pixels <= size_px - 1)).flatten(1).all(1)
    segments = segments_of_arrays(pixels[inside], image[inside], scene.track[inside], covariance_px2=covariance[inside])
    held = replace(OF_TABLES, refine=("lines",))
    default, dual = (
        adjust(segments, scene.poses, scene.camera, options).adjusted.adjusted
        for options in (held, replace(held, triangulation="dual"))
    )
    assert default.outcome is Outcome.CONVERGED and default.noise.measured < 1.1
    assert dual.noise.measured > 2.0 * default.noise.measured


def test_stated_noise_decides_whether_planes_differ() -> None:
    """A baseline of 1 m, 2 cm of it across the plane: 0.2 degrees between the planes of two views."""
    camera = circle(1).camera
    centres = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.02, 0.0]], dtype=torch.float64)
    ends = torch.tensor([[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0]], dtype=torch.float64)
    pixels, _ = camera.project(ends - centres[:, None])
    rays, _ = camera.unproject(pixels)
    names = []
    for sigma_px in (0.05, 1.0):
        covariance = sigma_px**2 * torch.eye(2, dtype=torch.float64).expand(2, 2, 2, 2)
        both = torch.zeros(2, dtype=torch.int64)
        rows = PlaneObservations.from_arcs(
            rays, upright(centres), both, 1, camera.unproject_jacobian(pixels), covariance_px2=covariance
        )
        names += triangulate("ml", rows).status_names
    assert names == ["weak", "parallel_planes"]


@pytest.mark.slow
def test_methods_compared_with_the_bound() -> None:
    """The table at the head of `omnilines.triangulation`, with fewer trials."""
    table = {}
    for name, make in SCENES.items():
        scene = make(10)
        observations, limit = scene.observe(scene.noisy(0.5, seed=61), 0.5), bound(scene, 0.5)
        runs = {method: triangulate(method, observations) for method in METHODS}
        for origin in ("shifted", "file"):
            label = f"dual, published weights, {origin} origin"
            runs[label] = triangulate("dual", observations, weights="published", origin=origin)
        table[name] = {k: float((square_error(r, scene.ends) / limit)[r.known].mean().sqrt()) for k, r in runs.items()}
        print(name, {k: f"{v:.3f}" for k, v in table[name].items()})
    for name, row in table.items():
        assert row["ml"] == min(row.values()), name
        assert row["dual"] < row["dual, published weights, file origin"], name
    assert table["wide"]["dual"] < 1.05 < table["wide"]["dual, published weights, shifted origin"]


# --- what a result offers


def test_end_points_withstand_stray_ends_and_follow_the_direction() -> None:
    scene = circle(2)
    pixels = scene.noisy(0.5, seed=66)
    # In three views of eight the segment is only a part of the line.
    pixels[:, :3, 1] = 0.6 * pixels[:, :3, 1] + 0.4 * pixels[:, :3, 0]
    result = triangulate("ml", scene.observe(pixels, 0.5))
    straight = (result.ends_m - scene.ends).norm(dim=-1).amax(-1)
    turned = (result.ends_m - scene.ends.flip(1)).norm(dim=-1).amax(-1)
    assert float(torch.minimum(straight, turned).median()) < 0.01
    without = triangulate("ml", replace(scene.observe(pixels, 0.5), arcs=None, noise=None))
    assert bool(torch.isnan(without.ends_m).all()) and bool(without.known.all())


def test_wrong_noise_is_refused_in_one_sentence() -> None:
    scene = circle(1)
    flat = scene.pixels.flatten(0, 1)
    rays, _ = scene.camera.unproject(flat)
    poses, by_pixel = scene.poses[torch.arange(8).repeat(40)], scene.camera.unproject_jacobian(flat)
    singular = torch.zeros(320, 2, 2, 2, dtype=torch.float64)
    with pytest.raises(InputError, match="positive definite, found 640 of 640"):
        PlaneObservations.from_arcs(rays, poses, scene.track, 40, by_pixel, covariance_px2=singular)
    with pytest.raises(InputError, match="give by_pixel"):
        PlaneObservations.from_arcs(rays, poses, scene.track, 40, None, covariance_px2=singular)
    with pytest.raises(InputError, match="found no arcs"):
        replace(scene.observe(scene.pixels, 0.5), arcs=None)
    with pytest.raises(InputError, match="at least 0, found -1"):
        triangulate("ml", scene.observe(scene.pixels), iterations=-1)


@pytest.mark.parametrize(("height_m", "status"), [(0.4, "ok"), (0.0, "epipolar")])
def test_arcs_that_say_little_change_nothing(height_m: float, status: str) -> None:
    """Of eight arcs four are exact and four of 300 px: the exact ones decide, also where they are all in one plane with the line,
    off which only the others lie."""
    camera = circle(1).camera
    places = torch.linspace(0.0, 3.5, 8, dtype=torch.float64)
    poor = torch.arange(8) % 2 == 1
    height = torch.where(poor, 0.4, height_m) * torch.sin(3.0 * places)
    centres = torch.stack([places, height, torch.zeros(8, dtype=torch.float64)], -1)
    ends = torch.tensor([[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0]], dtype=torch.float64)
    pixels, _ = camera.project(ends - centres[:, None])
    rays, _ = camera.unproject(pixels)
    sigma_px = torch.where(poor, 300.0, 0.02).to(torch.float64)
    covariance = sigma_px[:, None, None, None] ** 2 * torch.eye(2, dtype=torch.float64).expand(8, 2, 2, 2)
    track = torch.zeros(8, dtype=torch.int64)
    rows = PlaneObservations.from_arcs(
        rays, upright(centres), track, 1, camera.unproject_jacobian(pixels), covariance_px2=covariance
    )
    assert triangulate("ml", rows).status_names == (status,)
    assert triangulate("ml", rows.take(torch.nonzero(~poor).flatten(), track[:4], 1)).status_names == (status,)
