"""Speed beside other implementations, and how the adjustment grows with the number of observations.

Seconds depend on the machine and are only printed; what is asserted is the exponent of growth.
"""

import json
import math
import pathlib
import subprocess

import cv2
import numpy as np
import pytest
from timing import IMAGES, NO_PEERS, PEERS, SMALL, best_of, iteration_seconds, print_table

from camera_models import OpenCVFisheye, Pinhole

HERE = pathlib.Path(__file__).resolve().parent
POINTS, OBSERVATIONS = (1_000, 2_000) if SMALL else (100_000, 60_000)
SIZES = (400, 1_000) if SMALL else (1_000, 3_000, 10_000, 30_000, 100_000)
"""Observations of the adjustments whose growth is measured."""
SIZE = (1280, 960)
FISHEYE = [400.0, 400.0, 640.0, 480.0, 0.01, -0.002, 0.0005, 0.0]
PINHOLE = {"fx": 800.0, "fy": 800.0, "cx": 640.0, "cy": 480.0, "k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -5e-4, "k3": 0.0}


def points_in_front() -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(POINTS, 3))
    points[:, 2] = np.abs(points[:, 2]) + np.abs(points[:, :2]).max(1)  # inside 45 degrees per axis, where all models hold
    return points


def bench_against_peers() -> None:
    if not PEERS.is_file():
        pytest.skip(NO_PEERS)
    points = points_in_front()
    fisheye, pinhole = OpenCVFisheye(FISHEYE, SIZE), Pinhole.from_mapping(PINHOLE, SIZE)
    fisheye_px, pinhole_px = fisheye.project(points)[0], pinhole.project(points)[0]
    K, D = np.array([[400.0, 0, 640], [0, 400, 480], [0, 0, 1]]), np.array(FISHEYE[4:])
    P, E = np.array([[800.0, 0, 640], [0, 800, 480], [0, 0, 1]]), np.array([PINHOLE[k] for k in ("k1", "k2", "p1", "p2", "k3")])
    zero = np.zeros(3)
    cv_points = np.ascontiguousarray(points[None])
    ours = {
        "fisheye project": best_of(5, lambda: fisheye.project(points)),
        "fisheye unproject": best_of(5, lambda: fisheye.unproject(fisheye_px)),
        "pinhole project": best_of(5, lambda: pinhole.project(points)),
        "pinhole unproject": best_of(5, lambda: pinhole.unproject(pinhole_px)),
        "iteration": iteration_seconds(OBSERVATIONS),
    }
    opencv = {
        "fisheye project": best_of(5, lambda: cv2.fisheye.projectPoints(cv_points, zero, zero, K, D)),
        "fisheye unproject": best_of(5, lambda: cv2.fisheye.undistortPoints(fisheye_px[None], K, D)),
        "pinhole project": best_of(5, lambda: cv2.projectPoints(points, zero, zero, P, E)),
        "pinhole unproject": best_of(5, lambda: cv2.undistortPoints(pinhole_px[None], P, E)),
    }
    rows = [[name, "OpenCV", f"{1e3 * ours[name]:.1f}", f"{1e3 * s:.1f}", f"{ours[name] / s:.2f}"] for name, s in opencv.items()]
    arguments = [str(HERE / "peer_pycolmap.py"), str(POINTS), str(OBSERVATIONS), str(IMAGES)]
    peer = json.loads(subprocess.run([PEERS, *arguments], check=True, capture_output=True, text=True).stdout.splitlines()[-1])
    pairs = (
        ("fisheye project", "project"),
        ("fisheye unproject", "unproject"),
        ("iteration", "iteration"),
    )
    rows += [[a, "pycolmap", f"{1e3 * ours[a]:.1f}", f"{1e3 * peer[b]:.1f}", f"{ours[a] / peer[b]:.2f}"] for a, b in pairs]
    assert len(rows) == len(opencv) + len(pairs)
    title = (
        f"Speed on one thread: {POINTS:,} points; one adjustment iteration of {OBSERVATIONS:,} observations in {IMAGES} images "
        "(lines here, points in pycolmap)"
    )
    print_table(title, ["what", "peer", "ours ms", "peer ms", "ours / peer"], rows)


def bench_iteration_grows_linearly() -> None:
    seconds = [iteration_seconds(n) for n in SIZES]
    rows = [[f"{n:,}", f"{1e3 * s:.1f}", f"{1e6 * s / n:.2f}"] for n, s in zip(SIZES, seconds, strict=True)]
    print_table("One iteration of the sector cost", ["observations", "ms", "us per observation"], rows)
    exponent = math.log(seconds[-1] / seconds[0]) / math.log(SIZES[-1] / SIZES[0])
    print(f"  time grows with the power {exponent:.2f} of the observations")
    assert SMALL or exponent < 1.15
