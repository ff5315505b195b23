"""Photos that are there twice in a rig: under the names of two cameras, or under two names of one camera."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from rig_views import RigScene, pair

import omnilines as ol
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import render_target
from camera_models import InputError, OpenCVFisheye
from omnilines.calibration.thresholds import DuplicateThresholds
from omnilines.pipelines.calibrate_rig import RigResult
from omnilines.pipelines.rig_copies import rig_without_copies
from omnilines.records import Corners

NOISE_PX = 0.2
BOARD = "checkerboard:8x6:30mm"
LENS = OpenCVFisheye([200.0, 200.0, 319.5, 239.5, 0.01, -0.004, 0.001, -0.0001], (640, 480))


def with_views(table: Corners, copied: Sequence[tuple[int, str, str]], moved_px: float = 0.0) -> Corners:
    """The table and, for each (view, camera, frame), that view once more as one of this camera and frame."""
    rows = [np.flatnonzero(table.view == v) for v, _, _ in copied]
    again = np.concatenate(rows)
    names = tuple(f"{camera}/{frame}.png" for _, camera, frame in copied)
    noise = moved_px * np.random.default_rng(1).standard_normal((len(again), 2))
    assert table.cameras is not None and table.frames is not None
    return replace(
        table,
        view=np.concatenate([table.view, len(table.images) + np.repeat(np.arange(len(copied)), [len(own) for own in rows])]),
        view_names=(*table.view_names, *names),
        images=(*table.images, *names),
        cameras=(*table.cameras, *(camera for _, camera, _ in copied)),
        frames=(*table.frames, *(frame for _, _, frame in copied)),
        board_m=np.concatenate([table.board_m, table.board_m[again]]),
        pixels=np.concatenate([table.pixels, table.pixels[again] + noise]),
    )


def without_views(table: Corners, lost: Sequence[int]) -> Corners:
    stays = np.setdiff1d(np.arange(len(table.images)), lost)
    rows = np.isin(table.view, stays)
    assert table.cameras is not None and table.frames is not None
    return replace(
        table,
        view=np.searchsorted(stays, table.view[rows]),
        view_names=tuple(table.view_names[v] for v in stays),
        images=tuple(table.images[v] for v in stays),
        cameras=tuple(table.cameras[v] for v in stays),
        frames=tuple(table.frames[v] for v in stays),
        board_m=table.board_m[rows],
        pixels=table.pixels[rows],
    )


def calibrated(rig: RigScene, table: Corners, **more: object) -> RigResult:
    sizes = {"cam0": rig.models[0].image_size, "cam1": rig.models[1].image_size, "copy": rig.models[0].image_size}
    models = {"cam0": "pinhole", "cam1": "opencv-fisheye", "copy": "pinhole"}
    seen = dict.fromkeys(table.cameras or ())
    given = {name: size for name, size in sizes.items() if name in seen}
    return ol.calibrate_rig(table, given, models={name: models[name] for name in seen}, **more)


def views_of(table: Corners, camera: str) -> list[int]:
    return [v for v, name in enumerate(table.cameras or ()) if name == camera]


def fitting_both(table: Corners) -> int:
    """A view of the first camera that is within the image of the second too."""
    return next(v for v in views_of(table, "cam0") if (table.pixels[table.view == v] < 950.0).all())


def assert_same(one: RigResult, other: RigResult) -> None:
    assert one.names == other.names
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=0)
    for a, b in zip(one.fit.members, other.fit.members, strict=True):
        torch.testing.assert_close(a.model.parameters, b.model.parameters, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("moved_px", [0.0, 0.03])
def test_one_photo_under_the_names_of_two_cameras_is_used_of_neither(moved_px: float) -> None:
    """Such a copy, encoded anew or not, refused the whole calibration."""
    rig = pair(10)
    table = rig.noisy(NOISE_PX, 0)
    own = fitting_both(table)
    there = f"cam1/{table.frames[own]}.png"
    lost = [own, *(v for v in views_of(table, "cam1") if table.frames[v] == table.frames[own])]
    apart = without_views(table, lost)
    copied = with_views(without_views(table, lost[1:]), [(own, "cam1", table.frames[own])], moved_px)
    result = calibrated(rig, copied)
    reasons = {view.image: view for view in result.views if not view.used}
    assert reasons.keys() == {table.images[own], there}
    for image, other in ((table.images[own], there), (there, table.images[own])):
        view = reasons[image]
        assert f"same pixels as {other} of another camera" in str(view.reason)
        assert (view.camera, view.frame) == (image.split("/")[0], table.frames[own])
    assert_same(result, calibrated(rig, apart))


def test_the_same_photos_under_two_names_of_cameras_are_refused() -> None:
    rig = pair(6)
    table = rig.noisy(NOISE_PX, 0)
    own = views_of(table, "cam0")
    # Encoded anew, corners move by less than the tolerance.
    copied = with_views(table, [(v, "copy", table.frames[v]) for v in own], 0.03)
    said = (
        rf"cameras cam0 and copy .* in {len(own)} photos of both, first in {table.images[own[0]]} and copy/{table.frames[own[0]]}"
    )
    with pytest.raises(InputError, match=said):
        calibrated(rig, copied)
    # All but two of them: too few for a camera.
    with pytest.raises(InputError, match=rf"cam0 and copy .* in {len(own) - 2} photos of both"):
        calibrated(rig, with_views(table, [(v, "copy", table.frames[v]) for v in own[2:]], 0.03))


def test_a_corner_twice_in_a_view_is_refused_in_a_rig_too() -> None:
    """It was refused of one camera, and of a rig from a file, but counted twice in a table made in Python."""
    rig = pair(4)
    table = rig.noisy(NOISE_PX, 0)
    again = replace(
        table,
        view=np.append(table.view, table.view[7]),
        board_m=np.concatenate([table.board_m, table.board_m[7:8]]),
        pixels=np.concatenate([table.pixels, table.pixels[7:8] + 1.0]),
    )
    with pytest.raises(InputError, match=rf"once in a view, found one of view {table.view_names[0]} again in row {len(table)}"):
        calibrated(rig, again)


@pytest.mark.slow
def test_copies_within_a_camera_do_not_count_twice() -> None:
    """Instants saved twice made the standard deviations of a rig smaller by the root of two."""
    rig = pair(10)
    table = rig.noisy(NOISE_PX, 0)
    twice = with_views(table, [(v, table.cameras[v], f"{table.frames[v]}b") for v in range(len(table.images))])
    result = calibrated(rig, twice)
    lost = [view for view in result.views if not view.used]
    assert len(lost) == len(table.images) and all("It is a copy of" in str(view.reason) for view in lost)
    assert_same(result, calibrated(rig, table))


@pytest.mark.slow
def test_of_a_board_at_rest_only_what_was_copied_is_left_out() -> None:
    """A resting board is within the tolerance in all its photos."""
    rig = pair(10)
    table = rig.noisy(NOISE_PX, 0)
    own = fitting_both(table)
    resting = with_views(table, [(own, "cam0", f"{k}") for k in range(4)], 0.03)
    first = len(table.images)
    result = calibrated(rig, with_views(resting, [(first + 2, "cam1", "4")]))
    assert {view.image for view in result.views if not view.used} == {"cam0/2.png", "cam1/4.png"}


@pytest.mark.slow
def test_a_copied_photo_is_not_looked_through_again() -> None:
    board = pattern(BOARD)
    poses = random_board_poses(board, LENS, 5, math.radians(60), seed=1)
    shots = [render_target(board, LENS, pose, blur_px=0.5, supersample=2) for pose in poses]
    left = {"0.png": shots[0], "1.png": shots[1], "2.png": shots[2], "2b.png": shots[2]}
    right = {"0.png": shots[3], "1.png": shots[1], "2.png": shots[4]}
    least = {"left": 1, "right": 1}
    found = ol.detect_rig({"left": left, "right": right}, BOARD)
    own = rig_without_copies(found, least, DuplicateThresholds(), in_cameras=True)
    assert own.corners.images == ("left/0.png", "left/2.png", "right/0.png", "right/2.png")
    assert [photo.name for item in own.cameras for photo in item.found.photos] == list(own.corners.images)
    assert [(view.camera, view.image) for view in own.skipped] == [
        ("left", "left/1.png"), ("left", "left/2b.png"), ("right", "right/1.png"),
    ]  # fmt: skip
    assert "same pixels as right/1.png" in str(own.skipped[0].reason) and "copy of left/2.png" in str(own.skipped[1].reason)
    resting = rig_without_copies(found, least, DuplicateThresholds(), in_cameras=False)
    assert "left/2b.png" in resting.corners.images
