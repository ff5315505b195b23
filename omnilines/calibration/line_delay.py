"""The line delay of a rolling shutter, and how it is said."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class LineDelay:
    """How long after one row of the image the next one is exposed."""

    camera: str
    columns: bool
    """Whether the image is read column by column, as that of a camera that was turned by a quarter."""
    delay_s: float
    """Of a row to that below it, or of a column to that on its right; negative where they are read the other way."""
    sigma_s: float
    """One standard deviation."""
    modelled: bool
    """Whether the calibration holds it; else its frames were taken to be of one instant."""

    @property
    def order(self) -> str:
        """In which rows, or columns, are read."""
        if self.columns:
            return "columns read left to right" if self.delay_s > 0 else "columns read right to left"
        return "rows read top to bottom" if self.delay_s > 0 else "rows read bottom to top"

    @property
    def text(self) -> str:
        """In microseconds, with two digits of the standard deviation."""
        sigma_us = 1e6 * self.sigma_s
        digits = max(0, 1 - math.floor(math.log10(max(sigma_us, 1e-9))))
        return f"{1e6 * self.delay_s:.{digits}f} ± {sigma_us:.{digits}f} µs a {'column' if self.columns else 'row'}"

    def note(self, image_size: tuple[int, int]) -> str:
        """What a person should know of it."""
        whole_ms = 1e3 * abs(self.delay_s) * image_size[0 if self.columns else 1]
        said = f"rolling shutter: {self.text}, {self.order}, {whole_ms:.3g} ms for the whole image"
        if self.modelled:
            middle = "column" if self.columns else "row"
            return f"{said}; it is modelled, and the pose of a frame is that at the instant of its middle {middle}."
        return f"{said}, as the board's motion between frames tells; it is not modelled: give `rolling_shutter` for that."
