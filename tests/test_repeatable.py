"""Every process finds the same, to the last bit."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from camera_models.repeatable import total
from omnilines.commands.render_scene import render_scene

FITS = """
import numpy as np, torch
from camera_models.repeatable import least_squares
random = np.random.default_rng(0)
for n, p in ((711, 4), (100, 8), (401, 6), (350, 6)):
    matrix = torch.tensor(np.vander(random.uniform(size=n), p))
    print(least_squares(matrix, torch.tensor(random.normal(size=(n, 1)))).numpy().tobytes().hex())
"""


@pytest.mark.slow
def test_least_squares_end_alike_in_every_process():
    said = {subprocess.run([sys.executable, "-c", FITS], capture_output=True, text=True, check=True).stdout for _ in range(4)}
    assert len(said) == 1 and len(said.pop().split()) == 4


ARCS = """
import sys
import omnilines as ol
arcs = ol.extract(sys.argv[1], ol.load(sys.argv[1] + "/calibration.yaml"))
print(b"".join(photo.endpoints_px.tobytes() + photo.covariance_px2.tobytes() for photo in arcs.photos).hex())
"""


@pytest.mark.full
def test_arcs_are_the_same_whether_functions_are_compiled_or_loaded(tmp_path: Path) -> None:
    render_scene(tmp_path / "room", scene="plain-room", views=3, size=(320, 240))
    kept = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "compiled")}
    command = [sys.executable, "-c", ARCS, str(tmp_path / "room")]
    first, second = (subprocess.run(command, env=kept, capture_output=True, text=True, check=True).stdout for _ in range(2))
    assert len(first) > 10_000 and first == second
    assert list((tmp_path / "compiled").rglob("*.nbc"))


def test_sums_are_right_and_the_same_on_any_number_of_threads() -> None:
    values = torch.randn(500_000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).exp()
    threads, found = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            found.append(total(values))
    finally:
        torch.set_num_threads(threads)
    assert len(set(found)) == 1
    assert abs(found[0] / math.fsum(values.flatten().tolist()) - 1) < 1e-14


def test_infinite_values_of_both_signs_add_up_to_nan_without_a_word() -> None:
    """Of what observations leave open; a warning is an error in tests."""
    assert math.isnan(total(torch.tensor([math.inf, 1.0, -math.inf], dtype=torch.float64)))
