"""A camera, the great circles of straight lines, and the directions in which those of each photo meet, as one problem.

Camera parameters (along a basis), directions and frames of three directions at right angles are the kept blocks; the normal of
each circle is an eliminated one. Residuals: the distance of every edge point from the curve of its circle over its standard
deviation (`readings.py`), and for a circle that belongs to a direction d the product n . d over the stray of its lines.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import rotation_from_vector
from omnilines.calibration.lines.prior import CameraPrior
from omnilines.calibration.lines.readings import EdgeReadings, offsets, tangent_basis
from omnilines.least_squares import KeptGroup, Linearisation
from omnilines.least_squares.structure import Structure


@dataclass(frozen=True)
class Families:
    """Which chains are of lines along one direction. The first 3 f directions are those of f frames at right angles."""

    direction: Float[Tensor, "k 3"]
    frames: int
    photo: Int[Tensor, " k"]
    stray_rad: Float[Tensor, " c"]
    """Standard deviation by which the line of each chain may stray from its direction."""
    of_chain: Int[Tensor, " c"]
    """Direction of each chain, -1 for none."""

    @staticmethod
    def none(chains: int) -> "Families":
        """No direction."""
        nothing = torch.zeros(0, dtype=torch.long)
        zero = torch.zeros(0, dtype=torch.float64)
        return Families(zero.reshape(0, 3), 0, nothing, zero.new_ones(chains), torch.full((chains,), -1))

    @property
    def lone(self) -> int:
        """Directions that are of no frame."""
        return len(self.direction) - 3 * self.frames


@dataclass(frozen=True)
class CameraAndCircles:
    """State of the adjustment."""

    model: CameraModel
    normal: Float[Tensor, "c 3"]
    direction: Float[Tensor, "k 3"]


class LineProblem:
    """See the module. `weight` multiplies the residuals of each chain: 0 leaves it out."""

    def __init__(
        self,
        readings: EdgeReadings,
        families: Families,
        basis: Float[Tensor, "p q"],
        weight: Float[Tensor, " c"],
        prior: CameraPrior | None = None,
    ) -> None:
        self.readings, self.families, self.basis, self.weight, self.prior = readings, families, basis, weight, prior
        self.members = torch.nonzero(families.of_chain >= 0).flatten()
        of_member = families.of_chain[self.members]
        index = torch.cat([readings.chain, self.members])
        held = torch.full_like(readings.chain, -1)
        in_frame = of_member < 3 * families.frames
        frame = torch.where(in_frame, of_member // 3, -1)
        lone = torch.where(in_frame, -1, of_member - 3 * families.frames)
        groups = []
        if basis.shape[1]:
            groups.append(
                KeptGroup(torch.cat([torch.zeros_like(readings.chain), torch.full_like(of_member, -1)]), 1, basis.shape[1])
            )
        if families.frames:
            groups.append(KeptGroup(torch.cat([held, frame]), families.frames, 3))
        if families.lone:
            groups.append(KeptGroup(torch.cat([held, lone]), families.lone, 2))
        self.structure = Structure(index, readings.chains, 2, tuple(groups))

    def linearise(self, state: CameraAndCircles) -> Linearisation:
        """Whitened residuals: of points, then of the members of families."""
        points, chain = offsets(state.model, self.readings, state.normal), self.readings.chain
        basis = tangent_basis(state.normal)
        scale = self.weight[chain] / self.readings.sigma_px
        by_circle = (points.by_circle[:, None] @ basis[chain])[:, 0] * scale[:, None]
        residual = torch.cat([points.px * scale, self._off(state)])
        d, n = state.direction[self._of_member], state.normal[self.members]
        per = (self.weight[self.members] / self.families.stray_rad[self.members])[:, None]
        by_member = (d[:, None] @ basis[self.members])[:, 0] * per
        by_kept = []
        if self.basis.shape[1]:
            by_kept.append(_padded(points.by_parameter @ self.basis * scale[:, None], after=len(d)))
        if self.families.frames:
            by_kept.append(_padded(torch.linalg.cross(d, n) * per, before=len(chain)))
        if self.families.lone:
            by_kept.append(_padded((n[:, None] @ tangent_basis(d))[:, 0] * per, before=len(chain)))
        return Linearisation(
            residual[:, None],
            torch.cat([by_circle, by_member])[:, None],
            tuple(part[:, None] for part in by_kept),
            None if self.prior is None else self.prior.residuals(state.model, self.structure.kept_size),
        )

    @property
    def _of_member(self) -> Int[Tensor, " m"]:
        return self.families.of_chain[self.members]

    def _off(self, state: CameraAndCircles) -> Float[Tensor, " m"]:
        off = (state.normal[self.members] * state.direction[self._of_member]).sum(-1)
        return off * self.weight[self.members] / self.families.stray_rad[self.members]

    def retract(self, state: CameraAndCircles, kept: Tensor, eliminated: Tensor) -> CameraAndCircles:
        """Parameters along the basis; directions and normals across themselves; frames turned from the left."""
        q, frames = self.basis.shape[1], self.families.frames
        model = state.model
        if q:
            model = model.with_parameters(model.parameters + self.basis @ kept[:q])
        turned, lone = kept[q : q + 3 * frames].reshape(-1, 3), kept[q + 3 * frames :].reshape(-1, 2)
        direction = state.direction.clone()
        if frames:
            axes = direction[: 3 * frames].reshape(frames, 3, 3)
            direction[: 3 * frames] = (axes @ rotation_from_vector(turned).mT).reshape(-1, 3)
        if len(lone):
            direction[3 * frames :] = _moved(direction[3 * frames :], lone)
        return CameraAndCircles(model, _moved(state.normal, eliminated), direction)

    def gauge(self, state: CameraAndCircles) -> Float[Tensor, "k 0"]:
        """None."""
        return torch.zeros(self.structure.kept_size, 0, dtype=torch.float64)


def _moved(unit: Float[Tensor, "n 3"], step: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    return torch.nn.functional.normalize(unit + (tangent_basis(unit) @ step[..., None])[..., 0], dim=-1)


def _padded(values: Float[Tensor, "n q"], before: int = 0, after: int = 0) -> Float[Tensor, "m q"]:
    """Rows of zeros before and after."""
    return torch.nn.functional.pad(values, (0, 0, before, after))
