"""Poses by structure from motion against truth: rendered rooms for every camera; with --real the surveyed castle and a rig.

    python tests/bench/bench_posing.py [--views 20] [--size 1100] [--seeds 3] [--real] [--photos 12] [--small]

Errors are those after a similarity. Of the rig, whose places nobody knows, the photos placed and the residuals are given. Time is
CPU time of everything from photos to poses.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from courtyard import read_courtyard

from camera_models import load
from camera_models.formats import read as read_calibration
from camera_models.rotations import similarity_alignment
from omnilines.files import find_photos, read_photo
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.posing.sfm import sfm_poses
from omnilines.records import ImagePoses

Cameras = tuple[tuple[str, float | None], ...]
CAMERAS: Cameras = (("opencv-fisheye", 190.0), ("scaramuzza", 220.0), ("equirectangular", None), ("pinhole", None))
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
HEADER = "| {:<24} | {:>6} | {:>6} | {:>16} | {:>16} | {:>7} |"


def row(name: str, found: PhotoPoses, truth: ImagePoses, seconds: float) -> str:
    index = [truth.images.index(image) for image in found.poses.images]
    true = truth.cam_from_world[index]
    scale, similarity = similarity_alignment(found.poses.cam_from_world.centre, true.centre)
    moved = moved_poses(found.poses, float(scale), similarity).cam_from_world
    position = 1e3 * (moved.centre - true.centre).norm(dim=-1).numpy()
    rotation = np.degrees((moved @ true.inverse()).log()[:, :3].norm(dim=-1).numpy())
    places, turns = (f"{np.median(e):.2f} / {e.max():.2f}" for e in (position, rotation))
    return HEADER.format(name, len(truth), len(found.poses), places, turns, f"{seconds:.0f} s")


def timed(*arguments: object, **options: object) -> tuple[PhotoPoses, float]:
    start = time.process_time()
    found = sfm_poses(*arguments, **options)  # type: ignore[arg-type]
    return found, time.process_time() - start


def rooms(cameras: Cameras, views: int, side: int, seeds: list[int]) -> None:
    for seed in seeds:
        for model, fov in cameras:
            with tempfile.TemporaryDirectory() as folder:
                size = (2 * side, side) if model == "equirectangular" else (side, side)
                scene = render_scene("room", model, RenderOptions(fov, views, size, seed=seed))
                scene.save(folder)
                names = scene.poses.images
                calibration, cameras = load(Path(folder) / "calibration.yaml"), dict.fromkeys(names, "cam0")
                read = Path(folder).joinpath
                found, seconds = timed(
                    names, lambda n, read=read: read_photo(read(n)), calibration, cameras, Path(folder) / "work"
                )
                print(row(f"{model}, seed {seed}", found, scene.poses, seconds), flush=True)


def castle(photos: int) -> None:
    data = DATA / "lines" / "castle30"
    poses, camera = read_courtyard(data)
    names, truth = poses.images[:photos], poses.cam_from_world[:photos]
    with tempfile.TemporaryDirectory() as work:
        read = (data / "images").joinpath
        found, seconds = timed(names, lambda n: read_photo(read(n)), {"cam0": camera}, dict.fromkeys(names, "cam0"), Path(work))
    print(row("castle30", found, ImagePoses(names, truth), seconds), flush=True)


def hall() -> None:
    folder = DATA / "rigs" / "omnimvs" / "itbt_sample"
    calibration = read_calibration(folder / "config.yaml").calibration
    names = [photo.name for photo in find_photos([folder])]
    camera_of, frame_of = {n: n.split("/")[0] for n in names}, {n: Path(n).stem for n in names}
    with tempfile.TemporaryDirectory() as work:
        read = folder.joinpath
        found, seconds = timed(names, lambda n: read_photo(read(n)), calibration, camera_of, Path(work), frame_of=frame_of)
    print(f"itbt_sample: {len(found.poses)} of {len(names)} placed, {seconds:.0f} s; {' '.join((*found.notes, *found.left_out))}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--size", type=int, default=1100)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3])
    parser.add_argument("--photos", type=int, default=12)
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--small", action="store_true", help="few photos of a room, and of the castle and the rig where they are")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(HEADER.format("camera", "photos", "placed", "position, mm", "rotation, deg", "CPU"))
    if options.small:
        rooms(CAMERAS[:1], 6, 500, [3])
        if DATA.is_dir():
            castle(3)
            hall()
    elif options.real:
        castle(options.photos)
        hall()
    else:
        rooms(CAMERAS, options.views, options.size, options.seeds)
