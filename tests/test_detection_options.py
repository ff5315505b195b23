"""What decides detection: every option is named, said, and reaches the code that it decides."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import calib_patterns
import omnilines as ol
from calib_patterns import Detection, DetectionOptions, pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.guided_part import guided_search_of_part
from calib_patterns.rendering import render_target
from calib_patterns.tangent_views import detect_in_views
from camera_models import InputError, OpenCVFisheye
from camera_models.pose import Pose
from omnilines.options import walk, with_settings

LENS = OpenCVFisheye([160.0, 160.0, 319.5, 239.5, 0.01, -0.003, 0.0, 0.0], (640, 480))
PLAIN, TAGS = "checkerboard:8x5:30mm", "aprilgrid:3x3:60mm:0.3:36h11"


@lru_cache(maxsize=2)
def view(specification: str) -> tuple[np.ndarray, Pose]:
    board = pattern(specification)
    pose = random_board_poses(board, LENS, 1, 0.9, min_spacing_px=8.0, seed=3)[0]
    return render_target(board, LENS, pose, blur_px=0.6, noise_grey=2.0, seed=1), pose


def detected(specification: str, *settings: str, options: DetectionOptions = DetectionOptions()) -> Detection:
    return pattern(specification).detect(view(specification)[0], options=with_settings(options, settings))[0]


def test_every_option_has_a_sentence_and_the_options_are_a_key() -> None:
    options = list(walk(DetectionOptions()))
    assert len(options) > 50 and all(sentence.endswith(".") for _, _, sentence in options)
    assert hash(DetectionOptions()) == hash(DetectionOptions()) and DetectionOptions() == DetectionOptions()
    with pytest.raises(AttributeError):
        DetectionOptions().min_corners = 3  # type: ignore[misc]


@pytest.mark.parametrize(
    ("specification", "setting"),
    [
        (PLAIN, "corners.min_clearness=1000"),
        (PLAIN, "fit.max_sigma_px=0.0001"),
        (PLAIN, "saddles.min_response=1e9"),
        (TAGS, "growth.max_sigma_squares=0.0001"),
        (TAGS, "tags.min_likeness=1"),
        (TAGS, "corners.min_clearness=1000"),
    ],
)
def test_what_asks_for_too_much_finds_nothing(specification: str, setting: str) -> None:
    whole = len(pattern(specification).points_m)
    # The classic detector does without saddle points, and its grids are judged as a whole: here none is good enough.
    usual = DetectionOptions()
    without = replace(usual, grid=usual.grid._replace(min_good_share=2.0))
    assert len(detected(specification)) == len(detected(specification, options=without)) == whole
    assert len(detected(specification, setting, "appearance.min_correlation=2", options=without)) == 0


@pytest.mark.parametrize("specification", [PLAIN, TAGS])
def test_what_is_fitted_otherwise_lies_elsewhere_by_less_than_it_is_certain(specification: str) -> None:
    usual, narrow = detected(specification), detected(specification, "fit.window_squares=0.34", "fit.window_gap_share=0.5")
    np.testing.assert_array_equal(usual.ids, narrow.ids)
    off = np.linalg.norm(usual.pixels - narrow.pixels, axis=1)
    assert 0 < off.max() < 6.0 * narrow.sigma_px.max()


def test_guided_search_and_views_take_options_too() -> None:
    image, pose = view(PLAIN)
    board, found = pattern(PLAIN), detected(PLAIN)
    part = Detection(found.ids[:20], found.pixels[:20], found.sigma_px[:20])
    assert len(guided_search_of_part(image, board, LENS, pose, part).detection) == 40
    nowhere = with_settings(DetectionOptions(), ["guided.certain_px=0", "guided.certain_squares=0"])
    assert len(guided_search_of_part(image, board, LENS, pose, part, nowhere).detection) == 20
    assert len(detect_in_views(image, board, LENS)) == 40
    assert len(detect_in_views(image, board, LENS, options=DetectionOptions(min_corners=41))) == 0


def test_the_verb_keeps_its_options_for_what_the_camera_leads_to() -> None:
    options = with_settings(DetectionOptions(), ["sharpness.min_photos=2"])
    found = ol.detect({"one": view(PLAIN)[0]}, PLAIN, camera=LENS, options=options)
    assert found.options == options and len(found.corners.pixels) == 40
    with pytest.raises(InputError, match="found in none"):
        ol.detect({"one": view(PLAIN)[0]}, PLAIN, options=with_settings(options, ["search.side_px=24"]))


def test_the_package_says_what_it_exports() -> None:
    assert set(calib_patterns.__all__) == set(dir(calib_patterns))
    for name in calib_patterns.__all__:
        assert getattr(calib_patterns, name) is not None
    with pytest.raises(AttributeError, match="nothing_of_it"):
        calib_patterns.nothing_of_it  # noqa: B018
