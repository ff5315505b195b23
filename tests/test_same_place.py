"""Photos of one place count once: a burst confirms no line."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import omnilines as ol
from camera_models import Calibration, CameraModel
from camera_models.pose import Pose
from omnilines.pipelines.arcs import skipped
from omnilines.pipelines.photo_arcs import PhotoArcs
from omnilines.pipelines.same_place import without_same_place
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.records import ImagePoses

PLACES = 5


def saved_again(photo: np.ndarray, seed: int) -> np.ndarray:
    """The same shot a moment later: a little brighter, with other noise, and compressed."""
    lit = 1.02 * photo.astype(float) + np.random.default_rng(seed).normal(0.0, 2.0, photo.shape)
    found = cv2.imdecode(cv2.imencode(".jpg", lit.clip(0, 255).astype(np.uint8))[1], cv2.IMREAD_COLOR)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def burst() -> Iterator[tuple[PhotoArcs, PhotoPoses, CameraModel]]:
    """Two photos of each of five places of a room."""
    made = ol.render("room", "equirectangular", views=PLACES, size_px=(1024, 512), seed=3)
    photos, rows = {}, []
    for k, name in enumerate(made.photos):
        photos |= {f"{k}a.png": np.asarray(made.photos[name]), f"{k}b.png": saved_again(np.asarray(made.photos[name]), k)}
        rows += 2 * [made.poses.images.index(name)]
    poses = ImagePoses(tuple(photos), made.poses.cam_from_world[torch.tensor(rows)], ("cam0",) * len(rows))
    yield ol.extract(photos, made.camera), PhotoPoses(poses), made.camera


def used(arcs: PhotoArcs) -> list[str]:
    return [one.photo.name for one in arcs.used]


@pytest.mark.slow
def test_the_second_photo_of_a_place_is_left_out(burst: tuple[PhotoArcs, PhotoPoses, CameraModel]) -> None:
    arcs, posed, camera = burst
    left, poses = without_same_place(arcs, posed, Calibration({"cam0": camera}))
    assert used(left) == [f"{k}a.png" for k in range(PLACES)] == list(poses.poses.images)
    reasons = [one.reason for one in left.photos if one.reason is not None]
    assert reasons[0] == "It shows what 0a.png shows from the same place, which tells no distances."
    asked, _ = without_same_place(arcs, posed, Calibration({"cam0": camera}), asked=("1b.png",))
    assert used(asked) == ["0a.png", "1b.png", "2a.png", "3a.png", "4a.png"]


def test_a_photo_that_shows_no_line_changes_nothing(burst: tuple[PhotoArcs, PhotoPoses, CameraModel]) -> None:
    """As of a bare wall, or with a mask over all of it."""
    arcs, posed, camera = burst
    bare = replace(skipped(arcs.photos[3].photo, "cam0", ""), reason=None)
    given = replace(arcs, photos=(*arcs.photos[:3], bare, *arcs.photos[4:]))
    left, poses = without_same_place(given, posed, Calibration({"cam0": camera}))
    assert used(left) == ["0a.png", "1a.png", "1b.png", "2a.png", "3a.png", "4a.png"] == list(poses.poses.images)


@pytest.mark.slow
def test_a_burst_has_the_lines_of_single_photos(burst: tuple[PhotoArcs, PhotoPoses, CameraModel]) -> None:
    arcs, posed, camera = burst
    single = replace(arcs, photos=arcs.photos[::2])
    rows = torch.arange(0, 2 * PLACES, 2)
    alone = ImagePoses(posed.poses.images[::2], posed.poses.cam_from_world[rows], ("cam0",) * PLACES)
    both, one = ol.reconstruct(arcs, posed.poses, camera), ol.reconstruct(single, alone, camera)
    np.testing.assert_array_equal(both.lines.ends_m, one.lines.ends_m)
    assert sum("from the same place" in detail.text for detail in both.details) == PLACES


def test_photos_that_are_apart_or_show_other_things_stay(burst: tuple[PhotoArcs, PhotoPoses, CameraModel]) -> None:
    arcs, posed, camera = burst
    calibration = Calibration({"cam0": camera})
    singles = replace(arcs, photos=arcs.photos[::2])
    assert used(without_same_place(singles, posed, calibration)[0]) == used(singles)
    # As if the second photo of each place had been taken elsewhere: it shows the same, and so no edge is near.
    poses = posed.poses.cam_from_world
    aside = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], dtype=torch.float64).repeat(PLACES, 1)
    apart = replace(posed, poses=replace(posed.poses, cam_from_world=Pose(poses.rotation, poses.translation + aside)))
    assert used(without_same_place(arcs, apart, calibration)[0]) == used(arcs)


def test_where_too_few_places_are_left_none_is_left_out(burst: tuple[PhotoArcs, PhotoPoses, CameraModel]) -> None:
    """What is wrong is said of all photos, not of the two that would be left."""
    arcs, posed, camera = burst
    two = replace(arcs, photos=arcs.photos[:4])
    assert used(without_same_place(two, posed, Calibration({"cam0": camera}))[0]) == used(two)
