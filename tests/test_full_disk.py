"""Full disks, quotas, folders that cannot be written to: one sentence, and what was there stays whole."""

import contextlib
import errno
import os
import resource
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hostile.case import contents
from hostile.good import give

from camera_models.formats import disk
from omnilines import cli
from omnilines.files.sets import claimed

SCENE = ("--calibration", "IN/calibration.yaml", "--poses", "IN/poses.csv", "--segments", "IN/segments.csv", "--out", "OUT")
RECTIFY = ("rectify", "IN/photos", "--calibration", "IN/calibration.yaml", "--out", "OUT")
SMALL = ("--size", "64x48")
RUNS = {
    "adjust": (("adjust", *SCENE), ("adjust", *SCENE, "--cost", "sector")),
    "rectify": ((*RECTIFY, "--view", "cube", "--size", "64x64"), (*RECTIFY, *SMALL, "--poses", "IN/poses.csv")),
    "pattern": (("pattern", "checkerboard:4x3:30mm", "--out", "OUT"), ("pattern", "checkerboard:4x3:30mm", "--out", "OUT")),
}
"""Command -> the run of before, the run that the disk has no room for."""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    give("omnilines", "poses.csv", "segments.csv", "photos")(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str) -> int:
    """The exit status of a command."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    return int(ended.value.code or 0)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a command says that is refused."""
    capsys.readouterr()
    status, said = run(*arguments), capsys.readouterr()
    assert status == 2 and said.out == "" and said.err.strip().startswith("omnilines: "), said
    assert len(said.err.strip().splitlines()) == 1, said
    return said.err


@pytest.mark.parametrize(
    ("name", "number"),
    [pytest.param("adjust", errno.ENOSPC, marks=pytest.mark.full), ("rectify", errno.EDQUOT), ("pattern", errno.ENOSPC)],
)
@pytest.mark.slow
def test_whatever_file_finds_no_room_the_old_results_stay(
    name: str, number: int, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before, command = RUNS[name]
    assert run(*before) == 0
    old = contents(home)
    files = 0
    while True:
        count = iter(range(1000))

        def moment(when: str, path: Path, count: Iterator[int] = count, last: int = files) -> None:
            if when == "inside" and next(count) == last:
                raise OSError(number, os.strerror(number), str(path))

        monkeypatch.setattr(disk, "moment", moment)
        capsys.readouterr()
        if run(*command) == 0:
            break
        assert os.strerror(number) in capsys.readouterr().err
        assert contents(home) == old
        files += 1
    # All files, and the list of them.
    assert files == {"adjust": 8, "rectify": 9, "pattern": 3}[name]


@contextlib.contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """No file of this process grows larger."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.slow
def test_a_limit_on_the_size_of_files_leaves_the_old_results(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, command = RUNS["adjust"]
    # What the other command compiles is kept in files too, and these are larger.
    assert run(*command) == 0 and run(*before) == 0
    old = contents(home)
    with file_size_limit(100_000):  # the report is larger
        assert "report.html cannot be written (File too large)" in refused(capsys, *command)
    assert contents(home) == old


@contextlib.contextmanager
def mounted(folder: Path, *options: str) -> Iterator[None]:
    """Within it a small file system lies there, where this process may mount one."""
    done = subprocess.run(["mount", "-t", "tmpfs", *options, "tmpfs", folder], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"file systems cannot be mounted here: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


def test_a_full_file_system_leaves_the_old_results(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Room for the photos but not for the cubes too, and for no file at all."""
    (home / "OUT").mkdir()
    with mounted(home / "OUT", "-o", "size=256k"):
        assert run(*RECTIFY, *SMALL) == 0
        old = contents(home)
        assert "No space left on device" in refused(capsys, *RECTIFY, "--view", "cube", "--size", "400x400")
        assert contents(home) == old
        with contextlib.suppress(OSError), (home / "OUT/filler").open("wb", buffering=0) as file:
            while True:
                file.write(b"\0" * 4096)
        old = contents(home)
        assert "No space left on device" in refused(capsys, *RECTIFY, *SMALL, "--fov-deg", "80")
        assert contents(home) == old


def test_a_read_only_file_system_is_named_before_any_work(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "OUT").mkdir()
    with mounted(home / "OUT", "-o", "ro"):
        for _, command in RUNS.values():
            assert "cannot be written to" in refused(capsys, *command)


def as_another_user(work: Callable[[], str]) -> str:
    """What a function returns in a process of a user without rights."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        said = "failed"
        try:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
            said = work()
        finally:
            os.write(writer, said.encode())
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as stream:
        said = stream.read()
    os.waitpid(child, 0)
    return said


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root becomes another user")
@pytest.mark.parametrize("what", ["the folder", "a sub-folder"])
def test_a_folder_of_another_user_is_named_and_nothing_is_changed(what: str, tmp_path: Path) -> None:
    for parent in tmp_path.parents[:-2]:
        parent.chmod(parent.stat().st_mode | 0o111)
    out = tmp_path / "out"
    with claimed(out, ["a.csv", "sub/b.csv"], by="test") as folder:
        for name in ("a.csv", "sub/b.csv"):
            disk.write_atomically(folder / name, "old")
    for path in (tmp_path, out):
        path.chmod(0o777)
    (out if what == "the folder" else out / "sub").chmod(0o755)
    old = contents(out)

    def work() -> str:
        """Write the same files."""
        try:
            with claimed(out, ["a.csv", "sub/b.csv"], by="test") as folder:
                disk.write_atomically(folder / "a.csv", "new")
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        return "written"

    said = as_another_user(work)
    assert said.startswith("InputError") and "can" in said and ("sub" in said) == (what == "a sub-folder"), said
    assert contents(out) == old
