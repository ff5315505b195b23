"""Whether videos are those of calibrated cameras, asked before any of their frames is read."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np

from camera_models import Calibration, InputError
from camera_models.wording import listed
from omnilines.files import PhotoArray
from omnilines.files.cameras import read_cameras
from omnilines.files.masks import check_masks, with_masks
from omnilines.photo_size import wrong_size

Sizes: TypeAlias = Mapping[str, tuple[int, int]]
"""Width and height (px) that the camera of each video sees, by its name."""


def cameras_of_videos(calibration: str | Path, sizes: Sizes, mask: Path | None = None) -> Calibration:
    """The calibration of the cameras of videos.

    Raises InputError as `read_cameras` does, where a video is of none of the cameras, or of another size, and where a mask is
    none of them.
    """
    blank = np.zeros((), dtype=np.uint8)
    frames = [PhotoArray(name, np.broadcast_to(blank, size[::-1])) for name, size in sizes.items()]
    cameras = read_cameras(calibration, frames)
    for name, size in sizes.items():
        if len(cameras) > 1 and name not in cameras:
            raise InputError(
                f"Videos named like the cameras {listed(cameras)} of {calibration} were expected, found {name}; rename it, or "
                "give the calibration of its camera alone."
            )
        why = wrong_size("video", size, cameras[name if len(cameras) > 1 else next(iter(cameras))].image_size)
        if why is not None:
            raise InputError(f"{name}: {why}")
    # Names of frames, which masks of a folder have, are not known yet.
    if mask is not None and not mask.is_dir():
        check_masks(with_masks(frames, mask), sizes)
    return cameras
