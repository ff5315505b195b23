"""Images that show what several lenses see, side by side or one above the other, as 360 degree cameras write them."""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt

from camera_models.errors import InputError


@dataclass(frozen=True)
class Split:
    """How such an image is cut into those of its lenses, all of one size."""

    names: tuple[str, ...]
    """Of the lenses, from left to right or from the top down."""
    stacked: bool = False
    """Whether they are one above the other."""

    @staticmethod
    def of(text: str) -> "Split":
        """From `left,right` (side by side) or `front/back` (one above the other). Raises InputError otherwise."""
        stacked = "/" in text
        names = tuple(name.strip() for name in text.split("/" if stacked else ","))
        if (
            len(names) < 2
            or len(set(names)) < len(names)
            or not all(re.fullmatch(r"[A-Za-z0-9_-]{1,60}", name) for name in names)
        ):
            raise InputError(
                "`split` was expected as the names of lenses, left,right where they are side by side or top/bottom where one is "
                f"above the other, found '{text[:60]}'."
            )
        return Split(names, stacked)

    def parts(self, pixels: UInt[np.ndarray, "h w *channels"]) -> list[UInt[np.ndarray, "h_part w_part *channels"]]:
        """The image of each lens. Raises InputError where its width, or height, is no multiple of their number."""
        side = pixels.shape[0 if self.stacked else 1]
        if side % len(self.names):
            raise InputError(
                f"Images were expected whose {'height' if self.stacked else 'width'} is {len(self.names)} equal parts, found "
                f"{side} px; leave `split` out, or give photos as the camera wrote them."
            )
        return np.split(pixels, len(self.names), axis=0 if self.stacked else 1)
