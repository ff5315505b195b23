"""Camera models that project onto a unit sphere first: u = fx x / D(X) + cx, v = fy y / D(X) + cy with a denominator D > 0.

Both models of the form have the inverse of the extended unified model in them: of the radius r = hypot(x, y) / D,

    h(alpha, r^2) = (1 - alpha^2 r^2) / (alpha sqrt(1 - (2 alpha - 1) r^2) + 1 - alpha)

is the height for which (x, y, h) is a ray of the sphere whose centre lies alpha / (1 - alpha) above the projection centre.
Their domain is a cone about +z that ends where r stops growing, or where it is infinite.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._model import CameraModel
from camera_models._radial import named_vector
from camera_models.errors import InputError

FURTHEST_RADIUS = 1e8
"""Radius r in focal lengths that stands for an infinite one."""
INSIDE = 0.999
"""Points beyond the domain are replaced by one at this share of its largest angle, where the pixel is finite."""
START_MARGIN = 1.02
"""The start of a calibration holds angles up to this many times the largest that it is handed."""


def within(points: Float[Tensor, "*batch 3"], largest_angle: float) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
    """The points, each one beyond the cone of `largest_angle` (rad) about +z replaced by one inside at the same azimuth, and
    which were inside."""
    with torch.no_grad():
        s = torch.hypot(points[..., 0], points[..., 1])
        valid = (torch.atan2(s, points[..., 2]) <= largest_angle) & ((s > 0) | (points[..., 2] > 0))
        if bool(valid.all()):
            return points, valid
        on_axis = (s == 0)[..., None]
        ahead = torch.where(on_axis, points.new_tensor([1.0, 0.0]), points[..., :2] / torch.where(s == 0, 1.0, s)[..., None])
        edge = INSIDE * largest_angle
        rim = torch.cat([math.sin(edge) * ahead, torch.full_like(ahead[..., :1], math.cos(edge))], -1)
    return torch.where(valid[..., None], points, rim), valid


def onto_sphere(plane: Float[Tensor, "*batch 2"], height: Float[Tensor, "*batch"], xi: Tensor) -> Float[Tensor, "*batch 3"]:
    """Unit bearings X with (x, y, z + xi) parallel to (plane, height): where that ray meets the sphere about (0, 0, -xi)."""
    r2 = (plane**2).sum(-1)
    root = safe_sqrt(height**2 + (1 - xi**2) * r2)
    reach = (height * xi + root) / (height**2 + r2).clamp_min(1e-300)
    bearings = torch.cat([plane * reach[..., None], (height * reach - xi)[..., None]], -1)
    return bearings / bearings.norm(dim=-1, keepdim=True).clamp_min(1e-300)


def safe_sqrt(square: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Square root, zero with a zero gradient where the argument is not positive."""
    positive = square > 0
    return torch.where(positive, torch.where(positive, square, torch.ones_like(square)).sqrt(), torch.zeros_like(square))


def ray_height(alpha: Tensor, r2: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """h(alpha, r^2) of the module's header, in whichever of its two forms does not cancel."""
    root = safe_sqrt(1 - (2 * alpha - 1) * r2)
    if abs(float(alpha.detach()) - 0.5) < 0.25:
        return (1 - alpha**2 * r2) / (alpha * root + 1 - alpha)
    return (alpha * root - (1 - alpha)) / (2 * alpha - 1)


def fold_radius(alpha: float) -> float:
    """The r at which the ray (r, h) touches the sphere, beyond which no point is projected."""
    return min((2 * alpha - 1) ** -0.5, FURTHEST_RADIUS) if alpha > 0.5 else FURTHEST_RADIUS


def least_cosine(alpha: Tensor) -> Tensor:
    """Cosine of the angle at which r is infinite (alpha < 1/2) or largest, seen from the centre of the sphere."""
    return -torch.minimum(alpha / (1 - alpha).clamp_min(1e-300), (1 - alpha) / alpha.clamp_min(1e-300))


def refuse_mirror(name: str, mirror: bool) -> None:
    """Raise InputError for a camera that looks along -z."""
    if mirror:
        raise InputError(f"Camera model {name} expects a lens that looks along +z, found `mirror`; use `model` scaramuzza.")


def nearest_curves(
    curves: Float[Tensor, "*g n"], allowed: Bool[Tensor, "*g"], rho: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "*g"], Float[Tensor, "*g"]]:
    """Squared error of rho = f r for every curve r(theta), infinite where not allowed, and the best f."""
    curves = torch.where(allowed[..., None], curves, torch.ones_like(curves))
    focal = (curves @ rho) / (curves**2).sum(-1)
    error = ((focal[..., None] * curves - rho) ** 2).sum(-1)
    return torch.where(allowed, error, torch.full_like(error, math.inf)), focal


def local_minima(error: Float[Tensor, " g"]) -> list[int]:
    """Places of the values that are finite and no larger than either neighbour."""
    padded = torch.nn.functional.pad(error, (1, 1), value=math.inf)
    lowest = (error <= padded[:-2]) & (error <= padded[2:]) & torch.isfinite(error)
    return torch.nonzero(lowest).flatten().tolist()


class SphereModel(CameraModel):
    """A model with fx fy cx cy and two parameters of the denominator's shape."""

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "SphereModel":
        """The model of named parameters; all six are expected."""
        return cls(named_vector(cls.PARAMETER_NAMES, parameters, cls.NAME), image_size)

    @property
    @abstractmethod
    def max_radius(self) -> float:
        """The r = hypot(x, y) / D up to which the model is one-to-one, in focal lengths."""

    @abstractmethod
    def _ray(self, plane: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        """Unit bearings of (x, y) / D, any within `max_radius`."""

    @abstractmethod
    def _denominator(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """D of points within the domain."""

    @abstractmethod
    def _slopes(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 2"]]:
        """d D / d point and d D / d the two shape parameters."""

    @cached_property
    def max_angle(self) -> float:
        """The angle at `max_radius`."""
        with torch.no_grad():
            x, _, z = self._ray(torch.tensor([self.max_radius, 0.0], dtype=torch.float64)).tolist()
        return math.atan2(x, z)

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """Principal point (cx, cy)."""
        return self.parameters[2:4]

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        points, valid = within(points, self.max_angle)
        return self.parameters[:2] * points[..., :2] / self._denominator(points)[..., None] + self.parameters[2:4], valid

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        plane = (pixels - self.parameters[2:4]) / self.parameters[:2]
        valid = (plane.detach() ** 2).sum(-1) <= self.max_radius**2
        return self._ray(torch.where(valid[..., None], plane, torch.zeros_like(plane))), valid

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """With m = (x, y) / D: d m = (d(x, y) - m dD) / D."""
        points, valid = within(points, self.max_angle)
        fx, fy, cx, cy = self.parameters.detach()[:4].tolist()
        over = 1 / self._denominator(points)
        mx, my = points[..., 0] * over, points[..., 1] * over
        slope, by_shape = self._slopes(points)
        sx, sy, sz = (slope * over[..., None]).unbind(-1)
        first, second = (by_shape * over[..., None]).unbind(-1)
        fmx, fmy = fx * mx, fy * my
        by_u, by_v = [fx * over - fmx * sx, -fmx * sy, -fmx * sz], [-fmy * sx, fy * over - fmy * sy, -fmy * sz]
        by_point = torch.stack([*by_u, *by_v], -1).unflatten(-1, (2, 3))
        zero, one = torch.zeros_like(mx), torch.ones_like(mx)
        columns = [mx, zero, one, zero, -fmx * first, -fmx * second, zero, my, zero, one, -fmy * first, -fmy * second]
        by_parameter = torch.stack(columns, -1).unflatten(-1, (2, 6))
        pixels = torch.stack([fmx + cx, fmy + cy], -1)
        if bool(valid.all()):
            return pixels, valid, by_point, by_parameter
        keep = valid[..., None, None]
        return pixels, valid, torch.where(keep, by_point, 0.0), torch.where(keep, by_parameter, 0.0)
