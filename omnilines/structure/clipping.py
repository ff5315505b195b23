"""Lines clipped to the stretches that photos show."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from omnilines.geometry.line import PlueckerLines
from omnilines.structure.kernels.clip import clipped
from omnilines.structure.options import ClippingOptions


@dataclass(frozen=True)
class Stretches:
    """Supported stretches of lines, in the order of the lines and along each of them."""

    line: Int[np.ndarray, " k"]
    positions_m: Float[np.ndarray, "k 2"]
    """Along the line, as `PlueckerLines.point_at` measures them."""
    ends_m: Float[np.ndarray, "k 2 3"]
    views: Int[np.ndarray, " k"]
    """Photos that show some of it."""

    def rows(self, chosen: Int[np.ndarray, " m"]) -> "Stretches":
        """Some of them, in this order."""
        return Stretches(self.line[chosen], self.positions_m[chosen], self.ends_m[chosen], self.views[chosen])


def supported_stretches(
    lines: PlueckerLines,
    *,
    line: Int[np.ndarray, " n"],
    positions_m: Float[np.ndarray, "n 2"],
    sigma_m: Float[np.ndarray, "n 2"],
    image: Int[np.ndarray, " n"],
    enough_views: Int[np.ndarray, " l"],
    options: ClippingOptions = ClippingOptions(),
) -> Stretches:
    """Where n arcs, each with its line, photo and the positions of its ends along the line (the lower first), support the lines.

    Every place of a stretch is shown by `min_photos_everywhere`, and by no fewer than see the line on both sides of it but not
    there; the whole by as many as `enough_views` says. An end is where the ends of several photos agree within `sigma_m`, not the
    farthest of them, and drawn in by some standard deviations of it. A line may have none, or several with gaps between them.
    """
    order = np.argsort(line, kind="stable")
    starts = np.searchsorted(line[order], np.arange(len(lines) + 1))
    low, high = np.ascontiguousarray(positions_m[order].T)
    positions, owner, views = clipped(starts, low, high, sigma_m[order], image[order], enough_views, options)
    own = lines[torch.as_tensor(owner)]
    ends = torch.stack([own.point_at(torch.as_tensor(np.ascontiguousarray(place))) for place in positions.T], 1)
    return Stretches(owner, positions, ends.numpy(), views)
