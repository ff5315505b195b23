"""What a container leaves of a machine: cores and memory."""

import os
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
