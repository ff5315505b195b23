"""Options of calibrations and adjustments: each is found by its name and sentence, and decides what it says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from board_views import board_corners, board_views

import omnilines as ol
from calib_patterns import DetectionOptions
from camera_models import InputError, OpenCVFisheye
from omnilines.adjustment.noise import Noise, fitting
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.adjustment.scene import reconstruct_lines
from omnilines.calibration.duplicates import duplicate_views
from omnilines.calibration.options import CalibrationOptions
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.thresholds import CalibrationThresholds, NoiseThresholds, StartThresholds, ViewThresholds
from omnilines.footage.options import FrameOptions
from omnilines.options import require_ranges, walk, with_settings
from omnilines.synthetic.lines import circle_world

SIZE = (1280, 960)
LENS = OpenCVFisheye([400.0, 401.0, 640.0, 480.0, 0.02, -0.005, 0.0, 0.0], SIZE)


def calibrated(*settings: str) -> CameraCalibration:
    corners = board_corners(LENS, board_views(LENS, 80, 10, 2), 0.2, 1)
    return calibrate_camera(corners, SIZE, "opencv-fisheye", thresholds=with_settings(CalibrationThresholds(), settings))


def test_every_threshold_has_a_sentence_and_is_an_option_of_a_calibration() -> None:
    options, thresholds = list(walk(CalibrationOptions())), list(walk(CalibrationThresholds()))
    assert len(thresholds) > 30 and all(threshold in options for threshold in thresholds)
    assert all(sentence.endswith(".") for _, _, sentence in (*options, *walk(AdjustmentOptions())))
    assert len(list(walk(AdjustmentOptions()))) == 5


@pytest.mark.slow
def test_thresholds_decide_a_calibration() -> None:
    usual, strict = calibrated(), calibrated("robust.reject_sigma=2.5")
    assert usual.kept.sum() > 0.99 * len(usual.kept) > strict.kept.sum() + 0.02 * len(usual.kept)
    assert any("2.5 robust standard deviations" in note for note in strict.notes)
    with pytest.raises(InputError, match="needs at least 20, found 10"):
        calibrated("views.least_views=20")
    assert any("hangs on view" in note for note in calibrated("views.leverage_share=0.05").notes)
    assert any("tilted about one axis" in note for note in calibrated("degeneracy.one_axis_deg=89").notes)
    assert not any("hangs on" in note or "one axis" in note for note in usual.notes)


def test_thresholds_decide_what_is_a_duplicate() -> None:
    corners = board_corners(LENS, board_views(LENS, 80, 3, 2), 0.0, 1)
    pixels = corners.pixels.copy()
    pixels[corners.view == 2] = pixels[corners.view == 0] + 0.05
    alike = replace(corners, pixels=pixels)
    assert duplicate_views(alike, 0.0) == [(0, 2)]
    stricter = with_settings(CalibrationThresholds(), ["duplicates.least_tolerance_px=0.02"]).duplicates
    assert duplicate_views(alike, 0.0, stricter) == []
    assert duplicate_views(alike, 0.0, stricter._replace(noise_factor=10.0)) == []
    assert duplicate_views(alike, 0.01, stricter._replace(noise_factor=10.0)) == [(0, 2)]


def test_options_decide_an_adjustment() -> None:
    world = circle_world("wide", 0)
    given = (world.segments(0.5, 0), world.poses(), {"cam0": world.camera})
    usual = reconstruct_lines(*given, loss="cauchy")
    assert set(usual.lines.status) == {"ok"}
    weak = reconstruct_lines(*given, loss="cauchy", options=AdjustmentOptions(weak_share=1e-9))
    assert set(weak.lines.status) == {"weak"}
    wide = reconstruct_lines(*given, loss="cauchy", options=AdjustmentOptions(loss_scale=50.0))
    plain = reconstruct_lines(*given)
    assert abs(wide.adjusted.cost / plain.adjusted.cost - 1) < 0.02 < abs(usual.adjusted.cost / plain.adjusted.cost - 1)
    few = reconstruct_lines(*given, options=AdjustmentOptions(significance=1e-12))
    many = reconstruct_lines(*given, options=AdjustmentOptions(significance=0.5))
    assert len(few.suspect) == 0 < len(many.suspect)


def test_the_significance_is_that_of_chi_square() -> None:
    """Arcs of unit noise stand out as rarely as it says, and stated noise holds up to it."""
    whitened = torch.randn(200_000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for significance in (1e-1, 1e-2, 1e-3):
        out = float((~fitting(whitened, 0.0, 1.0, significance)).to(torch.float64).mean())
        assert 0.6 * significance < out < 1.2 * significance
    assert Noise(1.3, 40.0, True, 1e-3).holds and not Noise(1.3, 40.0, True, 1e-1).holds


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            CalibrationOptions(views=ViewThresholds(least_views=-3)),
            "views.least_views was expected to be a number from 1",
        ),
        (CalibrationOptions(noise=NoiseThresholds(significance=-1.0)), "noise.significance was expected"),
        (CalibrationOptions(searches=100_000), "searches was expected to be a number from 0 to 100, found 100000"),
        (CalibrationOptions(start=StartThresholds(half_angles_deg=(25.0, -400.0))), "start.half_angles_deg .* found -400"),
    ],
)
def test_options_made_in_python_have_the_ranges_of_those_set_by_name(options: CalibrationOptions, said: str) -> None:
    """They went on to calibrations without a result or without an end, or were used as they were."""
    corners = board_corners(LENS, board_views(LENS, 80, 10, 2), 0.2, 1)
    with pytest.raises(InputError, match=said):
        ol.calibrate(corners, image_size=SIZE, options=options)
    count = len(corners.view_names)
    several = replace(corners, cameras=("cam0",) * count, frames=corners.view_names)
    with pytest.raises(InputError, match=said):
        ol.calibrate_rig(several, SIZE, options)


def test_names_have_no_range() -> None:
    require_ranges(CalibrationOptions(refine_board=("surface",), model="pinhole", degree=None, coefficients=8))


def test_options_of_detection_have_ranges_too() -> None:
    photos = {"0.png": np.zeros((480, 640), dtype=np.uint8)}
    wrong = DetectionOptions(min_corners=-1)
    for look in (ol.detect, ol.detect_rig):
        with pytest.raises(InputError, match="min_corners was expected to be a number from 1"):
            look(photos, "checkerboard:8x6:30mm", options=wrong)
    with pytest.raises(InputError, match="min_corners was expected to be a number from 1"):
        ol.calibrate(photos, "checkerboard:8x6:30mm", detection=wrong)


def test_runs_of_one_video_may_be_none() -> None:
    """As the sentence of the option says."""
    assert with_settings(FrameOptions(), ["max_moving_runs=0"]).max_moving_runs == 0
