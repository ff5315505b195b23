"""omnilines render targets: photos of a calibration target through a camera that is known, to test any pipeline with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from calib_patterns import Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import Calibration, CameraEstimate, CameraModel, InputError, save
from camera_models.formats.calibration_data import ViewRecord
from camera_models.formats.disk import write_atomically
from camera_models.pose import Pose
from omnilines.commands.result import CommandResult
from omnilines.files import write_corners, write_poses
from omnilines.files.folders import output_folder
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import ImagePoses, Summary
from omnilines.synthetic.targets import board_angle_rad, example_camera, render_board_photos, simulate_corners

TRUE_CORNERS = "true_corners.csv"
"""Not `corners.csv`: the name of detected corners, which other commands would take instead of the photos."""


@dataclass(frozen=True)
class RenderedTargets:
    """The truth behind a set of photos, and where they were written."""

    model: CameraModel
    pattern: Pattern
    images: tuple[str, ...]
    cam_from_board: Pose
    max_angle_rad: float
    """The largest angle off axis at which a corner was to be shown."""
    files: tuple[Path, ...]


def render_targets(
    out: str | Path,
    *,
    pattern_spec: str = "checkerboard:8x6:30mm",
    model: str = "opencv-fisheye",
    fov_deg: float = 190.0,
    views: int = 20,
    size: tuple[int, int] = (1280, 960),
    noise: float = 2.0,
    blur: float = 0.5,
    seed: int = 0,
    max_angle_deg: float | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write photos (PNG), calibration.yaml (the true camera and cam_from_board), poses.csv and true_corners.csv into `out`.

    `fov_deg` is the angle across the largest image circle; boards reach to `max_angle_deg` off axis, by default to 85 / 95 of the
    circle's. `noise` is in grey levels of 255, `blur` in pixels (standard deviations). poses.csv holds cam_from_world with the
    board as the world. Photos, camera and poses follow from `seed`.

    Raises InputError for options out of range and GeometryError when the camera cannot see the target.
    """
    rendered = write_targets(
        out,
        pattern_spec=pattern_spec,
        model=model,
        fov_deg=fov_deg,
        views=views,
        size=size,
        noise=noise,
        blur=blur,
        seed=seed,
        max_angle_deg=max_angle_deg,
        progress=progress,
    )
    camera = rendered.model
    rows = (
        ("camera model", camera.NAME),
        ("image size", f"{size[0]}x{size[1]} px"),
        ("field of view", f"{fov_deg:g} degrees"),
        ("photos", str(len(rendered.images))),
        ("target", rendered.pattern.specification),
        ("boards reach", f"{math.degrees(rendered.max_angle_rad):.1f} degrees off axis"),
        ("written to", str(Path(out))),
    )
    data = {
        "model": camera.NAME,
        "image_size": list(camera.image_size),
        "parameters": camera.named_parameters(),
        "photos": list(rendered.images),
        "pattern": rendered.pattern.specification,
        "max_angle_deg": math.degrees(rendered.max_angle_rad),
        "seed": seed,
    }
    return CommandResult((Summary("Rendered photos", rows),), data, files=rendered.files)


def write_targets(
    out: str | Path,
    *,
    pattern_spec: str,
    model: str,
    fov_deg: float,
    views: int,
    size: tuple[int, int],
    noise: float,
    blur: float,
    seed: int,
    max_angle_deg: float | None = None,
    progress: ProgressCallback = silent,
) -> RenderedTargets:
    """Do what `render_targets` says and hand back the truth."""
    pattern = parse_pattern(pattern_spec)
    camera = example_camera(model, fov_deg, size, seed)
    reach = board_angle_rad(fov_deg) if max_angle_deg is None else math.radians(max_angle_deg)
    if not 0 < reach <= 0.5 * math.radians(fov_deg):
        raise InputError(
            f"Boards out to at most half the field of view of {fov_deg:g} degrees were expected, found {math.degrees(reach):g} "
            "degrees off axis; give a smaller angle."
        )
    folder = output_folder(out)
    images, poses = [], []
    progress("rendering photos", 0, views)
    for name, photo, cam_from_board in render_board_photos(camera, pattern, views, seed, reach, noise, blur):
        _write_photo(folder / name, photo)
        images.append(name)
        poses.append(cam_from_board)
        progress("rendering photos", len(images), views)
    inputs = {"pattern": pattern.specification, "model": model, "fov_deg": fov_deg, "noise": noise, "blur": blur}
    cam_from_board = Pose.stack(poses)
    tables = (folder / "calibration.yaml", folder / "poses.csv", folder / TRUE_CORNERS)
    save(tables[0], _truth(camera, pattern, images, cam_from_board, reach, provenance(inputs, seed)))
    write_poses(tables[1], ImagePoses(tuple(images), cam_from_board, ("cam0",) * views))
    write_corners(tables[2], simulate_corners(camera, pattern, cam_from_board, 0.0, seed))
    files = (*(folder / name for name in images), *tables)
    return RenderedTargets(camera, pattern, tuple(images), cam_from_board, reach, files)


def _truth(
    camera: CameraModel, pattern: Pattern, images: Sequence[str], cam_from_board: Pose, reach: float, origin: dict
) -> Calibration:
    corners = len(pattern.points_m)
    views = tuple(
        ViewRecord(image, "cam0", True, corners_used=corners, cam_from_board=cam_from_board[k]) for k, image in enumerate(images)
    )
    estimate = CameraEstimate(max_angle_deg=math.degrees(reach))
    return Calibration({"cam0": camera}, {"cam0": estimate}, views=views, provenance=origin)


def _write_photo(path: Path, photo: UInt8[np.ndarray, "h w"]) -> None:
    # Encoded in memory, since cv2.imwrite only says false where a disk is full or a name is not ASCII.
    encoded = cv2.imencode(".png", photo)[1]
    write_atomically(path, encoded.tobytes())
