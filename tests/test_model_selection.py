"""The choice of a camera model by held-out views: on lenses whose model is known, and on published corners."""

import json

import numpy as np
import pytest
import torch
from board_views import board_corners, board_views
from ov_plane import IMAGE_SIZE, read_split

from camera_models import DoubleSphere, InputError, OpenCVFisheye, Pinhole, Scaramuzza
from omnilines.calibration.select import Candidate, all_candidates, fit_boards, grows_beyond, select_model
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.views import board_points
from omnilines.files import read_corners

SIZE = (1280, 960)
FEW = (
    Candidate("opencv-fisheye", {}),
    Candidate("scaramuzza", {"degree": 3}),
    Candidate("scaramuzza", {"degree": 4}),
    Candidate("double-sphere", {}),
)


def test_every_model_that_can_be_calibrated_is_a_candidate():
    labels = [candidate.label for candidate in all_candidates()]
    assert "scaramuzza degree 4" in labels and "pinhole coefficients 5" in labels and "double-sphere" in labels
    assert not any("equirectangular" in label for label in labels)
    assert len(set(labels)) == len(labels)


def test_the_model_of_the_lens_is_taken_or_one_as_good_with_fewer_parameters():
    """A lens of each kind that the others cannot follow: noise of 0.02 px tells them apart."""
    lenses = {
        "opencv-fisheye": OpenCVFisheye([320.0, 320.0, 645.0, 470.0, -0.05, 0.03, -0.02, 0.004], SIZE),
        "scaramuzza degree 4": Scaramuzza([645.0, 470.0, 1.001, 3e-4, 3e-4, 338.0, -1.2e-3, 1.27e-6, -2.2e-9], SIZE),
        "double-sphere": DoubleSphere([290.0, 291.0, 655.0, 466.0, -0.18, 0.59], SIZE),
    }
    for label, lens in lenses.items():
        corners = board_corners(lens, board_views(lens, 85, 20, 4), 0.02, 1)
        selection = select_model(corners, SIZE, candidates=FEW)
        assert selection.chosen.candidate.label == label, selection.reason
        assert selection.reason.startswith(f"{label} was taken") and selection.reason.count(".  ") == 0
        # 20 views of 54 corners: held out costs a little over the noise per point.
        assert 0.02 * np.sqrt(2) * 0.95 < selection.chosen.held_out_px < 0.02 * np.sqrt(2) * 1.15
        assert all(trial.held_out_px > trial.in_sample_px for trial in selection.trials)


def test_a_model_that_cannot_hold_the_camera_is_named_and_the_rest_goes_on():
    mirror = Scaramuzza([644.0, 476.0, 1.0, 0.0, 0.0, -320.0, 9e-4, 0.0, 1e-9], SIZE)
    corners = board_corners(mirror, board_views(mirror, 80, 12, 5, mirror=True), 0.2, 5)
    two = (Candidate("opencv-fisheye", {}), Candidate("scaramuzza", {"degree": 4}))
    selection = select_model(corners, SIZE, mirror=True, candidates=two)
    assert selection.chosen.candidate.model == "scaramuzza"
    assert "found --mirror" in (selection.trials[0].failure or "")
    with pytest.raises(InputError, match="found --mirror"):
        select_model(corners, SIZE, mirror=True, candidates=two[:1])


def test_too_few_views_to_choose():
    lens = OpenCVFisheye([320.0, 320.0, 645.0, 470.0, 0.0, 0.0, 0.0, 0.0], SIZE)
    corners = board_corners(lens, board_views(lens, 80, 4, 1), 0.2, 1)
    with pytest.raises(InputError, match=r"At least 5 usable views .* found 4"):
        select_model(corners, SIZE, candidates=FEW)


def test_a_curve_that_folds_just_beyond_the_data_is_seen():
    lens = Pinhole([700.0, 700.0, 640.0, 480.0, 0, -0.3, 0, 0, 0, 0, 0, 0, 0], SIZE)
    # r (1 - 0.3 r^2) grows up to r = 1.054, whose image is 491.8 px from the centre.
    edge = 700 * (2 / 3) / np.sqrt(0.9)
    for share, grows in ((0.85, True), (0.95, False)):
        pixel = torch.tensor([[640.0 + share * edge, 480.0]], dtype=torch.float64)
        assert grows_beyond(lens, pixel) == grows


@pytest.mark.slow
def test_ov_plane_train_and_test(shared_data):
    """Corners of one lens in two sets of photos: fit on the first, poses alone on the second. 0.477 px is published for plain
    Kannala-Brandt with a Huber loss."""
    folder = shared_data / "calibration/ov_plane"
    train, test = read_split(folder, "train"), read_split(folder, "test")
    assert (len(train.view_names), len(test.view_names)) == (18, 7)
    points = board_points(test, np.ones(len(test), bool), list(range(7)))
    errors = {}
    for candidate in all_candidates():
        if candidate.model == "pinhole":
            continue
        result = calibrate_camera(train, IMAGE_SIZE, candidate.model, loss="none", options=candidate.options)
        assert all(view.used for view in result.views)
        errors[candidate.label] = float((fit_boards(result.model, points)[1] ** 2).sum(-1).mean().sqrt())
        print(f"{candidate.label:24s} train {result.rms_px_per_point:.4f} test {errors[candidate.label]:.4f} px per point")
    assert errors["opencv-fisheye"] < 0.477
    assert min(errors.values()) < 0.477
    robust = calibrate_camera(train, IMAGE_SIZE, "opencv-fisheye")
    assert float((fit_boards(robust.model, points)[1] ** 2).sum(-1).mean().sqrt()) < 0.477


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fisheye1", *(pytest.param(name, marks=pytest.mark.full) for name in ("kaidan", "gopro"))])
def test_held_out_views_of_published_corners(shared_data, name):
    """The model taken predicts views at least as well as the degree-4 polynomial of the published fits."""
    folder = shared_data / "calibration" / name
    size = tuple(json.loads((folder / "reference.json").read_text())["image_size"])
    selection = select_model(read_corners(folder / "corners.csv"), size, loss="none")
    by_label = {trial.candidate.label: trial for trial in selection.trials}
    for trial in selection.trials:
        print(f"{name} {trial.candidate.label:24s} {trial.in_sample_px:.4f} {trial.held_out_px:.4f} {trial.failure or ''}")
    assert selection.chosen.monotone and selection.chosen.held_out_px <= by_label["scaramuzza degree 4"].held_out_px * 1.01
    print(selection.reason)
