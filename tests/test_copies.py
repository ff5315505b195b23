"""Copies of photos: the same shot twice tells nothing more, in a scene, in a camera from lines, and in a check of one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import omnilines as ol
from camera_models import OpenCVFisheye
from camera_models.pose import Pose
from omnilines.pages.limits import unused_advice
from omnilines.pipelines.arc_chains import arc_chains_of
from omnilines.pipelines.chains import chains_of
from omnilines.pipelines.copies import copied_segments, copies
from omnilines.records import Segments

LENS = OpenCVFisheye([105.0, 105.0, 199.5, 199.5, 0.0, 0.0, 0.0, 0.0], (400, 400))


@pytest.fixture(scope="module")
def room() -> tuple[dict[str, np.ndarray], ol.ImagePoses]:
    made = ol.render("plain-room", LENS, ol.RenderOptions(views=5, seed=4))
    assert made.poses is not None
    return {name: made.photos[name] for name in made.poses.images}, made.poses


def test_copies_are_those_of_the_same_pixels() -> None:
    places = np.arange(8.0).reshape(2, 2, 2)
    found = copies(["a", "b", "c", "d", "e"], [places, np.zeros((0, 2, 2)), places + 1e-9, places.copy(), np.zeros((0, 2, 2))])
    assert found == [None, None, None, "It is a copy of a, and would count twice.", None]


@pytest.mark.full
def test_a_photo_twice_in_a_table_of_segments_is_named() -> None:
    rng = np.random.default_rng(0)
    image, track = np.repeat(np.arange(3), 4), np.tile([0, 1, 2, -1], 3)
    ends = rng.uniform(0.0, 500.0, (12, 2, 2))
    # The same rows in another order; what belongs to no line does not count.
    ends[8:11], track[8:11] = ends[[2, 0, 1]], [2, 0, 1]
    segments = Segments(image, ("a", "b", "c", "d"), track, ("x", "y", "z"), ends)
    (told,) = copied_segments(segments)
    assert told.startswith("c has exactly the segments of another photo")
    ends[8] += 1e-9
    assert copied_segments(replace(segments, endpoints_px=ends)) == ()
    assert copied_segments(segments.rows(np.zeros(0, dtype=np.int64))) == ()


@pytest.mark.slow
def test_a_copy_confirms_no_line(room: tuple[dict[str, np.ndarray], ol.ImagePoses]) -> None:
    """Whether its pose is known too or not, and whichever of both is named first."""
    photos, poses = room
    alone = ol.reconstruct(ol.extract(photos, LENS), poses, LENS)
    given = {"0copy.png": photos["view00.png"], **photos}
    rows = [0, *range(len(poses))]
    motion = poses.cam_from_world
    both = ol.ImagePoses(("0copy.png", *poses.images), Pose(motion.rotation[rows], motion.translation[rows]))
    for with_poses, lost in ((poses, "0copy.png"), (both, "view00.png")):
        scene = ol.reconstruct(ol.extract(given, LENS), with_poses, LENS)
        assert any(f"{lost} is skipped: It is a copy of" in note for note in scene.notes)
        assert len(scene.lines) == len(alone.lines)
        assert np.allclose(scene.lines.ends_m, alone.lines.ends_m, atol=1e-9)


@pytest.mark.slow
def test_copies_are_named_where_too_few_other_photos_are_left(room: tuple[dict[str, np.ndarray], ol.ImagePoses]) -> None:
    photo = room[0]["view00.png"]
    arcs = ol.extract({f"{k}.png": photo for k in range(5)}, LENS)
    said = "found 1; give more. 4 of 5 photos are copies of others and left out; of 1.png it is said: It is a copy of 0.png"
    with pytest.raises(ol.GeometryError, match=said):
        ol.estimate_poses(arcs, LENS, "sfm")


@pytest.mark.slow
def test_photos_of_other_cameras_are_no_copies(room: tuple[dict[str, np.ndarray], ol.ImagePoses]) -> None:
    """Of a rig whose cameras see the same, as a rendered one may."""
    photos, poses = room
    rig = ol.Calibration({"left": LENS, "right": LENS})
    given = {f"{side}/{name}": pixels for name, pixels in list(photos.items())[:3] for side in ("left", "right")}
    motion, rows = poses.cam_from_world, torch.arange(3).repeat_interleave(2)
    posed = ol.ImagePoses(tuple(given), Pose(motion.rotation[rows], motion.translation[rows]))
    scene = ol.reconstruct(ol.extract(given, rig), replace(posed, cameras=("left", "right") * 3), rig)
    assert not any("copy" in note for note in scene.notes)


def test_a_copy_tells_nothing_of_a_camera(room: tuple[dict[str, np.ndarray], ol.ImagePoses]) -> None:
    photos, _ = room
    name = "view01.png"
    given = {name: photos[name], "later.png": photos[name]}
    chains, skipped = arc_chains_of(given, LENS)
    assert chains.images == (name,)
    assert [one.text for one in skipped] == ["later.png is skipped: It is a copy of view01.png, and would count twice."]
    followed = chains_of(given)
    assert followed.chains.images == (name,) and "later.png is skipped: It is a copy of view01.png" in str(followed.skipped)


@pytest.mark.slow
def test_a_copy_of_a_board_tells_nothing_of_a_camera() -> None:
    """Neither its corners nor its photo, which the camera would look through again; and nobody is asked to take it anew."""
    photos = dict(ol.render("checkerboard:5x4:60mm", LENS, ol.RenderOptions(views=4, seed=3)).photos)
    twice = {**photos, **{f"{name} (1)": pixels for name, pixels in photos.items()}}
    once, both = (ol.calibrate(given, "checkerboard:5x4:60mm", model="opencv-fisheye") for given in (photos, twice))
    assert both.sigma == once.sigma
    assert both.camera.named_parameters() == once.camera.named_parameters()
    lost = [view for view in both.views if not view.used]
    assert {view.image for view in lost} == {f"{name} (1)" for name in photos}
    assert unused_advice(lost, len(twice)) == ()
