"""Lines of a real courtyard with surveyed poses (castle30): ours beside pylimap 2.0.0, judged by photos that neither was given.

    python tests/bench/bench_scene_castle.py --work DIR [--data ../shared/data/lines/castle30] [--views 4]

Both get the same 27 photos and poses, without every tenth photo. The same code measures both: reprojection is the RMS distance of
both ends of a segment from the image of its line, over the segments that each tool made its lines from. In the photos left out
every line that is unbroken over SEEN_PX or more is compared with the nearest segment along it, once of our arcs and once of
OpenCV's LSD (pylimap's own segments), of SEEN_PX / 2 and more. No line is known to be visible there; the shares by chance are
those of the same lines drawn SHIFTED_PX beside their places. Of ours a second row holds as many lines as pylimap has, those
that most photos show. pylimap takes half an hour; what it found is kept in `--work` as castle_pylimap.npz.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from bench_scene import CASTLE_METHOD, HELD_OUT, Found, castle, distances_px, ours, pylimap
from timing import print_table

from camera_models import Pinhole
from camera_models.pose import Pose
from omnilines.extraction import extract_arcs
from omnilines.files import read_photo
from omnilines.records import ImagePoses

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "lines" / "castle30"
SEEN_PX, MATCHED_PX, NEAR_PX, SHIFTED_PX = 40.0, 5.0, 2.0, 15.0
LEAST_COSINE = math.cos(math.radians(3.0))
SAMPLES = 201
DETECTORS = ("our arcs", "LSD")


def segments_of(path: Path, camera: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """(n 2 2) of each detector, in pixels, of those that are long enough."""
    lsd = cv2.createLineSegmentDetector().detect(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))[0].reshape(-1, 2, 2)
    arcs = extract_arcs(read_photo(path), camera, least_px=15.0).endpoints_px
    return tuple(s[np.linalg.norm(s[:, 1] - s[:, 0], axis=-1) >= SEEN_PX / 2] for s in (arcs, lsd.astype(np.float64)))  # type: ignore[return-value]


def drawn(ends_m: np.ndarray, pose: Pose, camera: Pinhole) -> np.ndarray:
    """(k 2 2) ends of the part of each line inside a photo, of those that are long enough."""
    share = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    found = []
    for ends in ends_m:
        pixel, valid = camera.project(pose.transform(torch.as_tensor(ends[:1] + share * (ends[1:] - ends[:1]))).numpy())
        inside = pixel[valid & ((pixel >= 0) & (pixel <= np.array(camera.image_size) - 1)).all(-1)]
        if len(inside) > 1 and np.linalg.norm(inside[-1] - inside[0]) >= SEEN_PX:
            found.append(inside[[0, -1]])
    return np.array(found).reshape(-1, 2, 2)


def nearest_px(lines_px: np.ndarray, segments_px: np.ndarray) -> np.ndarray:
    """RMS distance of both ends of the nearest segment along each line; infinite where none runs along it."""
    along = lines_px[:, 1] - lines_px[:, 0]
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    along /= length
    direction = segments_px[:, 1] - segments_px[:, 0]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    best = []
    for start, way, reach in zip(lines_px[:, 0], along, length[:, 0], strict=True):
        step = segments_px - start
        across = np.sqrt(((step @ np.array([-way[1], way[0]])) ** 2).mean(-1))
        middle = (step @ way).mean(-1)
        fits = (np.abs(direction @ way) > LEAST_COSINE) & (middle > 0) & (middle < reach)
        best.append(float(across[fits].min(initial=math.inf)))
    return np.array(best)


def held_out(ends_m: np.ndarray, poses: Pose, camera: Pinhole, photos: list[np.ndarray]) -> list[str]:
    """Of one detector: share of lines near a segment, the same by chance, and the median distance of those that have one."""
    place, beside = [], []
    for k, segments in enumerate(photos):
        lines = drawn(ends_m, poses[k], camera)
        across = (lines[:, 1] - lines[:, 0])[:, ::-1] * np.array([-1.0, 1.0])
        shift = (SHIFTED_PX * across / np.linalg.norm(across, axis=-1, keepdims=True))[:, None]
        place.append(nearest_px(lines, segments))
        beside += [nearest_px(lines + shift, segments), nearest_px(lines - shift, segments)]
    off, chance = np.concatenate(place), np.concatenate(beside)
    near = off < NEAR_PX
    return [
        f"{near.sum()} of {len(off)}",
        f"{100 * near.mean():.1f}",
        f"{100 * (chance < NEAR_PX).mean():.1f}",
        f"{np.median(off[off < MATCHED_PX]):.2f}",
    ]


def some(found: Found, lines: np.ndarray) -> Found:
    """Some of the lines with their segments."""
    place = np.full(len(found.ends_m), -1)
    place[lines] = np.arange(len(lines))
    own = place[found.line]
    used = np.flatnonzero(own >= 0)
    photo = tuple(found.photo[k] for k in used)
    return replace(
        found,
        ends_m=found.ends_m[lines],
        photos=found.photos[lines],
        line=own[used],
        photo=photo,
        segment_px=found.segment_px[used],
    )


def row(name: str, found: Found, poses: ImagePoses, camera: Pinhole, left_out: list[str], photos: list) -> list[str]:
    """One row of the table."""
    at = [poses.images.index(photo) for photo in found.photo]
    error = distances_px(found.ends_m[found.line], poses.cam_from_world[at], camera, found.segment_px)
    others = poses.cam_from_world[[poses.images.index(photo) for photo in left_out]]
    judged = [value for k in range(2) for value in held_out(found.ends_m, others, camera, [both[k] for both in photos])]
    return [name, str(len(found.ends_m)), f"{np.median(error):.3f}", *judged, f"{found.seconds:.0f}"]


def peers(folder: Path, kept: list[str], file: Path) -> Found:
    """What pylimap found, now or before."""
    if not file.is_file():
        found = pylimap(folder, kept, CASTLE_METHOD, 0.0)
        np.savez(file, **vars(found))
    with np.load(file) as table:
        arrays = {key: table[key] for key in ("ends_m", "photos", "line", "segment_px")}
        return Found(**arrays, photo=tuple(table["photo"].tolist()), seconds=float(table["seconds"]))


def main(data: Path, work: Path, views: int) -> None:
    work.mkdir(parents=True, exist_ok=True)
    folder, poses, camera = castle(data, work)
    left_out = list(poses.images[HELD_OUT // 2 :: HELD_OUT])
    kept = [name for name in poses.images if name not in left_out]
    (work / "castle_kept").mkdir(exist_ok=True)
    for name in kept:
        if not (work / "castle_kept" / name).exists():
            (work / "castle_kept" / name).symlink_to(data / "images" / name)
    own = ours(work / "castle_kept", folder / "calibration.yaml", folder / "poses.csv", work / "castle_ours")
    other = peers(folder, kept, work / "castle_pylimap.npz")
    own, other = (some(found, np.flatnonzero(found.photos >= views)) for found in (own, other))
    seen_most = some(own, np.argsort(-own.photos, kind="stable")[: len(other.ends_m)])
    photos = [segments_of(folder / name, camera) for name in left_out]
    names = ("omnilines", "  seen by most photos", "pylimap")
    rows = [row(name, f, poses, camera, left_out, photos) for name, f in zip(names, (own, seen_most, other), strict=True)]
    figures = (f"within {NEAR_PX:.0f} px", "%", "% by chance", "median px")
    columns = ["", f"lines of >= {views} photos", "reprojection px", *(f"{d}: {f}" for d in DETECTORS for f in figures), "s"]
    print_table(f"castle30, {len(kept)} photos; left out: {', '.join(left_out)}", columns, rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--views", type=int, default=4)
    options = parser.parse_args()
    main(options.data.resolve(), options.work.resolve(), options.views)
