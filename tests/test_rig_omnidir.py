"""A real pair of omnidirectional cameras: each camera alone, both together, and OpenCV's own calibration."""

import cv2
import numpy as np
import pytest
from omnidir_pair import omnidir_pair

from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.single import calibrate_camera
from omnilines.records import Corners


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "loss"),
    [
        ("scaramuzza", "none"),
        *(pytest.param(*both, marks=pytest.mark.full) for both in (("scaramuzza", "cauchy"), ("unified", "none"))),
    ],
)
def test_real_stereo_pair_is_nearly_as_good_together_as_alone(shared_data, model, loss):
    corners, *_ = omnidir_pair(shared_data / "calibration/omnidir_corners")
    kinds = {name: CameraSetup((704, 576), model) for name in ("cam0", "cam1")}
    result = calibrate_rig(corners, kinds, loss=loss)
    assert len(result.members) == 2 and all(view.used for view in result.views)
    for member in result.members:
        views = np.array([camera == member.name for camera in corners.cameras])
        rows = views[corners.view]
        table = Corners(
            corners.view[rows] - int(np.flatnonzero(views)[0]),
            tuple(np.array(corners.view_names)[views]),
            tuple(np.array(corners.images)[views]),
            corners.board_m[rows],
            corners.pixels[rows],
        )
        alone = calibrate_camera(table, (704, 576), model, loss=loss)
        assert alone.rms_px_per_point <= member.rms_px_per_point < 1.08 * alone.rms_px_per_point
    link = result.weakest
    assert link is not None and link.frames == 39
    # Their own documentation's result for these data: 0.161 m.
    assert abs(link.baseline_m - 0.161) < 1e-3 and 5e-5 < link.baseline_sigma_m < 5e-4


@pytest.mark.slow
def test_real_stereo_pair_is_no_worse_than_opencv(shared_data):
    """cv2.omnidir.stereoCalibrate, same model (skew held), on the pairs that it keeps; its RMS is recomputed from its result."""
    corners, first, second, board = omnidir_pair(shared_data / "calibration/omnidir_corners")
    empty = [np.zeros((3, 3)), np.zeros((1, 1)), np.zeros((1, 4)), np.zeros((3, 3)), np.zeros((1, 1)), np.zeros((1, 4))]
    given = [[part.reshape(1, 48, -1) for part in parts] for parts in (board, first, second)]
    size = (704, 576)
    rms, *_, found = cv2.omnidir.stereoCalibrate(
        *given, size, size, *empty, cv2.omnidir.CALIB_FIX_SKEW, (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-8)
    )
    kept = found.ravel().tolist()
    assert 30 <= len(kept) <= 39
    views = [v for v, frame in enumerate(corners.frames) if int(frame) in kept]
    rows = np.isin(corners.view, views)
    place = np.full(78, -1)
    place[views] = np.arange(len(views))
    own = Corners(
        place[corners.view[rows]],
        tuple(corners.view_names[v] for v in views),
        tuple(corners.images[v] for v in views),
        corners.board_m[rows],
        corners.pixels[rows],
        cameras=tuple(corners.cameras[v] for v in views),
        frames=tuple(corners.frames[v] for v in views),
    )
    result = calibrate_rig(own, {name: CameraSetup(size, "unified") for name in ("cam0", "cam1")}, loss="none")
    print(f"omnidir pair, {len(kept)} frames: {result.rms_px_per_point:.4f} px, OpenCV {rms:.4f} px")
    assert result.kept.all() and result.rms_px_per_point <= rms * (1 + 1e-6)
