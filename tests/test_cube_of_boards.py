"""Several boards on one body, seen by one camera: where they stand to one another is estimated with the camera."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from board_views import BOARD, board_views
from rig_views import PINHOLE, table_of
from test_cli import run

import omnilines as ol
from calib_patterns import pattern
from calib_patterns.rendering import graded_background, render_target
from camera_models import OpenCVFisheye
from camera_models.pose import Pose, rotation_from_vector

NOISE_PX = 0.1
SIDE_M = 0.3
FACES = [f"aprilgrid:4x4:40mm:0.3:36h11{start}" for start in ("", ":start=16", ":start=32")]


def turned(*vector: float) -> torch.Tensor:
    return rotation_from_vector(torch.tensor(vector, dtype=torch.float64))


def on_a_cube(middles_m: list[torch.Tensor]) -> Pose:
    """`first_from_board` of boards on three faces of a cube, none quite straight; z of each leads into it."""
    faces = [turned(0, 0, 0), turned(0.02, -np.pi / 2, 0.01), turned(np.pi / 2, 0, -0.03)]
    poses = [Pose(face, -0.5 * SIDE_M * face[:, 2] - face @ middle) for face, middle in zip(faces, middles_m, strict=True)]
    return Pose.stack([poses[0].inverse() @ pose for pose in poses])


def test_boards_of_a_table_are_placed_by_one_camera() -> None:
    """Corners with noise; two boards side by side, at an angle."""
    second = Pose(turned(0.1, -0.6, 0.05), torch.tensor([0.3, 0.02, 0.1], dtype=torch.float64))
    poses = board_views(PINHOLE, 40, 40, 3, distance_m=(0.5, 0.9))
    views, parts, boards = [], [], []
    rng = np.random.default_rng(0)
    limit = torch.tensor(PINHOLE.image_size) - 3
    for k in range(len(poses)):
        for name, pose in (("a", poses[k]), ("b", poses[k] @ second)):
            pixels, valid = PINHOLE.project(pose.transform(torch.as_tensor(BOARD)))
            if bool((valid & ((pixels >= 2) & (pixels <= limit)).all(-1)).all()):
                parts.append((len(views), BOARD, pixels.numpy() + NOISE_PX * rng.standard_normal(pixels.shape)))
                views.append(("cam0", f"{k:02d}"))
                boards.append(name)
    assert boards.count("b") >= 8
    corners = replace(table_of(views, parts), boards=tuple(boards))
    result = ol.calibrate_rig(corners, PINHOLE.image_size, model="pinhole").fit
    off = (result.target_from_board[1] @ second.inverse()).log().numpy()
    # Chi-square of six: beyond 28 once in ten thousand times.
    assert result.boards == ("a", "b") and off @ np.linalg.solve(result.board_covariance[1], off) < 28
    assert result.board_covariance[1].trace() > 0 and result.rms_px_per_axis < 1.02 * NOISE_PX


@pytest.mark.full
def test_photos_of_a_cube_give_camera_and_boards_in_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lens = OpenCVFisheye([330.0, 331.0, 399.5, 299.5, 0.02, -0.004, 0.0, 0.0], (800, 600))
    boards = [pattern(face) for face in FACES]
    truth = on_a_cube([torch.as_tensor(board.points_m.mean(0)) for board in boards])
    wall, rng = graded_background(lens, np.random.default_rng(0)), np.random.default_rng(1)
    folder = tmp_path / "cube"
    folder.mkdir()
    for k in range(16):
        seen = (
            turned(0, 0, rng.uniform(-3, 3)) @ turned(*(0.35 * rng.standard_normal(3))) @ turned(-0.6, 0, 0) @ turned(0, 0.75, 0)
        )
        place = torch.tensor([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.45, 0.65)], dtype=torch.float64)
        shot = wall
        for board, pose in zip(boards, Pose(seen, place) @ truth, strict=True):
            middle = pose.rotation @ torch.as_tensor(board.points_m.mean(0)) + pose.translation
            if float(pose.rotation[:, 2] @ middle / middle.norm()) > 0.25:
                shot = render_target(board, lens, pose, supersample=2, blur_px=0.5, background=shot).astype(np.float64)
        grey = shot + rng.normal(0, 2, shot.shape)
        assert cv2.imwrite(str(folder / f"{k:02d}.png"), grey.clip(0, 255).astype(np.uint8))
    asked = ("--pattern", ",".join(FACES), "--model", "opencv-fisheye", "--json")
    status, out, err = run(capsys, "calibrate", folder, *asked, "--out", tmp_path / "out")
    assert status == 0 and "have no photo of the same name" not in err
    data = json.loads(out)
    assert list(data["cameras"]) == ["cam0"] and list(data["boards"]) == FACES
    found = ol.calibrate_rig(ol.detect_rig(folder, FACES, camera="cam0"), model="opencv-fisheye").fit
    for k in (1, 2):
        assert np.allclose(data["boards"][FACES[k]]["translation_m"], found.target_from_board[k].translation, atol=1e-9)
        off = (found.target_from_board[k] @ truth[k].inverse()).log().numpy()
        assert off @ np.linalg.solve(found.board_covariance[k], off) < 28
