"""Photos among others that are mirrored or turned are named, and take no part in the calibration."""

from dataclasses import replace

import numpy as np
import pytest
from board_views import board_corners, board_views

from camera_models import OpenCVFisheye, Pinhole
from omnilines.calibration.single import calibrate_camera

FLIPPED = {2: (-1, 1), 5: (1, -1), 8: (-1, -1)}
LOOKS = {2: "like a mirror image", 5: "like an upside down mirror image", 8: "turned by 180 degrees"}


@pytest.mark.parametrize(
    ("truth", "reach"),
    [
        (OpenCVFisheye([420.0, 420.0, 530.0, 364.0, 0.01, -0.005, 0.001, 0.0], (1024, 768)), 75.0),
        (Pinhole([600.0, 600.0, 530.0, 364.0, 0.0, -0.28, 0.09, *[0.0] * 6], (1024, 768)), 38.0),
    ],
)
def test_flipped_photos_are_named_and_left_out(truth: OpenCVFisheye | Pinhole, reach: float) -> None:
    """Of a lens 19 px beside the middle: "wrong detection or numbering" was said, and some of them stayed."""
    corners = board_corners(truth, board_views(truth, reach, 12, 4), 0.05, 1)
    middle = (np.array(truth.image_size) - 1) / 2
    signs = np.array([FLIPPED.get(view, (1, 1)) for view in range(12)])[corners.view]
    mixed = replace(corners, pixels=middle + (corners.pixels - middle) * signs)
    found = calibrate_camera(mixed, truth.image_size, truth.NAME)
    reasons = {k: view.reason for k, view in enumerate(found.views) if not view.used}
    assert reasons == {k: f"beside the others it looks {look}; flip or turn it back" for k, look in LOOKS.items()}
    right = calibrate_camera(corners, truth.image_size, truth.NAME)
    assert all(view.used for view in right.views)
    # The centre is that of the right photos, to its uncertainty.
    sigma = np.sqrt(found.covariance.diagonal()[2:4])
    assert (np.abs((found.model.parameters - truth.parameters).numpy()[2:4]) < 4 * sigma).all()
