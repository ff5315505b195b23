"""The one writer of files: whole or not at all, in a folder where processes were killed, over links, pipes and full disks."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from camera_models.errors import InputError
from camera_models.formats import disk
from camera_models.formats.disk import read_bytes, write_atomically

TESTS = Path(__file__).parent
HOLD = """
import os, sys
from pathlib import Path
from camera_models.formats import disk
def moment(when, path):
    if when == "inside":
        print("inside", flush=True)
        sys.stdin.read()
disk.moment = moment
disk.write_atomically(sys.argv[1], b"new" * 1000)
"""


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)]), "OMP_NUM_THREADS": "1"}


def killed(count: int, *commands: str) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "hostile.killed", str(count), *commands],
        cwd=TESTS, env=environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    lines = done.stdout.splitlines()
    assert len(lines) - 1 >= count and all(line.endswith(": whole") for line in lines[:-1])


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="takes processes that are forked")
def test_aimed_kills_tear_nothing() -> None:
    killed(3, "convert", "extract")


@pytest.mark.full
@pytest.mark.skipif(not hasattr(os, "fork"), reason="takes processes that are forked")
def test_two_hundred_aimed_kills_tear_nothing() -> None:
    killed(200)


@pytest.fixture(autouse=True)
def unswept() -> None:
    disk._swept.clear()


def writer(path: Path) -> "subprocess.Popen[str]":
    """A process that holds in the middle of writing."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
    )
    assert process.stdout is not None and process.stdout.readline() == "inside\n"
    return process


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_writes_stays(tmp_path: Path) -> None:
    dead, living = writer(tmp_path / "a.txt"), writer(tmp_path / "b.txt")
    dead.kill()
    dead.communicate()
    assert len(list(tmp_path.glob(".*.part"))) == 2
    (tmp_path / ".mine.part").write_text("no temporary file of ours")
    write_atomically(tmp_path / "c.txt", "c")
    assert {path.name.split(".")[1] for path in tmp_path.glob(".*.part")} == {"b", "mine"}
    living.communicate("")
    assert living.returncode == 0 and (tmp_path / "b.txt").read_bytes() == b"new" * 1000
    assert {path.name for path in tmp_path.iterdir()} == {"b.txt", "c.txt", ".mine.part"}


def test_a_folder_a_pipe_and_a_device_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name, what in (("folder", "a folder"), ("pipe", "a pipe"), ("/dev/null", "a device")):
        with pytest.raises(InputError, match=f"it is {what}"):
            write_atomically(tmp_path / name, b"")
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "pipe"}


def test_a_link_is_replaced_and_what_it_leads_to_stays(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "link").symlink_to("precious")
    write_atomically(tmp_path / "link", "new")
    assert (tmp_path / "precious").read_text() == "mine" and (tmp_path / "link").read_text() == "new"
    assert not (tmp_path / "link").is_symlink()


def test_names_as_long_as_a_folder_takes(tmp_path: Path) -> None:
    name = "n" * 255
    write_atomically(tmp_path / name, "whole")
    assert (tmp_path / name).read_text() == "whole"
    with pytest.raises(InputError, match="File name too long"):
        write_atomically(tmp_path / ("n" * 256), "")


def test_a_full_disk_leaves_the_file_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_atomically(tmp_path / "a", "old")

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(disk.os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_atomically(tmp_path / "a", "new")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a", "old")]


@pytest.mark.skipif(not os.path.exists("/proc/self/mem"), reason="takes Linux's files that cannot be read")
def test_what_is_no_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(1 << 41)
    for path, said in ((tmp_path / "pipe", "a pipe"), (Path("/dev/zero"), "a device"), (tmp_path / "huge", "2199"),
                       (tmp_path, "is a folder"), (tmp_path / "no", "does not exist"), (Path("/proc/self/mem"), "cannot be read"),
                       (Path("a\0b"), "no file has such a name")):  # fmt: skip
        with pytest.raises(InputError, match=said):
            read_bytes(path)
    with contextlib.closing((tmp_path / "some").open("wb")) as file:
        file.write(b"0123456789")
    assert read_bytes(tmp_path / "some", 4) == b"0123" and read_bytes(tmp_path / "huge", 4) == b"\0" * 4
