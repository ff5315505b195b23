"""Lines of a rendered room and of a real courtyard from photos with known poses: ours beside pylimap 2.0.0.

    python tests/bench/bench_scene.py [--views 20] [--seed 0] [--work DIR] [--methods ours 90 120 cube best] [--castle DIR]

The room of `omnilines render scene`: 190 degree fisheye, 1100x1100, noise of 2 grey levels, exact calibration and poses. pylimap
takes pinhole cameras, so it is given views of `omnilines rectify`, with the poses of the views: one of 90 degrees a photo, one
of 120, or the five faces of a cube that a lens of 190 degrees fills. Its defaults are grey segments and 20 neighbours; at its
best, found by trial, it gets segments of every colour channel, all neighbours, and its separate adjustment of lines. Photos and
views are kept in `--work` (or $OMNILINES_BENCH, or a folder that is removed) and drawn once. Seconds are from the photos to the
lines: making the views counts, and so does the report of ours.

Scores are those of omnilines.evaluate_scene, over all lines that a method gives and over those of four views or more.
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

import cv2
import numpy as np
import torch
from timing import print_table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import camera_models
from camera_models import Calibration, Pinhole
from camera_models.pose import Pose
from camera_models.views import axis_from_camera, views
from omnilines.cli import main as omnilines
from omnilines.commands.rectify import rectify
from omnilines.commands.render_scene import render_scene
from omnilines.evaluate_scene import scene_scores
from omnilines.files import read_lines, read_poses, read_segments, write_poses
from omnilines.files.colmap_images import write_colmap_images
from omnilines.files.true_edges import Stretches, TrueEdges, read_stretches, read_true_edges
from omnilines.records import ImagePoses
from omnilines.scenes import SCENES

HERE = Path(__file__).resolve().parent
PEERS = HERE.parents[1] / ".venv-peers" / "bin" / "python"
SIZE, FOV_DEG, NOISE = (1100, 1100), 190.0, 2.0
PEER_SECONDS = 3600
LEAST_VIEWS = 4
HELD_OUT = 10
"""Every tenth photo of the courtyard, from the sixth on, is left out of the estimate."""
SEEN_PX, MATCHED_PX, NEAR_PX, PARALLEL_DEG = 40.0, 5.0, 2.0, 3.0


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
CASTLE_METHOD = Method("pylimap", "perspective", None, "grey", 20, True)


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


def room(work: Path, scene: str, count: int, seed: int) -> Path:
    """The photos and the truth, drawn unless they are there; the stretches are written last."""
    folder = work / f"{scene}_{count}_{seed}"
    if not (folder / "visibility.csv").is_file():
        render_scene(folder, scene=scene, model="opencv-fisheye", fov_deg=FOV_DEG, views=count, size=SIZE, noise=NOISE, seed=seed)
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
    clear = scene_scores(ends_m, edges, stretches, least_px=SEEN_PX)
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


def room_table(work: Path, scene: str, count: int, seed: int, methods: Sequence[str]) -> None:
    """Every method on one room, one row for all its lines and one for those of four photos and more."""
    folder = room(work, scene, count, seed)
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


def castle(data: Path, work: Path) -> tuple[Path, ImagePoses, Pinhole]:
    """The courtyard's cameras at half size as calibration.yaml, poses.csv and a COLMAP model beside links to its photos."""
    folder = work / "castle"
    (folder / "colmap").mkdir(parents=True, exist_ok=True)
    files = sorted((data / "cameras").glob("*.camera"))
    tables = [np.array(" ".join(file.read_text().split()).split(), dtype=np.float64) for file in files]
    k, size = tables[0][:9], tables[0][24:26]
    assert all((table[:9] == k).all() and len(table) == 26 for table in tables)
    half = {"fx": k[0] / 2, "fy": k[4] / 2, "cx": (k[2] + 0.5) / 2 - 0.5, "cy": (k[5] + 0.5) / 2 - 0.5}
    camera = Pinhole.from_mapping(half, (int(size[0]) // 2, int(size[1]) // 2))
    rotation = torch.as_tensor(np.stack([table[12:21].reshape(3, 3).T for table in tables]))
    centre = torch.as_tensor(np.stack([table[21:24] for table in tables]))
    names = tuple(file.name.removesuffix(".camera") for file in files)
    pose = Pose(rotation, -(rotation @ centre[..., None])[..., 0])
    table = ImagePoses(names, pose, ("cam0",) * len(names))
    camera_models.save(folder / "calibration.yaml", Calibration({"cam0": camera}))
    write_poses(folder / "poses.csv", table)
    write_colmap_images(folder / "colmap", {"cam0": camera}, table)
    for name in names:
        if not (folder / name).exists():
            (folder / name).symlink_to(data / "images" / name)
    return folder, table, camera


def distances_px(ends_m: np.ndarray, poses: Pose, camera: Pinhole, segment_px: np.ndarray) -> np.ndarray:
    """(n,) RMS distance of both ends of a segment from the image of its line; of a pinhole that is straight."""
    with torch.no_grad():
        points, _ = camera.project(poses.transform(torch.as_tensor(ends_m)).numpy())
    along = points[:, 1] - points[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.sqrt((((segment_px - points[:, :1]) * normal[:, None]).sum(-1) ** 2).mean(-1))


def held_out(found: Found, poses: ImagePoses, camera: Pinhole, folder: Path, names: Sequence[str]) -> tuple[float, float, int]:
    """Lines of four photos and more, projected into photos that they were not made from: median distance (px) of the nearest
    LSD segment along them, where one is within MATCHED_PX; share of all with one within NEAR_PX; and how many there were."""
    best = []
    share = np.linspace(0.0, 1.0, 201)[:, None]
    for name in names:
        pose = poses.cam_from_world[poses.images.index(name)]
        found_px = cv2.createLineSegmentDetector().detect(cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE))[0]
        segments = found_px.reshape(-1, 2, 2).astype(np.float64)
        segments = segments[np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1) >= SEEN_PX / 2]
        direction = segments[:, 1] - segments[:, 0]
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        for ends in found.ends_m[found.photos >= LEAST_VIEWS]:
            points = pose.transform(torch.as_tensor(ends[:1] + share * (ends[1:] - ends[:1])))
            pixel, valid = camera.project(points.numpy())
            inside = pixel[valid & ((pixel >= 0) & (pixel <= np.array(camera.image_size) - 1)).all(-1)]
            if len(inside) < 2 or np.linalg.norm(inside[-1] - inside[0]) < SEEN_PX:
                continue
            length = float(np.linalg.norm(inside[-1] - inside[0]))
            along = (inside[-1] - inside[0]) / length
            step = segments - inside[0]
            across = np.sqrt(((step @ np.array([-along[1], along[0]])) ** 2).mean(-1))
            middle = (step @ along).mean(-1)
            fits = (np.abs(direction @ along) > math.cos(math.radians(PARALLEL_DEG))) & (middle > 0) & (middle < length)
            best.append(float(across[fits].min(initial=math.inf)))
    distance = np.array(best)
    return float(np.median(distance[distance < MATCHED_PX])), float((distance < NEAR_PX).mean()), len(distance)


def castle_table(data: Path, work: Path, methods: Sequence[str]) -> None:
    """The courtyard without every tenth photo, and how its lines lie in these; pylimap with its separate adjustment."""
    folder, poses, camera = castle(data, work)
    left_out = poses.images[HELD_OUT // 2 :: HELD_OUT]
    kept = [name for name in poses.images if name not in left_out]
    photos = work / "castle_kept"
    photos.mkdir(exist_ok=True)
    for name in kept:
        if not (photos / name).exists():
            (photos / name).symlink_to(data / "images" / name)
    rows = []
    for label in methods:
        if label == "ours":
            found = ours(photos, folder / "calibration.yaml", folder / "poses.csv", work / "castle_ours")
        else:
            found = pylimap(folder, kept, CASTLE_METHOD, 0.0)
        used = found.photos[found.line] >= LEAST_VIEWS
        place = [poses.images.index(photo) for photo, wanted in zip(found.photo, used, strict=True) if wanted]
        error = distances_px(found.ends_m[found.line[used]], poses.cam_from_world[place], camera, found.segment_px[used])
        median, near, count = held_out(found, poses, camera, folder, left_out)
        rows.append(
            [
                "omnilines" if label == "ours" else CASTLE_METHOD.name,
                str(len(found.ends_m)),
                str(int((found.photos >= LEAST_VIEWS).sum())),
                f"{np.median(error):.3f}",
                f"{median:.3f}",
                f"{100 * near:.1f} of {count}",
                f"{found.seconds:.1f}",
            ]
        )
    print_table(
        f"castle30, {len(kept)} photos; held out: {', '.join(left_out)}",
        ["method", "lines", f">= {LEAST_VIEWS} photos", "reprojection px", "held-out px", f"% within {NEAR_PX:.0f} px", "s"],
        rows,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", choices=SCENES, default="room")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=os.environ.get("OMNILINES_BENCH"))
    parser.add_argument("--methods", nargs="+", default=["ours", *METHODS], choices=["ours", *METHODS])
    parser.add_argument("--castle", type=Path, help="the folder lines/castle30: its table instead of the room's")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(options.work or folder)
        place.mkdir(parents=True, exist_ok=True)
        if options.castle:
            castle_table(options.castle.resolve(), place, ["ours", "pylimap"] if "ours" in options.methods else ["pylimap"])
        else:
            room_table(place, options.scene, options.views, options.seed, options.methods)
