"""Rendered photos against closed forms and against the detector; board poses against what they promise."""

import math

import cv2
import numpy as np
import pytest
import torch

from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import BLACK_GREY, WHITE_GREY, render_target
from camera_models._model import CameraModel
from camera_models.errors import GeometryError, InputError
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose
from camera_models.scaramuzza import Scaramuzza

BOARD = pattern("checkerboard:8x6:32.5mm")
FISHEYE = OpenCVFisheye([286.0, 286.0, 639.5, 479.5, -0.01, 0.003, -0.001, 0.0001], (1280, 960))
PINHOLE = Pinhole.from_mapping({"fx": 400.0, "fy": 400.0, "cx": 319.5, "cy": 239.5}, (640, 480))
CAMERAS = [
    pytest.param(FISHEYE, math.radians(85.0), id="fisheye-190"),
    pytest.param(
        Pinhole.from_mapping({"fx": 500.0, "fy": 500.0, "cx": 322.0, "cy": 238.0, "k1": -0.1}, (640, 480)), 0.7, id="pinhole"
    ),
    pytest.param(Scaramuzza.examples()[0], math.radians(80.0), id="scaramuzza"),
]


def facing(distance_m: float) -> Pose:
    """Square to the axis, the first inner corner on it."""
    return Pose.of(np.eye(3), np.array([0.0, 0.0, distance_m]))


def test_grey_levels_are_areas() -> None:
    """A square board seen square on: pixels hold the area shares that the closed form of the print gives."""
    square_px = 37.3
    image = render_target(BOARD, PINHOLE, facing(400 * 0.0325 / square_px)).astype(np.float64)
    u, v = np.arange(640) - 319.5, np.arange(480) - 239.5

    def wave(x: np.ndarray) -> np.ndarray:
        """Mean of the square wave over each pixel."""
        edges = np.stack([x - 0.5, x + 0.5]) / square_px
        integral = 1.0 - np.abs(np.mod(edges, 2.0) - 1.0)
        return (integral[1] - integral[0]) * square_px

    on_board = (np.abs(u - 3.5 * square_px) < 4.4 * square_px)[None] & (np.abs(v - 2.5 * square_px) < 3.4 * square_px)[:, None]
    white = 0.5 * (1.0 - wave(v)[:, None] * wave(u)[None])
    expected = BLACK_GREY + (WHITE_GREY - BLACK_GREY) * white
    assert on_board.sum() > 30_000
    assert np.abs(image - expected)[on_board].max() <= 0.5 + 1e-6  # rounding to whole grey levels


@pytest.mark.slow
def test_anti_aliasing_has_converged() -> None:
    """The default sampling agrees with a far finer one on a strongly tilted board at the rim."""
    pose = random_board_poses(BOARD, FISHEYE, 1, math.radians(85.0), seed=5)[0]
    coarse = render_target(BOARD, FISHEYE, pose).astype(np.float64)
    fine = render_target(BOARD, FISHEYE, pose, supersample=16).astype(np.float64)
    assert np.abs(coarse - fine).max() <= 4 and np.sqrt(((coarse - fine) ** 2).mean()) < 0.2


def test_margin_background_and_what_the_lens_does_not_see() -> None:
    lens = OpenCVFisheye([200.0, 200.0, 319.5, 239.5, -0.2, 0.0, 0.0, 0.0], (640, 480))
    image = render_target(BOARD, lens, facing(0.5), background=np.full((480, 640), 77.0))
    radius = np.hypot(*np.meshgrid(np.arange(640) - 319.5, np.arange(480) - 239.5))
    limit = float(
        lens.project(np.array([[math.sin(lens.max_angle - 1e-6), 0.0, math.cos(lens.max_angle - 1e-6)]]))[0][0, 0] - 319.5
    )
    assert 150 < limit < 230
    assert (image[radius > limit + 1] == 0).all()
    assert set(np.unique(image[(radius < limit - 1) & (radius > 140)])) == {77}
    x, y = np.array([-1.5, 3.5]) * 0.0325
    margin, _ = lens.project(np.array([[x, y, 0.5]]))
    assert image[round(margin[0, 1]), round(margin[0, 0])] == round(WHITE_GREY)


def test_a_board_behind_is_not_drawn_and_its_back_is_blank() -> None:
    background = np.full((480, 640), 77.0)
    assert (render_target(BOARD, PINHOLE, facing(-0.4), background=background) == 77).all()
    back = Pose.of(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.4]))
    assert set(np.unique(render_target(BOARD, PINHOLE, back, background=background))) <= set(range(77, int(WHITE_GREY) + 1))
    assert (render_target(BOARD, PINHOLE, back, background=background) == int(WHITE_GREY)).sum() > 10_000


def test_blur_noise_vignetting_and_seed() -> None:
    pose, flat = facing(0.4), np.full((480, 640), 120.0)
    clean = render_target(BOARD, PINHOLE, pose, background=flat).astype(np.float64)
    noisy = render_target(BOARD, PINHOLE, pose, background=flat, noise_grey=3.0, seed=1).astype(np.float64)
    far = np.s_[400:, :]
    assert abs((noisy - clean)[far].std() - math.sqrt(9 + 1 / 12)) < 0.1
    dimmed = render_target(BOARD, PINHOLE, pose, background=flat, vignetting=0.5)
    assert dimmed[-1, -1] == 60 and dimmed[239, 319] == clean[239, 319].astype(np.uint8)
    blurred = render_target(BOARD, PINHOLE, pose, background=flat, blur_px=2.0).astype(np.float64)
    np.testing.assert_allclose(blurred, cv2.GaussianBlur(clean, (0, 0), 2.0), atol=1.1)
    again = render_target(BOARD, PINHOLE, pose, noise_grey=3.0, seed=1)
    assert (again == render_target(BOARD, PINHOLE, pose, noise_grey=3.0, seed=1)).all()
    assert (again != render_target(BOARD, PINHOLE, pose, noise_grey=3.0, seed=2)).any()


def test_options_out_of_range() -> None:
    for options in ({"supersample": 1}, {"blur_px": -1.0}, {"vignetting": 2.0}, {"background": np.zeros((4, 4))}):
        with pytest.raises(InputError, match="change the one out of range"):
            render_target(BOARD, PINHOLE, facing(0.4), **options)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "max_angle"), CAMERAS)
def test_board_poses_keep_their_promises(model: CameraModel, max_angle: float) -> None:
    poses = random_board_poses(BOARD, model, 20, max_angle, seed=3)
    points = poses.transform(torch.as_tensor(BOARD.points_m).expand(20, -1, -1))
    pixels, valid = model.project(points)
    angle = torch.atan2(points[..., :2].norm(dim=-1), points[..., 2]).amax(1)
    limit = torch.tensor(model.image_size) - 1
    assert valid.all() and (pixels >= 0).all() and (pixels <= limit).all()
    assert (angle <= max_angle).all() and (poses.centre[:, 2] < 0).all()
    grid = pixels.reshape(20, 6, 8, 2)
    assert grid.diff(dim=1).norm(dim=-1).min() >= 12 and grid.diff(dim=2).norm(dim=-1).min() >= 12
    middle = poses.transform(torch.as_tensor(BOARD.points_m.mean(0))[None].expand(20, 1, 3))[:, 0]
    tilt = torch.acos((middle * poses.rotation[:, :, 2]).sum(-1) / middle.norm(dim=-1))
    assert tilt.max() <= math.radians(45.001) and tilt.max() > math.radians(35)
    one, same, other = (random_board_poses(BOARD, model, 4, max_angle, seed=seed).translation for seed in (3, 3, 4))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    centre_side = pixels.mean(1) > model.centre_px
    assert len({tuple(side.tolist()) for side in centre_side}) == 4  # boards in every quadrant


def test_boards_reach_the_largest_angle() -> None:
    poses = random_board_poses(BOARD, FISHEYE, 20, math.radians(85.0), seed=0)
    points = poses.transform(torch.as_tensor(BOARD.points_m).expand(20, -1, -1))
    reach = torch.rad2deg(torch.atan2(points[..., :2].norm(dim=-1), points[..., 2]).amax(1))
    assert (reach > 84.9).sum() >= 5


@pytest.mark.slow
def test_no_pose_is_an_error() -> None:
    with pytest.raises(GeometryError, match="found no such pose"):
        random_board_poses(pattern("checkerboard:60x50:5mm"), PINHOLE, 2, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "max_angle"), [*CAMERAS[:2], pytest.param(*CAMERAS[2].values, marks=pytest.mark.full, id=CAMERAS[2].id)]
)
def test_detected_corners_are_where_the_model_projects_them(model: CameraModel, max_angle: float) -> None:
    """Twenty noisy photos out to the rim: at most one lost, no bias, hundredths of a pixel."""
    poses = random_board_poses(BOARD, model, 20, max_angle, seed=11)
    errors, lost = [], 0
    for index in range(20):
        image = render_target(BOARD, model, poses[index], blur_px=0.5, noise_grey=2.0, vignetting=0.3, seed=index)
        detection, _ = BOARD.detect(image)
        if len(detection) == 0:
            lost += 1
            continue
        pixels, _ = model.project(poses[index].transform(torch.as_tensor(BOARD.points_m)))
        truth = pixels.numpy()
        own, turned = detection.pixels - truth[detection.ids], detection.pixels - truth[::-1][detection.ids]
        errors.append(own if np.abs(own).max() < np.abs(turned).max() else turned)
    assert lost <= 1
    error = np.concatenate(errors)
    assert np.sqrt((error**2).mean()) < 0.03 and np.abs(error).max() < 0.3 and np.abs(error.mean(0)).max() < 0.005
