"""Lines of a real hall from one instant of a rig of four cameras of 220 degrees, judged by a camera that had no part in them.

    python tests/bench/bench_scene_rig.py [--data ../shared/data/rigs/omnimvs/itbt_sample] [--out DIR] [--small]

For each instant and each camera: `omnilines reconstruct --poses rig` on the photos of the other three, three views a line.
Every line is drawn into the photo of the camera left out, where it is unbroken over SEEN_PX or more, and compared with the arcs
that `extract_arcs` finds there: the nearest one that runs along it. No line is known to be visible there, so that some of those
without an arc are hidden; the shares by chance are those of the same lines drawn SHIFTED_PX beside their places.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from timing import print_table, skip

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from held_out import MATCHED_PX, NEAR_PX, held_out

import camera_models
from camera_models.formats import read as read_calibration
from omnilines.cli import main as omnilines
from omnilines.extraction import ExtractionOptions, extract_arcs
from omnilines.files import read_lines, read_photo, read_poses

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "rigs" / "omnimvs" / "itbt_sample"


def reconstructed(folder: Path, instant: str, cameras: list[str], calibration: Path, out: Path) -> bool:
    """`omnilines reconstruct` on what some cameras saw at one instant, into out/scene; whether it found a line."""
    for name in cameras:
        (out / "photos" / name).mkdir(parents=True)
        (out / "photos" / name / instant).symlink_to(folder / name / instant)
    arguments = ["reconstruct", str(out / "photos"), "--calibration", str(calibration), "--poses", "rig", "--min-views", "3"]
    try:
        omnilines([*arguments, "--out", str(out / "scene")])
    except SystemExit as finished:
        return not finished.code
    return True


def main(folder: Path, out: Path, small: bool) -> None:
    if not folder.is_dir():
        skip(f"the folder {folder} with photos of a rig is absent")
    calibration = read_calibration(folder / "config.yaml").calibration
    assert calibration.rig is not None
    out.mkdir(parents=True, exist_ok=True)
    camera_models.save(out / "calibration.yaml", calibration)
    names, rows = list(calibration.cameras), []
    instants = sorted(file.name for file in (folder / names[0]).glob("*.png"))
    for instant in instants[: 1 if small else None]:
        for name in names[: 1 if small else None]:
            work = out / Path(instant).stem / f"without_{name}"
            if not reconstructed(folder, instant, [n for n in names if n != name], out / "calibration.yaml", work):
                rows.append([f"{name}/{instant}", "0", *[""] * 5])
                continue
            lines, poses = read_lines(work / "scene" / "lines.csv"), read_poses(work / "scene" / "poses.csv")
            other = poses.images[0].split("/")[0]
            rig = calibration.rig
            pose = rig[name].cam_from_rig @ rig[other].cam_from_rig.inverse() @ poses.cam_from_world[0]
            arcs = extract_arcs(
                read_photo(folder / name / instant), calibration[name], options=ExtractionOptions(min_length_px=15.0)
            )
            off, chance = held_out(lines.ends_m[lines.known], pose, calibration[name], arcs.endpoints_px)
            rows.append(
                [
                    f"{name}/{instant}",
                    str(int(lines.known.sum())),
                    f"{np.median(lines.rms_px[lines.known]):.2f}",
                    str(len(off)),
                    f"{np.median(off[off < MATCHED_PX]):.2f}",
                    f"{100 * (off < NEAR_PX).mean():.0f}",
                    f"{100 * (chance < NEAR_PX).mean():.0f}",
                ]
            )
    print_table(
        f"{folder.name}: lines of three cameras in the fourth",
        ["left out", "lines", "rms px", "drawn", "median px", f"% within {NEAR_PX:.0f} px", "% by chance"],
        rows,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--small", action="store_true", help="one camera of one instant")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        main(options.data.resolve(), options.out or Path(scratch), options.small)
