"""Files of other tools in tests: written as text or bytes, read as the pair of cameras that they hold."""

from pathlib import Path

import numpy as np
import torch

from camera_models.formats import read

RAYS = np.random.default_rng(0).normal(size=(200, 3)) * [0.5, 0.5, 0.0] + [0, 0, 1.0]


def put(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def rig_pair(path: Path, **options: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation that take points of the first camera of a file to the second."""
    first, second = (item.cam_from_rig for item in read(path, **options).calibration.rig.values())
    assert (first.rotation - torch.eye(3)).abs().max() == 0
    return second.rotation.numpy(), second.translation.numpy()
