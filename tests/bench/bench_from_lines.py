"""Cameras calibrated from the lines of rendered rooms, from no guess, against the true ones.

    python tests/bench/bench_from_lines.py [--first 100] [--seeds 20] [--size 640x480] [--small]

Furnished rooms, one for each seed, through a fisheye of 190 degrees and a pinhole camera of 90 degrees with distortion. A start
fails where no camera comes of it, or one whose bearings are off by more than a degree. Squared errors are over the covariance
that is stated, and over their degrees of freedom: 1 in the mean where it holds.
"""

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from timing import print_table

import omnilines as ol
from camera_models import CameraModel, OmnilinesError, Pinhole
from omnilines.evaluation.cameras import bearing_error_deg

FAILED_DEG = 1.0


def wide_angle(size: tuple[int, int]) -> CameraModel:
    """90 degrees across, with the distortion of a cheap lens."""
    unit = size[0] / 1280.0
    distortion = {"k1": -0.22, "k2": 0.05, "p1": 0.0004, "p2": -0.0003, "k3": -0.004}
    centre = {"cx": 645.0 * unit, "cy": 476.0 * unit}
    zeros = dict.fromkeys(("skew", "k4", "k5", "k6"), 0.0)
    return Pinhole.from_mapping({"fx": 640.0 * unit, "fy": 641.0 * unit, **centre, **distortion, **zeros}, size)


def calibrated(kind: str, seed: int, size: tuple[int, int], views: int) -> tuple[float, float, float] | None:
    """Root mean square and largest error of bearings (degrees), and squared error over covariance a degree of freedom; None where
    it fails."""
    if kind == "pinhole":
        made = ol.render("room", wide_angle(size), views=views, size_px=size, seed=seed)
    else:
        made = ol.render("room", kind, fov_deg=190.0, views=views, size_px=size, seed=seed)
    photos = {name: made.photos[name] for name in made.photos}
    try:
        found = ol.calibrate(photos, "lines", model=kind)
    except OmnilinesError as error:
        print(f"{kind}, room {seed}: {error}", flush=True)
        return None
    rms, worst = bearing_error_deg(found.camera, made.camera, math.radians(found.fit.max_angle_deg))
    covariance = torch.as_tensor(found.covariance)
    free = covariance.diagonal() > 0
    off = (found.camera.parameters - made.camera.parameters)[free]
    share = float(off @ torch.linalg.solve(covariance[free][:, free], off)) / int(free.sum())
    print(f"{kind}, room {seed}: {rms:.4f} degrees, {worst:.4f} at most, squared error {share:.2f}", flush=True)
    return None if rms > FAILED_DEG else (rms, worst, share)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--small", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    width, height = map(int, given.size.split("x"))
    kinds = ("opencv-fisheye",) if given.small else ("opencv-fisheye", "pinhole")
    seeds, views = (1, 5) if given.small else (given.seeds, 10)
    rows = []
    for kind in kinds:
        all_found = [calibrated(kind, seed, (width, height), views) for seed in range(given.first, given.first + seeds)]
        found = np.array([one for one in all_found if one is not None]).reshape(-1, 3)
        rms, worst, share = found.T if len(found) else np.full((3, 1), np.nan)
        figures = (f"{np.median(rms):.4f}", f"{rms.max():.4f}", f"{worst.max():.4f}", f"{share.mean():.2f}")
        rows.append([kind, f"{len(found)} of {seeds}", *figures])
    header = ["camera", "rooms", "bearings: median, degrees", "worst room", "anywhere", "squared error / covariance"]
    print_table(f"Cameras from the lines of {views} photos of a room, {given.size} px", header, rows)


if __name__ == "__main__":
    main()
