"""Frames chosen from a rendered video of a board in hand, with motion blur and a rolling shutter.

The calibration from them is compared with the Cramer-Rao bound of the best as many of all frames, were the board at rest in each;
the time to choose them with the length of the video.
"""

import math
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from rendered_video import Path6, Shutter, random_path, write_video
from timing import SMALL, print_table

import omnilines as ol
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.calibration.held_out import ViewTerms
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.telling import ViewInformation, telling_instants
from omnilines.calibration.views import board_points
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


def bench_frames_of_a_video() -> None:
    board = pattern(BOARD)
    lens = example_camera("double-sphere", 200.0, SIZE, 0)
    poses = random_board_poses(board, lens, PLACES, math.radians(90.0), min_spacing_px=6.0 if SMALL else 12.0, seed=1)
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
    bound = _bound(lens, path, times, noise_px, len(taken))
    basis = lens.calibration_basis()
    inverse = torch.linalg.pinv(basis)
    stated = inverse @ torch.as_tensor(fit.covariance) @ inverse.mT
    off = inverse @ (fit.model.parameters - lens.parameters)
    size = len(off)
    of_bound = math.exp(0.5 * float(torch.logdet(stated) - torch.logdet(bound)) / size)
    error = math.sqrt(float(off @ torch.linalg.solve(bound, off)) / size)
    film_s = len(times) / RATE
    row = [f"{film_s:.0f}", f"{len(times)}", f"{len(taken)}", f"{100 * at_rest:.0f}", f"{noise_px:.3f}", f"{of_bound:.2f}",
           f"{fit.corner_sigma_px / noise_px:.2f}", f"{error:.2f}", f"{seconds:.1f}", f"{cpu_seconds:.1f}"]  # fmt: skip
    header = [
        "video s",
        "frames",
        "taken",
        "% at rest",
        "noise px",
        "stated / bound",
        "of it noise",
        "error / bound",
        "s",
        "s of all cores",
    ]
    print_table(f"{lens.NAME} of 200 degrees, {SIZE[0]}x{SIZE[1]}, blur and rolling shutter; asked {LIMIT}", header, [row])
    assert SMALL or cpu_seconds < film_s


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
    """Covariance of the parameters (along their basis) from the `count` best of all frames, were the board at rest in each."""
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
