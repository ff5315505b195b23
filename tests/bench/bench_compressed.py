"""Arcs and lines of rendered rooms whose photos went through a camera's JPEG.

    python tests/bench/bench_compressed.py [--scene room] [--model opencv-fisheye] [--views 20] [--seeds 0] [--small]

The same photos (noise of 2 grey levels, blur 0.5 px) as they are drawn, as JPEG of quality 90 and 75, and as phones make them:
noise taken out where colours differ little (bilateral), sharpened (0.8 of what a Gaussian of 1 px takes away), JPEG of quality
85. Colours are at half the resolution in all JPEGs, as in most cameras. Arcs are those of `extract`, of 25 px and more; lines
those of `reconstruct` with exact poses, scored by omnilines.evaluation and omnilines.studies.scene_validation. "chi2" is the
median over ends of arcs of their squared distance from the true great circle over its variance, 1 where variances are right
(over 0.455, that of chi-square of one degree of freedom).
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from timing import print_table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from bench_extraction import LEAST_PX, end_sigmas

import omnilines as ol
from omnilines.evaluation.arcs import arc_scores
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.pipelines.rendered import RenderedScene
from omnilines.scenes import SCENES
from omnilines.studies.scene_validation import RebuiltScene, compare_scene

FOV_DEG, SIZE = {"opencv-fisheye": 190.0, "scaramuzza": 220.0}, (1100, 1100)
CHI2_MEDIAN = 0.455


def jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)


def phone(image: np.ndarray) -> np.ndarray:
    calm = cv2.bilateralFilter(image, 5, 12.0, 1.5).astype(np.float32)
    sharp = calm + 0.8 * (calm - cv2.GaussianBlur(calm, (0, 0), 1.0))
    return jpeg(np.clip(np.rint(sharp), 0, 255).astype(np.uint8), 85)


TREATMENTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as drawn": lambda image: image,
    "JPEG 90": lambda image: jpeg(image, 90),
    "JPEG 75": lambda image: jpeg(image, 75),
    "phone": phone,
}


def arc_row(label: str, truth: RenderedScene, arcs: ol.PhotoArcs) -> list[str]:
    every = arcs.segments
    long = np.concatenate([one.length_px for one in arcs.used]) >= LEAST_PX
    columns = {name: getattr(every, name)[long] for name in ("image", "track", "endpoints_px", "covariance_px2")}
    table = replace(every, sigma_px=None, **columns)
    scores = arc_scores(truth.camera, truth.poses, truth.edges, truth.stretches, table)
    sigmas = end_sigmas(truth, scores, table).ravel()
    return [
        label,
        f"{100 * scores.covered_share:.1f}",
        f"{100 * scores.on_edge_share:.1f}",
        f"{100 * scores.on_line_share:.1f}",
        f"{scores.arcs_per_stretch:.2f}",
        f"{len(table) / len(arcs.used):.0f}",
        f"{scores.direction_deg(50):.3f}, {scores.direction_deg(95):.2f}",
        f"{100 * (sigmas < 1.96).mean():.1f}",
        f"{np.median(sigmas**2) / CHI2_MEDIAN:.2f}",
    ]


def line_row(label: str, truth: RenderedScene, arcs: ol.PhotoArcs) -> list[str]:
    lines = RebuiltScene.of(ol.reconstruct(arcs, truth.poses, truth.camera))
    found = compare_scene(truth, lines)
    return [
        label,
        " ".join(f"{value:.3f}" for value in found.scores.recall[:3]),
        " ".join(f"{value:.3f}" for value in found.scores.precision[:3]),
        f"{1e3 * found.scores.median_error_m:.2f}",
        f"{found.scores.direction_deg(50):.3f}",
        str(found.scores.lines),
        f"{100 * found.inside_share:.1f}",
        f"{100 * found.covariance_share:.1f}",
        f"{lines.slack_px:.2f}",
    ]


def tables(scene: str, model: str, views: int, seeds: list[int], size: tuple[int, int]) -> None:
    arcs_of, lines_of = list[list[str]](), list[list[str]]()
    for seed in seeds:
        truth = render_scene(scene, model, RenderOptions(FOV_DEG.get(model), views, size, seed=seed))
        truth = replace(truth, photos=dict(truth.photos))
        for name, treat in TREATMENTS.items():
            photos = {photo: treat(pixels) for photo, pixels in truth.photos.items()}
            arcs, label = ol.extract(photos, truth.camera), f"{scene} {seed}, {name}"
            arcs_of.append(arc_row(label, truth, arcs))
            lines_of.append(line_row(label, truth, arcs))
    header = [
        "photos",
        "covered",
        "on an edge",
        "on a line",
        "arcs per stretch",
        "arcs a photo",
        "direction 50, 95 (deg)",
        "inside 95",
    ]
    print_table(f"Arcs, {model}", [*header, "chi2"], arcs_of)
    header = ["photos", "recall 1 5 10 mm", "strict precision", "error mm", "direction (deg)", "lines"]
    print_table(f"Lines, {model}", [*header, "ends inside 95", "lines inside 95", "slack px"], lines_of)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", choices=SCENES, default="room")
    parser.add_argument("--model", default="opencv-fisheye")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--small", action="store_true", help="a few small photos")
    options, size = parser.parse_args(), SIZE
    if options.small:
        options.scene, options.views, size = "plain-room", 6, (500, 500)
    tables(options.scene, options.model, options.views, options.seeds, size)
