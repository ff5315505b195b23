"""Many noise seeds: stated covariances of lines and poses cover the truth, and poor poses still lead to the optimum."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from camera_models.pose import Pose
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import adjust_lines, end_sigma_m
from omnilines.adjustment.scene import reconstruct_lines
from omnilines.geometry.line import PlueckerLines, end_radius_sigmas
from omnilines.geometry.line_chart import LineChart
from omnilines.synthetic.lines import LineWorld, circle_world, room_world

NOISE_PX = 0.5
NORMAL_95 = 1.959964


def world(name: str) -> LineWorld:
    return room_world(1) if name == "room" else circle_world(name, 1)


def chart_errors(found: LineChart, true: PlueckerLines) -> torch.Tensor:
    """Chart coordinates (t, 4) of the true lines as seen from the found ones, to first order."""
    sign = torch.sign((true.direction * found.S[:, :, 0]).sum(-1))[:, None]
    true = PlueckerLines(sign * true.direction, sign * true.moment)
    lines = found.lines()
    off = torch.cat([true.direction - lines.direction, true.moment - lines.moment], -1)
    return (torch.linalg.pinv(found.jacobian()) @ off[..., None])[..., 0]


@pytest.mark.parametrize("cost", ["whitened", "sector"])
@pytest.mark.parametrize("name", ["wide", "short", "room"])
@pytest.mark.parametrize("seeds", [10, pytest.param(200, marks=pytest.mark.full)])
@pytest.mark.slow
def test_covariances_cover_the_truth(name, cost, seeds):
    """95 percent intervals, poses fixed and two poses held: pooled 93 to 97 percent over 200 seeds, and no line or pose
    outside 90 to 99 (its coordinates together). The covariance is that of the cost itself."""
    scene = world(name)
    true, truth = PlueckerLines.from_points(scene.ends_m[:, 0], scene.ends_m[:, 1]), scene.poses().cam_from_world
    held = torch.zeros(scene.images, dtype=torch.bool)
    held[[0, scene.images // 2]] = True
    fixed, free, poses = [], [], []
    for seed in range(seeds):
        arcs = arcs_from_segments(scene.segments(NOISE_PX, seed), scene.poses(), {"cam0": scene.camera}).arcs
        for refine, kept in ((False, fixed), (True, free)):
            result = adjust_lines(arcs, true, truth, cost=cost, refine_poses=refine, held=held)
            sigma = result.line_covariance.diagonal(dim1=1, dim2=2).sqrt()
            kept.append((chart_errors(result.state.chart, true).abs() <= NORMAL_95 * sigma).numpy())
        moved = (result.state.cam_from_world @ truth.inverse()).log()[~held]
        sigma = result.pose_covariance[~held].diagonal(dim1=1, dim2=2).sqrt()
        poses.append((moved.abs() <= NORMAL_95 * sigma).numpy())
    shares = {"lines, poses fixed": np.mean(fixed, (0, 2)), "lines": np.mean(free, (0, 2)), "poses": np.mean(poses, (0, 2))}
    for what, items in shares.items():
        print(f"{name} {cost} {what}: covered {items.mean():.3f}, single ones {items.min():.3f} to {items.max():.3f}")
    for items in shares.values():
        if seeds == 200:
            assert 0.93 <= items.mean() <= 0.97
            assert 0.90 <= items.min() and items.max() <= 0.99
        else:
            assert 0.88 <= items.mean() <= 0.99


def test_both_ends_lie_within_the_stated_radius():
    """`sigma_m` is that of one coordinate: 1.96 of it hold both ends of fewer lines, `end_radius_sigmas` of 95 percent."""
    scene = world("wide")
    true, truth = PlueckerLines.from_points(scene.ends_m[:, 0], scene.ends_m[:, 1]), scene.poses().cam_from_world
    farther = []
    for seed in range(25):
        arcs = arcs_from_segments(scene.segments(NOISE_PX, seed), scene.poses(), {"cam0": scene.camera}).arcs
        found = adjust_lines(arcs, true, truth, cost="whitened", refine_poses=False)
        sigma = end_sigma_m(found.state.chart, found.line_covariance, scene.ends_m)
        away = found.state.chart.lines()[:, None].distance_to(scene.ends_m)
        farther.append((away.amax(-1) / sigma).numpy())
    inside = {radius: float((np.concatenate(farther) < radius).mean()) for radius in (NORMAL_95, end_radius_sigmas(2))}
    print(inside)
    assert inside[NORMAL_95] < 0.93 and inside[end_radius_sigmas(2)] > 0.95


@pytest.mark.parametrize("trials", [range(2), pytest.param(range(2, 100), marks=pytest.mark.full)], ids=["2", "all"])
def test_poor_poses_lead_to_the_same_optimum(trials):
    """Poses off by 5 degrees and 0.3 m on the wide set-up: at least 98 of 100 reach what a start from the truth reaches."""
    missed = []
    for seed in trials:
        scene = circle_world("wide", seed)
        given, segments = scene.poses(), scene.segments(NOISE_PX, seed)
        arcs = arcs_from_segments(segments, given, {"cam0": scene.camera}).arcs
        lines = PlueckerLines.from_points(scene.ends_m[:, 0], scene.ends_m[:, 1])
        best = adjust_lines(arcs, lines, given.cam_from_world)
        random = torch.randn(scene.images, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        turn, shift = (part / part.norm(dim=-1, keepdim=True) for part in random.split(3, -1))
        rotation = Pose.exp(torch.cat([math.radians(5) * turn, 0 * shift], -1)).rotation @ given.cam_from_world.rotation
        centre = given.cam_from_world.centre + 0.3 * shift
        start = replace(given, cam_from_world=Pose(rotation, -(rotation @ centre[..., None])[..., 0]))
        found = reconstruct_lines(segments, start, {"cam0": scene.camera}, refine_poses=True)
        if not (np.isfinite(found.residual_px).all() and found.adjusted.cost <= best.cost * (1 + 1e-6)):
            missed.append(seed)
    print(f"{len(trials) - len(missed)} of {len(trials)} reach the optimum")
    assert len(missed) <= round(0.02 * len(trials))
