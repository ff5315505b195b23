"""What arcs look like: the colours on either side of each, read in a band around it through the camera model.

No view is rectified: the model says which pixels the arc passes, and which way in the photo its great circle is turned off it.
"""

import numpy as np
import torch
from jaxtyping import Float, Shaped

from camera_models import CameraModel
from omnilines.geometry.sphere import arc_normal, points_on_arc
from omnilines.matching.kernels.appearance import median_logs
from omnilines.matching.options import AppearanceOptions

ALONG = 16
"""Places along an arc at which its sides are read."""
ARCS_AT_A_TIME = 256
"""So that torch needs no threads of its own, which burn more time than they save where every core looks at a photo already."""
_STEP_RAD = 1e-4


def side_colours(
    image: Shaped[np.ndarray, "h w *channels"],
    model: CameraModel,
    bearings: Float[np.ndarray, "n 2 3"],
    options: AppearanceOptions = AppearanceOptions(),
) -> Float[np.ndarray, "n 2 3"]:
    """Logarithms of the colours beside n arcs given by end bearings (unit, camera frame): (arc, side, blue green red).

    Side 0 lies towards the normal V1 x V2. Each is the mean over the offsets of the median along the arc of ln(grey level +
    dark_grey); a grey photo has three equal channels. NaN where no place beside the arc is in the photo.
    """
    if not len(bearings):
        return np.zeros((0, 2, 3))
    height, width = image.shape[:2]
    image = np.ascontiguousarray(image).reshape(height, width, -1)
    parts = [_sides(image, model, bearings[k : k + ARCS_AT_A_TIME], options) for k in range(0, len(bearings), ARCS_AT_A_TIME)]
    return np.concatenate(parts)


def _sides(
    image: Shaped[np.ndarray, "h w c"], model: CameraModel, bearings: Float[np.ndarray, "n 2 3"], options: AppearanceOptions
) -> Float[np.ndarray, "n 2 3"]:
    ends = torch.as_tensor(bearings)
    share = torch.linspace(options.margin_share, 1.0 - options.margin_share, ALONG, dtype=torch.float64)
    with torch.no_grad():
        places = points_on_arc(ends[:, 0], ends[:, 1], share)
        normal = arc_normal(ends[:, 0], ends[:, 1])[:, None]
        pixels, valid = model.project(torch.stack([places, places + _STEP_RAD * normal]))
    on, step = pixels[0].numpy(), (pixels[1] - pixels[0]).numpy()
    if model.PERIODIC:
        step[..., 0] -= model.image_size[0] * np.round(step[..., 0] / model.image_size[0])
    unit = 1.0 if image.dtype == np.uint8 else 257.0
    seen = (valid[0] & valid[1]).numpy()
    return median_logs(image, unit, on, step, seen, np.array(options.offsets_px), model.PERIODIC, options.dark_grey)
