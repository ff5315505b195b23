"""A camera, the great circles of straight lines, and the directions in which those of each photo meet, as one problem.

Camera parameters (along a basis), directions and frames of three directions at right angles are the kept blocks; the normal of
each circle is an eliminated one. Residuals: the distance of every edge point from the curve of its circle over its standard
deviation (`readings.py`), and for a circle that belongs to a direction d the product n . d over the stray of its lines.

Right angles of the world are off by a little. The axes of the frame of photo p are R_p (I + E(b + c_p)), with small symmetric E:
the angles yz, xz and xy are off by b in all photos, which show one building, and by c_p in this one. What is known of b and c
beforehand (`right_angles.py`) is one more residual for each of their entries.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import rotation_from_vector
from omnilines.calibration.lines.prior import CameraPrior
from omnilines.calibration.lines.readings import offsets, tangent_basis
from omnilines.calibration.lines.turning import Turning
from omnilines.calibration.lines.weighting import WeightedChains
from omnilines.least_squares import KeptGroup, KeptPrior, Linearisation
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
    curvature: float = 1.0
    """Of the robust cost of strays, over that of the weighted squares: weights fall where strays grow."""

    @staticmethod
    def none(chains: int) -> "Families":
        """No direction."""
        nothing = torch.zeros(0, dtype=torch.long)
        zero = torch.zeros(0, dtype=torch.float64)
        return Families(zero.reshape(0, 3), 0, nothing, zero.new_ones(chains), torch.full((chains,), -1))

    @property
    def in_frame(self) -> Bool[Tensor, " c"]:
        """Chains of lines along an axis of a frame."""
        return (self.of_chain >= 0) & (self.of_chain < 3 * self.frames)

    @property
    def frame_stray_rad(self) -> float:
        """Of the median line of frames; 0 where there is none."""
        own = self.stray_rad[self.in_frame]
        return float(own.median()) if len(own) else 0.0

    @property
    def lone(self) -> int:
        """Directions that are of no frame."""
        return len(self.direction) - 3 * self.frames


LOST_SIGMAS = 3.0
"""A point that a camera no longer sees is taken to be off by so much: none gains by not seeing edges."""
PAIRS = ((1, 2), (0, 2), (0, 1))
"""Axes of a frame between which right angles may be off, in the order of their deviations."""


@dataclass(frozen=True)
class AngleSigmas:
    """Standard deviations (rad) by which right angles are off."""

    shared: tuple[float, float, float]
    """In all photos alike: the angles yz, xz and xy."""
    own: float
    """Of each photo beside."""

    @staticmethod
    def of_strays(families: Families) -> "AngleSigmas":
        """By as much as single lines stray from their directions: where nothing better is known."""
        stray = families.frame_stray_rad
        return AngleSigmas((stray, stray, stray), stray)


@dataclass(frozen=True)
class CameraAndCircles:
    """State of the adjustment."""

    model: CameraModel
    normal: Float[Tensor, "c 3"]
    direction: Float[Tensor, "k 3"]
    off_rad: Float[Tensor, "f 3"]
    """By how much the right angles of each frame are off: those that all frames share, then those of each beside."""

    @staticmethod
    def right(model: CameraModel, normal: Float[Tensor, "c 3"], families: Families) -> "CameraAndCircles":
        """With right angles exact."""
        return CameraAndCircles(model, normal, families.direction, normal.new_zeros(families.frames + 1, 3))


class LineProblem:
    """See the module."""

    def __init__(
        self,
        chains: WeightedChains,
        families: Families,
        basis: Float[Tensor, "p q"],
        angles: AngleSigmas,
        turning: Turning,
        prior: CameraPrior | None = None,
    ) -> None:
        self.chains, self.families, self.basis, self.angles, self.prior = chains, families, basis, angles, prior
        self.turning = turning
        readings = chains.blocks
        self.members = torch.nonzero(families.of_chain >= 0).flatten()
        of_member = families.of_chain[self.members]
        index = torch.cat([readings.chain, self.members])
        held = torch.full_like(readings.chain, -1)
        in_frame = families.in_frame[self.members]
        frame = torch.where(in_frame, of_member // 3, -1)
        lone = torch.where(in_frame, -1, of_member - 3 * families.frames)
        groups = []
        if basis.shape[1]:
            groups.append(KeptGroup(torch.zeros_like(index), 1, basis.shape[1]))
        if families.frames:
            groups.append(KeptGroup(torch.cat([held, frame]), families.frames, 3))
        if families.lone:
            groups.append(KeptGroup(torch.cat([held, lone]), families.lone, 2))
        if families.frames:
            groups.append(KeptGroup(torch.cat([held, torch.where(in_frame, 0, -1)]), 1, 3))
            groups.append(KeptGroup(torch.cat([held, frame]), families.frames, 3))
        self.structure = Structure(index, readings.chains, 2, tuple(groups))

    @property
    def angle_columns(self) -> slice:
        """Kept columns of the deviations of right angles: those shared first."""
        return slice(self.structure.kept_size - 3 * (self.families.frames + 1) * bool(self.families.frames), None)

    @property
    def curvature(self) -> Float[Tensor, " n"]:
        """Of the robust cost at each residual, over that of the weighted squares."""
        ones = torch.ones(len(self.structure.index), dtype=torch.float64)
        ones[: len(ones) - len(self.members)] = self.chains.curvature
        ones[len(ones) - len(self.members) :] = self.families.curvature
        return ones

    def linearise(self, state: CameraAndCircles) -> Linearisation:
        """Whitened residuals: of points, then of the members of families."""
        readings = self.chains.blocks
        weight = self.chains.weight * readings.times.rsqrt()
        points, chain = offsets(state.model, readings, state.normal), readings.chain
        basis = tangent_basis(state.normal)
        scale = weight[chain] / readings.sigma_px
        by_circle = (points.by_circle[:, None] @ basis[chain])[:, 0] * scale[:, None]
        # Strays are stated as they are, however noisy edges turn out to be.
        growth, by_camera = self.turning.growth(state.model)
        per = (weight * self.chains.scale / self.families.stray_rad)[self.members] / growth
        d, n = state.direction[self._of_member], state.normal[self.members]
        lost = self.chains.at.valid & ~points.valid
        strays = (n * d).sum(-1) * per
        residual = torch.cat([torch.where(lost, LOST_SIGMAS * weight[chain], points.px * scale), strays])
        by_member = (d[:, None] @ basis[self.members])[:, 0] * per[:, None]
        by_kept = []
        if self.basis.shape[1]:
            by_kept.append(torch.cat([points.by_parameter * scale[:, None], -strays[:, None] * by_camera]) @ self.basis)
        if self.families.frames:
            by_kept.append(_padded(torch.linalg.cross(d, n) * per[:, None], len(chain)))
        if self.families.lone:
            by_kept.append(_padded((n[:, None] @ tangent_basis(d))[:, 0] * per[:, None], len(chain)))
        if self.families.frames:
            by_kept += 2 * [_padded(self._by_angle(state, n) * per[:, None], len(chain))]
        return Linearisation(
            residual[:, None],
            torch.cat([by_circle, by_member])[:, None],
            tuple(part[:, None] for part in by_kept),
            self._known(state),
        )

    @property
    def _of_member(self) -> Int[Tensor, " m"]:
        return self.families.of_chain[self.members]

    def _by_angle(self, state: CameraAndCircles, n: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Derivatives of n . d by the deviations of right angles: where those of a and b are off, a moves to b by half of it."""
        axes = state.direction[: 3 * self.families.frames].reshape(-1, 3, 3)
        of, inside = self._of_member, self.families.in_frame[self.members]
        along = (axes[torch.where(inside, of // 3, 0)] @ n[..., None])[..., 0]
        found = [torch.where(of % 3 == a, along[:, b], torch.where(of % 3 == b, along[:, a], 0.0)) for a, b in PAIRS]
        return 0.5 * torch.where(inside[:, None], torch.stack(found, -1), 0.0)

    def _known(self, state: CameraAndCircles) -> KeptPrior | None:
        """What is known of the camera and of right angles."""
        size = self.structure.kept_size
        parts = [] if self.prior is None else [self.prior.residuals(state.model, size)]
        if self.families.frames:
            own = torch.full((self.families.frames, 3), self.angles.own, dtype=torch.float64)
            per = 1.0 / torch.cat([torch.tensor([self.angles.shared], dtype=torch.float64), own]).flatten()
            rows = torch.eye(size, dtype=torch.float64)[self.angle_columns] * per[:, None]
            parts.append(KeptPrior(state.off_rad.flatten() * per, rows))
        if not parts:
            return None
        return KeptPrior(torch.cat([one.residual for one in parts]), torch.cat([one.by_kept for one in parts]))

    def retract(self, state: CameraAndCircles, kept: Tensor, eliminated: Tensor) -> CameraAndCircles:
        """Parameters along the basis; directions and normals across themselves; frames turned from the left, and bent."""
        q, frames = self.basis.shape[1], self.families.frames
        model, direction, off = state.model, state.direction.clone(), state.off_rad
        if q:
            model = model.with_parameters(model.parameters + self.basis @ kept[:q])
        turned = kept[q : q + 3 * frames].reshape(-1, 3)
        lone = kept[q + 3 * frames : q + 3 * frames + 2 * self.families.lone].reshape(-1, 2)
        if frames:
            change = kept[self.angle_columns].reshape(-1, 3)
            off = off + change
            axes = _bent(direction[: 3 * frames].reshape(frames, 3, 3), change[:1] + change[1:])
            direction[: 3 * frames] = (axes @ rotation_from_vector(turned).mT).reshape(-1, 3)
        if len(lone):
            direction[3 * frames :] = _moved(direction[3 * frames :], lone)
        return CameraAndCircles(model, _moved(state.normal, eliminated), direction, off)

    def gauge(self, state: CameraAndCircles) -> Float[Tensor, "k 0"]:
        """None."""
        return torch.zeros(self.structure.kept_size, 0, dtype=torch.float64)


def _bent(axes: Float[Tensor, "f 3 3"], change: Float[Tensor, "f 3"]) -> Float[Tensor, "f 3 3"]:
    """Axes (rows) with the angles between them widened the other way: their products grow by `change`."""
    moved = axes.clone()
    for k, (a, b) in enumerate(PAIRS):
        half = 0.5 * change[:, k, None]
        moved[:, a], moved[:, b] = moved[:, a] + half * axes[:, b], moved[:, b] + half * axes[:, a]
    return torch.nn.functional.normalize(moved, dim=-1)


def _moved(unit: Float[Tensor, "n 3"], step: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    return torch.nn.functional.normalize(unit + (tangent_basis(unit) @ step[..., None])[..., 0], dim=-1)


def _padded(values: Float[Tensor, "n q"], before: int) -> Float[Tensor, "m q"]:
    """Rows of zeros before."""
    return torch.nn.functional.pad(values, (0, 0, before, 0))
