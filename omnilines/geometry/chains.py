"""Edge points of photos, linked to chains: each is thought to be a straight line of the world. No camera need be known."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class Chains:
    """Points of an edge each, in the order in which they lie along it. All photos are of one camera.

    `image`: the photo of each chain, in `images`. `chain`: the chain of each point, never falling, so that the points of a chain
    stand together. `pixels`: points in pixels (u right, v down; the first pixel's centre is at 0, 0). `normals`: unit vectors
    across the edge in the image, towards the brighter side. `sigma_px`: standard deviation of a point along its normal.
    """

    images: tuple[str, ...]
    image_size: tuple[int, int]
    image: Int[np.ndarray, " chains"]
    chain: Int[np.ndarray, " points"]
    pixels: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]
    sigma_px: Float[np.ndarray, " points"]

    @property
    def count(self) -> int:
        """Number of chains."""
        return len(self.image)

    def of_chains(self, kept: Bool[np.ndarray, " chains"]) -> "Chains":
        """Some of them, numbered anew; photos keep their numbers."""
        rows = kept[self.chain]
        return replace(
            self,
            image=self.image[kept],
            chain=(np.cumsum(kept) - 1)[self.chain[rows]],
            pixels=self.pixels[rows],
            normals=self.normals[rows],
            sigma_px=self.sigma_px[rows],
        )
