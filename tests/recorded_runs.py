"""Every command once on rendered and, where they are present, real photos, to compare the files that two versions write.

    python tests/recorded_runs.py record FOLDER        run every command; FOLDER must not exist
    python tests/recorded_runs.py compare FOLDER OTHER name every file of the results that differs

A change that moves code and means to change no result is checked so: record with the version before it, record with the one after
it (both times with the tree on PYTHONPATH), compare. What may differ is left out: the software
and command that a file names, plots, times.
"""

# ruff: noqa: E501 (a command is one line)
import contextlib
import csv
import io
import os
import re
import shutil
import sys
import time
import traceback
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # sums in one order

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
BOARD = "checkerboard:8x6:30mm"

SYNTHETIC = (
    f"render targets --model opencv-fisheye --fov-deg 190 --views 10 --size 640x480 --pattern {BOARD} --noise 2 --seed 3 --out photos",
    f"detect photos --pattern {BOARD} --out corners",
    f"detect photos --pattern {BOARD} --calibration photos/calibration.yaml --out corners_guided",
    f"calibrate photos --pattern {BOARD} --out calibrated",
    f"calibrate photos --pattern {BOARD} --model opencv-fisheye --refine-board flatness --out calibrated_fisheye",
    "calibrate corners/corners.csv --image-size 640x480 --model auto --out calibrated_auto",
    "calibrate corners/corners.csv --image-size 640x480 --model pinhole --loss none --out calibrated_pinhole",
    "render targets --model scaramuzza --fov-deg 180 --views 6 --size 1000x800 --pattern aprilgrid:3x3:60mm:0.3:36h11 --seed 1 --out tags",
    "calibrate tags --pattern aprilgrid:3x3:60mm:0.3:36h11 --model double-sphere --out calibrated_tags",
    "convert calibrated/calibration.yaml converted/cameras.txt --model opencv-fisheye --fov 150",
    "rectify photos --calibration calibrated/calibration.yaml --view perspective --fov-deg 90 --size 320x240 --out views",
    f"pattern {BOARD} --out board.pdf",
    "validate --model opencv-fisheye --fov-deg 190 --views 8 --size 640x480 --out validated",
    "experiment wide --trials 2 --noise 0.5,2 --out wide",
    "experiment short --trials 2 --noise 1 --out short",
    "experiment room --trials 2 --noise 1 --out room_study",
    f"experiment board --data photos --pattern {BOARD} --model opencv-fisheye --out board_lines",
    "render scene --scene room --model scaramuzza --fov-deg 190 --views 9 --size 700x700 --seed 5 --out room",
    "extract room --calibration room/calibration.yaml --out arcs",
    "reconstruct room --calibration room/calibration.yaml --poses room/poses.csv --out scene",
    "reconstruct room --calibration room/calibration.yaml --poses room/poses.csv --refine lines,poses --colmap --out scene_poses",
    "reconstruct room --calibration room/calibration.yaml --poses sfm --out scene_sfm",
    "reconstruct --calibration room/calibration.yaml --poses room/poses.csv --segments scene/segments.csv --out scene_matched",
    "reconstruct room --calibration room/calibration.yaml --poses room/poses.csv --segments arcs/segments.csv --out scene_given",
    "reconstruct --calibration room/calibration.yaml --poses room/poses.csv --segments scene/segments.csv --triangulation averaging "
    "--cost sector --robust --out scene_sector",
    "adjust --calibration room/calibration.yaml --poses room/poses.csv --segments scene/segments.csv --refine lines,poses,intrinsics "
    "--loss cauchy --out adjusted",
    "validate --scene room --views 8 --size 600x600 --out validated_scene",
)
REAL = (
    f"calibrate {DATA}/calibration/fisheye1/images --pattern checkerboard:8x6:32.5mm --out fisheye1",
    f"calibrate {DATA}/calibration/kaidan/images --pattern checkerboard:7x11:30mm --mirror --out kaidan",
    f"detect {DATA}/calibration/fisheye190/images --pattern checkerboard:7x6:30mm --out fisheye190",
    f"calibrate {DATA}/rigs/stereo_fisheye --pattern checkerboard:9x6:24.23mm --model opencv-fisheye --out stereo",
    f"detect {DATA}/rigs/charuco_close/1 --pattern charuco:20x20:4mm:3.2mm:DICT_4X4_1000:legacy --out charuco",
    f"experiment house --data {DATA}/lines/house --out house",
    "extract york --calibration york.yaml --out york_arcs",
    "reconstruct castle --calibration castle/calibration.yaml --poses castle/poses.csv --out castle_scene",
    "reconstruct castle --calibration castle/calibration.yaml --poses sfm --out castle_sfm",
)
SHOWN = {".csv", ".yaml", ".txt", ".obj", ".ply", ".json", ".pdf", ".svg"}
"""Kinds of files that are compared; of pages the text of their tables."""


def prepare_real() -> None:
    """A few photos of `york` and `castle30` with their calibrations and poses."""
    from courtyard import write_courtyard

    york = DATA / "lines" / "york"
    Path("york").mkdir()
    for photo in sorted((york / "images").iterdir())[:3]:
        shutil.copy(photo, "york")
    shutil.copy(york / "calibration.yaml", "york.yaml")
    castle = DATA / "lines" / "castle30"
    names = sorted(path.name for path in (castle / "images").iterdir())[:7]
    write_courtyard(Path("castle"), castle, names)


def run(command: str) -> str:
    """One command in this process; what it printed and how it ended."""
    from omnilines.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            main(command.split())
        except SystemExit as stopped:
            print(f"exit {stopped.code or 0}")
        except Exception:
            traceback.print_exc()
            print("exit traceback")
    return out.getvalue()


def record(folder: Path) -> None:
    """Run all commands in a new folder."""
    folder.mkdir(parents=True)
    os.chdir(folder)
    commands = list(SYNTHETIC)
    if DATA.exists():
        prepare_real()
        commands += REAL
    for command in commands:
        start = time.process_time()
        printed = run(command)
        out = command.split()[-1]
        Path(f"{Path(out).name}.printed").write_text(printed)
        print(f"{time.process_time() - start:7.1f} s  {printed.strip().splitlines()[-1]:8}  {command[:110]}", flush=True)


def shown(path: Path) -> str:
    """What of a file is compared."""
    if path.suffix == ".npz":
        import numpy as np

        with np.load(path) as arrays:
            return repr({name: arrays[name].tobytes() for name in sorted(arrays.files)})
    if path.suffix == ".pdf":
        return re.sub(r"/CreationDate.*", "", path.read_bytes().decode("latin-1"))
    text = path.read_text(errors="replace")
    if path.suffix == ".printed":
        return re.sub(r"[0-9.]+ s\b", "", text)
    if path.suffix == ".html":
        return "\n".join(re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", text))
    return re.sub(r"(?m)^\s*(software|command|cam_made_by):.*$", "", text)


def compare(first: Path, second: Path) -> int:
    """Print the files that differ, with how far numbers in tables are apart; the number of them."""
    names = sorted(
        {str(p.relative_to(f)) for f in (first, second) for p in f.rglob("*") if p.is_file() and "work" not in p.parts}
    )
    kinds = SHOWN | {".printed", ".html", ".npz"}
    differing = 0
    for name in names:
        one, other = first / name, second / name
        if not (one.exists() and other.exists()):
            print(f"{name}: only in {first if one.exists() else second}")
            differing += 1
        elif (one.suffix in kinds and shown(one) != shown(other)) or (
            one.suffix in (".png", ".jpg") and one.read_bytes() != other.read_bytes()
        ):
            print(f"{name}: differs{apart(one, other)}")
            differing += 1
    print(f"{differing} of {len(names)} files differ")
    return differing


def apart(one: Path, other: Path) -> str:
    """How far the numbers of two tables are apart, where they have the same cells."""
    if one.suffix not in (".csv", ".yaml", ".obj", ".txt"):
        return ""
    number = r"[-+]?\d+\.\d+(?:[eE][-+]?\d+)?"
    texts = [shown(path) for path in (one, other)]
    values = [[float(value) for value in re.findall(number, text)] for text in texts]
    if len(values[0]) != len(values[1]):
        rows = [len(list(csv.reader(text.splitlines()))) for text in texts]
        return f", {rows[0]} and {rows[1]} rows"
    worst = max((abs(a - b) / max(abs(a), abs(b), 1e-12) for a, b in zip(*values, strict=True)), default=0.0)
    return f", numbers by {worst:.1e} of their size at most"


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "record":
        record(Path(sys.argv[2]))
    elif len(sys.argv) == 4 and sys.argv[1] == "compare":
        sys.exit(min(compare(Path(sys.argv[2]), Path(sys.argv[3])), 1))
    else:
        sys.exit(__doc__)
