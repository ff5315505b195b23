"""What the tests of the CSV tables share."""

from typing import Any

import numpy as np


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
