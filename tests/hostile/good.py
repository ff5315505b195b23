"""Good inputs, small and made once: calibrations in every format, tables, photos, scenes. Cases copy them and spoil the copy."""

import csv
import functools
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

import camera_models
import omnilines as ol
from calib_patterns import pattern
from calib_patterns.rendering import render_target
from camera_models import Calibration
from camera_models.formats import write
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose, rotation_from_vector

FX = 170.25
"""A focal length whose digits stand nowhere else in a file."""
SIZE = (646, 482)
LENS = camera_models.OpenCVFisheye([FX, 171.5, 325.0, 236.0, -0.01, 0.003, -0.001, 0.0001], SIZE)
PINHOLE = camera_models.Pinhole([FX, 171.5, 325.0, 236.0, 0.0, -0.01, 0.003, 0.001, 0.0001, 0, 0, 0, 0], SIZE)
ODD = camera_models.OpenCVFisheye([171.5, FX, 325.0, 236.0, -0.01, 0.003, 0.0, 0.0], SIZE)
SHORT = camera_models.OpenCVFisheye([FX, FX, 325.0, 236.0, -0.01, 0.003, 0.0, 0.0], SIZE)
SQUARE = camera_models.OpenCVFisheye([FX, FX, 325.0, 236.0, -0.01, 0.003, -0.001, 0.0001], SIZE)
PLAIN = camera_models.Pinhole([FX, 171.5, 325.0, 236.0, *([0.0] * 9)], SIZE, 0)
POLYNOMIAL = camera_models.Scaramuzza([325.0, 236.0, 1.0, 0.0, 0.0, FX, -1.2e-3, 1e-7, -2e-9], SIZE)
SPEC = "checkerboard:7x5:30mm"
POSES = [
    ((0.5, 0.1, 0.1), (-0.14, -0.10, 0.22)),
    ((-0.4, 0.3, 0.0), (-0.02, -0.06, 0.20)),
    ((0.1, -0.6, 0.3), (-0.12, 0.02, 0.24)),
    ((0.2, 0.5, -0.2), (-0.20, -0.06, 0.20)),
    ((-0.5, -0.2, 0.1), (0.02, 0.02, 0.22)),
]
CORNERS = ("view", "image", "board_x_m", "board_y_m", "u_px", "v_px")
FILES: dict[str, tuple[str, str, tuple[camera_models.CameraModel, ...]]] = {
    "omnilines": ("calibration.yaml", "omnilines", (LENS,)),
    "omnilines-rig": ("rig.yaml", "omnilines", (LENS, PINHOLE)),
    "opencv-yml": ("camera.yml", "opencv", (LENS,)),
    "opencv-xml": ("camera.xml", "opencv", (PINHOLE,)),
    "opencv-pair": ("pair.yml", "opencv", (LENS, PINHOLE)),
    "opencv-rig": ("rig.yml", "opencv", (LENS, PINHOLE, LENS)),
    "kalibr": ("camchain.yaml", "kalibr", (LENS, PINHOLE)),
    "basalt": ("calibration.json", "basalt", (LENS, PINHOLE)),
    "colmap-txt": ("cameras.txt", "colmap", (LENS, PINHOLE)),
    "colmap-bin": ("cameras.bin", "colmap", (LENS, PINHOLE)),
    "mrcal": ("camera.cameramodel", "mrcal", (PINHOLE,)),
    "ocamcalib": ("calib_results.txt", "ocamcalib", (POLYNOMIAL,)),
    "ocamcalib-rig": ("ocam.yaml", "ocamcalib", (POLYNOMIAL, POLYNOMIAL)),
    "anipose": ("calibration.toml", "anipose", (LENS, PINHOLE)),
    "caliscope": ("camera_array.toml", "caliscope", (LENS, PINHOLE)),
    "mc-calib": ("calibrated_cameras_data.yml", "mc-calib", (LENS, PINHOLE)),
    "camodocal": ("camodocal.yaml", "camodocal", (LENS,)),
    "aria": ("aria.json", "aria", (LENS, PLAIN)),
    "ftheta": ("ftheta.json", "ftheta", (ODD,)),
    "openmvg": ("sfm_data.json", "openmvg", (SQUARE,)),
    "usd": ("rig.usda", "usd", (LENS, PINHOLE)),
    "metashape": ("metashape.xml", "metashape", (LENS,)),
    "lensfun": ("lensfun.xml", "lensfun", (SHORT,)),
    "nerfstudio": ("transforms.json", "nerfstudio", (LENS,)),
    "opensfm": ("camera_models.json", "opensfm", (LENS, PINHOLE)),
    "ros": ("camera_info.yaml", "ros", (LENS,)),
}
"""Kind of file -> its name, its format, its cameras."""


def pose_of(turn: tuple[float, ...], shift: tuple[float, ...]) -> Pose:
    """exp(turn), shift."""
    return Pose(rotation_from_vector(torch.tensor(turn, dtype=torch.float64)), torch.tensor(shift, dtype=torch.float64))


def table(path: Path, header: tuple[str, ...], rows: list[list[object]]) -> None:
    """Write a CSV."""
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


@functools.cache
def _place() -> tempfile.TemporaryDirectory[str]:
    """Gone when this process ends."""
    return tempfile.TemporaryDirectory(prefix="hostile-good-", ignore_cleanup_errors=True)


@functools.cache
def store() -> Path:
    """The folder of all good inputs of this process."""
    folder = Path(_place().name)
    for kind, (name, own, models) in FILES.items():
        cameras = {f"cam{index}": model for index, model in enumerate(models)}
        poses = [pose_of((0.0, 0.1 * index, 0.0), (0.1 * index, 0.0, 0.0)) for index in range(len(models))]
        rig = {cam: RigCamera(pose) for cam, pose in zip(cameras, poses, strict=True)} if len(models) > 1 else {}
        (folder / kind).mkdir()
        write(folder / kind / name, Calibration(cameras, rig=rig), own)
    _corners(folder)
    _scene(folder)
    _photos(folder)
    _lines(folder)
    _video(folder / "a.avi")
    return folder


def _corners(folder: Path) -> None:
    rows: list[list[object]] = []
    board = pattern(SPEC).points_m
    for index, (turn, shift) in enumerate(POSES):
        pixels, _ = LENS.project(pose_of(turn, shift).transform(torch.as_tensor(board)).numpy())
        rows += [[f"v{index}", f"{index}.png", *point[:2], *pixel] for point, pixel in zip(board, pixels, strict=True)]
    table(folder / "corners.csv", CORNERS, rows)


def _scene(folder: Path) -> None:
    """Ten lines seen by six cameras."""
    rng = np.random.default_rng(0)
    ends = rng.uniform([-1, -1, 1.5], [1, 1, 3], (10, 2, 3))
    poses: list[list[object]] = []
    segments: list[list[object]] = []
    for k in range(6):
        pose = pose_of(tuple(rng.uniform(-0.3, 0.3, 3)), tuple(rng.uniform(-0.8, 0.8, 3)))
        poses.append([f"{k}.png", "", *pose.quaternion.tolist(), *pose.translation.tolist()])
        pixels, _ = LENS.project(pose.transform(torch.as_tensor(ends.reshape(-1, 3))).numpy())
        noisy = (pixels + 0.2 * rng.standard_normal(pixels.shape)).reshape(-1, 4)
        segments += [[f"{k}.png", f"line{j}", *row] for j, row in enumerate(noisy)]
    table(folder / "poses.csv", ("image", "camera", "qw", "qx", "qy", "qz", "tx", "ty", "tz"), poses)
    table(folder / "segments.csv", ("image", "track", "u1_px", "v1_px", "u2_px", "v2_px"), segments)


def _photos(folder: Path) -> None:
    (folder / "photos").mkdir()
    for index, (turn, shift) in enumerate(POSES[:3]):
        image = render_target(pattern(SPEC), LENS, pose_of(turn, shift), noise_grey=1.0, blur_px=0.5, seed=index)
        assert cv2.imwrite(str(folder / "photos" / f"{index}.png"), image)


def _lines(folder: Path) -> None:
    """The scene as `adjust` writes it."""
    poses, segments = ol.read_poses(folder / "poses.csv"), ol.read_segments(folder / "segments.csv")
    ol.adjust(segments, poses, LENS).save(folder / "scene")


def _video(path: Path) -> None:
    """Three pictures without a target, four times each."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (320, 240))
    for k in range(12):
        writer.write(np.random.default_rng(k // 4).integers(0, 255, (240, 320, 3), dtype=np.uint8))
    writer.release()


def give(*names: str) -> Callable[[Path], None]:
    """Copies of good inputs in IN/: calibrations by their kind in FILES, others by their name."""

    def prepare(folder: Path) -> None:
        target = folder / "IN"
        target.mkdir(exist_ok=True)
        for name in names:
            source = store() / (f"{name}/{FILES[name][0]}" if name in FILES else name)
            if source.is_dir():
                shutil.copytree(source, target / source.name)
            else:
                shutil.copyfile(source, target / source.name)

    return prepare
