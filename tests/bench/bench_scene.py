"""Lines of a rendered room from photos with known poses: ours beside pylimap 2.0.0.

    python tests/bench/bench_scene.py [--views 20] [--seed 0] [--work DIR] [--methods ours 90 120 cube best] [--small]

The room of `omnilines render scene`: 190 degree fisheye, 1100x1100, noise of 2 grey levels, exact calibration and poses. pylimap
takes pinhole cameras, so it is given views of `omnilines rectify`, with the poses of the views: one of 90 degrees a photo, one
of 120, or the five faces of a cube that a lens of 190 degrees fills. Its defaults are grey segments and 20 neighbours; at its
best, found by trial, it gets segments of every colour channel, all neighbours, and its separate adjustment of lines. Photos and
views are kept in `--work` (or $OMNILINES_BENCH, or a folder that is removed) and drawn once. Seconds are from the photos to the
lines: making the views counts, and so does the report of ours.

Scores are those of omnilines.evaluation.scene, over all lines that a method gives and over those of four views or more.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from timing import NO_PEERS, PEERS, print_table, skip

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import camera_models
from camera_models.views import axis_from_camera, views
from omnilines.cli import main as omnilines
from omnilines.commands.rectify import rectify
from omnilines.commands.render_scene import render_scene
from omnilines.evaluation.scene import scene_scores
from omnilines.files import read_lines, read_poses, read_segments
from omnilines.files.true_edges import Stretches, TrueEdges, read_stretches, read_true_edges
from omnilines.scenes import SCENES

HERE = Path(__file__).resolve().parent
SIZE, FOV_DEG, NOISE = (1100, 1100), 190.0, 2.0
PEER_SECONDS = 3600
LEAST_VIEWS = 4
SEEN_PX = 40.0


@dataclass(frozen=True)
class Method:
    """How pylimap is run."""

    name: str
    view: str
    fov_deg: float | None
    segments: str
    neighbours: int | None
    adjust: bool


METHODS = {
    "90": Method("pylimap, one view of 90 degrees", "perspective", 90.0, "grey", 20, False),
    "120": Method("pylimap, one view of 120 degrees", "perspective", 120.0, "grey", 20, False),
    "cube": Method("pylimap, cube, default", "cube", None, "grey", 20, False),
    "best": Method("pylimap, cube, best", "cube", None, "colour", None, True),
}


@dataclass(frozen=True)
class Found:
    """Lines, the photos of each, and the segments that each was made from: (line, photo, u1, v1, u2, v2)."""

    ends_m: np.ndarray
    photos: np.ndarray
    line: np.ndarray
    photo: tuple[str, ...]
    segment_px: np.ndarray
    seconds: float


def pylimap(folder: Path, names: Sequence[str], method: Method, before_s: float) -> Found:
    """pylimap on the perspective photos of a folder with a COLMAP model; a photo counts once, however many views show a line."""
    request = {
        "images": str(folder),
        "model": str(folder / "colmap"),
        "names": list(names),
        "segments": method.segments,
        "neighbours": method.neighbours,
        "adjust": method.adjust,
    }
    start = time.perf_counter()
    done = subprocess.run(
        [PEERS, HERE / "peer_limap_scene.py"],
        input=json.dumps(request),
        capture_output=True,
        text=True,
        check=True,
        timeout=PEER_SECONDS,
    )
    seconds = time.perf_counter() - start + before_s
    answer = json.loads(done.stdout.splitlines()[-1])
    rows = [(k, *part) for k, parts in enumerate(answer["observations"]) for part in parts]
    cube = method.view == "cube"
    source = [{part[0].rpartition("_")[0] if cube else part[0] for part in parts} for parts in answer["observations"]]
    return Found(
        np.array(answer["ends_m"]).reshape(-1, 2, 3),
        np.array([len(photos) for photos in source], dtype=np.int64),
        np.array([row[0] for row in rows], dtype=np.int64),
        tuple(row[1] for row in rows),
        np.array([row[2:] for row in rows]).reshape(-1, 2, 2),
        seconds,
    )


def ours(photos: Path, calibration: Path, poses: Path, out: Path) -> Found:
    """`omnilines reconstruct` as a user calls it, report included; from nothing, as a second run would do nothing."""
    shutil.rmtree(out, ignore_errors=True)
    start = time.perf_counter()
    arguments = ["reconstruct", str(photos), "--calibration", str(calibration), "--poses", str(poses), "--out", str(out)]
    try:
        omnilines(arguments)
    except SystemExit as finished:
        assert not finished.code, f"omnilines reconstruct ended with {finished.code}"
    seconds = time.perf_counter() - start
    lines, table = read_lines(out / "lines.csv"), read_segments(out / "segments.csv")
    known = np.flatnonzero(lines.known)
    number = {lines.tracks[k]: row for row, k in enumerate(known)}
    row = np.array([number.get(name, -1) for name in table.tracks] + [-1], dtype=np.int64)[table.track]
    used = np.flatnonzero(row >= 0)
    photo = tuple(table.images[k] for k in table.image[used])
    return Found(lines.ends_m[known], lines.views[known], row[used], photo, table.endpoints_px[used], seconds)


def room(work: Path, scene: str, count: int, size: tuple[int, int], seed: int) -> Path:
    """The photos and the truth, drawn unless they are there; the stretches are written last."""
    folder = work / f"{scene}_{count}_{size[0]}_{seed}"
    if not (folder / "visibility.csv").is_file():
        render_scene(folder, scene=scene, model="opencv-fisheye", fov_deg=FOV_DEG, views=count, size=size, noise=NOISE, seed=seed)
    return folder


def views_of(folder: Path, method: Method) -> tuple[Path, float]:
    """The views that pylimap is given, and the seconds it took to make them."""
    out = folder.with_name(f"{folder.name}_{method.view}{method.fov_deg or ''}")
    noted = out / "seconds.json"
    if not noted.is_file():
        start = time.perf_counter()
        rectify([folder], folder / "calibration.yaml", out, view=method.view, poses=folder / "poses.csv", fov_deg=method.fov_deg)
        noted.write_text(json.dumps(time.perf_counter() - start))
    return out, json.loads(noted.read_text())


def lost_share(folder: Path, method: Method) -> float:
    """Share of the solid angle that the photos show which the views do not."""
    calibration = camera_models.load(folder / "calibration.yaml")
    camera = calibration["cam0"]
    k = np.arange(50_000) + 0.5
    up = 1 - 2 * k / len(k)
    turn = math.pi * (1 + math.sqrt(5)) * k
    rays = np.stack([np.sqrt(1 - up * up) * np.cos(turn), np.sqrt(1 - up * up) * np.sin(turn), up], -1)
    pixel, shown = camera.project(rays)
    inside = ((pixel >= -0.5) & (pixel <= np.array(camera.image_size) - 0.5)).all(-1)
    estimate = calibration.estimates["cam0"]
    shown &= inside & (rays[:, 2] >= math.cos(math.radians(estimate.max_angle_deg or 180.0)))
    kept = np.zeros(len(rays), dtype=bool)
    for view in views(method.view, fov_deg=method.fov_deg):
        if view.name != "back":
            pixel, valid = view.camera.project(rays @ (view.view_from_axis @ axis_from_camera(camera)).T)
            kept |= valid & ((pixel >= -0.5) & (pixel <= np.array(view.camera.image_size) - 0.5)).all(-1)
    return float((shown & ~kept).sum() / shown.sum())


COLUMNS = (
    "method",
    "recall",
    "of long stretches",
    "strict precision",
    "R, m",
    "P, %",
    "error mm",
    "direction 50, 95 (deg)",
    "repeated %",
    "lines",
    "lines/s",
    "s",
    "field lost %",
)


def scored(label: str, ends_m: np.ndarray, edges: TrueEdges, stretches: Stretches, seconds: float, lost: float) -> list[str]:
    """One row of the table of a room."""
    score = scene_scores(ends_m, edges, stretches)
    clear = scene_scores(ends_m, edges, stretches, min_px=SEEN_PX)
    return [
        label,
        " ".join(f"{value:.3f}" for value in score.recall),
        " ".join(f"{value:.3f}" for value in clear.recall),
        " ".join(f"{value:.3f}" for value in score.precision),
        " ".join(f"{value:.1f}" for value in score.length_recall_m),
        " ".join(f"{100 * value:.0f}" for value in score.inlier_share),
        f"{1e3 * score.median_error_m:.2f}",
        f"{score.direction_deg(50):.3f} {score.direction_deg(95):.2f}",
        f"{100 * score.repeated_share:.1f}",
        str(score.lines),
        f"{score.lines / seconds:.1f}",
        f"{seconds:.1f}",
        f"{100 * lost:.0f}",
    ]


def room_table(work: Path, scene: str, count: int, size: tuple[int, int], seed: int, methods: Sequence[str]) -> None:
    """Every method on one room, one row for all its lines and one for those of four photos and more."""
    folder = room(work, scene, count, size, seed)
    edges = read_true_edges(folder / "truth.csv")
    stretches = read_stretches(folder / "visibility.csv", edges)
    rows = []
    for name in methods:
        method = METHODS.get(name)
        if method is None:
            found = ours(folder, folder / "calibration.yaml", folder / "poses.csv", folder.with_name(f"{folder.name}_ours"))
        else:
            seen, before_s = views_of(folder, method)
            names = [image for image in read_poses(seen / "poses.csv").images if not image.endswith("_back.png")]
            found = pylimap(seen, names, method, before_s)
        label, lost = method.name if method else "omnilines", lost_share(folder, method) if method else 0.0
        rows.append(scored(label, found.ends_m, edges, stretches, found.seconds, lost))
        many = found.ends_m[found.photos >= LEAST_VIEWS]
        rows.append(scored(f"  of >= {LEAST_VIEWS} photos", many, edges, stretches, found.seconds, lost))
    print_table(
        f"{scene} of seed {seed}, {count} photos; recall of edges visible in {LEAST_VIEWS} photos, and of their stretches of "
        f"{SEEN_PX:.0f} px and more; thresholds 1, 5, 10 mm",
        COLUMNS,
        rows,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", choices=SCENES, default="room")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=os.environ.get("OMNILINES_BENCH"))
    parser.add_argument("--methods", nargs="+", default=["ours", *METHODS], choices=["ours", *METHODS])
    parser.add_argument("--small", action="store_true", help="a few small photos, ours and one view of 90 degrees")
    options = parser.parse_args()
    size, here = SIZE, [name for name in options.methods if name == "ours" or PEERS.is_file()]
    if options.small:
        options.scene, options.views, size, here = "plain-room", 6, (500, 500), here[:2]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(options.work or folder)
        place.mkdir(parents=True, exist_ok=True)
        room_table(place, options.scene, options.views, size, options.seed, here)
    if not PEERS.is_file() and options.methods != ["ours"]:
        skip(NO_PEERS)
