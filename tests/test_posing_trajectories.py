"""Poses from trajectories (TUM, EuRoC, KITTI) and tables of omega, phi, kappa, beside SciPy's interpolation and real numbers."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

import omnilines as ol
from camera_models import Calibration, GeometryError, InputError, OpenCVFisheye
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.posing.from_tool import poses_from_tool
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.photo_times import number_of, time_of
from omnilines.posing.tools import pose_file_of
from omnilines.records import LengthUnit

CAMERA = OpenCVFisheye([30.0, 30.0, 31.5, 23.5, 0.0, 0.0, 0.0, 0.0], (64, 48))
ALONE = Calibration({"cam0": CAMERA})
START_NS = 1403636579763555584
STEP_NS = 50_000_000


def moving(times_s: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Centres and world_from_body rotations of a body that walks and turns."""
    centres = np.stack([1.2 * times_s, 0.3 * np.sin(2 * times_s), 0.1 * np.cos(3 * times_s)], -1)
    return centres, Rotation.from_rotvec(np.stack([0.2 * np.sin(times_s), 0.5 * times_s, 0.1 * times_s**2], -1))


def tum(times_ns: np.ndarray, in_s: bool = True) -> str:
    """timestamp tx ty tz qx qy qz qw."""
    centres, turns = moving((times_ns - START_NS) * 1e-9)
    stamps = [f"{t // 10**9}.{t % 10**9:09d}" if in_s else f"{t}.000000" for t in times_ns.tolist()]
    rows = [
        " ".join([t, *map(repr, [*c, *q])]) for t, c, q in zip(stamps, centres.tolist(), turns.as_quat().tolist(), strict=True)
    ]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n"


def euroc(times_ns: np.ndarray) -> str:
    """The scalar of a quaternion first, velocities behind."""
    centres, turns = moving((times_ns - START_NS) * 1e-9)
    head = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]\n"
    rows = [
        ",".join([str(t), *map(repr, [*c, q[3], *q[:3], 0.1])])
        for t, c, q in zip(times_ns.tolist(), centres.tolist(), turns.as_quat().tolist(), strict=True)
    ]
    return head + "\r\n".join(rows) + "\r\n"


def vins(times_ns: np.ndarray) -> str:
    """Nanoseconds, the scalar first, the velocity behind, a comma at the end."""
    centres, turns = moving((times_ns - START_NS) * 1e-9)
    quaternions = turns.as_quat().tolist()
    return "".join(
        ",".join([str(t), *map(repr, [*c, q[3], *q[:3], 0.1, 0.2, 0.3])]) + ",\n"
        for t, c, q in zip(times_ns.tolist(), centres.tolist(), quaternions, strict=True)
    )


def rows_ns(count: int = 41) -> np.ndarray:
    return START_NS + STEP_NS * np.arange(count, dtype=np.int64)


def placed(
    path: Path, photos: list[str], cameras: Calibration = ALONE, camera_of: Any = None, body: Path | None = None
) -> PhotoPoses:
    tool = pose_file_of(path)
    assert tool is not None
    return poses_from_tool(path, tool, photos, cameras, camera_of or dict.fromkeys(photos, "cam0"), body=body)


def put(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def require_same(found: Pose, centres: np.ndarray, turns: Rotation, atol: float) -> None:
    np.testing.assert_allclose(found.centre.numpy(), centres, atol=atol)
    np.testing.assert_allclose(found.rotation.mT.numpy(), turns.as_matrix(), atol=atol)


@pytest.mark.parametrize("kind", ["tum", "tum in nanoseconds", "euroc", "vins"])
def test_photos_named_by_their_time_have_the_pose_of_that_time(tmp_path: Path, kind: str) -> None:
    made = {"euroc": euroc, "vins": vins}
    text = made[kind](rows_ns()) if kind in made else tum(rows_ns(), kind == "tum")
    path = put(tmp_path, "data.csv" if kind in made else "trajectory.txt", text)
    at = rows_ns()[[3, 17, 40]]
    nanoseconds = [f"cam0/{t}.png" for t in at.tolist()]
    seconds = [f"{t // 10**9}.{t % 10**9:09d}.jpg" for t in at.tolist()]
    ros = [f"frame_{t // 10**9}_{t % 10**9:09d}.png" for t in at.tolist()]
    for photos in (nanoseconds, seconds, ros):
        found = placed(path, photos)
        assert found.poses.images == tuple(photos)
        assert found.unit is LengthUnit.METRES
        require_same(found.poses.cam_from_world, *moving((at - START_NS) * 1e-9), atol=1e-6)
        assert not any("interpolated" in note for note in found.notes)


def test_between_rows_poses_are_interpolated_as_scipy_does_and_the_error_is_foretold(tmp_path: Path) -> None:
    path = put(tmp_path, "trajectory.tum", tum(rows_ns()))
    at = rows_ns()[2:36] + np.arange(34) % 4 * 12_500_000 + 4_000_000
    found = placed(path, [f"{t}.png" for t in at.tolist()])
    rows_s, at_s = ((t - START_NS) * 1e-9 for t in (rows_ns(), at))
    centres, turns = moving(rows_s)
    linear = np.stack([np.interp(at_s, rows_s, one) for one in centres.T], -1)
    require_same(found.poses.cam_from_world, linear, Slerp(rows_s, turns)(at_s), atol=1e-6)
    (note,) = (note for note in found.notes if "interpolated" in note)
    assert note.startswith("34 photos")
    moved_mm, turned_deg = (
        float(word) for word, unit in zip(note.split(), note.split()[1:], strict=False) if unit in ("mm", "degrees")
    )
    true_centres, true_turns = moving(at_s)
    errors_mm = 1e3 * np.linalg.norm(linear - true_centres, axis=-1)
    errors_deg = np.degrees((Slerp(rows_s, turns)(at_s).inv() * true_turns).magnitude())
    assert 0.5 < moved_mm / np.median(errors_mm) < 2
    assert 0.5 < turned_deg / np.median(errors_deg) < 2


def test_photos_outside_in_gaps_and_without_a_time_are_named(tmp_path: Path) -> None:
    rows = rows_ns()
    path = put(tmp_path, "trajectory.txt", tum(np.concatenate([rows[:10], rows[20:]])))
    before, in_gap, good = rows[0] - STEP_NS, rows[14], rows[5]
    # Half a millisecond before the first row is its time, written with fewer digits.
    almost = rows[0] - 500_000
    photos = [f"{t}.png" for t in (before, in_gap, good, almost)] + ["door.png", "frame_000012.png"]
    found = placed(path, photos)
    assert found.poses.images == (photos[2], photos[3])
    told = found.left_out
    assert list(told) == [photos[0], photos[1], "door.png", "frame_000012.png"]
    assert "before or after the trajectory" in told[photos[0]]
    assert "0.55 s apart" in told[photos[1]]
    assert "holds no time" in told["frame_000012.png"]
    with pytest.raises(InputError, match=r"photos named by a time from 1403636579\.763.* were expected, found door\.png"):
        placed(path, ["door.png"])


def test_what_is_a_time_and_what_a_number() -> None:
    assert time_of("a/frame_000012.png") is None
    assert time_of("0000000012.png") is None
    assert str(time_of("left_12.250.png")) == "12.250"
    assert time_of("depth_3.jpg") is None
    assert number_of("image_02/0000000012.png") == 12
    assert number_of("door.png") is None


def kitti(numbered: bool, full: bool = False) -> str:
    centres, turns = moving(np.arange(6) * 0.1)
    rows = []
    for k, (matrix, centre) in enumerate(zip(turns.as_matrix(), centres, strict=True)):
        cells = np.column_stack([matrix, centre]).ravel().tolist() + ([0.0, 0.0, 0.0, 1.0] if full else [])
        rows.append(" ".join([*([str(3 * k)] if numbered else []), *map(repr, cells)]))
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(("numbered", "full"), [(False, False), (True, False), (True, True)])
def test_photos_named_by_their_number_have_the_pose_of_that_frame(tmp_path: Path, numbered: bool, full: bool) -> None:
    path = put(tmp_path, "poses.txt", kitti(numbered, full))
    numbers = [0, 6] if numbered else [0, 2]
    photos = [f"image_02/{n:010d}.png" for n in numbers]
    found = placed(path, [*photos, "0000000099.png"])
    centres, turns = moving(np.array([0.0, 0.2]))
    require_same(found.poses.cam_from_world, centres, turns, atol=1e-9)
    assert "no frame 99" in found.left_out["0000000099.png"]


KALIBR = """cam0: {{camera_model: pinhole, T_cam_imu: {0}, timeshift_cam_imu: 0.01}}
cam1: {{camera_model: pinhole, T_cam_imu: {1}}}
"""


def four(pose: Pose) -> list[list[float]]:
    return [*torch.cat([pose.rotation, pose.translation[:, None]], -1).tolist(), [0.0, 0.0, 0.0, 1.0]]


def test_cameras_on_a_body_have_its_poses_moved(tmp_path: Path) -> None:
    path = put(tmp_path, "trajectory.txt", tum(rows_ns()))
    mounted = [Pose.exp([0.1, -1.2, 0.4, 0.05, -0.1, 0.2]), Pose.exp([0.3, 0.2, -0.4, -0.05, 0.1, 0.3])]
    body = put(tmp_path, "camchain.yaml", KALIBR.format(*(four(pose) for pose in mounted)))
    at = rows_ns()[7]
    photos = [f"cam0/{at}.png", f"cam1/{at}.png"]
    camera_of = dict(zip(photos, ("cam0", "cam1"), strict=True))
    two = Calibration({"cam0": CAMERA, "cam1": CAMERA})
    found = placed(path, photos, two, camera_of, body)
    # The clock of cam0 is 10 ms behind that of the body.
    for k, time_s in enumerate((0.36, 0.35)):
        rows_s = (rows_ns() - START_NS) * 1e-9
        centres, turns = moving(rows_s)
        centre = np.array([np.interp(time_s, rows_s, one) for one in centres.T])
        world_from_body = Pose.of(Slerp(rows_s, turns)(time_s).as_matrix(), centre)
        expected = mounted[k] @ world_from_body.inverse()
        np.testing.assert_allclose(found.poses.cam_from_world[k].translation, expected.translation, atol=1e-6)
        np.testing.assert_allclose(found.poses.cam_from_world[k].rotation, expected.rotation, atol=1e-6)
    # A rig places the other cameras: it is held.
    rig = {"cam0": RigCamera(Pose.identity()), "cam1": RigCamera(Pose.exp([0.0, 0.1, 0.0, 0.2, 0.0, 0.0]))}
    in_rig = placed(path, photos, Calibration(two.cameras, rig=rig), camera_of, body)
    own = Calibration(two.cameras, rig=rig).rig["cam1"].cam_from_rig @ mounted[0]
    centres, turns = moving(np.array([0.35]))
    expected = own @ Pose.of(turns.as_matrix()[0], centres[0]).inverse()
    np.testing.assert_allclose(in_rig.poses.cam_from_world[1].translation, expected.translation, atol=1e-6)
    # EuRoC names no camera, and has it the other way round.
    flat = np.array(four(mounted[1].inverse())).ravel().tolist()
    sensor = put(tmp_path, "sensor.yaml", f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {flat}\n")
    alone = placed(path, [f"{at}.png"], body=sensor)
    plain = placed(path, [f"{at}.png"])
    np.testing.assert_allclose(
        alone.poses.cam_from_world[0].translation, (mounted[1] @ plain.poses.cam_from_world[0]).translation, atol=1e-9
    )
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("body_T_cam0", np.array(four(mounted[1].inverse())))
    storage.write("td", 0.0)
    vins = put(tmp_path, "settings.yaml", storage.releaseAndGetString())
    of_vins = placed(path, [f"{at}.png"], body=vins)
    np.testing.assert_allclose(of_vins.poses.cam_from_world.translation, alone.poses.cam_from_world.translation, atol=1e-9)
    row = " ".join(map(repr, np.array(four(mounted[1].inverse()))[:3].ravel().tolist()))
    listed = put(tmp_path, "calib_cam_to_pose.txt", f"image_02: {row}\n")
    again = placed(path, [f"{at}.png"], body=listed)
    np.testing.assert_allclose(again.poses.cam_from_world.translation, alone.poses.cam_from_world.translation, atol=1e-9)
    for other, told in (("T_BS: 3", "T_BS must"), ("a: 3", "found none of these"), ("", "the file must")):
        with pytest.raises(InputError, match=told):
            placed(path, [f"{at}.png"], body=put(tmp_path, "bad.yaml", other))
    with pytest.raises(InputError, match="the places of left, right on the body were expected, found those of cam0, cam1"):
        placed(path, ["a/1.5.png"], Calibration({"left": CAMERA, "right": CAMERA}), {"a/1.5.png": "left"}, body)


PIX4D = """imageName X Y Z Omega Phi Kappa
DSC_0157.JPG 332081.126000 3488911.819856 4093.688402 -2.946680 3.053212 119.804001
"""
PIX4D_ROTATION = """-0.49632901575943477734 0.86794436424468834890 -0.01816834310427051929
0.86649900151927328196 0.49400145706385401034 -0.07170802455019638366
-0.05326338781351704077 -0.05133362440616233424 -0.99726018196053234366"""
"""R of the same photo in Pix4D's calibrated_camera_parameters.txt, where a pixel is K [R|-Rt] X."""


def test_omega_phi_kappa_are_those_of_pix4d(tmp_path: Path) -> None:
    """Two files of one project of Pix4D say the rotation of one photo in two ways."""
    path = put(tmp_path, "p_calibrated_external_camera_parameters.txt", PIX4D)
    found = placed(path, ["DSC_0157.JPG"])
    expected = np.array([float(cell) for cell in PIX4D_ROTATION.split()]).reshape(3, 3)
    np.testing.assert_allclose(found.poses.cam_from_world.rotation[0], expected, atol=1e-6)
    np.testing.assert_allclose(found.poses.cam_from_world.centre[0], [332081.126, 3488911.819856, 4093.688402], atol=1e-6)
    assert (found.unit, found.up) == (LengthUnit.METRES, (0.0, 0.0, 1.0))


def test_omega_phi_kappa_of_metashape(tmp_path: Path) -> None:
    """Tabs, labels without endings, a coordinate system before; a geographic one is refused."""
    row = "\t".join(["DSC 0157", *PIX4D.split()[8:], *["0"] * 9])
    head = "# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12, r13, r21, r22, r23, r31, r32, r33\n"
    text = f'# CoordinateSystem: PROJCS["WGS 84 / UTM zone 32N"]\n{head}{row}\n'
    found = placed(put(tmp_path, "cameras.txt", text), ["DSC 0157.JPG"])
    expected = np.array([float(cell) for cell in PIX4D_ROTATION.split()]).reshape(3, 3)
    np.testing.assert_allclose(found.poses.cam_from_world.rotation[0], expected, atol=1e-6)
    blank = placed(put(tmp_path, "blanks.txt", PIX4D.replace("DSC_0157.JPG", "my photo 7.JPG")), ["my photo 7.JPG"])
    assert blank.poses.images == ("my photo 7.JPG",)
    with pytest.raises(InputError, match="found a geographic one"):
        placed(put(tmp_path, "degrees.txt", text.replace("PROJCS", "GEOGCS")), ["DSC 0157.JPG"])


@pytest.mark.parametrize("kind", ["trajectory.txt", "data.csv", "poses.txt", "opk.txt"])
def test_a_damaged_file_is_refused_with_one_sentence_or_not_taken_for_one(tmp_path: Path, kind: str) -> None:
    whole = {"trajectory.txt": tum(rows_ns(5)), "data.csv": euroc(rows_ns(5)), "poses.txt": kitti(True), "opk.txt": PIX4D}[kind]
    harmed = [whole[: len(whole) * k // 30] for k in range(1, 30)]
    for old, new in ((" ", "  "), (".", ".."), ("0", "1e999"), ("1", "-"), ("-", "nan"), ("0.", "7."), ("\n", " "), ("0", "")):
        harmed.append(whole.replace(old, new))
    refused = 0
    for text in harmed:
        path = put(tmp_path, kind, text)
        tool = pose_file_of(path)
        try:
            if tool is not None:
                tool.read(path).cam_from_world.require_rigid()
        except InputError as error:
            refused += 1
            assert str(path) in str(error)
            assert "\n" not in str(error)
    assert refused > 4


def test_tables_of_our_own_are_no_trajectories(tmp_path: Path) -> None:
    own = "image,qw,qx,qy,qz,tx,ty,tz\na.png,1,0,0,0,0,0,0\n"
    assert pose_file_of(put(tmp_path, "poses.csv", own)) is None
    corners = "view,image,board_x_m,board_y_m,u_px,v_px\n0,1.png,0,0,1,1\n"
    assert pose_file_of(put(tmp_path, "corners.csv", corners)) is None


def test_body_counts_with_a_trajectory_only(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for time in rows_ns()[[3, 9, 12]].tolist():
        cv2.imwrite(str(photos / f"{time}.png"), np.zeros((48, 64), np.uint8))
    path = put(tmp_path, "trajectory.txt", tum(rows_ns()))
    body = put(tmp_path, "camchain.yaml", KALIBR.format(*[four(Pose.identity())] * 2).split("\n")[0])
    found = ol.estimate_poses(photos, ALONE, path, body=body)
    assert (len(found.poses), found.source, found.unit) == (3, "tool", LengthUnit.METRES)
    for source in ("sfm", "rig"):
        with pytest.raises(InputError, match="`body` was expected with `poses` of a trajectory"):
            ol.estimate_poses(photos, ALONE, source, body=body)


@pytest.mark.slow
def test_without_lines_it_is_said_whose_trajectory_was_read(tmp_path: Path) -> None:
    """Photos of noise have no lines, as have those that are given the poses of an IMU."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for k, time in enumerate(rows_ns()[[3, 9, 12, 20]].tolist()):
        ramp = np.add.outer(np.arange(48), (3 + k) * np.arange(64)) % 128
        cv2.imwrite(str(photos / f"{time}.png"), np.where(ramp < 64, 60, 190).astype(np.uint8))
    poses = ol.estimate_poses(photos, ALONE, put(tmp_path, "trajectory.txt", tum(rows_ns())))
    with pytest.raises(GeometryError, match=r"read as that of the camera; where it is that of an IMU"):
        ol.reconstruct(ol.extract(photos, ALONE["cam0"]), poses, ALONE)
