"""A rendered flat of five rooms from 13 sparse panoramas, or another scene: lines from exact poses, from rough ones, from none.

    python tests/bench/bench_scene_flat.py [--seed 0] [--ways exact rough sfm] [--off-deg 0.5] [--off-m 0.05]
        [--min-views 3] [--work DIR] [--small]
    python tests/bench/bench_scene_flat.py --scene plain-room --ways rough --off-deg 2 --off-m 0.1

The flat is seen by 13 panoramas of 2048x1024, other scenes by 20 photos of a 190 degree fisheye of 1100x1100; noise of 2 grey
levels, blur of 0.5 px, exact calibration. Rough poses are the true ones with normal errors of `--off-deg` about and `--off-m`
along each axis, drawn from the seed; they and those of `--poses sfm` are refined with the lines. Lines are brought into the true
frame by the camera centres, and scored as in docs/reconstruction.md at 1, 5 and 10 mm, recall over what three photos see. CPU
seconds are from the photos to the report. Photos are kept in `--work` (or $OMNILINES_BENCH) and drawn once.
"""

import argparse
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from bench_scene_own import CAMERA, LONG_PX, SMALL_CAMERA, run
from timing import print_table

from camera_models.pose import Pose
from camera_models.rotations import similarity_alignment
from omnilines.evaluation.scene import aligned_ends, scene_scores
from omnilines.files import read_lines, read_poses, write_poses
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.records import ImagePoses
from omnilines.scenes import SCENES

PANORAMA = ("--model", "equirectangular", "--size", "2048x1024")
LEAST_VIEWS = 3
COLUMNS = (
    "poses",
    "posed",
    "centres off mm",
    "recall 1 5 10 mm",
    f"stretches >= {LONG_PX:.0f} px",
    "strict precision",
    "lines",
    "CPU s",
)


def photos(work: Path, camera: Sequence[str], scene: str, views: int, seed: int) -> Path:
    """The photos and the truth, drawn unless they are there; the stretches are written last."""
    folder = work / f"{scene}_{views}_{seed}"
    if not (folder / "visibility.csv").is_file():
        run("render", "scene", "--scene", scene, *camera, "--views", str(views), "--seed", str(seed), "--out", str(folder))
    return folder


def disturbed(poses: ImagePoses, off_deg: float, off_m: float, seed: int) -> ImagePoses:
    """Cameras turned about, and moved along, each of their axes by normal errors of those standard deviations."""
    sigma = np.repeat([math.radians(off_deg), off_m], 3)
    errors = np.random.default_rng([seed, 20]).standard_normal((len(poses), 6)) * sigma
    return ImagePoses(poses.images, Pose.exp(torch.as_tensor(errors)) @ poses.cam_from_world, poses.cameras)


def row(folder: Path, way: str, off_deg: float, off_m: float, seed: int, more: list[str], out: Path) -> list[str]:
    """One source of poses; dashes where nothing comes of it."""
    truth = read_poses(folder / "poses.csv")
    edges = read_true_edges(folder / "truth.csv")
    stretches = read_stretches(folder / "visibility.csv", edges)
    source = {"exact": str(folder / "poses.csv"), "rough": str(out.with_suffix(".csv")), "sfm": "sfm"}[way]
    label = f"{off_deg:g} deg, {1e3 * off_m:g} mm off" if way == "rough" else way
    if way == "rough":
        write_poses(Path(source), disturbed(truth, off_deg, off_m, seed))
    refine = "lines" if way == "exact" else "lines,poses"
    start = sum(os.times()[:4])
    try:
        common = ("--calibration", str(folder / "calibration.yaml"), "--poses", source, "--refine", refine, "--out", str(out))
        run("reconstruct", str(folder), *common, *more)
    except SystemExit:
        return [label, *["-"] * (len(COLUMNS) - 2), f"{sum(os.times()[:4]) - start:.0f}"]
    seconds = sum(os.times()[:4]) - start
    lines, poses = read_lines(out / "lines.csv"), read_poses(out / "poses.csv")
    ends = aligned_ends(lines.ends_m[lines.known], poses, truth)
    every, long = (scene_scores(ends, edges, stretches, min_views=LEAST_VIEWS, min_px=least) for least in (0.0, LONG_PX))
    off = 1e3 * centre_errors_m(poses, truth)
    return [
        label,
        f"{len(poses)} of {len(truth)}",
        f"{np.median(off):.1f} / {off.max():.1f}",
        *(" ".join(f"{value:.3f}" for value in values) for values in (every.recall, long.recall, every.precision)),
        str(every.lines),
        f"{seconds:.0f}",
    ]


def centre_errors_m(found: ImagePoses, truth: ImagePoses) -> np.ndarray:
    """Distances of the camera centres from the true ones after the similarity that fits them best."""
    true = truth.cam_from_world.centre[[truth.images.index(name) for name in found.images]]
    scale, pose = similarity_alignment(found.cam_from_world.centre, true)
    return (pose.transform(scale * found.cam_from_world.centre) - true).norm(dim=-1).numpy()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", choices=SCENES, default="flat")
    parser.add_argument("--views", type=int, help="13 of the flat, 20 of others")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ways", nargs="+", choices=("exact", "rough", "sfm"), default=["exact", "rough", "sfm"])
    parser.add_argument("--off-deg", type=float, default=0.5)
    parser.add_argument("--off-m", type=float, default=0.05)
    parser.add_argument("--min-views", type=int, help="as of omnilines reconstruct")
    parser.add_argument("--small", action="store_true", help="a few small photos of a room, poses exact and rough")
    parser.add_argument("--work", type=Path, default=os.environ.get("OMNILINES_BENCH"))
    options = parser.parse_args()
    views, camera = (13, PANORAMA) if options.scene == "flat" else (20, CAMERA)
    if options.small:
        options.scene, options.ways, views, camera = "plain-room", ["exact", "rough"], 6, SMALL_CAMERA
    views = options.views or views
    with tempfile.TemporaryDirectory() as temporary:
        seen = photos(Path(options.work or temporary), camera, options.scene, views, options.seed)
        more = [] if options.min_views is None else ["--min-views", str(options.min_views)]
        rows = [row(seen, way, options.off_deg, options.off_m, options.seed, more, Path(temporary) / way) for way in options.ways]
    print_table(f"{options.scene}, seed {options.seed}, {views} photos", COLUMNS, rows)
