"""What the cameras of a rig see by themselves, from which fits begin that tie them less, or otherwise."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from camera_models.pose import Pose


@dataclass(frozen=True, eq=False)
class SeenAlone:
    """What the cameras of a rig see by themselves, as the rig numbers it."""

    cam_from_board: Mapping[int, Pose]
    """Of views of the table."""
    kept: Bool[np.ndarray, " n"]
    """Rows of the table that fit."""
