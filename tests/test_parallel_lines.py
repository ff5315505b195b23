"""Scenes whose lines are all parallel: nothing tells where photos were taken along them, which is said and not solved."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import omnilines as ol
from camera_models import GeometryError, OpenCVFisheye
from camera_models.pose import Pose
from omnilines.pipelines.options import OF_TABLES
from omnilines.records import ImagePoses, Segments

CAMERA = OpenCVFisheye([320.0, 322.0, 510.0, 390.0, 0.02, -0.01, 0.002, 0.0], (1032, 778))
CAMERAS, LINES = 6, 20


def scene(others: int, off_rad: float = 0.0) -> tuple[Segments, ImagePoses]:
    """Lines along one direction, but for some `others`, with 0.3 px of noise that is stated; poses off by so much."""
    rng = np.random.default_rng(4)
    centre = rng.uniform(-0.8, 0.8, (CAMERAS, 3)) * [1.5, 1.0, 0.3]
    turn = torch.as_tensor(np.concatenate([0.1 * rng.standard_normal((CAMERAS, 3)), np.zeros((CAMERAS, 3))], 1))
    rotation = Pose.exp(turn).rotation
    poses = Pose(rotation, -(rotation @ torch.as_tensor(centre)[..., None])[..., 0])
    middle = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 3.5], (LINES, 3))
    way = np.tile([0.1, 0.3, 0.4], (LINES, 1))
    way[:others] = rng.uniform(-0.4, 0.4, (others, 3))
    ends = torch.as_tensor(np.stack([middle - way, middle + way], 1))
    image, track = np.repeat(np.arange(CAMERAS), LINES), np.tile(np.arange(LINES), CAMERAS)
    pixels, seen = CAMERA.project(poses[torch.as_tensor(image)].transform(ends[track]))
    assert bool(seen.all())
    names = tuple(f"{k}.png" for k in range(CAMERAS))
    found = pixels.numpy() + 0.3 * rng.standard_normal((len(track), 2, 2))
    segments = Segments(image, names, track, tuple(f"t{k}" for k in range(LINES)), found, sigma_px=np.full(len(track), 0.3))
    moved = Pose.exp(torch.as_tensor(off_rad * rng.standard_normal((CAMERAS, 6)))) @ poses
    return segments, ImagePoses(names, moved, ("cam0",) * CAMERAS)


@pytest.mark.slow
@pytest.mark.parametrize("off_rad", [0.0, 0.003, 0.03])
def test_poses_are_not_refined_by_lines_that_are_all_parallel(off_rad: float) -> None:
    segments, poses = scene(0, off_rad)
    with pytest.raises(GeometryError, match="nothing tells where photos were taken along them"):
        ol.adjust(segments, poses, CAMERA)


@pytest.mark.slow
def test_held_poses_a_prior_or_lines_of_another_direction_are_enough() -> None:
    segments, poses = scene(0)
    assert ol.adjust(segments, poses, CAMERA, replace(OF_TABLES, refine=("lines",))).lines.known.all()
    assert ol.adjust(segments, poses, CAMERA, pose_sigma=(1e-3, 1e-3)).lines.known.all()
    segments, poses = scene(2, 0.003)
    assert ol.adjust(segments, poses, CAMERA).adjusted.adjusted.noise.measured < 1.3
