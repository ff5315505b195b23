"""What errors of held poses leave uncertain of lines: against poses that are drawn from their covariance."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_calibration_errors import CAMERA, CAMERAS, LINES, charts, squares_m2, world

import omnilines as ol
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.state import moved_poses
from omnilines.geometry.line import PlueckerLines
from omnilines.pipelines.calibration_errors import wider_lines
from omnilines.pipelines.options import OF_TABLES
from omnilines.pipelines.pose_errors import errors_by_poses
from omnilines.records import ImagePoses, Lines

HELD, DRAWS = replace(OF_TABLES, refine=("lines",)), 60


def covariance() -> np.ndarray:
    """Of each pose: a milliradian and three millimetres, which go together, and twice as much of every second photo."""
    mix = np.eye(6)
    mix[4, 0], mix[3, 1] = 0.8, -0.8
    root = np.diag([1e-3] * 3 + [3e-3] * 3) @ (mix / np.linalg.norm(mix, axis=1)[:, None])
    return np.stack([(1 + k % 2) ** 2 * root @ root.T for k in range(CAMERAS)])


def adjusted() -> tuple[Lines, ImagePoses, torch.Tensor]:
    """Lines with held poses, these with their covariance, and what it leaves uncertain of lines."""
    segments, poses, _ = world()
    known = replace(poses, covariance=covariance())
    lines = ol.adjust(segments, poses, CAMERA, HELD).lines
    found = errors_by_poses(lines, arcs_from_segments(segments, poses, {"cam0": CAMERA}).arcs, np.arange(LINES), known, HELD)
    assert found is not None
    return lines, known, found


@pytest.mark.slow
@pytest.mark.parametrize("draws", [20, pytest.param(DRAWS, marks=pytest.mark.full)])
def test_lines_scatter_as_is_stated_where_poses_are_drawn_from_their_covariance(draws: int) -> None:
    segments, poses, _ = world()
    lines, _, found = adjusted()
    expected, rng, at, moved = squares_m2(lines, found.numpy()), np.random.default_rng(1), torch.as_tensor(lines.ends_m), 0.0
    for _ in range(draws):
        step = np.stack([rng.multivariate_normal(np.zeros(6), one) for one in covariance()])
        there = moved_poses(poses.cam_from_world, torch.arange(CAMERAS), torch.as_tensor(step))
        ends = torch.as_tensor(ol.adjust(segments, replace(poses, cam_from_world=there), CAMERA, HELD).lines.ends_m)
        other = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[:, None].closest_point(at)
        moved += (other - at).square().sum((1, 2)).numpy() / draws
    wider = math.sqrt(DRAWS / draws)
    assert 0.8**wider < moved.sum() / expected.sum() < 1.25**wider
    assert (moved < 3.0**wider * expected).all() and (moved > expected / 3.0**wider).all()


def test_they_widen_sigma_and_make_lines_weak() -> None:
    lines, _, found = adjusted()
    wider = wider_lines(lines, found, HELD.adjustment.weak_share)
    assert wider.covariance is not None and lines.covariance is not None
    np.testing.assert_allclose(wider.covariance, lines.covariance + found.numpy())
    assert (wider.sigma_m > lines.sigma_m).all() and set(wider.status) == {"ok"} and len(charts(wider)) == LINES
    far = wider_lines(lines, 1e6 * found, HELD.adjustment.weak_share)
    assert set(far.status) == {"weak"}


def test_poses_that_are_refined_or_exact_add_nothing() -> None:
    segments, poses, _ = world()
    lines, known, _ = adjusted()
    arcs = arcs_from_segments(segments, poses, {"cam0": CAMERA}).arcs
    assert errors_by_poses(lines, arcs, np.arange(LINES), poses, HELD) is None
    assert errors_by_poses(lines, arcs, np.arange(LINES), known, OF_TABLES) is None
