"""One photo searched with a camera: what a detection missed of the board, and a board that it lost."""

import numpy as np
import torch

from calib_patterns import Detection, DetectionOptions, Pattern
from calib_patterns.fitted_again import fitted_again
from calib_patterns.guided_part import guided_search_of_part
from calib_patterns.tangent_views import detect_in_views
from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.calibration.initialise import BoardPoints, resect_boards

LEAST_FOR_POSE = 4


def resected(pattern: Pattern, model: CameraModel, found: Detection) -> Pose | None:
    """cam_from_board of corners seen by a known camera, by linear least squares; None of fewer than four."""
    bearings, valid = model.unproject(found.pixels)
    if valid.sum() < LEAST_FOR_POSE:
        return None
    board = torch.as_tensor(pattern.points_m[found.ids[valid]])
    points = BoardPoints(torch.zeros(len(board), dtype=torch.int64), 1, board, torch.as_tensor(found.pixels[valid]))
    return resect_boards(points, torch.as_tensor(bearings[valid]))[0]


def completed(
    image: np.ndarray,
    pattern: Pattern,
    model: CameraModel,
    found: Detection,
    cam_from_board: Pose | None = None,
    *,
    options: DetectionOptions = DetectionOptions(),
) -> Detection | None:
    """The corners found and those that the camera leads to from them, all fitted along the edges that it sees; None where they
    are too few or contradict the camera."""
    pose = resected(pattern, model, found) if cam_from_board is None else cam_from_board
    if pose is None:
        return None
    guided = guided_search_of_part(image, pattern, model, pose, found, options)
    if not guided.fits or len(guided.detection) < options.min_corners:
        return None
    return fitted_again(image, pattern, model, guided.cam_from_board, guided.detection, options)


def searched(
    image: np.ndarray,
    pattern: Pattern,
    model: CameraModel,
    found: Detection,
    *,
    mirrored: bool = False,
    options: DetectionOptions = DetectionOptions(),
) -> Detection:
    """Everything that a photo shows of a board for a camera: from the corners found or, where none fit the camera, from
    straightened views; what was found where neither leads further."""
    whole = completed(image, pattern, model, found, options=options)
    if whole is None:
        lost = detect_in_views(image, pattern, model, mirrored=mirrored, options=options)
        whole = completed(image, pattern, model, lost, options=options)
    return found if whole is None else whole
