"""A 360 degree camera from photos of a board: two lenses back to back that overlap only in a rim, their images in one file."""

import math
from pathlib import Path

import numpy as np
import pytest
from pair_360 import BOARDS, NAMES, mounts, write_boards
from rig_views import twin_lenses

from camera_models import CameraModel, load
from omnilines.cli import main


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def check_truth(out: Path, models: tuple[CameraModel, ...], most_px: float, most_deg: float, most_mm: float) -> None:
    """Where the lenses see what is up to 98 degrees off axis, and where the second stands."""
    found = load(out / "calibration.yaml")
    assert tuple(found.rig) == NAMES
    off = (found.rig["right"].cam_from_rig @ mounts()[1].inverse()).log()
    turned_deg, moved_mm = math.degrees(float(off[:3].norm())), 1e3 * float(off[3:].norm())
    theta, phi = np.meshgrid(np.radians(np.arange(2.0, 99.0, 4.0)), np.radians(np.arange(0.0, 360.0, 15.0)))
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    away_px = [
        np.linalg.norm(found[name].project(rays)[0] - truth.project(rays)[0], axis=-1).max()
        for name, truth in zip(NAMES, models, strict=True)
    ]
    print(f"largest error {max(away_px):.3f} px; turned by {turned_deg:.4f} degrees, moved by {moved_mm:.3f} mm")
    assert max(away_px) < most_px and turned_deg < most_deg and moved_mm < most_mm


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side_px", "frames", "limits"),
    [(400, 10, (0.2, 0.04, 0.15)), pytest.param(640, 40, (0.1, 0.02, 0.08), marks=pytest.mark.full)],
)
def test_both_lenses_are_calibrated_from_photos_that_hold_both(
    tmp_path: Path, side_px: int, frames: int, limits: tuple[float, float, float]
) -> None:
    models = twin_lenses("double-sphere", side_px)
    write_boards(tmp_path / "both", models, frames)
    out = tmp_path / "rig"
    given = ["calibrate", tmp_path / "both", "--split", ",".join(NAMES), "--pattern", BOARDS]
    assert run(*given, "--model", "double-sphere", "--out", out) == 0
    check_truth(out, models, *limits)
