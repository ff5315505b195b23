"""A scene whose size says that its lengths are not in metres. Directions alone tell no scale: nothing else depends on it."""

import numpy as np
import torch

from camera_models.wording import rounded
from omnilines.pipelines.options import JudgeOptions
from omnilines.records import ImagePoses, LengthUnit, Lines


def size_notes(lines: Lines, poses: ImagePoses, options: JudgeOptions) -> tuple[str, ...]:
    """A sentence where half of the lines are farther from the cameras than photos show lines, or nearer than lenses focus."""
    known = lines.known
    if lines.unit is not LengthUnit.METRES or not known.any():
        return ()
    middle = torch.as_tensor(lines.ends_m[known].mean(1))
    centres = poses.cam_from_world.centre
    nearest = torch.full((len(middle),), torch.inf, dtype=torch.float64)
    for centre in centres:
        nearest = torch.minimum(nearest, (middle - centre).norm(dim=-1))
    away = float(np.median(nearest.numpy()))
    if options.near_m <= away <= options.far_m:
        return ()
    if away > options.far_m:
        likely = "if the poses are in millimetres, divide tx, ty and tz by 1000"
    else:
        likely = "if the poses are not in metres, scale tx, ty and tz"
    return (
        f"Half of the lines lie {rounded(away)} m or {'more' if away > options.far_m else 'less'} from the cameras: {likely}.",
    )
