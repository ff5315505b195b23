"""Seconds a photo beside OpenCV's classic detector with its refinement, on the photos of ../shared/data.

Printed only: seconds depend on the machine.
"""

import pathlib
import time

import cv2
import numpy as np
import pytest
from timing import SMALL, print_table

from calib_patterns import pattern

DATA = pathlib.Path(__file__).resolve().parents[3] / "shared" / "data"
SETS = (
    ("fisheye1", "checkerboard:6x8:32.5mm", False),
    ("fisheye190", "checkerboard:7x6:30mm", False),
    ("kaidan", "checkerboard:7x11:30mm", True),
)
REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)


def classic(grey: np.ndarray, nx: int, ny: int) -> bool:
    found, corners = cv2.findChessboardCorners(grey, (nx, ny))
    if found:
        cv2.cornerSubPix(grey, corners, (5, 5), (-1, -1), REFINEMENT)
    return bool(found)


def bench_detection() -> None:
    if not DATA.is_dir():
        pytest.skip("the folder ../shared/data with real photos is absent")
    rows = []
    for name, specification, mirrored in SETS:
        board = pattern(specification)
        files = sorted((DATA / f"calibration/{name}/images").iterdir())[: 2 if SMALL else None]
        photos = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in files]
        board.detect(photos[0], mirrored=mirrored)
        theirs, ours, hits = [], [], [0, 0]
        for grey in photos:
            start = time.perf_counter()
            hits[0] += classic(grey, board.nx, board.ny)
            theirs.append(time.perf_counter() - start)
            start = time.perf_counter()
            hits[1] += len(board.detect(grey, mirrored=mirrored)[0]) > 0
            ours.append(time.perf_counter() - start)
        ratio = np.median(ours) / np.median(theirs)
        rows.append((name, f"{hits[0]} of {len(photos)}", f"{np.median(theirs):.3f}", f"{hits[1]} of {len(photos)}",
                     f"{np.median(ours):.3f}", f"{max(ours):.2f}", f"{ratio:.1f}"))  # fmt: skip
        assert hits[1] >= hits[0]
    header = ("photos", "classic finds", "median s", "ours", "median s", "worst s", "ratio of medians")
    print_table("Detection of a plain board, one thread", header, rows)
