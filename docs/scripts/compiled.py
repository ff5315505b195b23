"""The compiled functions that commands call, with the types of their arguments: omnilines/compiling/entries.yaml.

    python docs/scripts/compiled.py            # runs commands on small rendered photos, and writes the list anew
    python docs/scripts/compiled.py --check [OUT ...]    # says what the list lacks of what they call

A test runs the check, of all commands or of those that write to some folders. Writing also compiles each function once more, to
tell how long it takes: about five minutes in all.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

from omnilines.compiled_cache import VARIABLE
from omnilines.compiling.entries import TABLE, entries

HEAD = "# Written by docs/scripts/compiled.py: compiled functions that commands call, and with what (argument_types.py).\n"
BOARD = "checkerboard:8x6:30mm"
PHOTOS = ["--size", "640x640", "--fov-deg", "190", "--model", "opencv-fisheye"]
ROOM = ["room", "--calibration", "room/calibration.yaml"]
RUNS = [
    ("", ["render", "targets", "--pattern", BOARD, "--views", "8", *PHOTOS, "--out", "board"]),
    ("boards", ["calibrate", "board", "--pattern", BOARD, "--model", "opencv-fisheye", "--out", "camera"]),
    ("experiment", ["experiment", "board", "--data", "board", "--pattern", BOARD, "--model", "opencv-fisheye", "--out", "lines"]),
    ("", ["render", "scene", "--scene", "room", "--views", "6", *PHOTOS, "--out", "room"]),
    ("arcs", ["extract", *ROOM, "--out", "arcs"]),
    ("arcs", ["directions", *ROOM, "--out", "directions"]),
    ("arcs", ["check", *ROOM, "--out", "check"]),
    ("arcs", ["calibrate", "room", "--pattern", "lines", "--model", "opencv-fisheye", "--out", "from_lines"]),
    ("scene", ["reconstruct", *ROOM, "--poses", "sfm", "--out", "from_photos"]),
    ("scene", ["reconstruct", *ROOM, "--poses", "room/poses.csv", "--refine", "lines,poses", "--out", "scene"]),
    ("adjust", ["adjust", "--segments", "scene/segments.csv", *ROOM[1:], "--poses", "room/poses.csv", "--out", "adjusted"]),
]
"""Jobs and commands that do them."""
CALLED = "called.json"
"""What a command called, as it tells in its folder."""
Calls = dict[str, dict[str, list[object]]]
"""Of each function the jobs that call it, and the lists of arguments."""


def calls(outs: list[str]) -> Calls:
    """What the commands call that write to some folders, to any where none is named; each in a process of its own, where numba
    asks for a function as it is called for the first time."""
    found: Calls = {}
    with tempfile.TemporaryDirectory() as folder:
        for job, run in [of_job for of_job in RUNS if not outs or of_job[1][-1] in outs]:
            subprocess.run([sys.executable, __file__, "--run", *run], cwd=folder, stdout=subprocess.DEVNULL, check=True)
            for function, kinds in json.loads(Path(folder, CALLED).read_text()).items():
                its = found.setdefault(function, {"jobs": [], "arguments": []})
                its["jobs"] += [job] if job not in its["jobs"] else []
                its["arguments"] += [kind for kind in kinds if kind not in its["arguments"]]
    return dict(sorted(found.items()))


def run_and_tell(arguments: list[str]) -> None:
    """Run a command, and write what it called to a file."""
    from numba.core.dispatcher import Dispatcher

    from omnilines.cli import app
    from omnilines.compiling.argument_types import written

    called: dict[str, list[object]] = {}
    compile_for = Dispatcher._compile_for_args

    def told(self: Any, *values: Any, **named: Any) -> Any:
        module = self.py_func.__module__
        if module.startswith(("omnilines", "calib_patterns", "camera_models")):
            kinds = called.setdefault(f"{module}.{self.py_func.__qualname__}", [])
            its = [written(self.typeof_pyval(value), module) for value in values]
            if its not in kinds:
                kinds.append(its)
        return compile_for(self, *values, **named)

    Dispatcher._compile_for_args = told
    try:
        app(arguments, standalone_mode=False)
    finally:
        Path(CALLED).write_text(json.dumps(called))


def seconds(functions: list[str]) -> dict[str, float]:
    """How long each takes to compile, one after another in one process, with nothing compiled before."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, VARIABLE: folder}
        command = [sys.executable, "-m", "omnilines.compiling", *functions]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as process:
            assert process.stdout is not None
            taken, before = {}, time.monotonic()
            for line in process.stdout:
                taken[line.strip()] = round(time.monotonic() - before, 1)
                before = time.monotonic()
    return taken


def write(found: Calls, taken: dict[str, float]) -> None:
    """The list, a function in a few lines."""
    rows = []
    for function, its in found.items():
        kinds = yaml.safe_dump(its["arguments"], default_flow_style=True, width=1_000_000).strip()
        rows += [f"- function: {function}", f"  jobs: {' '.join(its['jobs'])}", f"  seconds: {taken.get(function, 0.0)}"]
        rows += [f"  arguments: {kinds}"]
    TABLE.write_text(HEAD + "\n".join(rows) + "\n")


def check(found: Calls) -> list[str]:
    """What the list lacks, a line each."""
    listed = {entry.function: entry for entry in entries()}
    wanting = [f"{function} is not listed" for function in found if function not in listed]
    for function, entry in listed.items():
        its = found.get(function, {"jobs": [], "arguments": []})
        wanting += [f"{function} is called by {job}" for job in its["jobs"] if job not in entry.jobs]
        wanting += [f"{function} is called with {kind}" for kind in its["arguments"] if tuple(kind) not in entry.arguments]
    return wanting


if __name__ == "__main__":
    if sys.argv[1:2] == ["--run"]:
        run_and_tell(sys.argv[2:])
    elif sys.argv[1:2] == ["--check"]:
        sys.exit("\n".join(check(calls(sys.argv[2:]))) or None)
    else:
        # A list of before a change may not be readable after it, and would compile what is not called.
        TABLE.write_text("[]\n")
        found = calls([])
        write(found, dict.fromkeys(found, 0.0))
        write(found, seconds(list(found)))
