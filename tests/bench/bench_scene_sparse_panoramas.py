"""A real flat from fewer and smaller panoramas (flat_panoramas), photos alone and with rough poses, beside all photos in full.

    python tests/bench/bench_scene_sparse_panoramas.py [--work DIR] [--data DIR] [--photos 0,2,4,7 ...] [--ways sfm rough]
        [--small]

The photos are made 2048x1024, each with an exposure, white balance and gamma of its own, and kept as JPEGs of quality 85. What is
compared with are the poses and arcs of all photos in full size, photos alone (`bench_scene_panoramas.py --work DIR` leaves them
in DIR/all, and they are taken from there). Rough poses are those with normal errors of OFF_M along and OFF_DEG about each axis;
they are refined. Centres are compared after the similarity that rotations and centres give. Found again: of the lines that are
40 px long in the photos that had no part, those within 2 px of an arc found there in full size (`held_out.py`), in pixels of the
small photos.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch
from bench_scene_flat import disturbed
from bench_scene_panoramas import COMMAND, DATA, SIZE, Cost, in_photo, reconstructed
from timing import print_table, skip

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from held_out import NEAR_PX, SEEN_PX, held_out

import camera_models
from camera_models import Calibration, CameraModel, Equirectangular
from omnilines.files import find_photos, read_lines, read_poses, read_segments, write_poses
from omnilines.posing.photo_poses import align_to, moved_poses
from omnilines.records import ImagePoses

REDUCED, SMALL_SIZES = (2048, 1024), ((1344, 672), (1024, 512))
QUALITY = 85
METRES = 0.63
"""Of a unit of the reference, from the height of its ceiling (3.95 units, taken for 2.5 m)."""
OFF_M, OFF_DEG = 0.05, 0.5
EVERY, SECOND, THIRD, MIXED = "0,1,2,3,4,5,6,7", "0,2,4,7", "0,3,7", "0,2,3,5,7"
FEW = 4
"""Photos up to which three have to see a line, not four."""


def reduced(photos: list[Path], folder: Path, size: tuple[int, int], vary: bool) -> list[Path]:
    """Smaller photos, as other exposures would show them."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    for photo in photos:
        grey = cv2.resize(cv2.imread(str(photo)), size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        gain, balance, gamma = (
            np.exp(rng.uniform(-0.35, 0.35)),
            np.exp(rng.normal(0.0, 0.04, 3)),
            np.exp(rng.uniform(-0.15, 0.15)),
        )
        level = 255.0 * np.clip(grey**gamma * gain * balance if vary else grey, 0.0, 1.0)
        cv2.imwrite(str(folder / photo.name), np.rint(level).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return [folder / photo.name for photo in photos]


def run(photos: list[Path], calibration: Path, poses: str, out: Path) -> Cost:
    """`omnilines reconstruct --refine lines,poses`, from the photos on."""
    fewer = ["--min-views", "3"] if len(photos) <= FEW else []
    source = ["--calibration", str(calibration), "--poses", poses, "--refine", "lines,poses"]
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, "reconstruct", *map(str, photos), *source, *fewer, "--out", str(out)]
    )
    _, status, used = os.wait4(process.pid, 0)
    assert status == 0, f"omnilines reconstruct ended with {status}"
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20)


def chosen(poses: ImagePoses, names: list[str]) -> ImagePoses:
    """In metres."""
    rows = [poses.images.index(name) for name in names]
    whole = ImagePoses(tuple(names), poses.cam_from_world[rows], ("cam0",) * len(rows))
    return moved_poses(whole, METRES, camera_models.Pose.identity())


def found_again(ends_m: np.ndarray, true: ImagePoses, others: list[str], reference: Path, camera: CameraModel, full: int) -> str:
    """Of lines in the world of the reference, over the photos that had no part."""
    table, scale, off = read_segments(reference / "segments.csv"), camera.image_size[0] / full, [np.zeros(0)]
    for name in others:
        arcs_px = (in_photo(table, name, full) + 0.5) * scale - 0.5
        arcs_px = arcs_px[np.linalg.norm(arcs_px[:, 1] - arcs_px[:, 0], axis=-1) >= SEEN_PX / 2]
        off.append(held_out(ends_m, true.cam_from_world[true.images.index(name)], camera, arcs_px)[0])
    every = np.concatenate(off)
    return f"{(every < NEAR_PX).sum()} of {len(every)}, {100 * (every < NEAR_PX).mean():.1f} %" if len(every) else ""


def row(photos: list[Path], way: str, out: Path, cost: Cost, reference: Path, camera: CameraModel, full: int) -> list[str]:
    """One run beside the reference."""
    names, true = [photo.name for photo in photos], read_poses(reference / "poses.csv")
    true = chosen(true, list(true.images))
    moved, scale, similarity = align_to(read_poses(out / "poses.csv"), true)
    own = true.cam_from_world[[true.images.index(name) for name in moved.images]]
    off_cm = 100.0 * (moved.cam_from_world.centre - own.centre).norm(dim=-1)
    lines = read_lines(out / "lines.csv")
    ends_m = similarity.transform(scale * torch.as_tensor(lines.ends_m[lines.known])).numpy()
    others = [name for name in true.images if name not in names]
    again = found_again(ends_m, true, others, reference, camera, full)
    which = f"{len(moved)} of {len(names)}"
    centres = f"{float(off_cm.median()):.2f} / {float(off_cm.max()):.2f}"
    return [way, which, centres, str(len(ends_m)), again, f"{cost.cpu_s:.0f}", f"{cost.peak_gb:.2f}"]


def main(data: Path, work: Path, subsets: list[list[int]], ways: list[str], small: bool) -> None:
    if not data.is_dir():
        skip(f"the folder {data} with panoramas is absent")
    work.mkdir(parents=True, exist_ok=True)
    every, full, size = [photo.path for photo in find_photos([data])], SIZE, REDUCED
    if small:
        full, size = SMALL_SIZES
        every = reduced(every[:5], work / "all_small", full, False)
    camera = Equirectangular.from_mapping({}, size)
    for name, model in (("full", Equirectangular.from_mapping({}, full)), ("reduced", camera)):
        camera_models.save(work / f"{name}.yaml", Calibration({"cam0": model}))
    if not (work / "all" / "segments.csv").is_file():
        reconstructed(every, work / "full.yaml", work / "all", None)
    photos = reduced(every, work / "reduced", size, True)
    for subset in subsets:
        rows, own = [], [photos[k] for k in subset]
        for way in ways:
            out, source = work / f"{way}_{'_'.join(map(str, subset))}", "sfm"
            if way == "rough":
                source = f"{out}.csv"
                given = chosen(read_poses(work / "all" / "poses.csv"), [photo.name for photo in own])
                write_poses(Path(source), disturbed(given, OFF_DEG, OFF_M, 1))
            rows.append(row(own, way, out, run(own, work / "reduced.yaml", source, out), work / "all", camera, full[0]))
        header = ["poses", "posed", "centres off cm, median / worst", "lines", "found again in the others", "CPU s", "peak GB"]
        print_table(f"photos {', '.join(map(str, subset))}", header, rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--work", type=Path, help="a folder that is removed where not given")
    parser.add_argument("--photos", nargs="+", default=[EVERY, MIXED, SECOND, THIRD], help="by their places in the row")
    parser.add_argument("--ways", nargs="+", choices=("sfm", "rough"), default=["sfm", "rough"])
    parser.add_argument("--small", action="store_true", help="the first photos, smaller still")
    options = parser.parse_args()
    if options.small:
        options.photos, options.ways = ["0,1,2,4"], ["rough"]
    with tempfile.TemporaryDirectory() as scratch:
        work, subsets = (options.work or Path(scratch)).resolve(), [[int(k) for k in text.split(",")] for text in options.photos]
        main(options.data.resolve(), work, subsets, options.ways, options.small)
