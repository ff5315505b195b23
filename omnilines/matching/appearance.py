"""What arcs look like: the colours on either side of each, read in a band around it through the camera model.

No view is rectified: points beside the arc are bearings turned off its great circle, and the model says which pixels they are.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped

from camera_models import CameraModel
from omnilines.geometry.sphere import arc_normal, points_on_arc

ALONG = 16
"""Places along an arc at which its sides are read."""
MARGIN = 0.06
"""Share of the arc left out at both ends."""
OFFSETS_PX = (2.0, 3.0, 4.0, 5.5)
"""Distances from the arc."""
DARK_GREY = 12.0
"""Added to grey levels of 255 before the logarithm: what noise and stray light make of black."""
_STEP_RAD = 1e-4


def side_colours(
    image: Shaped[np.ndarray, "h w *channels"], model: CameraModel, bearings: Float[np.ndarray, "n 2 3"]
) -> Float[np.ndarray, "n 2 3"]:
    """Logarithms of the colours beside n arcs given by end bearings (unit, camera frame): (arc, side, blue green red).

    Side 0 lies towards the normal V1 x V2. Each is the mean over OFFSETS_PX of the median along the arc of ln(grey level +
    DARK_GREY); a grey photo has three equal channels. NaN where no place beside the arc is in the photo.
    """
    if not len(bearings):
        return np.zeros((0, 2, 3))
    ends = torch.as_tensor(bearings)
    share = torch.linspace(MARGIN, 1.0 - MARGIN, ALONG, dtype=torch.float64)
    with torch.no_grad():
        places = points_on_arc(ends[:, 0], ends[:, 1], share)
        normal = arc_normal(ends[:, 0], ends[:, 1])[:, None]
        on, _ = model.project(places)
        off, _ = model.project(places + _STEP_RAD * normal)
        step = off - on
        if model.PERIODIC:
            step[..., 0] -= model.image_size[0] * torch.round(step[..., 0] / model.image_size[0])
        rate_px = step.norm(dim=-1, keepdim=True) / _STEP_RAD
        sides = torch.tensor([1.0, -1.0], dtype=torch.float64)[:, None] * torch.tensor(OFFSETS_PX, dtype=torch.float64)
        # (arc, side, offset, place, xyz)
        turned = places[:, None, None] + (sides[..., None, None] / rate_px[:, None, None]) * normal[:, None, None]
        pixels, valid = model.project(turned)
    return _medians(_read(image, pixels.numpy(), model.PERIODIC), valid.numpy() & _inside(pixels.numpy(), model))


def _inside(pixels: Float[np.ndarray, "*batch 2"], model: CameraModel) -> Bool[np.ndarray, "*batch"]:
    if model.PERIODIC:
        return np.ones(pixels.shape[:-1], dtype=bool)
    size = np.array(model.image_size)
    inside: Bool[np.ndarray, "*batch"] = np.all((pixels >= 0) & (pixels <= size - 1), axis=-1)
    return inside


def _read(image: Shaped[np.ndarray, "h w *channels"], pixels: Float[np.ndarray, "*batch 2"], closed: bool) -> np.ndarray:
    """Grey levels of 255 at pixels, three channels, between the pixels by interpolation."""
    if closed:
        image = np.concatenate([image, image[:, :1]], 1)
        pixels = np.stack([np.mod(pixels[..., 0], image.shape[1] - 1), pixels[..., 1]], -1)
    # remap takes images of fewer than 32768 rows and columns: the places are laid out in rows of 1024.
    flat = np.nan_to_num(pixels.reshape(-1, 2), nan=-1.0).astype(np.float32)
    padded = np.full((-len(flat) // 1024 * -1024, 2), -1.0, dtype=np.float32)
    padded[: len(flat)] = flat
    u, v = padded.reshape(-1, 1024, 2).transpose(2, 0, 1)
    found = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    found = found.reshape(len(padded), -1)[: len(flat)] / (1.0 if image.dtype == np.uint8 else 257.0)
    colours = np.repeat(found[:, :1], 3, 1) if found.shape[1] < 3 else found[:, :3]
    return colours.reshape(*pixels.shape[:-1], 3)


def _medians(colours: Float[np.ndarray, "n 2 k p 3"], valid: np.ndarray) -> Float[np.ndarray, "n 2 3"]:
    logs = np.log(colours + DARK_GREY)
    logs[~valid] = np.nan
    there = valid.any(-1)
    medians = np.full((*there.shape, 3), np.nan)
    medians[there] = np.nanmedian(logs[there], axis=1)
    count = there.sum(-1)
    mean = np.nansum(medians, axis=2) / np.maximum(count, 1)[..., None]
    mean[count == 0] = np.nan
    return mean
