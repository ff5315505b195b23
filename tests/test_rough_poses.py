"""Poses of a table that are a few degrees and decimetres off, before lines are matched."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from matching_scenes import MatchingScene, shaken
from test_matching_directions import scene

from camera_models import Calibration, GeometryError
from camera_models.pose import Pose
from omnilines.files import PhotoRef
from omnilines.matching.slack import lines_need_poses
from omnilines.pipelines.better_poses import better_poses
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs, viewed_arcs
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.progress import silent
from omnilines.records import ImagePoses

VIEWS = 10
NAMES = tuple(f"photo{k}.png" for k in range(VIEWS))


def found_arcs(exact: MatchingScene) -> list[FoundArcs]:
    arcs = exact.arcs(0.2, 1, colours=True)
    pixels = exact.camera.project(torch.as_tensor(arcs.bearings))[0].numpy()
    covariance, length = arcs.covariance_px2, np.full(len(arcs), 50.0)
    return [
        FoundArcs(PhotoRef(Path(name), name), "cam0", pixels[own], covariance[own], length[own], arcs.colours[own])
        for name, own in ((name, arcs.image == k) for k, name in enumerate(NAMES))
    ]


def table(poses: Pose, rows: range = range(VIEWS)) -> PhotoPoses:
    index = list(rows)
    return PhotoPoses(ImagePoses(tuple(NAMES[k] for k in index), poses[index], ("cam0",) * len(index)))


def in_another_world(poses: Pose) -> Pose:
    """As structure from motion gives them: of its own scale, place and orientation."""
    turn = Pose.exp(torch.tensor([0.4, -1.1, 0.7, 0.0, 0.0, 0.0], dtype=torch.float64)).rotation
    rotation = poses.rotation @ turn.mT
    centre = 0.3 * (poses.centre @ turn.mT) + torch.tensor([5.0, 1.0, -2.0], dtype=torch.float64)
    return Pose(rotation, -(rotation @ centre[..., None])[..., 0])


def must_not_be_asked() -> PhotoPoses:
    raise AssertionError("structure from motion was asked for")


@pytest.fixture(scope="module")
def exact() -> MatchingScene:
    return scene("panorama", views=VIEWS)


def better(exact: MatchingScene, given: Pose, from_photos) -> PhotoPoses:
    return better_poses(found_arcs(exact), table(given), Calibration({"cam0": exact.camera}), **options(from_photos))


def options(from_photos) -> dict:
    return {"from_photos": from_photos, "options": SceneOptions(), "progress": silent}


def test_good_poses_stay_as_they_are(exact: MatchingScene) -> None:
    result = better(exact, exact.poses, must_not_be_asked)
    torch.testing.assert_close(result.poses.cam_from_world.rotation, exact.poses.rotation, rtol=0, atol=0)
    assert not result.notes


def test_poses_that_are_only_turned_are_mended_by_directions(exact: MatchingScene) -> None:
    given = shaken(exact.poses, 0.3, 0.0, 3)
    result = better(exact, given, must_not_be_asked)
    assert len(result.notes) == 1 and "turned by the directions" in result.notes[0]
    torch.testing.assert_close(result.poses.cam_from_world.centre, given.centre, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_rough_poses_take_places_from_the_photos_in_their_own_world(exact: MatchingScene) -> None:
    """Two photos have no pose but the given one: it stays, turned."""
    given = shaken(exact.poses, 2.0, 100.0, 3)
    free = table(in_another_world(exact.poses), range(2, VIEWS))
    result = better(exact, given, lambda: free)
    assert "8 of 10 photos were placed by features" in result.notes[-1]
    centre = result.poses.cam_from_world.centre[2:]
    torch.testing.assert_close(centre.mean(0), given.centre[2:].mean(0), rtol=0, atol=0.1)
    apart = (centre[:, None] - centre[None]).norm(dim=-1)
    true = (exact.poses.centre[2:, None] - exact.poses.centre[None, 2:]).norm(dim=-1)
    ratio = (apart / true)[~torch.eye(VIEWS - 2, dtype=torch.bool)]
    assert float(ratio.max() / ratio.min()) < 1.0 + 1e-9 and 0.9 < float(ratio.mean()) < 1.1


@pytest.mark.parametrize(
    ("off_deg", "off_mm", "needed"), [(0.0, 0.0, True), (0.05, 2.0, True), (1.0, 100.0, False), (2.0, 100.0, False)]
)
def test_lines_need_good_poses_and_do_not_need_rough_ones(
    exact: MatchingScene, off_deg: float, off_mm: float, needed: bool
) -> None:
    """Whatever slack is allowed: turned by 3.2 px, poses that are off by more hold lines as well as before."""
    arcs = viewed_arcs(
        found_arcs(exact), table(shaken(exact.poses, off_deg, off_mm, 3)).poses, Calibration({"cam0": exact.camera})
    )
    assert [lines_need_poses(arcs, slack_px, 3.2) for slack_px in (0.2, 0.8)] == [needed, needed]


def test_where_the_photos_give_no_poses_the_note_says_so(exact: MatchingScene) -> None:
    def nothing() -> PhotoPoses:
        raise GeometryError("no three photos could be joined.")

    result = better(exact, shaken(exact.poses, 2.0, 100.0, 3), nothing)
    assert "the photos themselves give none: no three photos could be joined." in result.notes[-1]
    assert math.isfinite(float(result.poses.cam_from_world.translation.sum()))


def test_too_few_photos_are_left_to_matching(exact: MatchingScene) -> None:
    two = table(shaken(exact.poses, 2.0, 100.0, 3), range(2))
    assert better_poses(found_arcs(exact), two, Calibration({"cam0": exact.camera}), **options(must_not_be_asked)) is two
