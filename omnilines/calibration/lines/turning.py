"""How far lines turn off their directions, in radians, where their edges move by a pixel, and how that follows the camera.

The line of a chain with the normal n strays from the direction d of its family by n . d. A camera that draws all bearings
together makes strays smaller, and least squares of them in radians would follow that: the longer the focal length, the less they
are. In pixels nothing is gained. So a stray counts in the pixels that it is at the camera at which families were found.

Where the ends of a chain, seen at a and b, move across the edge so that a moves by a', n . d changes by

    (a' x b) . d / |a x b|,

and so for b. The rate of a line is the root of the sum of both squares. Under another camera d is where its lines meet then.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.lines.weighting import WeightedChains
from omnilines.calibration.uncertainty import bearing_jacobian

HALF_PX = 0.5
"""By which ends are moved to either side."""
STEP_RAD = 1e-5
"""By which bearings are moved, at most, for the derivative by a parameter."""
HELD_SHARE = 1e-3
"""Weight with which a direction stays where it was, of that of a line: one line alone does not place it."""


@dataclass(frozen=True)
class Turning:
    """Of the chains that belong to directions."""

    ends: Float[Tensor, "m 2 2 2"]
    """Pixels: the first and the last of each chain, moved to both sides."""
    of_line: Int[Tensor, " m"]
    """Its direction."""
    direction: Float[Tensor, "k 3"]
    rad_per_px: Float[Tensor, " m"]
    """Under the camera at which directions were found."""

    @staticmethod
    def of(model: CameraModel, chains: WeightedChains, direction: Float[Tensor, "k 3"], of_chain: Int[Tensor, " c"]) -> "Turning":
        """With the circles that chains have under `model`, of those that belong to a direction (-1 for none)."""
        blocks, members = chains.blocks, torch.nonzero(of_chain >= 0).flatten()
        last = torch.cumsum(blocks.counts, 0)
        ends = torch.stack([last - blocks.counts, last - 1], -1)[members]
        across = blocks.normals[ends]
        on_curve = blocks.pixels[ends] + chains.at.px[ends][..., None] * across
        moved = torch.stack([on_curve + HALF_PX * across, on_curve - HALF_PX * across], 2)
        bearing, _ = model.unproject(moved)
        return Turning(moved, of_chain[members], direction, _rates(bearing, of_chain[members], direction))

    def growth(self, model: CameraModel) -> tuple[Float[Tensor, " m"], Float[Tensor, "m p"]]:
        """Of the rate of each line, from that camera to another, and the derivatives of its logarithm by the parameters; none of
        a line whose ends that camera does not see."""
        bearing, valid, by_parameter, _ = bearing_jacobian(model, self.ends.reshape(-1, 2))
        by_parameter = torch.where(valid[:, None, None], by_parameter, 0.0)
        seen, shape = valid.reshape(-1, 4).all(-1), (*self.ends.shape[:-1], 3)
        by_logarithm = torch.zeros(len(self.ends), by_parameter.shape[-1], dtype=torch.float64)
        for k, moved in enumerate(by_parameter.unbind(-1)):
            size = float(moved.abs().max()) if len(moved) else 0.0
            if size > 0:
                step = STEP_RAD / size
                high, low = (self._rates((bearing + way * step * moved).reshape(shape)) for way in (1.0, -1.0))
                by_logarithm[:, k] = torch.where(seen, torch.log(high / low) / (2.0 * step), 0.0)
        return torch.where(seen, self._rates(bearing.reshape(shape)) / self.rad_per_px, 1.0), by_logarithm

    def _rates(self, bearing: Float[Tensor, "m 2 2 3"]) -> Float[Tensor, " m"]:
        return _rates(bearing, self.of_line, self.direction)


def _rates(bearing: Float[Tensor, "m 2 2 3"], of_line: Int[Tensor, " m"], before: Float[Tensor, "k 3"]) -> Float[Tensor, " m"]:
    """rad / px, of lines by the bearings of their first and last ends, each moved to both sides."""
    first, second = bearing.mean(2).unbind(1)
    by_first, by_second = ((bearing[:, :, 0] - bearing[:, :, 1]) / (2.0 * HALF_PX)).unbind(1)
    normal = torch.linalg.cross(first, second)
    length = normal.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    unit = normal / length
    held = HELD_SHARE * (torch.eye(3, dtype=unit.dtype) - before[:, :, None] * before[:, None])
    moments = held.index_add(0, of_line, unit[:, :, None] * unit[:, None])
    direction = torch.linalg.eigh(moments)[1][of_line, :, 0]
    ends = torch.stack([torch.linalg.cross(by_first, second), torch.linalg.cross(first, by_second)], 1)
    return ((ends @ direction[..., None])[..., 0] / length).norm(dim=-1).clamp_min(1e-300)
