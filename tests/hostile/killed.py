"""Kills aimed at every moment of writing: what is found is the old set of results or the new one, whole, and a rerun mends it.

    python -m hostile.killed COUNT [COMMAND ...]      # from tests/

One line for each kill; exits with 1 where something was torn.

Everything is imported once; each run is a process forked from that, which kills itself at one of the moments of the writer.
"""

import contextlib
import importlib
import itertools
import os
import pkgutil
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import torch
from hostile.good import give

import omnilines
from camera_models.formats import disk
from camera_models.formats.disk import MANIFEST, MOVING
from omnilines import cli
from omnilines.files.folders import WORK
from omnilines.files.sets import settle

SCENE = ("--calibration", "IN/calibration.yaml", "--poses", "IN/poses.csv", "--segments", "IN/segments.csv", "--out", "OUT")
TARGETS = ("render", "targets", "--pattern", "checkerboard:4x3:30mm", "--size", "320x240", "--views", "2", "--out", "OUT")
LENS = ("--calibration", "IN/calibration.yaml", "--out", "OUT")
RECTIFY = ("rectify", "IN/photos", *LENS, "--size", "64x48")
CONVERT = ("convert", "IN/rig.yaml", "OUT/rig", "--to", "ros")
COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "convert": (CONVERT, (*CONVERT, "--fov", "90", "--model", "pinhole")),
    "reconstruct": (("reconstruct", *SCENE), ("reconstruct", *SCENE, "--triangulation", "svd")),
    "pattern": (("pattern", "checkerboard:4x3:30mm", "--out", "OUT"), ("pattern", "checkerboard:4x3:30mm", "--out", "OUT")),
    "extract": (("extract", "IN/photos", *LENS), ("extract", "IN/photos/0.png", *LENS)),
    "rectify": ((*RECTIFY, "--fov-deg", "80"), (*RECTIFY, "--poses", "IN/poses.csv")),
    "targets": ((*TARGETS, "--seed", "1"), (*TARGETS, "--seed", "2")),
    "detect": (
        ("detect", "IN/photos/0.png", "--pattern", "checkerboard:7x5:30mm", "--out", "OUT"),
        ("detect", "IN/photos", "--pattern", "checkerboard:7x5:30mm", "--out", "OUT"),
    ),
}  # fmt: skip
"""Command -> the run of before, the run that is killed."""
NEVER = 10**9


def forked(arguments: tuple[str, ...], folder: Path, last: int) -> tuple[int, int]:
    """Run a command in a process of its own that ends at its moment number `last`: the signal it ended by, and its moments."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        count = itertools.count()

        def moment(when: str, path: Path) -> None:
            os.write(writer, b".")
            if next(count) == last:
                os.kill(os.getpid(), signal.SIGKILL)

        disk.moment = moment
        disk._swept.clear()
        os.chdir(folder)
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        with contextlib.suppress(SystemExit):
            cli.main(list(arguments))
        os._exit(0)
    os.close(writer)
    moments = 0
    while part := os.read(reader, 4096):
        moments += len(part)
    os.close(reader)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), moments


def results(folder: Path) -> dict[str, bytes]:
    """What lies in OUT, hidden files but for its list aside, and what is kept for the next run."""
    out = folder / "OUT"
    found = {path.relative_to(out): path for path in sorted(out.rglob("*")) if path.is_file()}
    found = {name: path for name, path in found.items() if name.parts[0] != WORK}
    shown = {name: path for name, path in found.items() if not any(part[0] == "." and part != MANIFEST for part in name.parts)}
    return {name.as_posix(): path.read_bytes() for name, path in shown.items()}


def hidden(folder: Path) -> list[str]:
    """What a run that was ended left in OUT."""
    return [path.name for path in (folder / "OUT").rglob(".*") if path.name != MANIFEST]


def torn(folder: Path, old: dict[str, bytes], new: dict[str, bytes]) -> list[str]:
    """What is wrong with a folder that holds neither the old set nor the new one, nor the new one to be moved."""
    if (folder / "OUT" / MOVING).exists():
        settle(folder / "OUT")
        return different(results(folder), new)
    now = results(folder)
    return [] if now in (old, new) else different(now, old)


def different(now: dict[str, bytes], wanted: dict[str, bytes]) -> list[str]:
    """Names of files that are not as they should be."""
    return [f"{name} differs" for name in sorted({*now, *wanted}) if now.get(name) != wanted.get(name)]


def kills(name: str, folder: Path, chosen: Callable[[int], list[int]], tell: Callable[[str], None]) -> tuple[int, int]:
    """Kill one command at the chosen ones of its moments, with an old result and without; (kills, failures)."""
    before, command = COMMANDS[name]
    clean = folder / "clean"
    clean.mkdir()
    give("omnilines", "omnilines-rig", "poses.csv", "segments.csv", "photos")(clean)
    (clean / "OUT").mkdir()
    old, new = (shutil.copytree(clean, folder / part) for part in ("old", "new"))
    assert forked(before, old, NEVER)[0] == 0
    again = shutil.copytree(old, folder / "again")
    # What an earlier run has kept is not written again.
    moments = {clean: forked(command, new, NEVER)[1], old: forked(command, again, NEVER)[1]}
    assert all(moments.values())
    assert results(new) == results(again), f"{name} is not the same twice: {different(results(again), results(new))}"
    count = failures = 0
    for start, last in [(part, last) for part in (clean, old) for last in chosen(moments[part])]:
        work = shutil.copytree(start, folder / "work")
        status, _ = forked(command, work, last)
        wrong = [] if status == -signal.SIGKILL else [f"status {status}"]
        copy = shutil.copytree(work, folder / "copy")
        wrong += torn(copy, results(start), results(new))
        shutil.rmtree(copy)
        forked(command, work, NEVER)
        wrong += [f"{path} is left" for path in hidden(work)]
        wrong += [f"{path} after a rerun" for path in different(results(work), results(new))]
        tell(f"{name} from {start.name} at {last} of {moments[start]}: {', '.join(wrong) or 'whole'}")
        count, failures = count + 1, failures + bool(wrong)
        shutil.rmtree(work)
    return count, failures


def main(wanted: int, names: Sequence[str]) -> int:
    """Spread a number of kills over commands and their moments."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    # What commands import where they need it too.
    for module in pkgutil.walk_packages(omnilines.__path__, "omnilines."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    each = -(-wanted // (2 * len(names)))

    def chosen(moments: int) -> list[int]:
        # The last ones are those at which results are moved; repeated where there are fewer moments than kills.
        return [(k + 1) * moments // each - 2 if 2 * each <= moments else k % moments for k in range(each)]

    total = failed = 0
    for name in names:
        with tempfile.TemporaryDirectory(prefix="killed-") as folder:
            count, failures = kills(name, Path(folder), chosen, lambda line: print(line, flush=True))
        total, failed = total + count, failed + failures
    print(f"{total} kills, {failed} failures")
    return int(failed > 0 or total < wanted)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:] or list(COMMANDS)))
