"""Arcs in rendered rooms: ours, plain LSD on the photo, LSD on a cube map; time, and memory of a panorama of 50 megapixels.

    python tests/bench/bench_extraction.py [--scene room] [--views 3] [--seeds 0 1] [--panorama] [--small]

LSD is OpenCV's, on the grey photo, segments of 25 px and more. The figures are those of omnilines.evaluation.arcs. "repeated" is
the share of the edges that two photos both see (40 px, 10 grey levels) and that either found, that both found; "inside 95" is
the share of end points whose distance from the true great circle is below 1.96 of its standard deviation. Time is CPU time.
"""

import argparse
import math
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from camera_models import CameraModel, Equirectangular
from camera_models.resampling import resample, sampling_grid
from camera_models.views import axis_from_camera, views
from omnilines.evaluation.arcs import ArcScores, arc_scores
from omnilines.extraction import extract_arcs
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.pipelines.rendered import RenderedScene
from omnilines.records import Segments
from omnilines.scenes import SCENES

Cameras = tuple[tuple[str, float | None], ...]
CAMERAS: Cameras = (("opencv-fisheye", 190.0), ("scaramuzza", 220.0), ("equirectangular", None), ("pinhole", None))
LEAST_PX = 25.0
Method = Callable[[np.ndarray, CameraModel], tuple[np.ndarray, np.ndarray | None]]


def ours(image: np.ndarray, model: CameraModel) -> tuple[np.ndarray, np.ndarray | None]:
    found = extract_arcs(image, model)
    return found.endpoints_px, found.covariance_px2


def lsd(grey: np.ndarray) -> np.ndarray:
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64)
    return ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1) >= LEAST_PX]


def raw_lsd(image: np.ndarray, model: CameraModel) -> tuple[np.ndarray, np.ndarray | None]:
    ends = lsd(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    seen = model.unproject(ends)[1].all(-1)
    return ends[seen], None


def cube_lsd(image: np.ndarray, model: CameraModel) -> tuple[np.ndarray, np.ndarray | None]:
    grey, parts = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), []
    for view in views("cube"):
        turn = (view.view_from_axis @ axis_from_camera(model)).T
        if view.name not in GRIDS:
            GRIDS[view.name] = sampling_grid(view.camera, model, turn)
        ends = lsd(resample(grey, GRIDS[view.name]))
        pixels, valid = model.project(view.camera.unproject(ends)[0] @ turn.T)
        parts.append(pixels[valid.all(-1)])
    return np.concatenate(parts), None


GRIDS: dict = {}
METHODS: tuple[tuple[str, Method], ...] = (("omnilines", ours), ("LSD on the photo", raw_lsd), ("LSD on a cube map", cube_lsd))


def scored(scene: RenderedScene, method: Method) -> tuple[ArcScores, Segments, float]:
    ends, covariances, image, spent = [], [], [], 0.0
    for k, name in enumerate(scene.poses.images):
        photo = scene.photos[name]
        start = time.process_time()
        found, covariance = method(photo, scene.camera)
        spent += time.process_time() - start
        ends.append(found)
        covariances.append(covariance)
        image.append(np.full(len(found), k))
    known = None if covariances[0] is None else np.concatenate(covariances)
    table = Segments(
        np.concatenate(image),
        scene.poses.images,
        np.full(sum(map(len, ends)), -1),
        (),
        np.concatenate(ends),
        covariance_px2=known,
    )
    scores = arc_scores(scene.camera, scene.poses, scene.edges, scene.stretches, table)
    return scores, table, spent / len(scene.poses)


def inside_95(scene: RenderedScene, scores: ArcScores, table: Segments) -> float:
    """Share of end points whose distance across from the true great circle is below 1.96 standard deviations."""
    return math.nan if table.covariance_px2 is None else float((end_sigmas(scene, scores, table) < 1.96).mean())


def end_sigmas(scene: RenderedScene, scores: ArcScores, table: Segments) -> np.ndarray:
    """Distance across from the true great circle over its standard deviation, of both ends of every arc on a line: (n, 2)."""
    rows = np.flatnonzero(scores.on_line)
    pose = scene.poses.cam_from_world
    rotation, translation = pose.rotation.numpy()[table.image[rows]], pose.translation.numpy()[table.image[rows]]
    points = np.einsum("nij,nkj->nki", rotation, scene.edges.ends_m[scores.edge[rows]]) + translation[:, None]
    normal = np.cross(points[:, 0], points[:, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    pixels = table.endpoints_px[rows]
    step = 1e-4
    height = [
        (scene.camera.unproject(pixels + np.array(move))[0] * normal[:, None]).sum(-1) for move in ((0, 0), (step, 0), (0, step))
    ]
    slope = np.stack([height[1] - height[0], height[2] - height[0]], -1) / step
    return np.abs(height[0]) / np.sqrt(np.einsum("nki,nkij,nkj->nk", slope, table.covariance_px2[rows], slope))


def repeatability(scene: RenderedScene, scores: ArcScores, table: Segments) -> float:
    """Of the edges that two following photos see and either found: the share that both found."""
    both, either = 0, 0
    seen = scene.stretches
    for k in range(len(scene.poses) - 1):
        long = [
            {int(e) for e in seen.edge[(seen.image == i) & (seen.length_px >= 40) & (seen.contrast_rgb >= 10)]}
            for i in (k, k + 1)
        ]
        found = [{int(e) for e in scores.edge[(table.image == i) & scores.on_edge]} for i in (k, k + 1)]
        common = long[0] & long[1]
        both += len(common & found[0] & found[1])
        either += len(common & (found[0] | found[1]))
    return both / max(either, 1)


def table_of_scenes(cameras: Cameras, name: str, view_count: int, seeds: list[int], size: tuple[int, int]) -> None:
    print(
        "camera | method | covered | on an edge | on a line | arcs per stretch | mean px | direction median, 95th (deg) | "
        "inside 95 | repeated | CPU s"
    )
    for model, fov_deg in cameras:
        rows: dict[str, list[list[float]]] = {method: [] for method, _ in METHODS}
        for seed in seeds:
            scene = render_scene(name, model, RenderOptions(fov_deg, view_count, size, seed=seed))
            scene = replace(scene, photos=dict(scene.photos))
            GRIDS.clear()
            for method, find in METHODS:
                find(scene.photos[scene.poses.images[0]], scene.camera)
                rows[method].append(figures(scene, find))
        for method, found in rows.items():
            v = np.mean(found, axis=0)
            print(
                f"{model} | {method} | {100 * v[0]:.1f} | {100 * v[1]:.1f} | {100 * v[2]:.1f} | {v[3]:.2f} | {v[4]:.0f} | "
                f"{v[5]:.3f}, {v[6]:.2f} | {100 * v[7]:.1f} | {100 * v[8]:.0f} | {v[9]:.2f}",
                flush=True,
            )


def figures(scene: RenderedScene, find: Method) -> list[float]:
    """The columns of the table, of one scene."""
    scores, table, spent = scored(scene, find)
    return [
        scores.covered_share,
        scores.on_edge_share,
        scores.on_line_share,
        scores.arcs_per_stretch,
        scores.mean_arc_px,
        scores.direction_deg(50),
        scores.direction_deg(95),
        inside_95(scene, scores, table),
        repeatability(scene, scores, table),
        spent,
    ]


def panorama(width: int) -> None:
    """Time and largest memory of a panorama: a textured image of many turned squares, made in place."""
    height = width // 2
    image = np.full((height, width, 3), 120, dtype=np.uint8)
    rng = np.random.default_rng(0)
    for _ in range(3000):
        corners = cv2.boxPoints(
            (rng.uniform([0, 0.05 * width], [width, 0.45 * width]).tolist(), rng.uniform(50, 400, 2).tolist(), rng.uniform(0, 90))
        )
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.uniform(30, 220, 3).tolist(), cv2.LINE_AA)
    model = Equirectangular([], (width, height))
    start = time.process_time()
    found = extract_arcs(image, model)
    spent = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    print(f"{width * height / 1e6:.0f} megapixels: {len(found)} arcs, {spent:.1f} s of CPU, at most {peak:.2f} GB in all")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", choices=SCENES, default="room")
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--size", type=int, nargs=2, default=[1280, 960])
    parser.add_argument("--panorama", action="store_true")
    parser.add_argument("--small", action="store_true", help="everything once, with little data")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if options.small:
        table_of_scenes(CAMERAS[:1], "plain-room", 2, [0], (480, 360))
        panorama(1000)
    elif options.panorama:
        panorama(10_000)
    else:
        table_of_scenes(CAMERAS, options.scene, options.views, options.seeds, (options.size[0], options.size[1]))
