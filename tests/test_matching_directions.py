"""Rotations of photos from directions that their lines share: rooms of parallel lines, furniture askew, four kinds of cameras."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matching_scenes import SIZE, MatchingScene, camera_named, from_views, looking, random_arcs, shaken

from camera_models.pose import Pose
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.shared_directions import turned_poses

CAMERAS = ["fisheye", "panorama", *(pytest.param(name, marks=pytest.mark.full) for name in ("scaramuzza", "pinhole"))]


def lines_along(directions: np.ndarray, each: int, rng: np.random.Generator) -> torch.Tensor:
    """Segments of random lengths at random places, `each` along every direction."""
    way = np.repeat(directions, each, 0) * rng.uniform(0.5, 2.0, (each * len(directions), 1))
    middle = rng.uniform(0.05, 0.95, way.shape) * SIZE
    return torch.as_tensor(np.stack([middle - 0.5 * way, middle + 0.5 * way], 1))


def turned_about_up(degrees: float) -> np.ndarray:
    """Two horizontal directions."""
    angle = math.radians(degrees)
    return np.array([[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0]])


def scene(name: str, askew_deg: float = 6.0, views: int = 10) -> MatchingScene:
    """Walls and uprights, furniture askew, and lines of no family."""
    rng = np.random.default_rng(5)
    camera, half_rad = camera_named(name)
    free = rng.standard_normal((20, 3))
    families = [np.eye(3), turned_about_up(askew_deg), free / np.linalg.norm(free, axis=-1, keepdims=True)]
    ends = torch.cat([lines_along(own, each, rng) for own, each in zip(families, (25, 15, 1), strict=True)])
    centres = rng.uniform(0.2, 0.8, (views, 3)) * SIZE
    axes = rng.standard_normal((views, 3)) * np.array([1.0, 1.0, 0.3])
    return from_views(camera, half_rad, looking(centres, axes), ends)


def errors_deg(found: Pose, truth: Pose) -> np.ndarray:
    """Angles to the true rotations, up to a turn of the world: that of the middle photo."""
    turn = (found.rotation.mT @ truth.rotation)[:, None] @ (found.rotation.mT @ truth.rotation)[None].mT
    angles = torch.rad2deg(torch.arccos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)))
    return angles[int(angles.sum(1).argmin())].numpy()


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("degrees", [0.0, 1.0, 3.0])
def test_rotations_follow_from_directions_however_wrong_the_poses_are(name: str, degrees: float) -> None:
    exact = scene(name)
    given = shaken(exact.poses, degrees, 200.0, 3)
    arcs = exact.arcs(0.2, 1, poses=given)
    found, fixed = turned_poses(arcs)
    errors = errors_deg(found[fixed], exact.poses[fixed])
    if name == "pinhole":
        # Six of its photos show 20 arcs and fewer; one of the others may take the furniture, 6 degrees askew, for the walls.
        confused = np.abs(errors - 6.0) < 0.2
        assert fixed.sum() >= 3 and confused.sum() <= 1 and errors[~confused].max() < 0.2
    else:
        assert fixed.all() and np.median(errors) < 0.1 and errors.max() < 0.2
    torch.testing.assert_close(found.rotation[~fixed], given.rotation[~fixed], rtol=0, atol=0)
    torch.testing.assert_close(found.centre, given.centre, rtol=0, atol=1e-12)


def test_a_result_does_not_depend_on_the_rotations_given() -> None:
    exact = scene("fisheye")
    turned = [turned_poses(exact.arcs(0.2, 1, poses=shaken(exact.poses, 2.0, 0.0, seed)))[0] for seed in (1, 2)]
    assert errors_deg(turned[0], turned[1]).max() < 1e-3


def test_the_world_as_a_whole_is_not_turned() -> None:
    exact = scene("panorama")
    found, _ = turned_poses(exact.arcs(0.2, 1))
    cosine = ((found.rotation @ exact.poses.rotation.mT).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    assert float(torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))).max()) < 0.1


def test_a_photo_of_one_family_keeps_its_pose_and_others_are_turned() -> None:
    exact = scene("fisheye")
    given = shaken(exact.poses, 1.0, 0.0, 4)
    arcs = exact.arcs(0.2, 1, poses=given)
    upright = np.abs(exact.truth().direction[:, 2].numpy()) > 0.999
    only = arcs.rows(np.flatnonzero((arcs.image != 3) | upright[exact.line]))
    found, fixed = turned_poses(only)
    assert not fixed[3] and fixed.sum() == len(fixed) - 1
    torch.testing.assert_close(found.rotation[3], given.rotation[3], rtol=0, atol=0)


@pytest.mark.parametrize("count", [0, 1, 300])
def test_arcs_of_no_family_leave_all_poses(count: int) -> None:
    arcs: ViewedArcs = random_arcs("fisheye", 5, 60, 2)
    some = arcs.rows(np.arange(min(count, len(arcs))))
    found, fixed = turned_poses(replace(some, poses=arcs.poses))
    assert not fixed.any()
    torch.testing.assert_close(found.rotation, arcs.poses.rotation, rtol=0, atol=0)
