"""Views turned level by the lines of each photo: against rendered photos whose tilt is known."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

import omnilines as ol
from camera_models import OpenCVFisheye
from camera_models.views import looking
from omnilines.cli import main
from omnilines.files.levels import read_levels

LENS = OpenCVFisheye([105.0, 105.0, 199.5, 199.5, 0.0, 0.0, 0.0, 0.0], (400, 400))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two photos of a room, tilted, and one of noise."""
    folder = tmp_path_factory.mktemp("upright") / "room"
    ol.render("plain-room", LENS, ol.RenderOptions(views=2, seed=4)).save(folder)
    noise = np.random.default_rng(0).integers(110, 130, (400, 400, 3)).astype(np.uint8)
    assert cv2.imwrite(str(folder / "noise.png"), noise)
    return folder


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        main([str(one) for one in arguments])
    told = capsys.readouterr()
    return int(end.value.code or 0), told.out, " ".join(told.err.split())


@pytest.mark.slow
def test_views_are_level_and_say_what_they_were_turned_by(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ("rectify", room, "--calibration", room / "calibration.yaml", "--upright", "--json", "--out", tmp_path)
    status, out, _ = run(capsys, *given, "--view", "cube", "--size", "64x64", "--yaw-deg", "30")
    data, rows, true = json.loads(out), read_levels(tmp_path / "upright.csv"), ol.read_poses(room / "poses.csv")
    assert status == 0 and [row.image for row in rows] == data["views"] and len(rows) == 12
    assert any("noise.png is left out: no vertical stands out in its lines." in note for note in data["notes"])
    assert len(list(tmp_path.glob("*.png"))) == 12
    for k, photo in enumerate(true.images):
        front, right, *_ = own = [row for row in rows if row.image.startswith(Path(photo).stem)]
        rotation = true.cam_from_world.rotation[k].numpy()
        up = front.view_from_camera @ rotation[:, 2]
        error = math.acos(min(1.0, -float(up[1])))
        sigma = math.sqrt(np.linalg.eigvalsh(front.covariance)[-1])
        assert error < 2e-3 and error < 4 * sigma and 0 < sigma < 2e-3
        # No error about the vertical: where a level view looks is a choice.
        assert np.abs(front.covariance[1]).max() < 1e-12
        assert own[4].view_from_camera @ rotation[:, 2] == pytest.approx([0, 0, 1], abs=2e-3)
        assert right.view_from_camera @ front.view_from_camera.T == pytest.approx(looking(90.0, 0.0), abs=1e-12)
        # The optical axis stays where it is, 30 degrees to the left of the middle, above or below the horizon.
        axis = front.view_from_camera[:, 2]
        assert math.degrees(math.atan2(axis[0], axis[2])) == pytest.approx(-30.0, abs=1e-6)
        assert math.degrees(front.tilt_rad) == pytest.approx(data["upright"][k]["tilt_deg"])


@pytest.mark.slow
def test_a_level_view_is_the_photo_that_a_level_camera_takes(room: Path) -> None:
    """Its own vertical is straight up: levelled again it does not move."""
    names = ol.read_poses(room / "poses.csv").images
    photos = {name: cv2.imread(str(room / name)) for name in names}
    first = ol.rectify(photos, ol.load(room / "calibration.yaml"), "panorama", size=(1000, 500), upright=True)
    made = dict(first.pixels())
    again = ol.rectify(made, first.camera, "panorama", size=(100, 50), upright=True)
    tilts = [one.level.tilt_rad for one in again.views if one.level is not None]
    before = [one.level.tilt_rad for one in first.views if one.level is not None]
    assert len(tilts) == len(before) == 2 and max(tilts) < 3e-3 < 0.02 < max(before)
    shown = [float(pixels.any(-1).mean()) for pixels in made.values()]
    assert list(first.shown_share.values()) == pytest.approx(shown, abs=0.01)


def test_photos_may_be_turned_one_by_one(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What earlier views were turned by stays beside them."""
    names = ol.read_poses(room / "poses.csv").images
    given = ("--calibration", room / "calibration.yaml", "--size", "64x48", "--out", tmp_path)
    for name in names:
        assert run(capsys, "rectify", room / name, *given, "--upright")[0] == 0
    both = read_levels(tmp_path / "upright.csv")
    assert [row.image for row in both] == [f"{Path(name).stem}.png" for name in names]
    assert run(capsys, "rectify", room / "noise.png", room / names[0], *given)[0] == 0
    assert [row.image for row in read_levels(tmp_path / "upright.csv")] == [both[1].image]
    assert len(list(tmp_path.glob("*.png"))) == 3
    assert run(capsys, "rectify", room / names[1], *given)[0] == 0 and not (tmp_path / "upright.csv").exists()


def test_where_no_photo_shows_the_vertical_nothing_is_made(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("rectify", room / "noise.png", "--calibration", room / "calibration.yaml", "--out", tmp_path / "out")
    status, _, err = run(capsys, *given, "--upright")
    # Its arcs are kept, for the same command with other options.
    assert status == 2 and "or leave --upright out" in err and [path.name for path in (tmp_path / "out").iterdir()] == ["work"]
    status, _, err = run(capsys, *given, "--set", "directions.tried_rad=0.01")
    assert status == 2 and "directions.tried_rad counts only with --upright" in err
