"""Segments that lie outside the images that a calibration is of: refused."""

from collections.abc import Mapping, Sequence

import numpy as np

from camera_models import CameraModel, InputError
from omnilines.pipelines.options import JudgeOptions
from omnilines.records import Segments


def require_inside(
    segments: Segments, camera_of: Sequence[str], cameras: Mapping[str, CameraModel], options: JudgeOptions = JudgeOptions()
) -> None:
    """`camera_of` names the camera of each photo of `segments.images`.

    Raises InputError where a segment ends farther outside the image of its camera than detectors draw lines on. A panorama has
    no end to the left or right: segments may go on beyond its seam.
    """
    if not len(segments):
        return
    size = np.array([cameras[name].image_size for name in camera_of], dtype=np.float64)[segments.image]
    beyond = np.maximum(-0.5 - segments.endpoints_px, segments.endpoints_px - (size - 0.5)[:, None])
    closed = np.array([cameras[name].PERIODIC for name in camera_of], dtype=bool)[segments.image]
    beyond[closed, :, 0] = 0.0
    beyond = beyond.max(-1)
    outside = (beyond > options.beyond_share * size.max(-1)[:, None]).any(-1)
    if not outside.any():
        return
    row, end = np.unravel_index(int(beyond.argmax()), beyond.shape)
    u, v = segments.endpoints_px[row, end]
    photo = int(segments.image[row])
    width, height = cameras[camera_of[photo]].image_size
    raise InputError(
        f"Segments inside the image of {width}x{height} px of camera {camera_of[photo]} were expected, found one of photo "
        f"{segments.images[photo]} that ends at ({u:g}, {v:g}), and {int(outside.sum())} of {len(segments)} outside; give the "
        "calibration of photos of this size, or correct the segments."
    )
