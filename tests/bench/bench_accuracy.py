"""Residuals of published corners beside the best published fit that used every corner without a robust loss."""

import json
import os
import pathlib

import pytest
from timing import SMALL, print_table

from omnilines.calibration.single import calibrate_camera
from omnilines.files import read_corners

DATA = pathlib.Path(__file__).resolve().parents[3] / "shared" / "data" / "calibration"


def bench_published_corners() -> None:
    if not DATA.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"CI must have the shared data beside the project, at {DATA}; it is absent.")
        pytest.skip("the folder ../shared/data with published corners is absent")
    rows = []
    names = ("fisheye1",) if SMALL else ("fisheye1", "gopro", "kaidan")
    for name in names:
        reference = json.loads((DATA / name / "reference.json").read_text())
        width, height = reference["image_size"]
        best = reference["published"]["urban_subpix"]["rms_px_per_axis"]
        corners = read_corners(DATA / name / "corners.csv")
        ours = calibrate_camera(corners, (width, height), "scaramuzza", loss="none", options={"degree": 4}).rms_px_per_axis
        rows.append([name, f"{ours:.4f}", f"{best:.4f}"])
        assert ours <= best + 1e-3
    assert len(rows) == len(names)
    print_table("rms_px_per_axis, degree 4, every corner, no robust loss", ["corners", "ours", "best published"], rows)
