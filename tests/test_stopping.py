"""Ctrl-C and SIGTERM: the command ends at once with one sentence, its status and no half-written file, and goes on later."""

import os
import pty
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from omnilines.commands.render_scene import render_scene

VIEWS = 6
WORKS = """
import os, signal, sys, time
# A test run may ignore it, as nohup does.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from omnilines.cli import main
from omnilines.pipelines import {module}
{patch}
main()
"""
IN_THREADS = """
real = arcs.extract_arcs
turn = __import__("itertools").count()
def slow(*given):
    own = next(turn)
    os.write(2, b"begun\\n")
    time.sleep(30 if own else 0)
    return real(*given)
arcs.extract_arcs = slow
"""
"""The first photo is looked at; the others take long, in as many threads as there are cores."""
IN_C_CODE = """
import hashlib
def busy(*given, **named):
    os.write(2, b"begun\\n")
    # As compiled code does, this runs without Python's lock, and no Python runs in the main thread until it is over.
    hashlib.pbkdf2_hmac("sha256", b"a", b"b", 1_000_000_000)
lines.match_arcs = busy
"""


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    render_scene(folder / "photos", scene="plain-room", views=VIEWS, size=(240, 240))
    for name in ("calibration.yaml", "poses.csv"):
        (folder / "photos" / name).rename(folder / name)
    return folder


def started(room, out, module, patch, stderr=subprocess.PIPE):
    command = [sys.executable, "-c", WORKS.format(module=module, patch=patch), "reconstruct", room / "photos"]
    command += ["--calibration", room / "calibration.yaml", "--poses", room / "poses.csv", "--out", out, "--json"]
    return subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, stderr=stderr)


def left_behind(folder):
    return [path for path in folder.rglob("*") if path.name.endswith((".part", ".tmp"))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.full),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.full),
    ],
)
def test_a_signal_ends_a_pool_of_threads_at_once(room, tmp_path, number, status):
    process = started(room, tmp_path / "scene", "arcs", IN_THREADS)
    assert process.stderr.readline() == b"begun\n"
    arcs = tmp_path / "scene" / "work" / "arcs"
    while not list(arcs.glob("*.npz")):
        assert process.poll() is None
        time.sleep(0.05)
    # On one core the second photo begins as soon as the first is done.
    assert process.stderr.readline() == b"begun\n"
    sent = time.monotonic()
    process.send_signal(number)
    out, said = process.communicate(timeout=20)
    assert process.returncode == status and time.monotonic() - sent < 5.0
    sentence = (
        f"omnilines: stopped; what was found is kept in {tmp_path / 'scene' / 'work'}, the same command goes on from there.\n"
    )
    assert said.decode().replace("begun\n", "") == sentence and out == b""
    assert len(list(arcs.glob("*.npz"))) == 1
    assert not left_behind(tmp_path) and not (tmp_path / "scene" / "lines.csv").exists()


IN_A_CALLBACK = """
class Held:
    def __del__(self):
        os.write(2, b"begun\\n")
        time.sleep(20)
def dropped(*given, **named):
    held = Held()
    del held
    time.sleep(20)
lines.match_arcs = dropped
"""


IN_A_PHOTO = """
real = detect.FirstLook.__call__
turn = __import__("itertools").count()
def slow(*given):
    own = next(turn)
    os.write(2, b"begun\\n")
    time.sleep(30 if own else 0)
    return real(*given)
detect.FirstLook.__call__ = slow
"""


@pytest.mark.slow
def test_a_calibration_that_is_stopped_keeps_the_corners_of_its_photos(tmp_path):
    photos, out = tmp_path / "photos", tmp_path / "result"
    photos.mkdir()
    for name in "abc":
        cv2.imwrite(str(photos / f"{name}.png"), np.full((240, 320), 128, dtype=np.uint8))
    command = ["calibrate", str(photos), "--pattern", "checkerboard:8x6:30mm", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-c", WORKS.format(module="detect", patch=IN_A_PHOTO), *command], stderr=subprocess.PIPE
    )
    assert process.stderr.readline() == b"begun\n"
    kept = out / "work" / "corners"
    while not list(kept.glob("*.npz")):
        assert process.poll() is None
        time.sleep(0.05)
    assert process.stderr.readline() == b"begun\n"
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=20)[1].decode().replace("begun\n", "")
    assert process.returncode == 130
    assert said.endswith(f"omnilines: stopped; what was found is kept in {out / 'work'}, the same command goes on from there.\n")
    assert len(list(kept.glob("*.npz"))) == 1 and not left_behind(tmp_path) and not (out / "calibration.yaml").exists()


@pytest.mark.slow
def test_a_signal_that_a_callback_loses_ends_the_command(room, tmp_path):
    process = started(room, tmp_path / "scene", "lines", IN_A_CALLBACK)
    assert process.stderr.readline() == b"begun\n"
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert process.returncode == 130 and said.count(b"\n") == 1 and said.startswith(b"omnilines: stopped")


@pytest.mark.slow
def test_a_signal_ends_compiled_code_and_brings_the_cursor_back(room, tmp_path):
    ours, theirs = pty.openpty()
    process = started(room, tmp_path / "scene", "lines", IN_C_CODE, stderr=theirs)
    os.close(theirs)
    seen = b""
    while b"begun" not in seen:
        seen += os.read(ours, 4096)
    sent = time.monotonic()
    process.send_signal(signal.SIGINT)
    try:
        while part := os.read(ours, 4096):
            seen += part
    except OSError:  # Linux's end of a terminal
        pass
    assert process.wait(timeout=20) == 130 and time.monotonic() - sent < 5.0
    process.stdout.close()
    os.close(ours)
    said = seen.decode(errors="replace")
    assert "omnilines: stopped; what was found is kept in" in said and "Traceback" not in said
    # Hidden by the progress line, shown in the end.
    assert said.rindex("\x1b[?25h") > said.rindex("\x1b[?25l")
    assert len(list((tmp_path / "scene" / "work" / "arcs").glob("*.npz"))) == VIEWS


def test_a_signal_ends_the_command_while_colmap_is_loaded() -> None:
    """Its log takes SIGTERM for a crash where nothing is done about it: a stack on standard error, and no sentence."""
    script = (
        "import os, signal, time\nfrom omnilines.cli._stopping import stoppable\n"
        "from omnilines.posing._pycolmap import pycolmap\n"
        "with stoppable():\n    pycolmap()\n    os.kill(os.getpid(), signal.SIGTERM)\n    time.sleep(20)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 143 and done.stderr == "omnilines: stopped.\n"
