"""Hundreds of photos through every command, each in a process of its own: within 2 GB, in a time that goes with the photos."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from omnilines.commands.render_scene import render_scene
from omnilines.commands.render_targets import render_targets
from omnilines.pipelines.render import MODEL, RenderOptions

FEW, MANY = 50, 500
LIMIT_MB = 2000
SLOWER = 2.0
"""Times as long as for few photos that a photo may take among many; a line of these scenes is seen by all of them."""
SIZE = (640, 480)
PATTERN = "checkerboard:8x6:30mm"
ROOT = Path(__file__).parents[1]
WATCHED = """
import os, sys
process = os.spawnv(os.P_NOWAIT, sys.argv[1], sys.argv[1:])
_, status, used = os.wait4(process, 0)
print(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss)
"""
"""Runs a command from a small process: what a process takes counts that of the one it was made by."""
START = "import sys\nfrom omnilines.cli import main\nmain(sys.argv[1:])\n"


class Cost(NamedTuple):
    cpu_s: float
    peak_mb: float


def cost(folder: Path, *arguments: str) -> Cost:
    """Of a command that must succeed."""
    command = [sys.executable, "-S", "-c", WATCHED, sys.executable, "-c", START, *arguments]
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )
    status, cpu_s, peak_kb = done.stdout.splitlines()[-1].split()
    assert status == "0", (arguments, done.stderr[-2000:])
    return Cost(float(cpu_s), float(peak_kb) / 1024)


def some(folder: Path, count: int) -> str:
    """A folder with the first photos of another, by links."""
    chosen = folder.parent / f"{folder.name}{count}"
    chosen.mkdir()
    for photo in sorted(folder.glob("*.png"))[:count]:
        (chosen / photo.name).symlink_to(photo)
    header, *rows = (folder / "poses.csv").read_text().splitlines(keepends=True)
    (chosen / "poses.csv").write_text("".join([header, *rows[:count]]))
    return chosen.name


@pytest.mark.full
def test_memory_and_time_of_hundreds_of_photos(tmp_path: Path) -> None:
    render_targets(tmp_path / "boards", PATTERN, MODEL, RenderOptions(190.0, MANY, SIZE))
    render_scene(tmp_path / "room", views=MANY, size=SIZE)
    lens = ("--calibration", "room/calibration.yaml")
    of_boards, of_room = ({count: some(tmp_path / name, count) for count in (FEW, MANY)} for name in ("boards", "room"))
    commands = {
        "detect": lambda count: ("detect", of_boards[count], "--pattern", PATTERN),
        "calibrate": lambda count: ("calibrate", of_boards[count], "--pattern", PATTERN, "--model", "opencv-fisheye"),
        "extract": lambda count: ("extract", of_room[count], *lens),
        "reconstruct": lambda count: ("reconstruct", of_room[count], *lens, "--poses", f"{of_room[count]}/poses.csv"),
    }
    for name, of_count in commands.items():
        cost(tmp_path, *of_count(FEW), "--out", f"{name}-first")  # compiles where nothing is compiled yet
        few, many = (cost(tmp_path, *of_count(count), "--out", f"{name}{count}") for count in (FEW, MANY))
        print(f"{name:12} {few.peak_mb:6.0f} {many.peak_mb:6.0f} MB {few.cpu_s / FEW:6.3f} {many.cpu_s / MANY:6.3f} s a photo")
        assert many.peak_mb < LIMIT_MB, name
        assert many.cpu_s / MANY < SLOWER * few.cpu_s / FEW, name
