"""A rendered room from its photos alone: own calibration, poses from structure from motion, and lines, against noise and blur.

    python tests/bench/bench_scene_own.py [--scene plain-room] [--views 20] [--seed 0] [--levels 2,0.5 4,0.8 8,1.2] [--small]

A level is the noise in grey levels and the blur in pixels. For each: 20 photos of a target and the photos of the room through one
camera (190 degree fisheye, 1100x1100); `omnilines calibrate`; `omnilines reconstruct --poses sfm --refine lines,poses`; the lines
are brought into the true frame by the camera centres (a similarity, since the scale is unknown) and scored at 1, 5, 10 mm.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from timing import print_table

from omnilines.cli import main as omnilines
from omnilines.evaluation.scene import aligned_ends, scene_scores
from omnilines.files import read_lines, read_poses
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.scenes import SCENES

CAMERA = ("--model", "opencv-fisheye", "--fov-deg", "190", "--size", "1100x1100")
SMALL_CAMERA = (*CAMERA[:-1], "600x600")
PATTERN = "checkerboard:8x6:30mm"
COLUMNS = (
    "noise, blur",
    "photos posed",
    "recall 1 5 10 mm",
    "stretches >= 40 px",
    "strict precision",
    "median error mm",
    "lines",
    "s",
)
LONG_PX = 40.0


def run(*arguments: str) -> None:
    """A command of omnilines; raises SystemExit where it fails."""
    try:
        omnilines(list(arguments))
    except SystemExit as finished:
        if finished.code:
            raise


def row(work: Path, camera: Sequence[str], scene: str, views: int, seed: int, noise: str, blur: str) -> list[str]:
    """One level."""
    common = ("--noise", noise, "--blur", blur, "--seed", str(seed))
    run("render", "targets", *camera, *common, "--pattern", PATTERN, "--views", "20", "--out", str(work / "targets"))
    run("render", "scene", "--scene", scene, *camera, *common, "--views", str(views), "--out", str(work / "room"))
    truth = read_poses(work / "room" / "poses.csv")
    edges = read_true_edges(work / "room" / "truth.csv")
    stretches = read_stretches(work / "room" / "visibility.csv", edges)
    start = time.perf_counter()
    run("calibrate", str(work / "targets"), "--pattern", PATTERN, "--model", "opencv-fisheye", "--out", str(work / "own"))
    own = str(work / "own" / "calibration.yaml")
    photos, out = str(work / "room"), work / "lines"
    run("reconstruct", photos, "--calibration", own, "--poses", "sfm", "--refine", "lines,poses", "--out", str(out))
    seconds = time.perf_counter() - start
    lines, poses = read_lines(out / "lines.csv"), read_poses(out / "poses.csv")
    ends = aligned_ends(lines.ends_m[lines.known], poses, truth)
    every, long = (scene_scores(ends, edges, stretches, min_px=least) for least in (0.0, LONG_PX))
    return [
        f"{noise}, {blur}",
        f"{len(poses)} of {views}",
        *(" ".join(f"{value:.3f}" for value in values) for values in (every.recall, long.recall, every.precision)),
        f"{1e3 * every.median_error_m:.2f}",
        str(every.lines),
        f"{seconds:.0f}",
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", choices=SCENES, default="plain-room")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--levels", nargs="+", default=["2,0.5", "4,0.8", "8,1.2"])
    parser.add_argument("--small", action="store_true", help="a few small photos with little noise")
    options, camera = parser.parse_args(), CAMERA
    if options.small:
        options.views, options.levels, camera = 8, options.levels[:1], SMALL_CAMERA
    rows = []
    for level in options.levels:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(row(Path(folder), camera, options.scene, options.views, options.seed, *level.split(",")))
    print_table(f"{options.scene}, seed {options.seed}: own calibration, own poses", COLUMNS, rows)
