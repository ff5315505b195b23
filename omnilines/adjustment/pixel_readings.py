"""What a table of segments may hold in place of `u1_px,v1_px,u2_px,v2_px`: its numbers read as other tools write them."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

OTHER_SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
"""Times the size of the image that the calibration is of, of photos that were scaled."""


@dataclass(frozen=True)
class PixelReading:
    """The same numbers, read in another way."""

    looks: str
    """What they seem to be, behind "the segments look"."""
    remedy: str
    """What to do, one imperative."""
    pixels: Float[Tensor, "n 2 2"]
    """End points, if they are to be read so."""


def other_pixels(given: Float[Tensor, "n 2 2"], size: Float[Tensor, "n 2"]) -> Iterator[PixelReading]:
    """The other ways to read segments of photos of so many pixels (width, height), the commonest mistakes first."""
    swapped, last = given.flip(-1), size[:, None] - 1
    right, down = (torch.tensor(axis, dtype=given.dtype) for axis in ((1.0, 0.0), (0.0, 1.0)))
    turned = "give them of the photos as the calibration is of them"
    yield PixelReading("to have u and v swapped", "swap these columns", swapped)
    yield PixelReading("to count v from the bottom of the image", "give v_px from the top", _mirrored(given, last, down))
    yield PixelReading("to be of photos that are mirrored", turned, _mirrored(given, last, right))
    yield PixelReading("to be of photos turned by 180 degrees", turned, last - given)
    yield PixelReading("to be of photos turned by 90 degrees", turned, _mirrored(swapped, last, right))
    yield PixelReading("to be of photos turned by 270 degrees", turned, _mirrored(swapped, last, down))
    ends = given.reshape(-1, 4)
    yield PixelReading("to be in the order u1, u2, v1, v2", "name the columns so", ends[:, [0, 2, 1, 3]].reshape(-1, 2, 2))
    extent = torch.stack([given[:, 0], given[:, 0] + given[:, 1]], 1)
    yield PixelReading("to hold width and height for the second end", "give the second end", extent)
    shares = given * size[:, None] - 0.5
    yield PixelReading("to be in shares of the image, not in pixels", "multiply by its width and height", shares)
    for scale in OTHER_SIZES:
        wide, high = (scale * size[0]).tolist()
        looks = f"to be of photos of {wide:.0f}x{high:.0f} px, not of {size[0, 0]:.0f}x{size[0, 1]:.0f}"
        yield PixelReading(looks, "give the calibration of photos of that size", (given + 0.5) / scale - 0.5)


def _mirrored(pixels: Float[Tensor, "n 2 2"], last: Float[Tensor, "n 1 2"], along: Float[Tensor, " 2"]) -> Float[Tensor, "n 2 2"]:
    """Counted from the other side, along one axis."""
    return pixels + along * (last - 2 * pixels)
