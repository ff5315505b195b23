"""A scene is the same scene whatever its unit of length: to the last bit where units differ by a power of two."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from engine_scenes import row
from matching_scenes import room
from rig_scene import RigScene

from camera_models.pose import Pose
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.lines import adjust_lines
from omnilines.geometry.line import PlueckerLines
from omnilines.matching.match import match_arcs

UNITS = (2.0**-20, 1024.0)


def scaled(poses: Pose, unit: float) -> Pose:
    return Pose(poses.rotation, unit * poses.translation)


def of_a_row(unit: float, partition: int) -> Adjusted:
    """By the compiled engine, in one piece or in parts."""
    scene = row(cameras=12, lines=80)
    lines = PlueckerLines(scene.lines.direction, unit * scene.lines.moment)
    return adjust_lines(scene.arcs, lines, scaled(scene.poses, unit), cost="whitened", partition=partition)


def of_a_rig(unit: float) -> Adjusted:
    """By the general engine, with a rig that moves."""
    scene = RigScene(lines=30)
    lines, frames = PlueckerLines(scene.lines.direction, unit * scene.lines.moment), scene.rig_from_world
    near = Pose.exp(1e-3 * torch.randn(len(frames), 6, generator=torch.Generator().manual_seed(0)).double()) @ frames
    rig = replace(scene.rig, cam_from_rig=scaled(scene.rig.cam_from_rig, unit))
    return adjust_lines(scene.arcs(0.3), lines, scaled(near, unit), cost="whitened", rig=rig, refine_rig=True)


@pytest.mark.slow
@pytest.mark.parametrize("partition", [0, 4])
def test_lines_and_poses_are_adjusted_alike_in_any_unit(partition: int) -> None:
    one = of_a_row(1.0, partition)
    for unit in UNITS:
        other = of_a_row(unit, partition)
        assert (other.iterations, other.cost) == (one.iterations, one.cost)
        poses, own = other.state.cam_from_world, one.state.cam_from_world
        assert torch.equal(poses.rotation, own.rotation) and torch.equal(poses.translation, unit * own.translation)
        assert torch.equal(other.state.chart.S, one.state.chart.S)
        assert torch.equal(other.state.chart.centre, unit * one.state.chart.centre)
        of_one_unit(one, other, unit)


@pytest.mark.slow
def test_rigs_are_adjusted_alike_in_any_unit() -> None:
    one = of_a_rig(1.0)
    for unit in UNITS:
        other = of_a_rig(unit)
        assert other.iterations == one.iterations and other.cost == pytest.approx(one.cost, rel=1e-12)
        sigma = one.pose_covariance.diagonal(dim1=1, dim2=2).sqrt()[:, 3:]
        off = other.state.cam_from_world.translation / unit - one.state.cam_from_world.translation
        assert float((off / sigma).abs().max()) < 1e-9
        of_one_unit(one, other, unit)


def of_one_unit(one: Adjusted, other: Adjusted, unit: float) -> None:
    """Covariances are the same."""
    sizes = torch.tensor([1.0] * 3 + [unit] * 3, dtype=torch.float64)
    found, own = other.pose_covariance / (sizes[:, None] * sizes), one.pose_covariance
    torch.testing.assert_close(found, own, rtol=0, atol=1e-9 * float(own.abs().max()))
    torch.testing.assert_close(other.line_covariance, one.line_covariance, rtol=0, atol=1e-9 * float(one.line_covariance.max()))


@pytest.mark.slow
def test_arcs_are_matched_alike_in_any_unit() -> None:
    scene = room("fisheye")
    arcs = scene.arcs(0.3, 1, colours=True)
    one = match_arcs(arcs)
    assert len(one.tracks) > 50
    for unit in UNITS:
        other = match_arcs(arcs.with_poses(scaled(arcs.poses, unit)))
        assert other.tolerance_px == one.tolerance_px
        np.testing.assert_array_equal(other.tracks.track, one.tracks.track)
        np.testing.assert_array_equal(other.hypotheses.score, one.hypotheses.score)
        torch.testing.assert_close(other.tracks.lines.lines.moment, unit * one.tracks.lines.lines.moment, rtol=0, atol=0)
