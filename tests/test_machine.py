"""What a container leaves of a machine: cores and memory."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from omnilines import machine
from omnilines.files import PhotoArray, PhotoRef, photos, photos_at_once


def test_available_memory_is_that_of_the_machine() -> None:
    found = machine.available_bytes()
    assert found is None or 1e7 < found < 1e15


def test_a_control_group_limits_memory_and_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(12)), raising=False)
    free = machine.available_bytes()
    assert machine.cores() == 12
    for said, expected in (("max 100000", 12), ("150000 100000", 2), ("20000 100000", 1), ("2000000 100000", 12), ("", 12)):
        (tmp_path / "cpu.max").write_text(said + "\n")
        assert machine.cores() == expected
    (tmp_path / "memory.current").write_text("1000000\n")
    (tmp_path / "memory.max").write_text("51000000\n")
    assert machine.available_bytes() == 50_000_000
    (tmp_path / "memory.max").write_text("500\n")
    assert machine.available_bytes() == 0
    (tmp_path / "memory.max").write_text("max\n")
    assert free is None or machine.available_bytes() > 50_000_000


def test_photos_at_a_time_are_as_many_as_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    large = PhotoArray("a.png", np.zeros((1000, 2000), np.uint8))
    photos.write_png(tmp_path / "b.png", np.zeros((500, 1000), np.uint8))
    small = PhotoRef(tmp_path / "b.png", "b.png")
    monkeypatch.setattr(photos, "available_bytes", lambda: 2_000_000_000)
    assert photos_at_once([small], 100) == 20 and photos_at_once([small, large], 100) == 5
    assert photos_at_once([large], 10**6) == 1
    monkeypatch.setattr(photos, "available_bytes", lambda: None)
    assert photos_at_once([small, large], 100) == 2


TOLD = (
    "import sys; from omnilines.cli import main\n"
    "try: main(sys.argv[1:] + ['pattern', 'checkerboard:4x3:30mm', '--out', 'p.pdf'])\n"
    "except SystemExit as end: assert not end.code, end.code\n"
    "import cv2, os, torch; from omnilines.machine import POOLS, cores\n"
    "print(cores(), torch.get_num_threads(), cv2.getNumThreads(), *{os.environ[name] for name in POOLS})"
)


@pytest.mark.slow
@pytest.mark.parametrize("given", [pytest.param(("--threads", "1"), marks=pytest.mark.full), ("--threads", "2")], ids=" ".join)
def test_torch_opencv_and_linear_algebra_use_as_many_threads_as_we(given: tuple[str, str], tmp_path: Path) -> None:
    wanted = min(int(given[1]), machine.cores())
    env = {name: value for name, value in os.environ.items() if name not in (*machine.POOLS, machine.THREADS)}
    done = subprocess.run([sys.executable, "-c", TOLD, *given], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == " ".join(4 * [str(wanted)])


def test_numbers_that_the_user_has_set_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*machine.POOLS, machine.THREADS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setenv(machine.WAITING, "ACTIVE")
    machine.agree_on_threads()
    assert os.environ["OMP_NUM_THREADS"] == "3" and machine.POOLS[1] not in os.environ
    assert os.environ[machine.WAITING] == "ACTIVE"
    monkeypatch.delenv(machine.WAITING)
    machine.agree_on_threads()
    assert os.environ[machine.WAITING] == "PASSIVE"
    monkeypatch.setenv(machine.THREADS, "1")
    assert machine.cores() == 1


def test_a_quota_is_told_to_the_pools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*machine.POOLS, machine.THREADS):
        monkeypatch.setenv(name, "")
    monkeypatch.setattr(machine, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)), raising=False)
    machine.agree_on_threads()
    assert not os.environ[machine.POOLS[0]]
    (tmp_path / "cpu.max").write_text("400000 100000\n")
    machine.agree_on_threads()
    assert {os.environ[name] for name in machine.POOLS} == {"4"}
