"""What the options of a stage decide: each at half and at double its value, on rendered photos with truth and on real ones.

    python tests/bench/bench_sensitivity.py [extraction | detection] [--only edges.] [--small]

Extraction: arcs of one photo of York Urban, one of castle30 and one of a rendered room, of which recall is the share of the
edges' length that arcs lie on, and precision the share of the arcs that lie on an edge (`omnilines.evaluation.arcs`). Detection:
corners of two rendered targets, with the root mean square distance from where they are, and of two real boards. The tables are
those of docs/options.md: figures at half and at double, the options that change most first.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from courtyard import read_courtyard

from calib_patterns import DetectionOptions
from calib_patterns import pattern as parse_pattern
from camera_models import CameraModel, Pinhole, load
from omnilines.evaluation.arcs import arc_scores
from omnilines.extraction import extract_arcs
from omnilines.extraction.options import ExtractionOptions
from omnilines.files import read_photo
from omnilines.pipelines.render import RenderOptions, render_scene, render_targets
from omnilines.pipelines.rendered import RenderedScene
from omnilines.records import Segments
from omnilines.studies.sensitivity import Outcome, sweep, table

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
BOARDS = (("checkerboard", "checkerboard:8x6:30mm", 3), ("tags", "aprilgrid:3x3:60mm:0.3:36h11", 1))
"""Rendered targets: what they are called, their specification and their seed."""
REAL_BOARDS = (("fisheye1", "checkerboard:8x6:32.5mm"), ("fisheye190", "checkerboard:7x6:30mm"))
Stage = tuple[Any, Callable[[Any], Outcome]]


def extraction(small: bool) -> Stage:
    """Options and what is made with them of a room and, where they are, of real photos."""
    room = render_scene("room", "opencv-fisheye", RenderOptions(190.0, 1, (320, 240) if small else (1280, 960), seed=1))
    photos = {"room": (room.photos[room.poses.images[0]], room.camera)}
    if DATA.is_dir() and not small:
        photos |= real_photos()

    def run(options: ExtractionOptions) -> Outcome:
        figures: dict[str, float] = {}
        result = b""
        for label, (image, camera) in photos.items():
            found = extract_arcs(image, camera, options=options)
            figures[f"{label}: arcs"] = len(found)
            result += found.endpoints_px.tobytes() + found.covariance_px2.tobytes()
            if label == "room":
                figures |= room_figures(room, found.endpoints_px)
        return Outcome(figures, result)

    return ExtractionOptions(), run


def room_figures(room: RenderedScene, ends_px: np.ndarray) -> dict[str, float]:
    """Recall and precision of the arcs of the only photo of a room, percent."""
    count = len(ends_px)
    found = Segments(np.zeros(count, dtype=np.int64), room.poses.images, np.full(count, -1), (), ends_px)
    scores = arc_scores(room.camera, room.poses, room.edges, room.stretches, found)
    return {"room: recall, %": 100 * scores.covered_share, "room: precision, %": 100 * scores.on_line_share}


def real_photos() -> dict[str, tuple[np.ndarray, CameraModel]]:
    """A photo of York Urban and one of the courtyard, at half its size."""
    york, castle = DATA / "lines" / "york", DATA / "lines" / "castle30"
    _, whole = read_courtyard(castle)
    fx, fy, cx, cy = (whole.named_parameters()[name] for name in ("fx", "fy", "cx", "cy"))
    size = (whole.image_size[0] // 2, whole.image_size[1] // 2)
    half = Pinhole.from_mapping({"fx": fx / 2, "fy": fy / 2, "cx": (cx + 0.5) / 2 - 0.5, "cy": (cy + 0.5) / 2 - 0.5}, size)
    first = [min((folder / "images").iterdir()) for folder in (york, castle)]
    return {
        "york": (read_photo(first[0]), load(york / "calibration.yaml")["cam0"]),
        "castle": (cv2.resize(read_photo(first[1]), size, interpolation=cv2.INTER_AREA), half),
    }


def detection(small: bool) -> Stage:
    """Options and what is made with them of rendered targets and, where they are, of photos of boards."""
    shown = []
    for label, spec, seed in BOARDS:
        options = RenderOptions(150.0, 1, (800, 600) if small else (1280, 960), seed=seed)
        rendered = render_targets(spec, "opencv-fisheye", options)
        shown.append((label, rendered.pattern, rendered.photos[rendered.poses.images[0]], rendered.corners))
    if DATA.is_dir() and not small:
        for label, spec in REAL_BOARDS:
            photo = read_photo(min((DATA / "calibration" / label / "images").iterdir()))
            shown.append((label, parse_pattern(spec), photo, None))

    def run(options: DetectionOptions) -> Outcome:
        figures: dict[str, float] = {}
        result = b""
        for label, target, photo, truth in shown:
            found, _ = target.detect(photo, options=options)
            figures[f"{label}: corners"] = len(found)
            result += found.ids.tobytes() + found.pixels.tobytes() + found.sigma_px.tobytes()
            if truth is not None:
                figures[f"{label}: off, px"] = rms_px(found.ids, found.pixels, truth.ids, truth.pixels)
        return Outcome(figures, result)

    return DetectionOptions(), run


def rms_px(ids: np.ndarray, pixels: np.ndarray, true_ids: np.ndarray, true_pixels: np.ndarray) -> float:
    """Root mean square of the distances of corners from where they are; NaN without any."""
    rows = np.searchsorted(true_ids, ids)
    return float(np.sqrt(((pixels - true_pixels[rows]) ** 2).sum(-1).mean())) if len(ids) else float("nan")


STAGES: dict[str, Callable[[bool], Stage]] = {"extraction": extraction, "detection": detection}
FEW = {"extraction": "extraction.pieces.", "detection": "detection.fit."}
"""Options that are swept where little is asked for."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", choices=list(STAGES), nargs="?", default="extraction")
    parser.add_argument("--only", default="", help="options whose names begin so")
    parser.add_argument("--small", action="store_true", help="small photos, and few options of every stage")
    asked = parser.parse_args()
    for stage in STAGES if asked.small else [asked.stage]:
        options, run = STAGES[stage](asked.small)
        print(f"\n{stage}\n", flush=True)
        only = FEW[stage] if asked.small else f"{stage}.{asked.only}"
        print(table(sweep(options, run, only=only, prefix=f"{stage}.")), flush=True)
