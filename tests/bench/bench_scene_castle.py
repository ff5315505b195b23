"""Lines of a real courtyard with surveyed poses (castle30): ours beside pylimap 2.0.0, judged by photos that neither was given.

    python tests/bench/bench_scene_castle.py [--work DIR] [--data ../shared/data/lines/castle30] [--views 4] [--small]

Both get the same 27 photos and poses, without every tenth photo. The same code measures both: reprojection is the RMS distance of
both ends of a segment from the image of its line, over the segments that each tool made its lines from. In the photos left out
every line that is SEEN_PX long or more is compared with the nearest segment along it: of our arcs, of OpenCV's LSD (pylimap's own
segments), and of EDLines, which neither uses; of SEEN_PX / 2 and more. No line is known to be visible there; the shares by chance
are those of the same lines drawn SHIFTED_PX beside their places. Further rows: as many of ours as pylimap has, those that most
photos show; and of both tools the lines that the other has too, within SHARED_M over half their length. pylimap takes half an
hour; what it found is kept in `--work` as castle_pylimap.npz.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from bench_scene import Found, Method, ours, pylimap
from timing import NO_PEERS, PEERS, print_table, skip

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from courtyard import read_courtyard, write_courtyard
from held_out import MATCHED_PX, NEAR_PX, SEEN_PX, held_out

from camera_models import Pinhole
from camera_models.pose import Pose
from omnilines.extraction import ExtractionOptions, extract_arcs
from omnilines.files import read_photo
from omnilines.files.colmap_scene import write_colmap_scene
from omnilines.records import ImagePoses

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "lines" / "castle30"
METHOD = Method("pylimap", "perspective", None, "grey", 20, True)
HELD_OUT = 10
"""Every tenth photo, from the sixth on, is left out of the estimate."""
SMALL = 7
"""Photos in all of a small run."""
DETECTORS = ("our arcs", "LSD", "EDLines")
SHARED_M, SHARED_COSINE = 0.05, np.cos(np.radians(5.0))


def distances_px(ends_m: np.ndarray, poses: Pose, camera: Pinhole, segment_px: np.ndarray) -> np.ndarray:
    """(n,) RMS distance of both ends of a segment from the image of its line; of a pinhole that is straight."""
    points = camera.project(poses.transform(torch.as_tensor(ends_m)).numpy())[0]
    along = points[:, 1] - points[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.sqrt((((segment_px - points[:, :1]) * normal[:, None]).sum(-1) ** 2).mean(-1))


def segments_of(path: Path, camera: Pinhole) -> list[np.ndarray]:
    """(n 2 2) of each detector, in pixels, of those that are long enough."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    drawing = cv2.ximgproc.createEdgeDrawing()
    drawing.detectEdges(grey)
    arcs = extract_arcs(read_photo(path), camera, options=ExtractionOptions(min_length_px=15.0)).endpoints_px
    found = [arcs, cv2.createLineSegmentDetector().detect(grey)[0], drawing.detectLines()]
    ends = [segments.reshape(-1, 2, 2).astype(np.float64) for segments in found]
    return [s[np.linalg.norm(s[:, 1] - s[:, 0], axis=-1) >= SEEN_PX / 2] for s in ends]


def shared(lines_m: np.ndarray, others_m: np.ndarray) -> np.ndarray:
    """Rows of the lines of which half the length lies within SHARED_M of others that are nearly parallel."""
    share = np.linspace(0.0, 1.0, 21)[:, None]
    way, other = lines_m[:, 1] - lines_m[:, 0], others_m[:, 1] - others_m[:, 0]
    length = np.linalg.norm(other, axis=-1)
    way, other = way / np.linalg.norm(way, axis=-1, keepdims=True), other / length[:, None]
    near = np.zeros(len(lines_m))
    for k, ends in enumerate(lines_m):
        parallel = np.abs(other @ way[k]) > SHARED_COSINE
        step = (ends[:1] + share * (ends[1:] - ends[:1]))[:, None] - others_m[None, parallel, 0]
        along = (step * other[parallel]).sum(-1).clip(0.0, length[parallel])
        off = np.linalg.norm(step - along[..., None] * other[parallel], axis=-1).min(1, initial=np.inf)
        near[k] = (off < SHARED_M).mean()
    return np.flatnonzero(near >= 0.5)


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
    shares = [
        value for k in range(len(DETECTORS)) for value in judged(found.ends_m, others, camera, [all_of[k] for all_of in photos])
    ]
    return [name, str(len(found.ends_m)), f"{np.median(error):.3f}", *shares, f"{found.seconds:.0f}"]


def judged(ends_m: np.ndarray, poses: Pose, camera: Pinhole, photos: list[np.ndarray]) -> list[str]:
    """Of one detector: share of lines near a segment, the same by chance, and the median distance of those that have one."""
    found = [held_out(ends_m, poses[k], camera, segments) for k, segments in enumerate(photos)]
    off, chance = (np.concatenate(part) for part in zip(*found, strict=True))
    near = off < NEAR_PX
    return [
        f"{near.sum()} of {len(off)}",
        f"{100 * near.mean():.1f}",
        f"{100 * (chance < NEAR_PX).mean():.1f}",
        f"{np.median(off[off < MATCHED_PX]):.2f}",
    ]


def peers(folder: Path, kept: list[str], file: Path) -> Found:
    """What pylimap found, now or before."""
    if not file.is_file():
        found = pylimap(folder, kept, METHOD, 0.0)
        np.savez(file, **vars(found))
    with np.load(file) as table:
        arrays = {key: table[key] for key in ("ends_m", "photos", "line", "segment_px")}
        return Found(**arrays, photo=tuple(table["photo"].tolist()), seconds=float(table["seconds"]))


def main(data: Path, work: Path, views: int, small: bool) -> None:
    if not data.is_dir():
        skip(f"the folder {data} with photos of a courtyard is absent")
    poses, camera = read_courtyard(data)
    if small:
        poses = ImagePoses(poses.images[:SMALL], poses.cam_from_world[:SMALL], poses.cameras[:SMALL])
    left_out = list(poses.images[HELD_OUT // 2 :: HELD_OUT])
    kept = [name for name in poses.images if name not in left_out]
    folder = work / "castle"
    kept_poses = write_courtyard(folder, data, kept)
    (folder / "colmap").mkdir(exist_ok=True)
    write_colmap_scene(folder / "colmap", {"cam0": camera}, kept_poses)
    own = ours(folder, folder / "calibration.yaml", folder / "poses.csv", work / "castle_ours")
    if not PEERS.is_file():
        skip(NO_PEERS)
    other = peers(folder, kept, work / "castle_pylimap.npz")
    own, other = (some(found, np.flatnonzero(found.photos >= views)) for found in (own, other))
    seen_most = some(own, np.argsort(-own.photos, kind="stable")[: len(other.ends_m)])
    photos = [segments_of(data / "images" / name, camera) for name in left_out]
    table = {
        "omnilines": own,
        "  seen by most photos": seen_most,
        "  pylimap has them too": some(own, shared(own.ends_m, other.ends_m)),
        "pylimap": other,
        "  omnilines has them too": some(other, shared(other.ends_m, own.ends_m)),
    }
    rows = [row(name, found, poses, camera, left_out, photos) for name, found in table.items()]
    figures = (f"within {NEAR_PX:.0f} px", "%", "% by chance", "median px")
    columns = ["", f"lines of >= {views} photos", "reprojection px", *(f"{d}: {f}" for d in DETECTORS for f in figures), "s"]
    print_table(f"castle30, {len(kept)} photos; left out: {', '.join(left_out)}", columns, rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--work", type=Path, help="keeps what was found; a folder that is removed where not given")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--small", action="store_true", help=f"the first {SMALL} photos")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        work = (options.work or Path(scratch)).resolve()
        main(options.data.resolve(), work, options.views, options.small)
