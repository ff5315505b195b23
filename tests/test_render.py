"""`render`: photos with their truth as objects, of scenes and targets, through drawn and through given cameras."""

from pathlib import Path

import numpy as np
import pytest
import torch

from camera_models import GeometryError, InputError, load
from omnilines.files import find_photos, read_photo, read_poses
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.pipelines.render import RenderOptions, render
from omnilines.pipelines.rendered import RenderedScene, RenderedTargets
from omnilines.scenes import build_scene


@pytest.fixture(scope="module")
def room() -> RenderedScene:
    made = render("room", views=2, size_px=(160, 120), seed=3)
    assert isinstance(made, RenderedScene)
    return made


def test_what_is_saved_is_what_the_objects_hold(room: RenderedScene, tmp_path: Path) -> None:
    told = []
    files = room.save(tmp_path / "out", lambda *step: told.append(step))
    assert [path.name for path in files[:2]] == list(room.photos) == ["view00.png", "view01.png"]
    assert all(path.is_file() for path in files) and told[-1] == ("rendering photos", 2, 2)
    for ref in find_photos([tmp_path / "out"]):
        np.testing.assert_array_equal(read_photo(ref.path), room.photos[ref.name])
    truth = load(tmp_path / "out/calibration.yaml")
    assert truth["cam0"].named_parameters() == room.camera.named_parameters() and truth.provenance["seed"] == 3
    torch.testing.assert_close(
        read_poses(tmp_path / "out/poses.csv").cam_from_world.translation, room.poses.cam_from_world.translation
    )
    edges = read_true_edges(tmp_path / "out/truth.csv")
    np.testing.assert_array_equal(edges.ends_m, room.edges.ends_m)
    np.testing.assert_array_equal(read_stretches(tmp_path / "out/visibility.csv", edges).t, room.stretches.t)


def test_nothing_is_rendered_before_it_is_read(room: RenderedScene) -> None:
    assert len(room.photos) == 2 and "view01.png" in room.photos
    first, again = room.photos["view01.png"], room.photos["view01.png"]
    assert first is not again
    np.testing.assert_array_equal(first, again)
    with pytest.raises(KeyError):
        room.photos["view02.png"]


@pytest.mark.slow
def test_given_polygons_cameras_and_poses_are_those_of_the_photos(room: RenderedScene) -> None:
    options = RenderOptions(fov_deg=190.0, seed=3)
    again = render(build_scene("room", 3), room.camera, options, poses=room.poses.cam_from_world)
    np.testing.assert_array_equal(again.photos["view00.png"], room.photos["view00.png"])
    moved = render(build_scene("room", 3), room.camera, options, poses=room.poses.cam_from_world[[1]])
    assert list(moved.photos) == ["view00.png"]


@pytest.mark.slow
def test_a_specification_with_a_colon_is_a_target() -> None:
    made = render("checkerboard:8x6:30mm", "pinhole", fov_deg=70.0, views=1, size_px=(320, 240))
    assert isinstance(made, RenderedTargets) and made.photos["view00.png"].shape == (240, 320)
    assert made.calibration.views[0].cam_from_board is not None
    # Where a lens is not asked for: 80 degrees of a pinhole camera.
    assert isinstance(wide := render("checkerboard:8x6:30mm", "pinhole", views=1), RenderedTargets) and wide.fov_deg == 80.0


@pytest.mark.slow
def test_what_cannot_be_rendered_is_refused(room: RenderedScene) -> None:
    with pytest.raises(InputError, match="'cave'"):
        render("cave")
    with pytest.raises(InputError, match="pattern that starts with"):
        render("chessboard:8x6:30mm")
    with pytest.raises(InputError, match="noise of at least 0"):
        render("room", noise_grey=-1.0)
    with pytest.raises(TypeError, match="blur"):
        render("room", blur=2.0)  # type: ignore[call-arg]
    with pytest.raises(GeometryError):
        render("checkerboard:80x60:30mm", room.camera)
