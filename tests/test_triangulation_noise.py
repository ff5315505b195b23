"""Triangulations under noise: the dissertation's set-up by Monte Carlo."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from triangulation_scenes import normal, unit

from camera_models.pose import Pose
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.geometry.line import PlueckerLines
from omnilines.synthetic.lines import room_world
from omnilines.triangulation import triangulate
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation


def dissertation_scene(trials: int, noise_px: float, step_deg: float) -> tuple[torch.Tensor, PlaneObservations]:
    """40 lines in [-1, 1]^3, 8 cameras on a circle of radius 4 m at height 3 m looking at the centre, noise on the end points."""
    azimuth = torch.deg2rad(torch.arange(8, dtype=torch.float64) * step_deg)
    centres = torch.stack([4 * azimuth.cos(), 4 * azimuth.sin(), torch.full_like(azimuth, 3.0)], -1)
    z = unit(-centres)
    x = unit(torch.linalg.cross(z, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(8, 3)))
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], -2)
    poses = Pose(rotation, -(rotation @ centres[..., None]).squeeze(-1))
    matrix = torch.tensor([[1520.4, 0.0, 302.32], [0.0, 1525.9, 246.87], [0.0, 0.0, 1.0]], dtype=torch.float64)
    ends = 2 * torch.rand(40 * trials, 2, 3, generator=torch.Generator().manual_seed(20), dtype=torch.float64) - 1
    track, camera = torch.arange(len(ends)).repeat_interleave(8), torch.arange(8).repeat(len(ends))
    pixels = poses[camera].transform(ends[track]) @ matrix.mT
    pixels = pixels[..., :2] / pixels[..., 2:] + noise_px * normal(len(track), 2, 2, seed=21)
    rays = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1) @ torch.linalg.inv(matrix).mT
    return ends, PlaneObservations.from_arcs(unit(rays), poses[camera], track, len(ends))


def rms_m(result: Triangulation, ends: torch.Tensor) -> float:
    squares = torch.stack([result.lines.distance_to(ends[:, e]) for e in range(2)]).square()
    return float(squares[:, result.known].mean().sqrt())


@pytest.mark.parametrize("step_deg", [45.0, 9.0])
def test_methods_compared_on_the_dissertations_set_up(step_deg: float, record_property: Callable[[str, float], None]) -> None:
    ends, observations = dissertation_scene(trials=5, noise_px=0.5, step_deg=step_deg)
    options = {
        "dual": ("dual", {}),
        "dual, published weights": ("dual", {"weights": "published"}),
        "dual, published weights, file's origin": ("dual", {"weights": "published", "origin": "file"}),
        "svd": ("svd", {}),
        "averaging": ("averaging", {}),
    }
    results = {name: triangulate(method, observations, **given) for name, (method, given) in options.items()}
    error = {name: 1e3 * rms_m(result, ends) for name, result in results.items()}
    print(step_deg, {name: f"{value:.3f} mm" for name, value in error.items()})
    for name, value in error.items():
        record_property(f"rms_mm {name}", value)
    known = torch.stack([r.known for r in results.values()]).double().mean()
    assert float(known) > 0.99
    assert error["dual"] < 1.01 * error["dual, published weights"]
    assert 1.2 * error["dual"] < error["dual, published weights, file's origin"]
    assert error["dual"] < 1.02 * error["svd"]
    assert error["averaging"] < 1.1 * error["dual"]
    # The residuals show the noise that was put in: 0.5 px at the mean scale of the matrix, a little less off the axis.
    sigma = float(results["dual"].residual_rad.square().mean().sqrt())
    assert sigma == pytest.approx(0.5 / 1523, rel=0.1)


def test_the_error_does_not_depend_on_where_the_world_origin_is() -> None:
    ends, observations = dissertation_scene(trials=1, noise_px=0.5, step_deg=45.0)
    truth = triangulate("dual", observations)
    shift = torch.tensor([30.0, -4.0, 12.0], dtype=torch.float64)
    moved = triangulate("dual", replace(observations, centre=observations.centre + shift))
    assert rms_m(moved, ends + shift) == pytest.approx(rms_m(truth, ends), rel=1e-9)
    published = {
        where: rms_m(
            triangulate("dual", replace(observations, centre=observations.centre + d), weights="published", origin="file"),
            ends + d,
        )
        for where, d in (("centre", 0 * shift), ("away", shift))
    }
    assert published["centre"] != pytest.approx(published["away"], rel=0.05)


def test_a_bandwidth_between_one_sample_and_all_of_them_moves_the_mode() -> None:
    ends, observations = dissertation_scene(trials=1, noise_px=2.0, step_deg=45.0)
    lines = {h: triangulate("averaging", observations, bandwidth=h).lines for h in (1e-9, 1e-3, 10.0)}
    chosen = triangulate("averaging", observations).lines
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    for found in lines.values():
        assert float(truth.angle_to(found).max()) < 0.1
    assert float(lines[1e-3].angle_to(lines[10.0]).median()) > 1e-5
    assert float(chosen.angle_to(lines[1e-9]).median()) > 1e-5


def test_the_most_likely_weights_win_back_what_unequal_arcs_cost() -> None:
    world, trials = room_world(0), 4
    true = world.poses(trials)
    arcs = arcs_from_segments(world.segments(0.5, 0, trials), true, {"cam0": world.camera}).arcs
    poses = true.cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(arcs.bearings, poses, arcs.track, arcs.tracks, arcs.by_pixel)
    found = [("dual", {}), ("dual", {"weights": "most-likely"}), ("ml", {})]
    ends = world.ends_m.repeat(trials, 1, 1)
    unit_m, likely_m, ml_m = (rms_m(triangulate(method, planes, **options), ends) for method, options in found)
    assert likely_m < 0.85 * unit_m
    assert ml_m < likely_m < 1.15 * ml_m
