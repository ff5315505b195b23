"""Whether a camera model follows the lens: residuals by their distance from the centre of the image.

What is wrong with a board or a photo differs from photo to photo, and covariances hold that (by_views.py). What a model cannot do
is the same in all photos, and no covariance holds it: corners at one distance from the centre then lie outwards, or inwards, in
all of them. The mean of each photo in each of some rings is one observation; that the rings have mean zero is tested by how much
photos differ within them (F test). Poses and parameters take up some of what rings have in common, so that a model which suits
fails less often than the test says.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from camera_models.wording import rounded

RINGS, LEAST_PHOTOS = 8, 3
"""Rings of as many corners each, and how many photos each has corners in."""


@dataclass(frozen=True)
class ModelMisfit:
    """What residuals have in common in all photos."""

    outward_px: Float[np.ndarray, " k"]
    """How much farther out than observed the camera sees the corners of a ring, mean of the photos."""
    radii_px: Float[np.ndarray, " k+1"]
    """From the centre: where the rings begin and end."""
    chance: float
    """Of as much by the differences between photos alone."""

    @property
    def largest_px(self) -> float:
        """In the ring where it is the largest."""
        return float(np.abs(self.outward_px).max())

    @property
    def where(self) -> str:
        """That ring."""
        worst = int(np.abs(self.outward_px).argmax())
        return f"{self.radii_px[worst]:.0f} to {self.radii_px[worst + 1]:.0f} px from the centre"

    def note(self, what: str) -> str:
        """One sentence and what follows from it; `what` does not follow, as in `pinhole model`."""
        return (
            f"The {what} does not follow this lens: all photos agree that corners lie off by up to "
            f"{rounded(self.largest_px)} px ({self.where}; F test over {len(self.outward_px)} rings, p = {self.chance:.1g}). "
            "What is stated of parameters and projection is that of a lens which the model follows: the true errors are larger, "
            "and residuals do not tell how large."
        )


def model_misfit(
    view: Int[np.ndarray, " n"],
    pixels: Float[np.ndarray, "n 2"],
    residual_px: Float[np.ndarray, "n 2"],
    centre_px: Float[np.ndarray, "2"],
    limit_px: float | None,
    significance: float,
) -> ModelMisfit | None:
    """What residuals (projected minus observed) have in common in all photos; None where nothing is that significant, or where
    photos or corners are too few to tell. Residuals beyond `limit_px`, those of rejected corners, count as of that length."""
    offset = pixels - centre_px
    radius = np.linalg.norm(offset, axis=1)
    outward = (residual_px * offset).sum(1) / np.maximum(radius, 1e-12)
    if limit_px is not None:
        outward = outward * np.minimum(1.0, limit_px / np.maximum(np.linalg.norm(residual_px, axis=1), 1e-300))
    edges = np.quantile(radius, np.linspace(0.0, 1.0, RINGS + 1))
    ring = np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, RINGS - 1)
    photo = np.unique(view, return_inverse=True)[1]
    count, total = np.zeros((2, int(photo.max()) + 1, RINGS))
    np.add.at(count, (photo, ring), 1.0)
    np.add.at(total, (photo, ring), outward)
    seen = count > 0
    photos = seen.sum(0)
    freedom = int(photos.sum()) - RINGS
    if photos.min() < LEAST_PHOTOS or freedom <= 0:
        return None
    mean = total / np.maximum(count, 1.0)
    common = mean.sum(0) / photos
    within = float(((mean - common) ** 2 * seen).sum()) / freedom
    statistic = float((photos * common**2).mean()) / max(within, 1e-300)
    chance = float(stats.f.sf(statistic, RINGS, freedom))
    return ModelMisfit(common, edges, chance) if math.isfinite(chance) and chance < significance else None
