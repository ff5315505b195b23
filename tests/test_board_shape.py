"""A board that is bent or whose squares are not square: derivatives, recovery, and what it costs to ask for nothing."""

import numpy as np
import pytest
import torch
from board_views import BOARD, board_corners, board_views

from camera_models import InputError, OpenCVFisheye
from omnilines.calibration.board_shape import TERM_NAMES, BoardShape
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.views import board_points
from omnilines.records import Corners

LENS = OpenCVFisheye([320.0, 321.0, 645.0, 470.0, 0.01, -0.005, 0.001, 0.0], (1280, 960))
TERMS = torch.tensor([0.002, 8e-4, -3e-4, 5e-4], dtype=torch.float64)


def bent_corners(noise_px: float, seed: int, views: int = 20, scale: float = 1.0) -> tuple[Corners, CameraAndBoards]:
    """Views of a board with the terms above, times `scale`."""
    poses = board_views(LENS, 80, views, 12)
    shape = BoardShape.to_refine(("aspect", "flatness"), torch.as_tensor(BOARD)).moved(scale * TERMS)
    corners = board_corners(LENS, poses, 0.0, 0)
    points = board_points(corners, np.ones(len(corners), bool), list(range(views)))
    state = CameraAndBoards(LENS, poses, shape)
    pixels = LENS.project(state.seen(points))[0].numpy()
    noisy = pixels + noise_px * np.random.default_rng(seed).standard_normal(pixels.shape)
    return Corners(corners.view, corners.view_names, corners.images, corners.board_m, noisy), state


def test_jacobian_is_that_of_automatic_differentiation():
    corners, state = bent_corners(0.3, 1, views=4)
    points = board_points(corners, np.ones(len(corners), bool), list(range(4)))
    problem = BoardProblem(points, LENS.calibration_basis(), None, state.shape)
    size = problem.structure.kept_size
    assert size == 8 + 4

    def moved(step):
        return problem.retract(state, step, torch.zeros(4, 6, dtype=torch.float64)).residual_px(points)

    dense = torch.autograd.functional.jacobian(moved, torch.zeros(size, dtype=torch.float64))
    torch.testing.assert_close(dense, problem.linearise(state).by_kept[0], rtol=1e-7, atol=1e-6)


@pytest.mark.slow
def test_terms_are_found_again():
    """Exactly without noise, and within their stated standard deviations with it; a plane board does not fit."""
    exact = calibrate_camera(bent_corners(0.0, 0)[0], LENS.image_size, "opencv-fisheye", refine_board=("aspect", "flatness"))
    np.testing.assert_allclose(list(exact.board_terms.values()), TERMS, atol=1e-7)
    assert tuple(exact.board_terms) == TERM_NAMES
    scores = []
    for seed in range(6):
        corners, _ = bent_corners(0.2, seed)
        result = calibrate_camera(corners, LENS.image_size, "opencv-fisheye", refine_board=("aspect", "flatness"))
        sigma = np.array(list(result.board_sigma.values()))
        scores.append((np.array(list(result.board_terms.values())) - TERMS.numpy()) / sigma)
        assert abs(result.rms_px_per_axis - 0.2) < 0.02
    # 24 scores of unit variance: their mean square lies in 0.4 to 1.9 but once in a thousand times.
    assert 0.4 < np.mean(np.square(scores)) < 1.9
    flat = calibrate_camera(corners, LENS.image_size, "opencv-fisheye", loss="none")
    # Eight standard deviations above the noise.
    assert flat.rms_px_per_axis > 0.22 and flat.board_terms == {}


def test_corners_are_judged_by_the_board_that_is_estimated():
    """A board as drawn leaves 1.2 px here, beside which corners that are 2 px off do not stand out, and good ones do."""
    corners, _ = bent_corners(0.1, 3, scale=4.0)
    rng = np.random.default_rng(0)
    wrong = np.isin(np.arange(len(corners)), rng.choice(len(corners), 25, replace=False))
    angle = rng.uniform(0, 2 * np.pi, wrong.sum())
    pixels = corners.pixels.copy()
    pixels[wrong] += 2.0 * np.stack([np.cos(angle), np.sin(angle)], -1)
    spoilt = Corners(corners.view, corners.view_names, corners.images, corners.board_m, pixels)
    result = calibrate_camera(spoilt, LENS.image_size, "opencv-fisheye", refine_board=("aspect", "flatness"))
    assert not result.kept[wrong].any() and result.kept[~wrong].mean() > 0.99
    assert result.rms_px_per_axis == pytest.approx(0.1, rel=0.05)


def test_one_kind_can_be_asked_for_alone():
    corners, _ = bent_corners(0.2, 3)
    result = calibrate_camera(corners, LENS.image_size, "opencv-fisheye", refine_board=("aspect",))
    assert list(result.board_terms) == ["aspect"]
    with pytest.raises(InputError, match="aspect and flatness, found 'size'"):
        calibrate_camera(corners, LENS.image_size, "opencv-fisheye", refine_board=("size",))
