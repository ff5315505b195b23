"""Whatever finite numbers a camera has: no crash in compiled code, no number that is none, no end of time and memory."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import wild_cameras

from omnilines.extraction.bearings import FARTHEST_PX, bearings_at, pixels_at

MEMORY_BYTES = 4 * 1024**3


def look(seed: int, count: int) -> None:
    """Run `wild_cameras` in a process with a limit."""
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, wild_cameras.__file__, str(seed), str(count)],
        capture_output=True,
        text=True,
        timeout=3600,
        check=False,
        env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES)),
    )
    assert done.returncode == 0 and done.stdout.endswith("done\n"), (done.returncode, done.stdout[-500:], done.stderr[-2000:])


@pytest.mark.slow
def test_wild_cameras() -> None:
    look(0, 6)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(1, 6))
def test_many_wild_cameras(seed: int) -> None:
    look(seed, 100)


@pytest.mark.parametrize("model", wild_cameras.KNOWN, ids=("k4", "k5", "k1"))
def test_places_and_bearings_are_finite(model) -> None:
    rng = np.random.default_rng(0)
    rays = rng.standard_normal((2000, 3))
    pixels, _ = pixels_at(model, rays)
    assert np.abs(pixels).max() <= FARTHEST_PX
    bearings, _ = bearings_at(model, rng.uniform(-1e3, 1e3, (2000, 2)))
    assert np.isfinite(bearings).all()
