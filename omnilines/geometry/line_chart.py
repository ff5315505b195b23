"""The 4-dof orthonormal chart of a line about its own centre and scale (design section 5; 2.5 to 2.10, 4.29 to 4.40).

(S, phi) in SO(3) x SO(2) stands for (cos(phi) s1, sin(phi) s2) ~ (d, (m - c x d) / rho): d = s1, m = rho tan(phi) s2 + c x d.
With the centre c at the distance rho from the line, phi is 45 degrees, where the chart has singular values 1, 1, 0.71 and 0.71;
in world coordinates it would degenerate for lines near the origin and far from it.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose, hat, rotation_from_vector
from omnilines.geometry.line import PlueckerLines, weighted_median_by_group

PHI_MIN_RAD, PHI_MAX_RAD = math.radians(20), math.radians(70)
"""A chart is well scaled between these."""
_ROUNDING = 1e-9
"""Of the distance of a line's cameras: far above what rounding makes of it, far below what is measured."""


@dataclass(frozen=True)
class LineChart:
    """Lines as manifold points; a step is delta = (rotation of S about its own axes, 3; phi, 1), all in radians."""

    centre: Float[Tensor, "n 3"]
    """c, metres, world frame."""
    scale: Float[Tensor, " n"]
    """rho, metres."""
    S: Float[Tensor, "n 3 3"]
    """Columns s1 = d, s2 = direction of the moment about c, s3 = s1 x s2."""
    phi: Float[Tensor, " n"]
    """atan(distance of c from the line / rho), in [0, pi/2)."""

    @staticmethod
    def from_lines(lines: PlueckerLines, centre: Float[Tensor, "n 3"], scale: Float[Tensor, " n"]) -> "LineChart":
        """The chart of lines about given centres. A line through its centre gets an arbitrary s2."""
        direction, moment = lines.direction, lines.moment_about(centre)
        distance = moment.norm(dim=-1)
        axis = torch.nn.functional.one_hot(direction.abs().argmin(-1), 3).to(direction.dtype)
        s2 = torch.where((distance > 0)[:, None], moment, torch.linalg.cross(direction, axis))
        s2 = s2 - (s2 * direction).sum(-1, keepdim=True) * direction
        s2 = s2 / s2.norm(dim=-1, keepdim=True)
        rotation = torch.stack([direction, s2, torch.linalg.cross(direction, s2)], -1)
        return LineChart(centre, scale, rotation, torch.atan2(distance, scale))

    @staticmethod
    def about_cameras(lines: PlueckerLines, centres: Float[Tensor, "k 3"], track: Int[Tensor, " k"]) -> "LineChart":
        """The chart in which to adjust n lines seen from k camera centres, `track` the line of each; phi starts at 45 degrees.

        rho is the median distance of a line's cameras; c lies at that distance from the line, straight out from it towards the
        camera whose distance is nearest to the median, of two the larger one. NaN for a line without a camera or through
        that camera.
        """
        distance = lines[track].distance_to(centres)
        scale = weighted_median_by_group(distance, torch.ones_like(distance), track, len(lines))
        mismatch = (distance - scale[track]).abs()
        least = torch.full_like(scale, torch.inf).scatter_reduce(0, track, mismatch, "amin")
        # Two cameras beside the median are equally near to it but for rounding: their last digits would choose the chart. It is
        # about the farther one, and of those as far the last, not the one that a thread of torch writes last.
        rounding = _ROUNDING * scale
        beside = (mismatch <= (least + rounding)[track]) & (distance >= (scale - rounding)[track])
        nearest = torch.nonzero(beside).squeeze(-1)
        row = torch.full_like(scale, len(track), dtype=torch.int64).scatter_reduce(
            0, track[nearest], nearest, "amax", include_self=False
        )
        camera = torch.cat([centres, torch.full_like(centres[:1], torch.nan)])[row]
        foot = lines.closest_point(camera)
        away = camera - foot
        return LineChart.from_lines(lines, foot + away * (scale / away.norm(dim=-1))[:, None], scale)

    def __getitem__(self, index: Any) -> "LineChart":
        return LineChart(self.centre[index], self.scale[index], self.S[index], self.phi[index])

    def __len__(self) -> int:
        return self.phi.shape[0]

    def after_similarity(self, scale: float, motion: Pose) -> "LineChart":
        """The lines where the world is X' = s R X + t, `motion` being (R, t), each in the chart that moves along."""
        centre = scale * (self.centre @ motion.rotation.mT) + motion.translation
        return LineChart(centre, scale * self.scale, motion.rotation @ self.S, self.phi)

    def _moment_about_centre(self) -> Tensor:
        return (self.scale * torch.tan(self.phi))[:, None] * self.S[:, :, 1]

    def lines(self) -> PlueckerLines:
        """The lines in the world frame."""
        direction = self.S[:, :, 0]
        return PlueckerLines(direction, self._moment_about_centre() + torch.linalg.cross(self.centre, direction))

    def retract(self, delta: Float[Tensor, "n 4"]) -> "LineChart":
        """S exp([delta_1..3]x), phi + delta_4."""
        return replace(self, S=self.S @ rotation_from_vector(delta[:, :3]), phi=self.phi + delta[:, 3])

    def _moment_jacobian(self) -> tuple[Tensor, Tensor]:
        """d d / d delta and d (moment about c) / d delta, each (n, 3, 4), at delta = 0."""
        s1, s2, s3 = self.S.unbind(-1)
        zero = torch.zeros_like(s1)
        direction = torch.stack([zero, -s3, s2, zero], -1)
        length = (self.scale * torch.tan(self.phi))[:, None]
        stretch = (self.scale / torch.cos(self.phi) ** 2)[:, None]
        return direction, torch.stack([length * s3, zero, -length * s1, stretch * s2], -1)

    def jacobian(self) -> Float[Tensor, "n 6 4"]:
        """d (d, m) / d delta at delta = 0, (d, m) in the world frame."""
        direction, moment = self._moment_jacobian()
        return torch.cat([direction, moment + hat(self.centre) @ direction], -2)

    def projection_normal(
        self, cam_from_world: Pose
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 6"], Float[Tensor, "n 3 4"]]:
        """M = R (m - C x d) of each line in its camera (4.16), d M / d pose (left perturbation) and d M / d line.

        M is formed as R (m_c + (c - C) x d): nothing depends on where the world origin is.
        """
        rotation, s1 = cam_from_world.rotation, self.S[:, :, 0]
        offset = self.centre - cam_from_world.centre
        normal = (rotation @ (self._moment_about_centre() + torch.linalg.cross(offset, s1))[..., None]).squeeze(-1)
        in_camera = (rotation @ s1[..., None]).squeeze(-1)
        # exp(delta) T moves M by w x M + v x (R d).
        by_pose = -torch.cat([hat(normal), hat(in_camera)], -1)
        direction, moment = self._moment_jacobian()
        return normal, by_pose, rotation @ (moment + hat(offset) @ direction)

    @property
    def needs_recentring(self) -> Bool[Tensor, " n"]:
        """Lines whose phi has left 20 to 70 degrees."""
        return (self.phi < PHI_MIN_RAD) | (self.phi > PHI_MAX_RAD)

    def recentred(self) -> "LineChart":
        """The same lines, with the centre of those that need it moved along its perpendicular back to the distance rho."""
        lines = self.lines()
        foot = lines.closest_point(self.centre)
        # foot - c = d x m_c points along s3, so the new centre lies on its other side.
        centre = torch.where(self.needs_recentring[:, None], foot - self.scale[:, None] * self.S[:, :, 2], self.centre)
        return LineChart.from_lines(lines, centre, self.scale)
