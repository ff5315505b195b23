"""What the tests of the CSV tables share."""

from pathlib import Path
from typing import Any

import numpy as np


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """All arrays of the file, which is closed again: an open one fails the test that the next collection falls into."""
    with np.load(path) as arrays:
        return dict(arrays)


def assert_same(a: Any, b: Any) -> None:
    """Equal records, numbers to the bit."""
    assert type(a) is type(b)
    fields = [key for key in vars(a) if key != "cam_from_world"]
    assert len(fields) >= 3
    for key in fields:
        x, y = getattr(a, key), getattr(b, key)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes(), key
        else:
            assert x == y, key
