"""What points ask of cameras: nothing of the right one but what noise makes, and what is wrong of another."""

import numpy as np
import torch

from camera_models import CameraModel, Equirectangular, OpenCVFisheye, Pinhole
from camera_models.pose import Pose
from omnilines.posing.cameras_by_points import CameraByPoints, cameras_by_points
from omnilines.posing.point_adjustment import Frames, PosesAndPoints, adjust_points
from omnilines.posing.tracks import Observations

PHOTOS, POINTS, NOISE_PX = 8, 200, 0.5
PINHOLE = Pinhole([500.0, 500.0, 399.5, 299.5, 0.0, -0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], (800, 600))
FISHEYE = OpenCVFisheye([200.0, 200.0, 319.5, 319.5, 0.0, 0.0, 0.0, 0.0], (640, 640))


def world(photos: int = PHOTOS) -> tuple[Pose, torch.Tensor]:
    """Cameras about a box of points, looking at it."""
    draw = torch.Generator().manual_seed(4)
    points = 2.0 * torch.rand(POINTS, 3, generator=draw, dtype=torch.float64) - 1.0
    poses = []
    for k in range(photos):
        turn = Pose.exp(torch.tensor([0.3 * (k % 3 - 1), 2.0 * np.pi * k / photos, 0.1 * k, 0.0, 0.0, 0.0], dtype=torch.float64))
        poses.append(Pose(torch.eye(3).double(), torch.tensor([0.1 * k, -0.1, 2.5]).double()) @ turn)
    return Pose.stack(poses), points


def seen_by(
    right: list[CameraModel], believed: list[CameraModel], frames: Frames, rig_from_world: Pose, points: torch.Tensor, seed: int
) -> Observations:
    """Bearings that the believed cameras give to the pixels at which the right ones see points, with noise."""
    noise = torch.Generator().manual_seed(seed)
    cam_from_world, parts = frames.photos(rig_from_world), []
    for photo, (camera, other) in enumerate(zip(right, believed, strict=True)):
        pose = cam_from_world[photo]
        pixels, imaged = camera.project(points @ pose.rotation.mT + pose.translation)
        pixels = pixels + NOISE_PX * torch.randn(pixels.shape, generator=noise, dtype=torch.float64)
        width, height = camera.image_size
        inside = ((pixels >= 0) & (pixels < torch.tensor([width, height]))).all(-1)
        bearings, valid = other.unproject(pixels)
        rows = torch.nonzero(imaged & inside & valid).flatten()
        own = torch.linalg.pinv(other.unproject_jacobian(pixels[rows])) / NOISE_PX
        parts.append((torch.full_like(rows, photo), rows, bearings[rows], own))
    photo, point, bearings, across = (torch.cat(one) for one in zip(*parts, strict=True))
    return Observations(photo, torch.arange(len(photo)), point, bearings, across)


def asked(right: CameraModel, believed: CameraModel, seed: int) -> dict[str, CameraByPoints]:
    """Of photos of one camera."""
    poses, points = world()
    frames = Frames(torch.arange(PHOTOS), Pose.identity(PHOTOS))
    seen = seen_by([right] * PHOTOS, [believed] * PHOTOS, frames, poses, points, seed)
    known = adjust_points(seen, frames, PosesAndPoints(poses, points)).state
    return cameras_by_points(seen, frames, known, {"cam0": believed}, ["cam0"] * PHOTOS)


def test_a_right_camera_changes_as_noise_lets_expect() -> None:
    """By Monte Carlo, in the units of the covariance that is stated: chi-square with the parameters that are estimated."""
    basis = torch.linalg.pinv(FISHEYE.calibration_basis()).numpy()
    squares = []
    for seed in range(20):
        found = asked(FISHEYE, FISHEYE, seed)["cam0"]
        change, covariance = basis @ found.change, basis @ found.covariance @ basis.T
        squares.append(change @ np.linalg.solve(covariance, change))
    expected = len(basis)
    # Of 20 means of a chi-square, whose variance is twice its degrees of freedom, within four standard deviations.
    assert abs(np.mean(squares) - expected) < 4.0 * np.sqrt(2.0 * expected / 20)


def test_a_focal_length_that_is_off_is_told() -> None:
    parameters = PINHOLE.parameters.clone()
    parameters[:2] *= 1.01
    found = asked(PINHOLE, PINHOLE.with_parameters(parameters), 1)["cam0"]
    sigma = np.sqrt(np.diag(found.covariance))
    np.testing.assert_array_less(np.abs(found.change[:2] + 5.0), 4.0 * sigma[:2])
    assert (sigma[:2] < 0.6).all() and 30.0 < np.degrees(found.max_angle_rad) < 46.0


def test_each_camera_of_a_rig_is_asked_for_itself() -> None:
    """The second of two is off; what has no parameters is not asked, and what saw nothing is not either."""
    instants = 6
    rig_from_world, points = world(instants)
    second = Pose(torch.eye(3).double(), torch.tensor([-0.2, 0.0, 0.0]).double())
    panorama = Equirectangular([], (1200, 600))
    parameters = FISHEYE.parameters.clone()
    parameters[:2] *= 1.01
    off = FISHEYE.with_parameters(parameters)
    names = ["cam0", "cam1", "cam2"] * instants
    beside = Pose.stack([Pose.identity(), second, second @ second] * instants)
    frames = Frames(torch.arange(instants).repeat_interleave(3), beside)
    cameras = {"cam0": FISHEYE, "cam1": off, "cam2": panorama, "cam3": PINHOLE}
    right = [FISHEYE, FISHEYE, panorama] * instants
    seen = seen_by(right, [cameras[name] for name in names], frames, rig_from_world, points, 2)
    known = adjust_points(seen, frames, PosesAndPoints(rig_from_world, points)).state
    found = cameras_by_points(seen, frames, known, cameras, names)
    assert set(found) == {"cam0", "cam1"}
    for name, change in (("cam0", 0.0), ("cam1", -2.0)):
        sigma = np.sqrt(np.diag(found[name].covariance))
        np.testing.assert_array_less(np.abs(found[name].change[:2] - change), 4.0 * sigma[:2])
        assert (sigma[:2] < 0.4).all()


def test_what_points_do_not_determine_is_not_asked() -> None:
    """Photos that share no points leave their places to one another open."""
    poses, points = world(2)
    frames = Frames(torch.arange(2), Pose.identity(2))
    seen = seen_by([FISHEYE] * 2, [FISHEYE] * 2, frames, poses, points, 3)
    apart = torch.where(seen.photo == 0, seen.point, seen.point + POINTS)
    every = Observations(seen.photo, seen.feature, apart, seen.bearings, seen.rows)
    doubled = Observations(
        *(torch.cat([one, one]) for one in (every.photo, every.feature, every.point, every.bearings, every.rows))
    )
    known = PosesAndPoints(poses, torch.cat([points, points]))
    assert cameras_by_points(doubled, frames, known, {"cam0": FISHEYE}, ["cam0"] * 2) == {}
