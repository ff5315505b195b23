"""Calibration beside cv2.fisheye.calibrate that is handed a good guess, its memory, and how the camera models compare on corners
of real lenses.

Seconds depend on the machine and are only printed; what is asserted are ratios against the peer in the same run.
"""

import json
import math
import pathlib
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from board_views import BOARD, board_corners, board_views
from ov_plane import IMAGE_SIZE, read_split
from timing import SMALL, best_of, print_table

from camera_models import OpenCVFisheye
from omnilines.calibration.select import all_candidates, fit_boards, select_model
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.views import board_points
from omnilines.files import read_corners
from omnilines.records import Corners

SIZE = (1280, 960)
TRUTH = OpenCVFisheye([320.0, 320.0, 639.5, 479.5, 0.01, -0.005, 0.001, 0.0], SIZE)
GUESS = np.array([[315.0, 0, 645], [0, 315, 475], [0, 0, 1]])
"""Within two percent of the focal length and 7 px of the centre."""
LIMITS = {20: math.inf} if SMALL else {20: 1.0, 100: 0.3, 300: 0.15}
"""Most of the peer's time, by the number of views."""
MEMORY_VIEWS = (10, 30) if SMALL else (100, 300, 900)
"""The memory of the second has a limit, and that of the last grows in proportion."""
MEMORY_LIMIT_MB = 200
LENSES = ("fisheye1",) if SMALL else ("fisheye1", "gopro", "kaidan")
CALIBRATIONS = pathlib.Path(__file__).resolve().parents[3] / "shared" / "data" / "calibration"


def simulated(views: int) -> Corners:
    return board_corners(TRUTH, board_views(TRUTH, 80, views, 0), 0.2, 1)


def with_opencv(corners: Corners) -> float:
    """RMS per point of cv2.fisheye.calibrate with the flags that make it converge."""
    boards = [np.ascontiguousarray(BOARD[None])] * len(corners.images)
    pixels = [np.ascontiguousarray(corners.pixels[corners.view == v][None]) for v in range(len(corners.images))]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    rms, *_ = cv2.fisheye.calibrate(boards, pixels, SIZE, GUESS.copy(), np.zeros((4, 1)), flags=flags, criteria=criteria)
    return float(rms)


def bench_calibration_against_opencv() -> None:
    """From corners to the finished calibration with covariance; ours starts without a guess and rejects outliers."""
    rows, ratios = [], {}
    for views in LIMITS:
        corners = simulated(views)
        assert abs(calibrate_camera(corners, SIZE, "opencv-fisheye").rms_px_per_point - with_opencv(corners)) < 2e-3
        ours = best_of(3, lambda: calibrate_camera(corners, SIZE, "opencv-fisheye"))  # noqa: B023
        peer = best_of(3, lambda: with_opencv(corners))  # noqa: B023
        ratios[views] = ours / peer
        rows.append([str(views), f"{1e3 * ours:.0f}", f"{1e3 * peer:.0f}", f"{ratios[views]:.2f}", f"{LIMITS[views]:.2f}"])
    print_table("Calibration, 54 corners a view, one thread", ["views", "ours ms", "cv2.fisheye ms", "ours / cv2", "limit"], rows)
    print("  mrcal is " + ("installed; run it by hand" if shutil.which("mrcal-calibrate-cameras") else "not installed here"))
    assert all(ratios[views] <= LIMITS[views] for views in LIMITS)


PEAK = """
import sys
sys.path[:0] = {path!r}
import torch
torch.set_num_threads(1)
from bench_calibration import SIZE, calibrate_camera, simulated

def peak_mb():
    return int(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))) / 1024

corners, few = simulated({views}), simulated(5)
calibrate_camera(few, SIZE, "opencv-fisheye")
before = peak_mb()
calibrate_camera(corners, SIZE, "opencv-fisheye")
print(peak_mb() - before)
"""


def bench_memory_of_calibration() -> None:
    """Peak resident memory of a process above that before the calibration."""
    peaks = {}
    for views in MEMORY_VIEWS:
        script = PEAK.format(path=[p for p in sys.path if p], views=views)
        peaks[views] = float(subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout)
    print_table("Memory of a calibration above the imports", ["views", "MB"], [[str(v), f"{mb:.0f}"] for v, mb in peaks.items()])
    assert peaks[MEMORY_VIEWS[1]] < MEMORY_LIMIT_MB
    assert peaks[MEMORY_VIEWS[-1]] < 3.5 * peaks[MEMORY_VIEWS[1]] + 10


def bench_models_on_real_lenses() -> None:
    """All models and degrees: fitted to all views, and by held-out views; on ov_plane by its own test photos."""
    if not CALIBRATIONS.is_dir():
        pytest.skip("the folder ../shared/data with published corners is absent")
    for name in LENSES:
        size = tuple(json.loads((CALIBRATIONS / name / "reference.json").read_text())["image_size"])
        selection = select_model(read_corners(CALIBRATIONS / name / "corners.csv"), size, loss="none")
        rows = [
            [
                trial.candidate.label + (" *" if trial is selection.chosen else ""),
                str(trial.parameters),
                f"{trial.in_sample_px:.4f}",
                f"{trial.held_out_px:.4f}",
                trial.failure or ("" if trial.monotone else "folds back just beyond the data"),
            ]
            for trial in selection.trials
        ]
        print_table(f"{name}: RMS px per point (* auto)", ["model", "parameters", "in sample", "held out", ""], rows)
        print(f"  {selection.reason}")
        assert len(rows) == len(all_candidates())
    train, test = (read_split(CALIBRATIONS / "ov_plane", split) for split in ("train", "test"))
    points = board_points(test, np.ones(len(test), bool), list(range(len(test.images))))
    rows = []
    for candidate in all_candidates():
        if candidate.model != "pinhole":
            fit = calibrate_camera(train, IMAGE_SIZE, candidate.model, loss="none", options=candidate.options)
            held_out = float((fit_boards(fit.model, points)[1] ** 2).sum(-1).mean().sqrt())
            rows.append([candidate.label, f"{fit.rms_px_per_point:.4f}", f"{held_out:.4f}"])
    print_table("ov_plane: RMS px per point", ["model", "train", "test, poses fitted"], rows)
    assert torch.get_num_threads() == 1 and len(rows) == len(all_candidates()) - 2
