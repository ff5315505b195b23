"""Every command on rendered and, where they are present, real photos, to compare the files that two versions write.

    python tests/recorded_runs.py prepare INPUTS            what commands read: photos, calibrations, poses, arcs; once
    python tests/recorded_runs.py record INPUTS FOLDER [N]  run every command N times (1) in new folders FOLDER/0, FOLDER/1, ...
    python tests/recorded_runs.py compare FOLDER OTHER      name every file of the results that differs

A change that moves code and means to change no result is checked so: prepare and record with the version before it, record with the
one after it from the same inputs (each time with the tree on PYTHONPATH), compare. Sums of BLAS and torch depend on where memory
lies, so that even one version writes two or three results that differ in the last digits: record it several times. A file differs
where no recording of one version is that of the other. What may differ is left out: the software and command that a file names,
plots, times.
"""

# ruff: noqa: E501 (a command is one line)
import csv
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

SAME_SUMS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_CBWR": "COMPATIBLE", "PYTHONHASHSEED": "0"}
"""Of the environment: what makes sums repeat as far as they can."""
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
BOARD = "checkerboard:8x6:30mm"
TAGS = "aprilgrid:3x3:60mm:0.3:36h11"
POSED = "--calibration in/room/calibration.yaml --poses in/room/poses.csv"

PREPARED = (
    f"render targets --model opencv-fisheye --fov-deg 190 --views 10 --size 640x480 --pattern {BOARD} --noise 2 --seed 3 --out photos",
    f"render targets --model scaramuzza --fov-deg 180 --views 6 --size 1000x800 --pattern {TAGS} --seed 1 --out tags",
    f"calibrate photos --pattern {BOARD} --out calibrated",
    "render scene --scene room --model scaramuzza --fov-deg 190 --views 9 --size 700x700 --seed 5 --out room",
    "extract room --calibration room/calibration.yaml --out arcs",
    "reconstruct room --calibration room/calibration.yaml --poses room/poses.csv --out scene",
)
COMMANDS = (
    f"render targets --model opencv-fisheye --fov-deg 190 --views 3 --size 640x480 --pattern {BOARD} --noise 2 --seed 3 --out photos",
    f"detect in/photos --pattern {BOARD} --out corners",
    f"detect in/photos --pattern {BOARD} --calibration in/photos/calibration.yaml --out corners_guided",
    f"calibrate in/photos --pattern {BOARD} --out calibrated",
    f"calibrate in/photos --pattern {BOARD} --model opencv-fisheye --refine-board flatness --out calibrated_fisheye",
    "calibrate in/calibrated/corners.csv --image-size 640x480 --model auto --out calibrated_auto",
    "calibrate in/calibrated/corners.csv --image-size 640x480 --model pinhole --loss none --out calibrated_pinhole",
    f"calibrate in/tags --pattern {TAGS} --model double-sphere --out calibrated_tags",
    "convert in/calibrated/calibration.yaml converted/cameras.txt --model opencv-fisheye --fov 150",
    "rectify in/photos --calibration in/calibrated/calibration.yaml --view perspective --fov-deg 90 --size 320x240 --out views",
    f"pattern {BOARD} --out board.pdf",
    "validate --model opencv-fisheye --fov-deg 190 --views 8 --size 640x480 --out validated",
    "experiment wide --trials 2 --noise 0.5,2 --out wide",
    "experiment short --trials 2 --noise 1 --out short",
    "experiment room --trials 2 --noise 1 --out room_study",
    "experiment book --out book",
    f"experiment board --data in/photos --pattern {BOARD} --model opencv-fisheye --out board_lines",
    "render scene --scene room --model scaramuzza --fov-deg 190 --views 2 --size 400x400 --seed 5 --out room",
    "extract in/room --calibration in/room/calibration.yaml --out arcs",
    f"reconstruct in/room {POSED} --out scene",
    f"reconstruct in/room {POSED} --refine lines,poses --colmap --out scene_poses",
    "reconstruct in/room --calibration in/room/calibration.yaml --poses sfm --out scene_sfm",
    f"reconstruct {POSED} --segments in/scene/segments.csv --out scene_matched",
    f"reconstruct in/room {POSED} --segments in/arcs/segments.csv --out scene_given",
    f"reconstruct {POSED} --segments in/scene/segments.csv --triangulation averaging --cost sector --robust --out scene_sector",
    f"adjust {POSED} --segments in/scene/segments.csv --refine lines,poses,intrinsics --loss cauchy --out adjusted",
    "validate --scene room --views 8 --size 600x600 --out validated_scene",
)
REAL = (
    f"calibrate {DATA}/calibration/fisheye1/images --pattern checkerboard:8x6:32.5mm --out fisheye1",
    f"calibrate {DATA}/calibration/kaidan/images --pattern checkerboard:7x11:30mm --mirror --out kaidan",
    f"detect {DATA}/calibration/fisheye190/images --pattern checkerboard:7x6:30mm --out fisheye190",
    f"calibrate {DATA}/rigs/stereo_fisheye --pattern checkerboard:9x6:24.23mm --model opencv-fisheye --out stereo",
    f"detect {DATA}/rigs/charuco_close/1 --pattern charuco:20x20:4mm:3.2mm:DICT_4X4_1000 --out charuco",
    f"experiment house --data {DATA}/lines/house --out house",
    "extract in/york --calibration in/york.yaml --out york_arcs",
    "reconstruct in/castle --calibration in/castle/calibration.yaml --poses in/castle/poses.csv --out castle_scene",
    "reconstruct in/castle --calibration in/castle/calibration.yaml --poses sfm --out castle_sfm",
)
SHOWN = {".csv", ".yaml", ".txt", ".obj", ".ply", ".json", ".pdf", ".svg"}
"""Kinds of files that are compared as text; of pages the text of their tables."""


def run(command: str, folder: Path) -> None:
    """One command in a process of its own; what it printed is kept as a file."""
    start = time.monotonic()
    call = [sys.executable, "-c", "import sys; from omnilines.cli import main; main(sys.argv[1:])", *command.split()]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False, env={**os.environ, **SAME_SUMS})
    name = Path(command.split()[-1]).name
    (folder / f"{name}.printed").write_text(f"{done.stdout}{done.stderr}exit {done.returncode}")
    print(f"{time.monotonic() - start:7.1f} s  exit {done.returncode}  {command[:110]}", flush=True)


def prepare(folder: Path) -> None:
    """What the commands read, in a new folder."""
    folder.mkdir(parents=True)
    for command in PREPARED:
        run(command, folder)
    if not DATA.exists():
        return
    from courtyard import write_courtyard

    york, castle = DATA / "lines" / "york", DATA / "lines" / "castle30"
    (folder / "york").mkdir()
    for photo in sorted((york / "images").iterdir())[:3]:
        shutil.copy(photo, folder / "york")
    shutil.copy(york / "calibration.yaml", folder / "york.yaml")
    write_courtyard(folder / "castle", castle, sorted(path.name for path in (castle / "images").iterdir())[:7])


def record(inputs: Path, folder: Path, times: int) -> None:
    """Run all commands in new folders."""
    for turn in range(times):
        here = folder / str(turn)
        here.mkdir(parents=True)
        (here / "in").symlink_to(inputs.resolve())
        for command in (*COMMANDS, *(REAL if DATA.exists() else ())):
            run(command, here)


def shown(path: Path) -> str:
    """What of a file is compared."""
    if path.suffix == ".npz":
        import numpy as np

        with np.load(path) as arrays:
            return repr({name: arrays[name].tobytes() for name in sorted(arrays.files)})
    if path.suffix == ".pdf":
        return re.sub(r"/CreationDate.*", "", path.read_bytes().decode("latin-1"))
    text = path.read_text(errors="replace")
    if path.name == "done.json":
        return ""  # a key of the version
    if path.suffix in (".printed", ".yaml"):
        text = re.sub(r"/[\w/.-]{1,200}/\d+/in/", "in/", text)
    if path.suffix == ".printed":
        return re.sub(r"(?m)^\[\d+:\d\d\] .*\n|[0-9.]+ s\b", "", text)  # times, and how far the command was then
    if path.suffix == ".html":
        return "\n".join(re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", text))
    return re.sub(r"(?m)^\s*(software|command|cam_made_by):.*$", "", text)


def recordings(folder: Path) -> dict[str, list[Path]]:
    """The files of all recordings in a folder, by their name within a recording."""
    found: dict[str, list[Path]] = {}
    for turn in sorted(folder.iterdir()):
        for path in sorted(turn.rglob("*")):
            name = path.relative_to(turn)
            if path.is_file() and name.parts[0] != "in" and "work" not in name.parts:
                found.setdefault(str(name), []).append(path)
    return found


def content(path: Path) -> str | bytes:
    """What is compared of a file."""
    kinds = SHOWN | {".printed", ".html", ".npz"}
    return shown(path) if path.suffix in kinds else path.read_bytes() if path.suffix in (".png", ".jpg") else ""


def compare(first: Path, second: Path) -> int:
    """Print the files that differ, with how far numbers in tables are apart; the number of them."""
    ones, others = recordings(first), recordings(second)
    names = sorted(ones.keys() | others.keys())
    differing = 0
    for name in names:
        if not (name in ones and name in others):
            print(f"{name}: only in {first if name in ones else second}")
            differing += 1
        elif not {content(path) for path in ones[name]} & {content(path) for path in others[name]}:
            itself = max((apart(ones[name][0], path) for path in ones[name][1:]), default="")
            print(f"{name}: differs{apart(ones[name][0], others[name][0])}" + (f" (of one version{itself})" if itself else ""))
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
    if len(sys.argv) == 3 and sys.argv[1] == "prepare":
        prepare(Path(sys.argv[2]))
    elif len(sys.argv) in (4, 5) and sys.argv[1] == "record":
        record(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]) if len(sys.argv) == 5 else 1)
    elif len(sys.argv) == 4 and sys.argv[1] == "compare":
        sys.exit(min(compare(Path(sys.argv[2]), Path(sys.argv[3])), 1))
    else:
        sys.exit(__doc__)
