"""Time, memory and exponents of `reconstruct` against photos: a building of flats of five rooms with walls between, given poses.

    python tests/bench/bench_scaling.py --work /tmp/building --photos 10 100 1000 --workers 0 2 --threads 1 2

A flat has PER_FLAT photos, so that their density does not change with their number. Photos are rendered once into the folder.
Every run is a process of its own; seconds are those of the processor, of all its processes. With workers, a Dask cluster of so
many processes extracts the arcs, and the process called has as many threads. The longest path is what that takes where each has a
core: the main thread, and the pool and the workers by their number. There can be no more workers than cores.

With `--threads`, the whole command with so many (as `omnilines --threads N`), by the clock: of the building, and of the 30 real
photos of `castle30` where `../shared` is present. Run it where nothing else does.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from timing import SMALL, print_table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from courtyard import read_courtyard, write_courtyard

from camera_models import Calibration, CameraEstimate, save
from camera_models.pose import Pose
from omnilines.files import write_png, write_poses
from omnilines.machine import cores
from omnilines.records import ImagePoses
from omnilines.scenes import eye, flat, largest_angle, render_photo, scene_camera, scene_poses

PER_FLAT, SIZE, FOV_DEG, NOISE = 125, (640, 480), 190.0, 2.0
FLAT_M, FLATS_IN_ROW = (11.6, 8.6), 4
CASTLE = Path(__file__).resolve().parents[3] / "shared" / "data" / "lines" / "castle30"
WORKER = """
import json, resource, sys, time
from pathlib import Path

if __name__ == "__main__":
    from omnilines.commands.cluster import workers
    from omnilines.commands.reconstruct import reconstruct_photos
    folder, out, photos, cluster = Path(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3]), sys.argv[4] or None
    stages, now = {}, ["reading", time.process_time()]

    def tell(stage, done, total):
        if stage != now[0]:
            stages[now[0]] = stages.get(now[0], 0.0) + time.process_time() - now[1]
            now[:] = [stage, time.process_time()]

    start, main, mine = time.perf_counter(), time.thread_time(), time.process_time()
    with workers(cluster) as executor:
        given = [folder / name for name in photos], folder / "calibration.yaml", str(folder / "poses.csv"), out
        reconstruct_photos(*given, executor=executor, progress=tell)
    tell("", 0, 0)
    own, theirs = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    main = time.thread_time() - main
    found = {"main": main, "pool": time.process_time() - mine - main, "workers": theirs.ru_utime + theirs.ru_stime}
    found |= {"cpu": own.ru_utime + own.ru_stime + found["workers"], "wall": time.perf_counter() - start}
    print(json.dumps({**found, "mb": own.ru_maxrss / 1024, "worker_mb": theirs.ru_maxrss / 1024, "stages": stages}))
"""


def names_of(photos: int) -> tuple[str, ...]:
    """Of the photos of a building."""
    return tuple(f"view{k:05d}.png" for k in range(photos))


def building(folder: Path, photos: int) -> None:
    """Photos of as many flats as that takes, side by side in one world, with poses and camera; drawn unless they are there."""
    camera, circle = scene_camera("opencv-fisheye", SIZE, seed=0, fov_deg=FOV_DEG)
    look, poses = eye(camera, circle), []
    for number in range(math.ceil(photos / PER_FLAT)):
        scene = replace(flat(number), walk_m=None)
        own = scene_poses(scene, PER_FLAT, number, camera)
        shift = np.array([FLAT_M[0] * (number % FLATS_IN_ROW), FLAT_M[1] * (number // FLATS_IN_ROW), 0.0])
        for k in range(min(PER_FLAT, photos - PER_FLAT * number)):
            path = folder / f"view{PER_FLAT * number + k:05d}.png"
            if not path.is_file():
                write_png(path, render_photo(scene, look, own[k], noise_grey=NOISE, seed=[number, k]))
            rotation = own[k].rotation.numpy()
            poses.append(Pose.of(rotation, own[k].translation.numpy() - rotation @ shift))
    names = names_of(photos)
    write_poses(folder / "poses.csv", ImagePoses(names, Pose.stack(poses), ("cam0",) * photos))
    shown = CameraEstimate(max_angle_deg=math.degrees(largest_angle(camera, circle)))
    save(folder / "calibration.yaml", Calibration({"cam0": camera}, {"cam0": shown}))


def run(folder: Path, photos: Sequence[str], workers: int, threads: int | None = None) -> dict:
    """What one reconstruction took. With `threads` all pools have so many; else torch has one, ours one a worker or core."""
    if max(workers, threads or 0) > cores():
        sys.exit(f"At most {cores()} workers or threads were expected, as there are cores, found {max(workers, threads or 0)}.")
    with tempfile.TemporaryDirectory() as out:
        script = Path(out) / "run.py"
        script.write_text(WORKER)
        number = {"OMNILINES_THREADS": str(threads or workers)} if threads or workers else {}
        pools = str(threads or 1)
        path = str(Path(__file__).resolve().parents[2])
        done = subprocess.run(
            [sys.executable, str(script), str(folder), f"{out}/scene", json.dumps(photos), "local" if workers else ""],
            check=True,
            capture_output=True,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": pools, "OMP_WAIT_POLICY": "PASSIVE", "PYTHONPATH": path, **number},
        )
    return json.loads(done.stdout.splitlines()[-1])


def exponent(few: float, many: float, factor: float) -> str:
    """p of time ~ photos^p."""
    return f"{math.log(many / few) / math.log(factor):.2f}" if few > 0 and many > 0 else ""


def measured(folder: Path, counts: list[int], workers: list[int]) -> dict[tuple[int, int], dict]:
    """What each run took, by photos and workers, printed as tables."""
    building(folder, max(counts))
    found = {(photos, count): run(folder, names_of(photos), count) for count in workers for photos in counts}
    rows = []
    for (photos, count), one in found.items():
        one["path"] = one["main"] + (one["pool"] + one["workers"]) / (count or cores())
        figures = (one["cpu"], 1e3 * one["cpu"] / photos, *(one[name] for name in ("main", "pool", "workers", "path", "wall")))
        rows.append([str(photos), str(count or "none"), *(f"{figure:.4g}" for figure in (*figures, one["mb"], one["worker_mb"]))])
    columns = ("CPU s", "ms a photo", "main thread", "its pool", "workers", "longest path s", "wall s", "MB", "MB a worker")
    print_table("reconstruct, given poses", ("photos", "workers", *columns), rows)
    of_photos = [found[photos, workers[0]]["stages"] for photos in counts]
    stages = []
    for name, last in of_photos[-1].items():
        each = [f"{1e3 * own.get(name, 0.0) / photos:.1f}" for photos, own in zip(counts, of_photos, strict=True)]
        grows = exponent(of_photos[-2].get(name, 0.0), last, counts[-1] / counts[-2]) if len(counts) > 1 else ""
        stages.append([name, *each, grows])
    print_table("CPU ms a photo by stage", ("stage", *map(str, counts), "exponent of the last two"), stages)
    return found


def by_the_clock(folder: Path, title: str, photos: Sequence[str], threads: Sequence[int]) -> list[dict]:
    """What whole commands took with so many threads, printed."""
    found = [run(folder, photos, 0, count) for count in threads]
    rows = [
        [str(count), *(f"{one[name]:.4g}" for name in ("wall", "cpu", "mb")), f"{found[0]['wall'] / one['wall']:.2f}"]
        for count, one in zip(threads, found, strict=True)
    ]
    print_table(f"reconstruct, {title}", ("threads", "wall s", "CPU s", "MB", f"times as fast as {threads[0]}"), rows)
    return found


def real_photos(work: Path, threads: Sequence[int], most: int | None = None) -> None:
    """The courtyard by the clock, where its photos are present."""
    if not CASTLE.is_dir():
        print(f"The folder {CASTLE} with photos of a courtyard is absent.")
        return
    names = read_courtyard(CASTLE)[0].images[:most]
    write_courtyard(work / "castle", CASTLE, names)
    by_the_clock(work / "castle", f"castle30, {len(names)} photos", names, threads)


def bench_many_photos_and_workers(tmp_path: Path) -> None:
    """Time and memory grow with the photos, not faster; the gain of workers is printed."""
    at_once = [count for count in (1, 2, 4) if count <= cores()]
    # A small run is once of each kind: a run of few photos, which share few lines, takes most of a minute.
    counts, workers = ([3, 6], [0, at_once[-1]]) if SMALL else ([10, 100, 1000], [0, *at_once])
    clocked = at_once[-1:] if SMALL else at_once
    found = measured(tmp_path, counts, workers)
    gains = [(found[counts[-1], workers[1]]["path"] / found[counts[-1], count]["path"], count) for count in workers[1:]]
    print("  ".join(f"{count} workers: {gain:.2f} times as fast as {workers[1]}" for gain, count in gains))
    by_the_clock(tmp_path, f"the building, {counts[-1]} photos", names_of(counts[-1]), clocked)
    real_photos(tmp_path, clocked, 3 if SMALL else None)
    few, many = (found[photos, 0] for photos in counts[-2:])
    factor = counts[-1] / counts[-2]
    assert many["mb"] < 4096
    assert SMALL or max(many[name] / few[name] for name in ("cpu", "mb")) <= factor**1.1


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=Path)
    parser.add_argument("--photos", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--workers", type=int, nargs="*", default=[0], help="0: the cores of one process; none: no tables of it")
    parser.add_argument("--threads", type=int, nargs="*", default=[])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        place = Path(options.work or made)
        place.mkdir(parents=True, exist_ok=True)
        if options.workers:
            measured(place, options.photos, options.workers)
        if options.threads:
            most = max(options.photos)
            building(place, most)
            by_the_clock(place, f"the building, {most} photos", names_of(most), options.threads)
            real_photos(place, options.threads)
