"""Arcs and lines of photos that are not ours: a surveyed courtyard, round photos of a fisheye, a street seen by a rig."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from courtyard import read_courtyard, write_courtyard
from held_out import NEAR_PX, held_out

import omnilines as ol
from camera_models import OpenCVFisheye, save
from camera_models.formats import read as read_calibration
from omnilines.cli import main
from omnilines.evaluation.cameras import bearing_error_deg
from omnilines.extraction import extract_arcs
from omnilines.extraction.image_circle import image_circle
from omnilines.files import read_lines, read_photo, read_poses

LEFT_OUT = "0005.jpg"


def test_ordinary_photos_have_no_image_circle(shared_data: Path) -> None:
    """Shaded arcades lie along their borders."""
    data = shared_data / "lines" / "castle30"
    poses, camera = read_courtyard(data)
    found = {name: image_circle(read_photo(data / "images" / name), camera) for name in poses.images[::3]}
    assert found == dict.fromkeys(found)


def test_round_photos_have_one_image_circle(shared_data: Path) -> None:
    files = sorted((shared_data / "calibration" / "ov_plane" / "test").glob("*.png"))
    lens = OpenCVFisheye.from_mapping({"fx": 350.0, "fy": 350.0, "cx": 640.0, "cy": 400.0}, (1280, 800))
    found = np.array([image_circle(read_photo(file), lens) for file in files], dtype=np.float64)
    np.testing.assert_allclose(found, np.broadcast_to(np.median(found, 0), found.shape), atol=4.0)


@pytest.mark.slow
def test_arcs_of_a_courtyard_lie_where_a_peer_sees_segments(shared_data: Path) -> None:
    """Of the length of OpenCV's LSD segments of 40 px and more most has an arc along it, within 2 px."""
    data = shared_data / "lines" / "castle30"
    camera = read_courtyard(data)[1]
    photo = data / "images" / LEFT_OUT
    ends = extract_arcs(read_photo(photo), camera).endpoints_px
    covered = np.zeros(camera.image_size[::-1], dtype=np.uint8)
    for start, end in ends.round().astype(int).tolist():
        cv2.line(covered, start, end, 255, thickness=5)
    segments = cv2.createLineSegmentDetector().detect(cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE))[0].reshape(-1, 2, 2)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1)
    long = segments[length >= 40.0]
    places = (long[:, :1] + np.linspace(0.0, 1.0, 41)[:, None] * (long[:, 1:] - long[:, :1])).round().astype(int).reshape(-1, 2)
    assert (covered[places[:, 1], places[:, 0]] > 0).mean() > 0.9


@pytest.mark.slow
def test_lines_of_a_courtyard_lie_where_a_photo_left_out_shows_edges(shared_data: Path, tmp_path: Path) -> None:
    """Surveyed poses; judged by OpenCV's LSD. No line is known to be visible there, so that not all can be confirmed."""
    data = shared_data / "lines" / "castle30"
    poses, camera = read_courtyard(data)
    write_courtyard(tmp_path / "photos", data, [f"{k:04}.jpg" for k in (3, 4, 6, 7)])
    files = [str(tmp_path / "photos" / name) for name in ("calibration.yaml", "poses.csv")]
    out = tmp_path / "scene"
    with pytest.raises(SystemExit, match="0"):
        main(["reconstruct", str(tmp_path / "photos"), "--calibration", files[0], "--poses", files[1], "--out", str(out)])
    lines = read_lines(out / "lines.csv")
    segments = cv2.createLineSegmentDetector().detect(cv2.imread(str(data / "images" / LEFT_OUT), cv2.IMREAD_GRAYSCALE))[0]
    pose = poses.cam_from_world[poses.images.index(LEFT_OUT)]
    place, beside = held_out(lines.ends_m[lines.known], pose, camera, segments.reshape(-1, 2, 2).astype(np.float64))
    assert len(place) > 30
    assert (place < NEAR_PX).mean() > 0.25 + (beside < NEAR_PX).mean()


@pytest.mark.full
def test_lines_of_a_courtyard_calibrate_its_camera(shared_data: Path) -> None:
    """It was surveyed without distortion: the rational variant, whose terms cancel, neither leads nor is taken."""
    data = shared_data / "lines" / "castle30"
    poses, camera = read_courtyard(data)
    found = ol.calibrate([str(data / "images" / name) for name in poses.images[::3]], "lines", model="pinhole")
    assert found.selection.chosen.candidate.options == {"coefficients": 5}
    assert not any("settled" in note for note in found.notes)
    assert bearing_error_deg(found.camera, camera, math.radians(found.fit.max_angle_deg))[0] < 0.15
    fx = camera.named_parameters()["fx"]
    assert abs(found.camera.named_parameters()["fx"] - fx) < 0.01 * fx < 4.0 * found.sigma["fx"]


@pytest.mark.slow
def test_lines_of_three_cameras_of_a_rig_lie_where_the_fourth_shows_edges(shared_data: Path, tmp_path: Path) -> None:
    """OmniMVS's rendered street, 220 degrees: the only instant there is, by cameras 0.85 to 1.2 m apart; judged by arcs."""
    data = shared_data / "rigs" / "omnimvs" / "sunny_single"
    calibration = read_calibration(data / "config.yaml").calibration
    assert calibration.rig is not None
    save(tmp_path / "calibration.yaml", calibration)
    for name in ("cam1", "cam3", "cam4"):
        (tmp_path / "photos" / name).mkdir(parents=True)
        (tmp_path / "photos" / name / "0001.png").symlink_to(data / name / "0001.png")
    inputs = ["--calibration", str(tmp_path / "calibration.yaml"), "--poses", "rig", "--min-views", "3"]
    with pytest.raises(SystemExit, match="0"):
        main(["reconstruct", str(tmp_path / "photos"), *inputs, "--out", str(tmp_path / "scene")])
    lines, poses = read_lines(tmp_path / "scene" / "lines.csv"), read_poses(tmp_path / "scene" / "poses.csv")
    cam1_from_world = poses.cam_from_world[poses.images.index("cam1/0001.png")]
    pose = calibration.rig["cam2"].cam_from_rig @ calibration.rig["cam1"].cam_from_rig.inverse() @ cam1_from_world
    arcs = extract_arcs(read_photo(data / "cam2" / "0001.png"), calibration["cam2"]).endpoints_px
    place, beside = held_out(lines.ends_m[lines.known], pose, calibration["cam2"], arcs)
    assert len(place) > 15
    assert (place < NEAR_PX).mean() > 0.5 + (beside < NEAR_PX).mean()


@pytest.mark.slow
def test_edges_of_a_printed_board_are_where_they_are_drawn_and_a_camera_that_stood_still_is_named(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A fisheye on a stand, calibrated with the same photos; the corners are known from the drawing of the board."""
    photos, own = shared_data / "calibration" / "fisheye_wide", tmp_path / "own"
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["calibrate", str(photos), "--pattern", "checkerboard:7x6:10mm", "--out", str(own)])
    known = ["--calibration", str(own / "calibration.yaml"), "--poses", str(own / "corners.csv")]
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["reconstruct", str(photos), *known, "--out", str(tmp_path / "lines")])
    said = capsys.readouterr().out
    assert "the camera stood still" in said and "less surely" not in said
    lines = read_lines(tmp_path / "lines" / "lines.csv")
    ends = lines.ends_m[lines.known] / 0.01
    upright = np.ptp(ends[..., 1], axis=1) > np.ptp(ends[..., 0], axis=1)
    place = np.where(upright[:, None], ends[..., 0], ends[..., 1])
    drawn = (np.abs(np.stack([place - np.rint(place), ends[..., 2]])) < 0.2).all((0, 2)) & (place > -0.5).all(1)
    drawn &= (place < np.where(upright, 7, 6)[:, None] - 0.5).all(1)
    assert len({(bool(u), round(p)) for u, p in zip(upright[drawn], place[drawn, 0], strict=True)}) >= 11
    away = np.hypot(place - np.rint(place), ends[..., 2])[drawn].max(1) * 0.01
    assert lines.calibration_sigma_m is not None and (lines.calibration_sigma_m > 0).all()
    assert (away < 2.45 * lines.sigma_m[lines.known][drawn]).mean() > 0.85
