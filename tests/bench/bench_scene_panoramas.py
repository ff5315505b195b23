"""Lines of a real flat from panoramas alone (flat_panoramas, 14 MP), judged by a panorama that had no part in them.

    python tests/bench/bench_scene_panoramas.py [--work DIR] [--data DIR] [--left-out NAME] [--arcs DIR] [--small]

`omnilines reconstruct --poses sfm` on all photos, and on all but one. The lines of the latter are brought into the frame of the
former by the poses of the photos of both, and drawn into the photo left out with the pose that it has there. Compared are the
arcs found in it (SEEN_PX / 2 and more), as `held_out.py` does it.

A panorama has all directions, so that every line of another room is drawn, through the walls. Hence three rows: every line;
those in view, which at least one of the NEIGHBOURS photos shows that share most lines with the photo left out in the run of all;
and those that both photos show which were taken nearest to it. Their rooms are its own or open to it, yet furniture, door frames
and what the photographer holds may still hide some, fewest of the last row. None of this asks the photo left out.

`--arcs` holds arcs kept by an earlier run of the same version (OUT/work/arcs); the CPU seconds then lack the extraction.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from timing import print_table, skip

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from held_out import MATCHED_PX, NEAR_PX, SEEN_PX, held_out

import camera_models
from camera_models import Calibration, CameraModel, Equirectangular, Pose
from omnilines.files import find_photos, read_lines, read_poses, read_segments
from omnilines.records import ImagePoses, Segments

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "lines" / "flat_panoramas"
SIZE, SMALL_SIZE = (5376, 2688), (1344, 672)
SMALL = 5
"""Photos in all of a small run."""
NEIGHBOURS = 2
COMMAND = "import sys; from omnilines.cli import main; main(sys.argv[1:])"


@dataclass(frozen=True)
class Cost:
    """Of one command, in a process of its own."""

    cpu_s: float
    peak_gb: float


def reconstructed(photos: list[Path], calibration: Path, out: Path, arcs: Path | None) -> Cost:
    """`omnilines reconstruct --poses sfm`, from nothing but the arcs."""
    shutil.rmtree(out, ignore_errors=True)
    if arcs is not None:
        shutil.copytree(arcs, out / "work" / "arcs")
        # Says that the folder is of an earlier run.
        shutil.copy(arcs.parent / ".omnilines.json", out / "work")
    arguments = ["reconstruct", *map(str, photos), "--calibration", str(calibration), "--poses", "sfm", "--out", str(out)]
    process = subprocess.Popen([sys.executable, "-c", COMMAND, *arguments])
    _, status, used = os.wait4(process.pid, 0)
    assert status == 0, f"omnilines reconstruct ended with {status}"
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20)


def photos_of_lines(table: Segments) -> list[set[str]]:
    """The photos that show each track."""
    shown: list[set[str]] = [set() for _ in table.tracks]
    for track, image in zip(table.track.tolist(), table.image.tolist(), strict=True):
        if track >= 0:
            shown[track].add(table.images[image])
    return shown


def neighbours(table: Segments, name: str) -> list[str]:
    """The photos that share most lines with one, most first."""
    shared = Counter(other for photos in photos_of_lines(table) if name in photos for other in photos if other != name)
    return [other for other, _ in shared.most_common(NEIGHBOURS)]


def in_frame_of(ends_m: np.ndarray, found: ImagePoses, other: ImagePoses) -> np.ndarray:
    """Lines (n 2 3) of some poses in the frame of others: turned as the photos of both are, scaled and shifted as their centres.

    A few centres that are some mm off would turn the scene by several pixels of a panorama.
    """
    place = {name: k for k, name in enumerate(other.images)}
    a, b = found.cam_from_world, other.cam_from_world[[place[name] for name in found.images]]
    u, _, vt = np.linalg.svd((b.rotation.mT @ a.rotation).sum(0).numpy())
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    from_middle, to_middle = (pose.centre.numpy() - pose.centre.numpy().mean(0) for pose in (a, b))
    scale = (to_middle * (from_middle @ turn.T)).sum() / (from_middle**2).sum()
    return scale * (ends_m - a.centre.numpy().mean(0)) @ turn.T + b.centre.numpy().mean(0)


def beside(poses: ImagePoses, name: str) -> set[str]:
    """The two photos taken nearest to one."""
    centre = poses.cam_from_world.centre.numpy()
    away = np.linalg.norm(centre - centre[poses.images.index(name)], axis=-1)
    return {poses.images[k] for k in np.argsort(away, kind="stable")[1:3]}


def in_photo(table: Segments, name: str, width_px: int) -> np.ndarray:
    """(n 2 2) arcs of a photo that are long enough, matched or not; those across the seam on both of its sides."""
    ends = table.endpoints_px[table.image == table.images.index(name)]
    across = np.abs(np.diff(ends[..., 0]))[:, 0] > 0.5 * width_px
    around = np.array([width_px, 0.0])
    left = ends[across] - around * (ends[across, :, :1] > 0.5 * width_px)
    ends = np.concatenate([ends[~across], left, left + around])
    return ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1) >= SEEN_PX / 2]


def judged(what: str, ends_m: np.ndarray, pose: Pose, camera: CameraModel, arcs_px: np.ndarray) -> list[str]:
    """One row of the second table."""
    off, chance = held_out(ends_m, pose, camera, arcs_px)
    near = off < NEAR_PX
    shares = (f"{100 * near.mean():.1f}", f"{100 * (chance < NEAR_PX).mean():.1f}")
    return [what, str(len(ends_m)), str(len(off)), str(int(near.sum())), *shares, f"{np.median(off[off < MATCHED_PX]):.2f}"]


def row(what: str, out: Path, cost: Cost, photos: int) -> list[str]:
    """One row of the first table."""
    lines, poses = read_lines(out / "lines.csv"), read_poses(out / "poses.csv")
    rms_px = np.median(lines.rms_px[lines.known])
    own = (f"{len(poses)} of {photos}", str(int(lines.known.sum())), f"{rms_px:.2f}")
    return [what, *own, f"{cost.cpu_s / photos:.1f}", f"{cost.peak_gb:.2f}"]


def reduced(data: Path, folder: Path) -> Path:
    """SMALL of the photos, of SMALL_SIZE."""
    folder.mkdir()
    for photo in find_photos([data])[:SMALL]:
        image = cv2.resize(cv2.imread(str(photo.path)), SMALL_SIZE, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"{photo.path.stem}.png"), image)
    return folder


def main(data: Path, work: Path, left_out: str | None, arcs: Path | None, small: bool) -> None:
    if not data.is_dir():
        skip(f"the folder {data} with panoramas is absent")
    work.mkdir(parents=True, exist_ok=True)
    camera = Equirectangular.from_mapping({}, SMALL_SIZE if small else SIZE)
    data = reduced(data, work / "reduced") if small else data
    camera_models.save(work / "calibration.yaml", Calibration({"cam0": camera}))
    photos = [photo.path for photo in find_photos([data])]
    name = left_out or photos[len(photos) // 2].name
    rest = [photo for photo in photos if photo.name != name]
    assert len(rest) == len(photos) - 1, f"one photo named {name} was expected in {data}"
    every = reconstructed(photos, work / "calibration.yaml", work / "all", arcs)
    fewer = reconstructed(rest, work / "calibration.yaml", work / "without", work / "all" / "work" / "arcs")
    rows = [row("all", work / "all", every, len(photos)), row(f"without {name}", work / "without", fewer, len(rest))]
    print_table(data.name, ["photos", "posed", "lines", "rms px", "CPU s a photo", "peak GB"], rows)
    judge(work, name, camera, len(rest))


def judge(work: Path, name: str, camera: CameraModel, photos: int) -> None:
    """The second table."""
    poses, seen = read_poses(work / "all" / "poses.csv"), read_segments(work / "all" / "segments.csv")
    pose = poses.cam_from_world[poses.images.index(name)]
    lines, own = read_lines(work / "without" / "lines.csv"), photos_of_lines(read_segments(work / "without" / "segments.csv"))
    ends_m = in_frame_of(lines.ends_m[lines.known], read_poses(work / "without" / "poses.csv"), poses)
    number = {track: k for k, track in enumerate(read_segments(work / "without" / "segments.csv").tracks)}
    near = set(neighbours(seen, name))
    tracks = [lines.tracks[k] for k in np.flatnonzero(lines.known)]
    in_view = np.array([bool(near & own[number[track]]) for track in tracks])
    nearest = beside(poses, name)
    by_both = np.array([nearest <= own[number[track]] for track in tracks])
    arcs_px = in_photo(seen, name, camera.image_size[0])
    rows = [
        judged("every line", ends_m, pose, camera, arcs_px),
        judged(f"in view: shown by {' or '.join(sorted(near))}", ends_m[in_view], pose, camera, arcs_px),
        judged(f"shown by both beside it: {' and '.join(sorted(nearest))}", ends_m[by_both], pose, camera, arcs_px),
    ]
    header = ["", "lines", f"{SEEN_PX:.0f} px long", f"within {NEAR_PX:.0f} px", "%", "% by chance", "median px"]
    print_table(f"lines of {photos} photos in {name}", header, rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--work", type=Path, help="a folder that is removed where not given")
    parser.add_argument("--left-out")
    parser.add_argument("--arcs", type=Path)
    parser.add_argument("--small", action="store_true", help=f"{SMALL} photos, reduced")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        work = (options.work or Path(scratch)).resolve()
        main(options.data.resolve(), work, options.left_out, options.arcs, options.small)
