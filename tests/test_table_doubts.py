"""What a table of corners, or of segments, says of itself where it cannot be right."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from board_views import BOARD, board_views
from test_judged_tracks import LENS as SCENE_LENS
from test_judged_tracks import scene

import omnilines as ol
from camera_models import InputError, OpenCVFisheye
from omnilines.records import Corners

LENS = OpenCVFisheye([300.0, 300.0, 479.5, 359.5, 0.02, -0.004, 0.0, 0.0], (960, 720))
BOARD_T = torch.as_tensor(BOARD)


def table(board: np.ndarray, noise_px: float = 0.1) -> Corners:
    """Eight views of the board, written with the places `board`."""
    poses = board_views(LENS, 60.0, 8, seed=3)
    pixels = np.stack([LENS.project(poses[k].transform(BOARD_T))[0].numpy() for k in range(8)])
    pixels = pixels + noise_px * np.random.default_rng(0).standard_normal(pixels.shape)
    names = tuple(f"{k}.png" for k in range(8))
    return Corners(np.repeat(np.arange(8), len(BOARD)), names, names, np.tile(board, (8, 1)), pixels.reshape(-1, 2))


def test_a_board_in_millimetres_is_asked_about_and_the_camera_is_the_same() -> None:
    good = ol.calibrate(table(BOARD), LENS.image_size, model="opencv-fisheye")
    large = ol.calibrate(table(1000.0 * BOARD), LENS.image_size, model="opencv-fisheye")
    assert any("in millimetres" in note for note in large.notes)
    assert not any("millimetres" in note or "do not rely" in note for note in good.notes)
    np.testing.assert_allclose(large.camera.parameters.numpy(), good.camera.parameters.numpy(), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_squares_that_are_no_squares_are_named() -> None:
    with pytest.raises(InputError, match=r"fit a board whose y is 1\.2"):
        ol.calibrate(table(BOARD * [1.0, 1 / 1.2, 1.0]), LENS.image_size, model="opencv-fisheye")


@pytest.mark.slow
def test_corners_in_no_order_are_refused() -> None:
    mixed = np.random.default_rng(1).permutation(len(BOARD))
    with pytest.raises(InputError, match=r"order of a board|explain"):
        ol.calibrate(table(BOARD[mixed]), LENS.image_size, model="opencv-fisheye")


def test_segments_outside_of_the_image_are_refused() -> None:
    segments, poses = scene(8, 5, seed=0)
    assert len(ol.triangulate(segments, poses, SCENE_LENS).lines) == 8
    with pytest.raises(InputError, match="Segments inside the image"):
        ol.triangulate(replace(segments, endpoints_px=segments.endpoints_px + 5000.0), poses, SCENE_LENS)
