"""Kills aimed at every moment of writing: what is found is the old result or the new one, file by file, and a rerun mends it.

    python -m hostile.killed COUNT      # from tests/; prints one line for each kill, exits with 1 where something was torn

Everything is imported once; each run is a process forked from that, which kills itself at one of the moments of the writer.
"""

import contextlib
import itertools
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import torch
from hostile.good import give

from camera_models.formats import disk
from omnilines import cli

SCENE = ("--calibration", "IN/calibration.yaml", "--poses", "IN/poses.csv", "--segments", "IN/segments.csv", "--out", "OUT")
TARGETS = ("render", "targets", "--pattern", "checkerboard:4x3:30mm", "--size", "320x240", "--views", "2", "--out", "OUT")
CONVERT = ("convert", "IN/rig.yaml", "OUT/rig", "--to", "ros")
COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "convert": (CONVERT, (*CONVERT, "--fov", "90", "--model", "pinhole")),
    "reconstruct": (("reconstruct", *SCENE), ("reconstruct", *SCENE, "--triangulation", "svd")),
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
    """What lies in OUT."""
    found = sorted(path for path in (folder / "OUT").rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def torn(now: dict[str, bytes], old: dict[str, bytes], new: dict[str, bytes]) -> list[str]:
    """Files that are neither what they were nor what they become."""
    wrong = [
        name for name, content in now.items() if not name.endswith(".part") and content not in (old.get(name), new.get(name))
    ]
    return wrong + [f"{name} is gone" for name in old if name not in now]


def kills(name: str, folder: Path, chosen: Callable[[int], list[int]], tell: Callable[[str], None]) -> tuple[int, int]:
    """Kill one command at the chosen ones of its moments, with an old result and without; (kills, failures)."""
    before, command = COMMANDS[name]
    clean = folder / "clean"
    clean.mkdir()
    give("omnilines", "omnilines-rig", "poses.csv", "segments.csv", "photos")(clean)
    (clean / "OUT").mkdir()
    old, new, again = (shutil.copytree(clean, folder / part) for part in ("old", "new", "again"))
    assert forked(before, old, NEVER)[0] == 0
    moments = forked(command, new, NEVER)[1]
    assert moments and forked(command, again, NEVER)[0] == 0
    assert results(new) == results(again), f"{name} is not the same twice: {torn(results(again), {}, results(new))}"
    count = failures = 0
    for start, last in [(part, last) for part in (clean, old) for last in chosen(moments)]:
        work = shutil.copytree(start, folder / "work")
        status, _ = forked(command, work, last)
        wrong = torn(results(work), results(start), results(new)) if status == -signal.SIGKILL else [f"status {status}"]
        forked(command, work, NEVER)
        after = results(work)
        wrong += [f"{path} is left" for path in after if path.endswith(".part")]
        wrong += [f"{path} differs after a rerun" for path, content in results(new).items() if after.get(path) != content]
        tell(f"{name} from {start.name} at {last} of {moments}: {', '.join(wrong) or 'whole'}")
        count, failures = count + 1, failures + bool(wrong)
        shutil.rmtree(work)
    return count, failures


def main(wanted: int) -> int:
    """Spread a number of kills over the commands and their moments."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    each = max(1, wanted // (2 * len(COMMANDS)))

    def chosen(moments: int) -> list[int]:
        # Repeated where there are fewer moments than kills, for what happens between two of them.
        return [k * moments // each if each <= moments else k % moments for k in range(each)]

    total = failed = 0
    for name in COMMANDS:
        with tempfile.TemporaryDirectory(prefix="killed-") as folder:
            count, failures = kills(name, Path(folder), chosen, lambda line: print(line, flush=True))
        total, failed = total + count, failed + failures
    print(f"{total} kills, {failed} failures")
    return int(failed > 0 or total < wanted)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
