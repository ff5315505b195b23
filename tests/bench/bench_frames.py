"""Frames chosen from a rendered video of a board in hand, with motion blur and a rolling shutter.

What they tell of the camera is compared with the Cramer-Rao bound of the best as many of the frames at rest, with the same noise
of their corners; so is the calibration from them, and the time to choose them with the length of the video. That bound is ideal:
it takes the errors of corners, which the truth shows, for independent, and those of one view are not quite.
`bench_what_frames_state` says whether what a calibration states of itself holds.
"""

import math
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from rendered_video import Path6, Shutter, frame, random_path, write_video
from timing import SMALL, print_table

import omnilines as ol
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import graded_background
from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.calibration.held_out import ViewTerms
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.telling import ViewInformation, telling_instants
from omnilines.calibration.views import board_points
from omnilines.files.videos import Video
from omnilines.footage.options import FrameOptions
from omnilines.synthetic.targets import example_camera, simulate_corners

BOARD = "checkerboard:8x6:30mm"
SIZE = (320, 240) if SMALL else (640, 480)
RATE = 10.0 if SMALL else 15.0
PLACES, MOVE_S, REST_S = (9 if SMALL else 67), 0.6, 0.3
SHUTTER = Shutter(exposure_s=0.02, readout_s=0.03, samples=4)
CHOSEN = FrameOptions(most_of_target=6) if SMALL else FrameOptions()
LIMIT = 1.2
"""Largest standard deviation from the chosen frames over that of the best as many."""
SPACING_PX = 6.0 if SMALL else 12.0
SETS, FRAMES = (1, 8) if SMALL else (24, 40)
"""Calibrations, and the frames of each."""


def bench_frames_of_a_video() -> None:
    board = pattern(BOARD)
    lens = example_camera("double-sphere", 200.0, SIZE, 0)
    poses = random_board_poses(board, lens, PLACES, math.radians(90.0), min_spacing_px=SPACING_PX, seed=1)
    path = random_path(poses[torch.as_tensor(np.random.default_rng(0).permutation(PLACES))], MOVE_S, REST_S)
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "board.avi"
        times = write_video(film, board, lens, path, SHUTTER, RATE)
        started, used = time.perf_counter(), time.process_time()
        chosen = ol.frames(film, board, options=CHOSEN)
        seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - used
        found = ol.detect(chosen.photos(), board)
    fit = ol.calibrate(found, model=lens.NAME).fit
    taken = [row.index for row in chosen.taken]
    at_rest = float(np.mean([path.rests(times[k], times[k] + SHUTTER.exposure_s + SHUTTER.readout_s) for k in taken]))
    noise_px = _noise_at_rest(found.corners, lens, path, times)
    resting = [k for k, time_s in enumerate(times) if path.rests(time_s, time_s + SHUTTER.exposure_s + SHUTTER.readout_s)]
    bound = _bound(lens, path, [times[k] for k in resting], noise_px, len(taken))
    of_taken = _bound(lens, path, [times[k] for k in taken], noise_px, len(taken))
    off, stated = _error(fit, lens)
    error, by_stated = (math.sqrt(float(off @ torch.linalg.solve(own, off)) / len(off)) for own in (bound, stated))
    told = _times(of_taken, bound)
    film_s = len(times) / RATE
    row = [f"{film_s:.0f}", f"{len(times)}", f"{len(taken)}", f"{100 * at_rest:.0f}", f"{noise_px:.3f}", f"{told:.2f}",
           f"{error:.2f}", f"{_times(stated, bound):.2f}", f"{fit.corner_sigma_px / noise_px:.2f}", f"{by_stated:.2f}",
           f"{seconds:.1f}", f"{cpu_seconds:.1f}"]  # fmt: skip
    header = ["video s", "frames", "taken", "% at rest", "noise px", "they tell / bound", "error / bound", "stated / bound",
              "of it noise", "error / stated", "s", "s of all cores"]  # fmt: skip
    print_table(f"{lens.NAME} of 200 degrees, {SIZE[0]}x{SIZE[1]}, blur and rolling shutter; asked {LIMIT}", header, [row])
    assert SMALL or (told <= LIMIT and cpu_seconds < film_s)


def bench_what_frames_state() -> None:
    """Errors of calibrations from frames at rest over what is stated of them, and of their corners: as photos, and as a video."""
    board, lens = pattern(BOARD), example_camera("double-sphere", 200.0, SIZE, 0)
    wall, rows = graded_background(lens, np.random.default_rng(0)), []
    figures: dict[str, list[tuple[float, float, float]]] = {"as photos (PNG)": [], "as a video (motion JPEG)": []}
    for seed in range(SETS):
        poses = random_board_poses(board, lens, FRAMES, math.radians(90.0), min_spacing_px=SPACING_PX, seed=1 + seed)
        path = random_path(poses, MOVE_S, REST_S)
        times = [k * (MOVE_S + REST_S) for k in range(FRAMES)]
        shots = [frame(board, lens, path, time_s, Shutter(), 2.0, 1000 * seed + k, wall) for k, time_s in enumerate(times)]
        for coding, shown in zip(figures, (shots, _through_a_video(shots)), strict=True):
            found = ol.detect({f"{k:06d}.png": pixels for k, pixels in enumerate(shown)}, board)
            fit = ol.calibrate(found, model=lens.NAME).fit
            off, stated = _error(fit, lens)
            noise_px = _noise_at_rest(found.corners, lens, path, times)
            square = float(off @ torch.linalg.solve(stated, off)) / len(off)
            figures[coding].append((noise_px**2, fit.corner_sigma_px**2, square))
    for coding, own in figures.items():
        noise_px, stated_px, over = np.sqrt(np.mean(own, 0))
        rows.append([coding, f"{SETS}", f"{noise_px:.4f}", f"{stated_px:.4f}", f"{over:.2f}"])
    header = ["frames", "sets", "error of corners px", "stated of them px", "error / stated of the camera"]
    print_table(f"{lens.NAME} of 200 degrees from {FRAMES} frames at rest", header, rows)


def _through_a_video(shots: list[np.ndarray]) -> list[np.ndarray]:
    """What a reader of a video of these frames sees."""
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "rests.avi"
        writer = cv2.VideoWriter(str(film), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), RATE, SIZE)
        for shot in shots:
            writer.write(cv2.cvtColor(shot, cv2.COLOR_GRAY2BGR))
        writer.release()
        return [shown.pixels for shown in Video.of(film).frames(range(len(shots)))]


def _error(fit: CameraCalibration, lens: CameraModel) -> tuple[torch.Tensor, torch.Tensor]:
    """How far the parameters are off, and the covariance stated of them, both along their basis."""
    inverse = torch.linalg.pinv(lens.calibration_basis())
    return inverse @ (fit.model.parameters - lens.parameters), inverse @ torch.as_tensor(fit.covariance) @ inverse.mT


def _times(one: torch.Tensor, other: torch.Tensor) -> float:
    """The standard deviations of one covariance over those of another, in the geometric mean of all directions."""
    return math.exp(0.5 * float(torch.logdet(one) - torch.logdet(other)) / len(one))


def _at(path: Path6, times: list[float]) -> Pose:
    """cam_from_board in the middle of the exposure of each frame."""
    middle_s = 0.5 * (SHUTTER.exposure_s + SHUTTER.readout_s)
    return Pose.stack([path.at(one + middle_s) for one in times])


def _noise_at_rest(found: ol.Corners, lens: CameraModel, path: Path6, times: list[float]) -> float:
    """Root mean square error per axis of the corners in frames at rest (px)."""
    errors = []
    for view, name in enumerate(found.view_names):
        time_s = times[int(Path(name).stem)]
        if path.rests(time_s, time_s + SHUTTER.exposure_s + SHUTTER.readout_s):
            rows = found.view == view
            seen, _ = lens.project(path.at(time_s).transform(torch.as_tensor(found.board_m[rows])))
            # A plain board may be found turned by half a turn.
            turned, _ = lens.project(path.at(time_s).transform(torch.as_tensor(found.board_m[rows][::-1].copy())))
            errors.append(
                min((found.pixels[rows] - other.numpy() for other in (seen, turned)), key=lambda e: float(np.square(e).sum()))
            )
    assert errors
    return float(np.sqrt(np.square(np.concatenate(errors)).mean()))


def _bound(lens: CameraModel, path: Path6, times: list[float], noise_px: float, count: int) -> torch.Tensor:
    """Covariance of the parameters (along their basis) from the `count` best of some frames, were the board at rest in each."""
    poses = _at(path, times)
    corners = simulate_corners(lens, pattern(BOARD), poses, 0.0, 0)
    whole = np.flatnonzero(np.bincount(corners.view, minlength=len(times)) == len(pattern(BOARD).points_m))
    front = [k for k in whole.tolist() if float(poses.rotation[k, :, 2] @ poses.translation[k]) > 0]
    rows = np.isin(corners.view, front)
    problem = BoardProblem(board_points(corners, rows, front), lens.calibration_basis(), None)
    matrix = ViewTerms.of(problem, CameraAndBoards(lens, poses[front])).matrix / noise_px**2
    unit = matrix.sum(0).diagonal().rsqrt()
    names = tuple(str(k) for k in front)
    scaled = ViewInformation(names, matrix * unit[:, None] * unit, torch.ones(len(names), dtype=torch.float64))
    best = telling_instants([scaled], {name: k for k, name in enumerate(names)}, len(front), count)
    return torch.linalg.inv(matrix[best].sum(0))
