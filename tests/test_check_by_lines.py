"""Whether lines bear out a camera: true ones stay, wrong ones are refused, and noise is not that of the wrong one."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from drawn_chains import FISHEYE, OPTIONS, disturbed, level_chains, true_chains

import omnilines as ol
from camera_models import Calibration, CameraModel, GeometryError, InputError
from omnilines.calibration.lines.check import LineCheck, line_check
from omnilines.calibration.lines.scores import LineScores
from omnilines.geometry.chains import Chains
from omnilines.pages.check import check_summaries
from omnilines.pages.limits_of_lines import check_advice
from omnilines.pipelines import check as check_module
from omnilines.pipelines.check import CheckResult
from omnilines.pipelines.check_options import CheckOptions
from omnilines.pipelines.line_camera import adjusted_camera, asked_camera
from omnilines.pipelines.line_options import LinesOptions
from omnilines.pipelines.line_scale import asked_by_lines
from omnilines.structure.options import DirectionsOptions


@pytest.mark.slow
def test_scores_add_up_to_nothing_at_the_minimum_and_photos_to_all() -> None:
    done = adjusted_camera(FISHEYE, true_chains(FISHEYE, 3))
    scores = LineScores.of(done.problem, done.state)
    unit = scores.score_covariance.diagonal().sqrt()
    assert float((scores.total / unit).abs().max()) < 1e-2
    whole = scores.photo_information(done.problem, done.state).sum(0) + scores.known_before
    torch.testing.assert_close(whole, scores.camera_information, rtol=1e-6, atol=1e-6 * float(whole.abs().max()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "refused"),
    [
        ({}, False),
        ({"fx": 1.15, "fy": 1.15}, True),
        pytest.param({"cx": 3.0}, True, marks=pytest.mark.full),
        pytest.param({"cy": -3.0}, True, marks=pytest.mark.full),
    ],
)
def test_check_refuses_what_is_off_and_nothing_else(changes: dict[str, float], refused: bool) -> None:
    chains, model = true_chains(FISHEYE, 1, photos=8), disturbed(FISHEYE, **changes)
    asked = asked_camera(model, chains, OPTIONS, DirectionsOptions())
    found = line_check(model, asked, None, significance=0.001)
    assert found.refused(0.001, 0.1) is refused
    assert (found.least_drift_px > 0.0) is (found.probability < 0.001)
    assert found.least_drift_px <= math.hypot(found.drift_px, found.sigma_px) * (1 + 1e-9)
    assert found.freedom == 8
    assert all(one.least_px <= one.drift_px * (1 + 1e-9) for one in found.regions)
    assert any(one.least_px > 0.0 for one in found.regions) is refused
    # A camera that is known no better than that is not contradicted.
    wide = torch.diag(torch.tensor([20.0, 20.0, 20.0, 20.0, 0.1, 0.1, 0.1, 0.1], dtype=torch.float64).square())
    assert not line_check(model, asked, wide, significance=0.001).refused(0.001, 0.1)


def checked(model: CameraModel, chains: Chains) -> LineCheck:
    """By chains alone."""
    return line_check(model, asked_camera(model, chains, OPTIONS, DirectionsOptions()), None, significance=0.001)


@pytest.mark.slow
def test_what_a_wrong_camera_makes_of_lines_is_not_taken_for_their_noise() -> None:
    """A focal length off by half a percent: lines do not meet by many times their noise; what they ask for is as certain as under
    the right camera, within a factor of two."""
    chains, off = true_chains(FISHEYE, 1), np.array([1.15, 1.154])
    right, wrong = checked(FISHEYE, chains), checked(disturbed(FISHEYE, fx=1.15, fy=1.154), chains)
    assert wrong.sigma_px < 2.0 * right.sigma_px
    assert (np.abs(wrong.change[:2] + off) < 4.0 * wrong.change_sigma[:2]).all()
    assert (off > 5.0 * wrong.change_sigma[:2]).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in range(1, 6))])
def test_walls_that_do_not_meet_at_right_angles_do_not_refuse_the_right_camera(seed: int) -> None:
    """Walls at 88 degrees are taken for right ones in each photo."""
    asked, notes = asked_by_lines(FISHEYE, level_chains(FISHEYE, seed, 88.0), LinesOptions())
    found = line_check(FISHEYE, asked, None, significance=0.001)
    assert found.probability > 0.001 and not found.frames and "Right angles are not used" in notes[0]


@pytest.mark.slow
def test_right_angles_refuse_a_camera_at_another_scale() -> None:
    chains = level_chains(FISHEYE, 0, 90.0)
    right, notes = asked_by_lines(FISHEYE, chains, LinesOptions())
    wrong, also = asked_by_lines(disturbed(FISHEYE, fx=2.3, fy=2.308), chains, LinesOptions())
    assert right.families.frames and wrong.families.frames and not notes and not also
    assert line_check(FISHEYE, right, None, significance=0.001).probability > 0.001
    off = disturbed(FISHEYE, fx=2.3, fy=2.308)
    assert line_check(off, wrong, None, significance=0.001).refused(0.001, 0.1)


@pytest.mark.full
def test_the_right_camera_is_refused_no_more_often_than_stated() -> None:
    """Of 100 sets of few edges: probabilities are not smaller than even ones (Kolmogorov and Smirnov, once in 1e4)."""
    found = np.sort([checked(FISHEYE, true_chains(FISHEYE, 100 + seed, photos=4)).probability for seed in range(100)])
    assert float((np.arange(1, 101) / 100 - found).max()) < 0.21 and int((found < 0.01).sum()) <= 5


@pytest.mark.full
def test_photos_as_cameras_save_them_tell_a_focal_length_that_is_off_by_half_a_percent() -> None:
    """JPEG of quality 75, which makes edges err by several times as much, and alike over many pixels: 0.7 px is then
    four to seven times the noise of the drift."""
    for seed in range(201, 207):
        made = ol.render("room", "opencv-fisheye", fov_deg=190.0, views=10, size_px=(640, 480), seed=seed)
        photos = {}
        for name in made.photos:
            saved = cv2.imencode(".jpg", np.asarray(made.photos[name]), [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
            photos[name] = cv2.imdecode(saved, cv2.IMREAD_COLOR)
        value = made.camera.named_parameters()
        off = disturbed(made.camera, fx=0.005 * value["fx"], fy=0.005 * value["fy"])
        right, wrong = ol.check(photos, made.camera), ol.check(photos, off)
        assert right.holds and right.found.probability > 0.01
        assert repr(right) == f"CheckResult(holds=True, photos=10, {right.verdict!r})"
        assert not wrong.holds and wrong.found.sigma_px < 2.0 * right.found.sigma_px


@pytest.mark.full
def test_photos_that_tell_nothing_bear_nothing_out(shared_data: Path) -> None:
    """Five streets, by a focal length of which they leave all open: no verdict, in place of "right, to 9000 px"."""
    york = shared_data / "lines" / "york"
    photos = sorted((york / "images").iterdir())[9:14]
    with pytest.raises(GeometryError, match=r"projects to 8 px were expected, found that they leave \d+ px open"):
        ol.check([str(photo) for photo in photos], ol.load(york / "calibration.yaml"))


def test_of_a_rig_the_camera_is_checked_whose_folder_the_photos_lie_in(monkeypatch: pytest.MonkeyPatch) -> None:
    other = FISHEYE.with_parameters(1.01 * FISHEYE.parameters)
    rig = Calibration({"left": FISHEYE, "right": other})
    dark = np.zeros((*FISHEYE.image_size[::-1], 3), dtype=np.uint8)
    asked = []

    def stop(_: object, model: object, *__: object, **___: object) -> None:
        asked.append(model)
        raise GeometryError("no edges")

    monkeypatch.setattr(check_module, "arc_chains_of", stop)
    with pytest.raises(GeometryError, match="no edges"):
        ol.check({"right/1.png": dark}, rig)
    assert asked == [other]
    with pytest.raises(InputError, match="Photos of one camera were expected, found those of left, right"):
        ol.check({"left/1.png": dark, "right/1.png": dark}, rig)
    with pytest.raises(InputError, match="one of the cameras left, right"):
        ol.check({"1.png": dark}, rig)


@pytest.mark.slow
def test_a_drift_is_not_said_to_be_less_than_it_is_at_least() -> None:
    found = checked(FISHEYE, true_chains(FISHEYE, 1, photos=4))
    some = replace(found, drift_px=0.0, least_drift_px=0.4862, sigma_px=1.734)
    wrong = CheckResult(some, False, CheckOptions(), ("a.png",), (), {})
    sure = "over the image (root mean square) it is off by at least 0.49 px with 99.9 percent confidence"
    only = f"{sure} (how much more, these photos tell to 1.7 px only); 0.1 px are allowed (probability"
    assert only in wrong.verdict
    hidden = CheckResult(replace(some, drift_px=0.91), False, CheckOptions(), ("a.png",), (), {})
    assert only in hidden.verdict and "0.91" not in hidden.verdict
    clear = CheckResult(replace(some, drift_px=0.91, sigma_px=0.04), False, CheckOptions(), ("a.png",), (), {})
    assert f"{sure}, most likely by 0.91 px (known to 0.04 px); 0.1 px are allowed" in clear.verdict


def test_what_chance_does_not_leave_open_refuses_a_camera_of_which_lines_tell_little() -> None:
    found = checked(FISHEYE, true_chains(FISHEYE, 1, photos=4))
    little = replace(found, drift_px=25000.0, least_drift_px=0.25, sigma_px=6300.0)
    wrong = CheckResult(little, False, CheckOptions(), ("a.png",), (), {})
    assert wrong.hardly_known and "25000" not in wrong.verdict
    assert "it is off by at least 0.25 px with 99.9 percent confidence (how much more, these photos leave open)" in wrong.verdict
    told = dict(check_summaries(wrong)[0].rows)
    assert told["most likely off by, beyond noise"] == "open" and told["off by at least"].startswith("0.25 px")
    assert check_advice(wrong)[0].limit.startswith("The parameter ")
    assert not CheckResult(found, True, CheckOptions(), ("a.png",), (), {}).hardly_known
