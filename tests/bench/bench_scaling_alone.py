"""Time, memory and errors of structure from motion against photos, from features on: a walk along a street of points.

    python tests/bench/bench_scaling_alone.py --photos 30 100 300

Nothing is rendered: features are points of house fronts and the road within 15 m, seen by a fisheye camera of 190 degrees every
0.35 m, with noise of 0.35 px, descriptors with noise, 40 percent of the points missing and 60 features of nothing in each photo.
Every size is a process of its own; seconds are those of the processor, errors those after a similarity.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from camera_models import CameraModel
from camera_models.pose import Pose
from camera_models.rotations import similarity_alignment
from omnilines.posing import sfm
from omnilines.posing.features import Features
from omnilines.posing.photo_poses import moved_poses
from omnilines.scenes import scene_camera
from omnilines.scenes.poses import _upright

STEP_M, POINTS_PER_M, FAR_M, NOISE_PX, CLUTTER, SHOWN = 0.35, 60, 15.0, 0.35, 60, 0.6


def street(photos: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Pose]:
    """Points, a descriptor of each, and the poses of a walk among them that looks to both sides in turn."""
    length = 40 + STEP_M * photos
    count = int(POINTS_PER_M * length)
    where, along = rng.integers(3, size=count), rng.uniform(-20, length - 20, count)
    aside = np.choose(where, [np.full(count, -6.0), np.full(count, 6.0), rng.uniform(-6, 6, count)])
    points = np.stack([along, aside, np.where(where == 2, 0.0, rng.uniform(0, 9, count))], -1)
    x = STEP_M * np.arange(photos) + rng.uniform(-0.1, 0.1, photos)
    wobble = rng.uniform([-0.2, -0.1], [0.2, 0.1], (photos, 2))
    places = np.stack([x, 1.5 * np.sin(x / 9) + wobble[:, 0], 1.6 + wobble[:, 1]], -1)
    azimuth = np.radians(50) * np.sin(x / 4) + rng.uniform(-0.2, 0.2, photos)
    rotation = _upright(azimuth, *np.radians(rng.uniform(-5, 5, (2, photos))))
    return points, rng.uniform(0, 100, (count, 128)), Pose.of(rotation, -np.einsum("nij,nj->ni", rotation, places))


def described(model: CameraModel, pose: Pose, points: np.ndarray, words: np.ndarray, rng: np.random.Generator) -> Features:
    """What a photo shows of the points, in any order, and clutter."""
    at = pose.transform(torch.as_tensor(points))
    pixels, valid = model.project(at)
    size = np.array(model.image_size) - 1
    inside = valid & ((pixels > 0) & (pixels < torch.as_tensor(size))).all(-1) & (at.norm(dim=-1) < FAR_M)
    seen = rng.permutation(np.flatnonzero(inside.numpy() & (rng.uniform(size=len(points)) < SHOWN)))
    own = pixels[seen].numpy() + NOISE_PX * rng.normal(size=(len(seen), 2))
    found = torch.as_tensor(np.concatenate([own, rng.uniform(0, 1, (CLUTTER, 2)) * size]))
    bearings, valid = model.unproject(found)
    jacobian = model.unproject_jacobian(found)
    good = valid & torch.isfinite(jacobian).flatten(1).all(-1)
    looks = np.concatenate([words[seen] + 6 * rng.normal(size=(len(seen), 128)), rng.uniform(0, 100, (CLUTTER, 128))])
    sigma = NOISE_PX * torch.linalg.matrix_norm(jacobian[good], ord=2)
    descriptors = torch.as_tensor(np.clip(looks, 0, 255).astype(np.uint8))[good]
    return Features(bearings[good], torch.linalg.pinv(jacobian[good]) / NOISE_PX, sigma, descriptors)


def posed(photos: int) -> dict:
    """What the poses of so many photos took, by stage, and how far off they are."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    model, _ = scene_camera("opencv-fisheye", (640, 480), seed=0, fov_deg=190.0)
    points, words, truth = street(photos, rng)
    features = [described(model, truth[k], points, words, rng) for k in range(photos)]
    sfm._features = lambda *_: features
    stages, now = {}, ["reading", time.process_time()]

    def tell(stage: str, done: int, total: int) -> None:
        if stage != now[0]:
            stages[now[0]] = stages.get(now[0], 0.0) + time.process_time() - now[1]
            now[:] = [stage, time.process_time()]

    names, start = [f"{k}.png" for k in range(photos)], time.process_time()
    with tempfile.TemporaryDirectory() as work:
        none = np.zeros((1, 1), np.uint8)
        found = sfm.sfm_poses(names, lambda _: none, {"c": model}, dict.fromkeys(names, "c"), Path(work), progress=tell)
    cpu = time.process_time() - start
    tell("", 0, 0)
    true = truth[[names.index(name) for name in found.poses.images]]
    scale, similarity = similarity_alignment(found.poses.cam_from_world.centre, true.centre)
    off = 1e3 * (moved_poses(found.poses, float(scale), similarity).cam_from_world.centre - true.centre).norm(dim=-1).numpy()
    mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"cpu": cpu, "mb": mb, "placed": len(off), "off": [float(np.median(off)), float(off.max())], "stages": stages}


def run(photos: int) -> dict:
    """The same in a process of its own."""
    command = [sys.executable, __file__, "--alone", str(photos)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, nargs="+", default=[30, 100, 300])
    parser.add_argument("--alone", type=int, help="one size, in this process, as JSON")
    parser.add_argument("--small", action="store_true", help="few photos")
    options = parser.parse_args()
    if options.alone:
        print(json.dumps(posed(options.alone)))
        sys.exit()
    counts = [12, 16] if options.small else options.photos
    runs = [run(photos) for photos in counts]
    print("| stage, CPU ms a photo |", *(f"{photos} |" for photos in counts))
    for stage in runs[-1]["stages"]:
        print(f"| {stage} |", *(f"{1e3 * one['stages'].get(stage, 0.0) / n:.1f} |" for n, one in zip(counts, runs, strict=True)))
    print("| all |", *(f"{1e3 * one['cpu'] / n:.0f} |" for n, one in zip(counts, runs, strict=True)))
    for title, key in (("peak, MB", "mb"), ("placed", "placed")):
        print(f"| {title} |", *(f"{one[key]:.0f} |" for one in runs))
    print("| off, mm, median and worst |", *(f"{one['off'][0]:.1f}, {one['off'][1]:.1f} |" for one in runs))
