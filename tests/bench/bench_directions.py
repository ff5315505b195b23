"""Manhattan frames of photos against hand-made vanishing directions, also of the same photos through fisheyes; rendered rooms.

    python tests/bench/bench_directions.py [--small]

York Urban (P. Denis, J. Elder, F. Estrada 2008), 51 photos of a pinhole camera: the worst of the three directions of each photo,
in degrees. Through a fisheye the photo is resampled about the axis; what lies beyond it is masked. Rendered rooms have furniture
that is turned by tenths of degrees beside the walls. Time is CPU time beyond extraction.
"""

import argparse
import csv
import math
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from timing import print_table, skip

import omnilines as ol
from camera_models import CameraModel, Equirectangular, OpenCVFisheye
from camera_models.resampling import resample, sampling_grid
from omnilines.photo_file import read_photo
from omnilines.pipelines.directions import circles_of
from omnilines.structure.manhattan import manhattan_frame
from omnilines.structure.meeting import meeting_directions

YORK = Path(__file__).resolve().parents[3] / "shared" / "data" / "lines" / "york"
BEND = (-0.02, 0.002, 0.0, 0.0)
ROOMS: tuple[tuple[str, float | None, tuple[int, int]], ...] = (
    ("opencv-fisheye", 190.0, (1100, 1100)),
    ("scaramuzza", 220.0, (1100, 1100)),
    ("equirectangular", None, (1600, 800)),
)


def through_fisheye(fov_deg: float, focal_px: float) -> OpenCVFisheye:
    half = math.radians(fov_deg / 2)
    side = 2 * int(focal_px * half * (1 + BEND[0] * half**2 + BEND[1] * half**4))
    return OpenCVFisheye([focal_px, focal_px, side / 2 - 0.5, side / 2 - 0.5, *BEND], (side, side))


def york_row(name: str, source: CameraModel, camera: CameraModel | None, small: bool) -> list[str]:
    true: dict[str, list[list[float]]] = {}
    for row in csv.DictReader((YORK / "vanishing_directions.csv").open()):
        true.setdefault(row["image"], []).append([float(row[axis]) for axis in "xyz"])
    grid = None if camera is None else sampling_grid(camera, source)
    mask = None if grid is None else cv2.erode(grid.valid.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    worst, seconds = list[float](), list[float]()
    for image, directions in list(true.items())[: 2 if small else None]:
        photo = read_photo(YORK / "images" / image)
        given = photo if grid is None else resample(photo, grid)
        arcs = ol.extract({image: given}, camera or source, mask=mask)
        begun = time.process_time()
        found = ol.directions(arcs, orthogonal=True).photos[0].meeting
        seconds.append(time.process_time() - begun)
        cosine = np.abs(np.array(directions) @ found.direction.T).max(1) if len(found) else np.zeros(3)
        worst.append(math.degrees(math.acos(min(1.0, float(cosine.min())))))
    error = np.array(worst)
    shares = [f"{(error < limit).mean():.1%}" for limit in (2, 5)]
    return [name, f"{np.median(error):.2f}", f"{error.mean():.2f}", *shares, f"{np.mean(seconds):.2f}"]


def room_row(scene: str, model: str, fov_deg: float | None, size: tuple[int, int], small: bool) -> list[str]:
    """Errors of directions, and the shares of directions and frames within the 95 percent of what is stated."""
    errors, inside, frames, missed = list[float](), list[bool](), list[bool](), 0
    for seed in range(1, 2 if small else 4):
        options = ol.RenderOptions(views=1 if small else 10, fov_deg=fov_deg, size_px=size, seed=seed)
        camera = Equirectangular([], size) if fov_deg is None else model
        made = ol.render(scene, camera, options)
        arcs = ol.extract(made.photos, made.camera)
        turns = dict(zip(made.poses.images, made.poses.cam_from_world.rotation.numpy(), strict=True))
        for one in arcs.used:
            circles, axes = circles_of(one, made.camera), turns[one.photo.name]
            found, frame = meeting_directions(circles), manhattan_frame(circles)
            seen = set()
            for direction, covariance in zip(found.direction, found.covariance, strict=True):
                cosine = direction @ axes
                k = int(np.abs(cosine).argmax())
                error = np.sign(cosine[k]) * axes[:, k] - direction
                if float(np.linalg.norm(error)) < math.radians(0.25):
                    seen.add(k)
                    errors.append(math.degrees(float(np.linalg.norm(error))))
                    inside.append(float(error @ np.linalg.pinv(covariance, 1e-6) @ error) < 5.991)
            missed += 3 - len(seen)
            if frame is not None:
                near = axes @ np.round(axes.T @ frame.cam_from_world) @ frame.cam_from_world.T
                turn = 0.5 * np.array([near[2, 1] - near[1, 2], near[0, 2] - near[2, 0], near[1, 0] - near[0, 1]])
                frames.append(float(turn @ np.linalg.solve(frame.covariance, turn)) < 7.815)
    shares = [f"{np.mean(one):.1%}" for one in (inside, frames)]
    return [scene, made.camera.NAME, f"{np.median(errors):.4f}", f"{max(errors):.3f}", str(missed), *shares]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--small", action="store_true")
    small = parser.parse_args().small
    torch.set_num_threads(1)
    scenes = ("plain-room",) if small else ("plain-room", "room", "street")
    rows = [room_row(scene, *one, small) for scene in scenes for one in ROOMS[: 1 if small else None]]
    header = ["scene", "camera", "median, degrees", "largest", "missed", "inside 95: directions", "frames"]
    print_table("Directions of rendered scenes", header, rows)
    if not YORK.is_dir():
        skip(f"York Urban is absent: {YORK}")
    source = ol.load(YORK / "calibration.yaml")["cam0"]
    focal_px = float(source.parameters[0])
    cameras = [("as they are", None), *((f"fisheye, {fov:g} degrees", through_fisheye(fov, focal_px)) for fov in (120.0, 190.0))]
    rows = [york_row(name, source, camera, small) for name, camera in cameras[: 2 if small else None]]
    header = ["photos", "worst of three, median", "mean", "within 2", "within 5", "CPU s a photo"]
    print_table("Manhattan frames of York Urban", header, rows)


if __name__ == "__main__":
    main()
