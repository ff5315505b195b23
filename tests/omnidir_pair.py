"""OpenCV's pair of omnidirectional cameras, as its test data have it."""

import cv2
import numpy as np

from omnilines.records import Corners


def omnidir_pair(folder) -> tuple[Corners, list, list, list]:
    """The 39 stereo pairs of OpenCV's test data, board in metres."""
    store = cv2.FileStorage(str(folder / "omni_stereocalib_data.xml"), cv2.FILE_STORAGE_READ)
    root = store.root()
    first, second, board = (
        [root.getNode(key).at(i).mat().reshape(48, -1) for i in range(39)]
        for key in ("imagePoints1", "imagePoints2", "objectPoints")
    )
    names = tuple(f"{camera}/{i:02d}" for camera in ("cam0", "cam1") for i in range(39))
    corners = Corners(
        np.repeat(np.arange(78), 48),
        names,
        names,
        np.concatenate([*board, *board]) / 1000.0,
        np.concatenate([*first, *second]),
        cameras=("cam0",) * 39 + ("cam1",) * 39,
        frames=tuple(f"{i:02d}" for i in range(39)) * 2,
    )
    return corners, first, second, board
