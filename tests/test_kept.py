"""What a run keeps for the next one."""

import gc
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from omnilines.files.kept import read_kept, write_kept

ARRAYS = {f"array{k}": np.full((3, 4), float(k)) for k in range(6)}


@pytest.fixture
def threads_meet() -> Iterator[None]:
    """Threads give way at every chance, and Python code runs while objects are made: CPython's parser was not ready for it."""

    def give_way(phase: str, found: dict[str, int]) -> None:
        for _ in range(300):
            pass

    interval, threshold = sys.getswitchinterval(), gc.get_threshold()
    gc.callbacks.append(give_way)
    sys.setswitchinterval(1e-6)
    gc.set_threshold(3)
    try:
        yield
    finally:
        gc.set_threshold(*threshold)
        sys.setswitchinterval(interval)
        gc.callbacks.remove(give_way)


def test_threads_read_at_once(tmp_path: Path, threads_meet: None) -> None:
    """3000 reads by four threads of Python 3.11.7 raised SystemError 20 times (github.com/python/cpython/issues/106905)."""
    path = tmp_path / "kept.npz"
    write_kept(path, "inputs", ARRAYS)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: read_kept(path, "inputs"), range(1000)))
    assert all(one is not None and one.keys() == ARRAYS.keys() for one in found)
    assert all(np.array_equal(one[name], array) for one in found if one is not None for name, array in ARRAYS.items())


def test_what_is_cut_changed_or_of_other_inputs_is_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "kept.npz"
    assert read_kept(path, "inputs") is None
    write_kept(path, "inputs", ARRAYS)
    content = path.read_bytes()
    assert read_kept(path, "others") is None
    for damaged in (b"", content[:20], content[:-1], content[:100] + b"x" + content[101:]):
        path.write_bytes(damaged)
        assert read_kept(path, "inputs") is None
