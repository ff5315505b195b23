"""York Urban: Manhattan frames through any lens against hand-made ones; labelled lines against arcs, LSD and EDLines.

    python tests/bench/bench_york.py [--small]

51 photos of a pinhole camera with hand-made orthogonal directions and labelled lines (P. Denis, J. Elder, F. Estrada, ECCV 2008).

Frames: the worst of the three directions of each photo, in degrees, also of the same photos resampled into fisheyes
(Kannala-Brandt and Scaramuzza, these with a slanted chip off its middle) in their middle and 55 degrees off the axis; what lies
beyond the photo is masked. Time is CPU time beyond extraction.

Lines, as N.-G. Cho, A. Yuille and S.-W. Lee compare them (A novel linelet-based representation for line segment detection, TPAMI
2018): a segment is on a labelled line where its middle lies within so many pixels of it and both differ by 5 degrees at most.
Recall is the length of labelled lines that segments on them cover; whole is how many lines are covered to three quarters;
precision the length of segments that lies on labelled lines. Each detector gives what it gives by itself. Lines that belong to
none of the three directions, and many that do, are not labelled, so that no detector is near 100 percent of precision.
"""

import argparse
import csv
import math
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from timing import print_table, skip

import omnilines as ol
from camera_models import CameraModel, OpenCVFisheye, Scaramuzza
from camera_models.resampling import resample, sampling_grid
from omnilines.extraction import ExtractionOptions
from omnilines.photo_file import read_photo

YORK = Path(__file__).resolve().parents[3] / "shared" / "data" / "lines" / "york"
BEND = (-0.02, 0.002, 0.0, 0.0)
AXIS, OFF_AXIS_DEG = np.array([0.6, 0.8, 0.0]), 55.0
SHORT_PX = 8.0
ANGLE_DEG, WHOLE = 5.0, 0.75
TOLERANCES_PX = (1.0, 2.0, 3.0)


def fisheye(fov_deg: float, focal_px: float) -> OpenCVFisheye:
    half = math.radians(fov_deg / 2)
    side = 2 * int(focal_px * half * (1 + BEND[0] * half**2 + BEND[1] * half**4))
    return OpenCVFisheye([focal_px, focal_px, side / 2 - 0.5, side / 2 - 0.5, *BEND], (side, side))


def scaramuzza(fov_deg: float, focal_px: float) -> Scaramuzza:
    """About equidistant: of r / tan(r / f) the first terms, and a little of the third power."""
    side = 2 * int(focal_px * math.radians(fov_deg / 2))
    radial = [focal_px, -1.0 / (3.0 * focal_px), 2e-9, -1.0 / (45.0 * focal_px**3)]
    return Scaramuzza([side / 2 + 9.5, side / 2 - 7.5, 0.9985, 0.0021, -0.0017, *radial], (side, side))


def york_table() -> dict[str, np.ndarray]:
    """The three directions of each photo as rows."""
    rows = defaultdict(list)
    for row in csv.DictReader((YORK / "vanishing_directions.csv").read_text().splitlines()):
        rows[row["image"]].append([float(row[axis]) for axis in "xyz"])
    return {image: np.array(own) for image, own in rows.items()}


def frame_row(name: str, source: CameraModel, camera: CameraModel | None, turned_deg: float, photos: list[str]) -> list[str]:
    true = york_table()
    turn = cv2.Rodrigues(math.radians(turned_deg) * AXIS)[0]
    grid = None if camera is None else sampling_grid(camera, source, turn)
    mask = None if grid is None else cv2.erode(grid.valid.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    worst, seconds = list[float](), list[float]()
    for image in photos:
        photo = read_photo(YORK / "images" / image)
        arcs = ol.extract({image: photo if grid is None else resample(photo, grid)}, camera or source, mask=mask)
        begun = time.process_time()
        found = ol.directions(arcs, orthogonal=True).photos[0].meeting
        seconds.append(time.process_time() - begun)
        cosine = np.abs(true[image] @ turn @ found.direction.T).max(1) if len(found) else np.zeros(3)
        worst.append(math.degrees(math.acos(min(1.0, float(cosine.min())))))
    error = np.array(worst)
    shares = [f"{(error < limit).mean():.1%}" for limit in (2, 5)]
    typical = [f"{one:.2f}" for one in (np.median(error), error.mean(), np.quantile(error, 0.9))]
    return [name, *typical, *shares, f"{np.mean(seconds):.2f}"]


class Covered(NamedTuple):
    """Lengths in pixels, and numbers of lines."""

    of_lines: float
    lines_px: float
    whole: int
    lines: int
    of_segments: float
    segments_px: float


def covered(segments: np.ndarray, lines: np.ndarray, tolerance_px: float) -> Covered:
    """What segments (n, 2, 2) and labelled lines (m, 2, 2) cover of each other."""
    along, length = directed(segments)
    line_along, line_length = directed(lines)
    across = np.stack([-line_along[:, 1], line_along[:, 0]], -1)
    off = np.einsum("mx,mnx->mn", across, segments.mean(1)[None] - lines[:, :1])
    on = (np.abs(line_along @ along.T) >= math.cos(math.radians(ANGLE_DEG))) & (np.abs(off) <= tolerance_px)
    shown = np.array([shared(lines[m], line_along[m], line_length[m], segments[on[m]]) for m in range(len(lines))])
    lying = [shared(segments[n], along[n], length[n], lines[on[:, n]]) for n in range(len(segments))]
    whole = int((shown >= WHOLE * line_length).sum())
    return Covered(float(shown.sum()), float(line_length.sum()), whole, len(lines), float(np.sum(lying)), float(length.sum()))


def directed(segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors along, and lengths."""
    along = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(along, axis=-1)
    return along / np.maximum(length, 1e-9)[:, None], length


def shared(one: np.ndarray, along: np.ndarray, length: float, others: np.ndarray) -> float:
    """Length of a segment onto which others fall."""
    place = np.sort(np.clip((others - one[0]) @ along, 0.0, length), -1)
    reached, total = 0.0, 0.0
    for low, high in sorted(map(tuple, place.tolist())):
        total += max(0.0, high - max(low, reached))
        reached = max(reached, high)
    return total


def lsd(grey: np.ndarray) -> np.ndarray | None:
    return cv2.createLineSegmentDetector().detect(grey)[0]


def ed_lines(grey: np.ndarray) -> np.ndarray | None:
    drawing = cv2.ximgproc.createEdgeDrawing()
    drawing.detectEdges(grey)
    return drawing.detectLines()


def line_rows(photos: list[str], source: CameraModel) -> list[list[str]]:
    labelled = defaultdict(list)
    for row in csv.DictReader((YORK / "lines.csv").read_text().splitlines()):
        labelled[row["image"]].append([float(row[key]) for key in ("u1_px", "v1_px", "u2_px", "v2_px")])
    images = {image: read_photo(YORK / "images" / image) for image in photos}
    found: dict[str, dict[str, np.ndarray]] = {}
    for name, options in (("omnilines", {}), (f"from {SHORT_PX:g} px", {"options": ExtractionOptions(min_length_px=SHORT_PX)})):
        found[name] = {one.photo.name: one.endpoints_px for one in ol.extract(images, source, **options).used}
    for name, detect in (("LSD", lsd), ("EDLines", ed_lines)):
        given = {image: detect(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)) for image, pixels in images.items()}
        found[name] = {
            image: np.zeros((0, 2, 2)) if own is None else own.reshape(-1, 2, 2).astype(float) for image, own in given.items()
        }
    rows = []
    for name, segments in found.items():
        cells = [name, str(sum(map(len, segments.values())))]
        for tolerance in TOLERANCES_PX:
            parts = [covered(segments[image], np.reshape(labelled[image], (-1, 2, 2)), tolerance) for image in photos]
            of_lines, lines_px, whole, lines, of_segments, segments_px = np.array(parts).sum(0)
            cells.append(f"{of_lines / lines_px:.1%}  {whole / lines:.1%}  {of_segments / segments_px:.1%}")
        rows.append(cells)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--small", action="store_true")
    small = parser.parse_args().small
    if not YORK.is_dir():
        skip(f"York Urban is absent: {YORK}")
    torch.set_num_threads(1)
    source = ol.load(YORK / "calibration.yaml")["cam0"]
    focal_px, photos = float(source.parameters[0]), list(york_table())[: 2 if small else None]
    rows = line_rows(photos, source)
    header = ["detector", "segments", *(f"recall, whole, precision at {one:g} px" for one in TOLERANCES_PX)]
    print_table("Labelled lines of York Urban", header, rows)
    lenses: list[tuple[str, CameraModel | None, float]] = [
        ("as they are", None, 0.0),
        ("fisheye, 120 degrees", fisheye(120.0, focal_px), 0.0),
        ("fisheye, 190 degrees", fisheye(190.0, focal_px), 0.0),
        ("scaramuzza, 120 degrees", scaramuzza(120.0, focal_px), 0.0),
        ("scaramuzza, 190 degrees", scaramuzza(190.0, focal_px), 0.0),
        ("the same, off the axis", scaramuzza(190.0, focal_px), OFF_AXIS_DEG),
    ]
    rows = [frame_row(name, source, camera, off, photos) for name, camera, off in lenses[: 2 if small else None]]
    header = ["photos", "worst of three, median", "mean", "90 percent", "within 2", "within 5", "CPU s a photo"]
    print_table("Manhattan frames of York Urban", header, rows)


if __name__ == "__main__":
    main()
