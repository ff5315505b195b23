"""How well lines keep the structure they should have: one plane, parallel families, right angles, even spacing.

Directions are compared without regard to their sign. Angles do not depend on the scale of the scene; what is in metres does.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import Array, array_function
from camera_models.errors import GeometryError


def _angles(first: Float[Tensor, "*batch1 3"], second: Float[Tensor, "*batch2 3"]) -> Tensor:
    """Angles (rad, in [0, pi/2]) between directions of any length; batches broadcast."""
    first, second = torch.broadcast_tensors(first, second)
    return torch.atan2(torch.linalg.cross(first, second).norm(dim=-1), (first * second).sum(-1).abs())


def _lengths(vectors: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vectors, dim=-1)


def _rms(values: Tensor) -> Tensor:
    return values.square().mean().sqrt()


@array_function
def mean_direction(directions: Float[Array, "n 3"]) -> Float[Array, "3"]:
    """The unit vector that maximises sum (d . u)^2 over n unit directions of either sign."""
    return torch.linalg.eigh(directions.mT @ directions)[1][:, -1]


@array_function
def coplanarity(ends_m: Float[Array, "n 2 3"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """RMS distance (m) of the end points of n segments from their best plane, and RMS angle (rad) of the segments to it.

    Raises GeometryError for fewer than two segments.
    """
    if len(ends_m) < 2:
        raise GeometryError(f"Co-planarity was expected to be asked of at least 2 lines, found {len(ends_m)}; give more lines.")
    points = ends_m.reshape(-1, 3)
    centred = points - points.mean(0)
    normal = torch.linalg.eigh(centred.mT @ centred)[1][:, 0]
    direction = ends_m[:, 1] - ends_m[:, 0]
    sine = (direction @ normal) / _lengths(direction)  # type: ignore[arg-type]
    return _rms(centred @ normal), _rms(torch.asin(sine.clamp(-1, 1)))


@array_function
def parallelism(directions: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Angle (rad) of each of n directions to their mean direction."""
    return _angles(directions, mean_direction(directions))  # type: ignore[arg-type]


@array_function
def orthogonality(first: Float[Array, "n 3"], second: Float[Array, "m 3"]) -> tuple[Float[Array, ""], Float[Array, "n m"]]:
    """Deviation from a right angle (rad) of the mean directions of two families, and of every pair of their directions."""
    means = _angles(mean_direction(first), mean_direction(second))  # type: ignore[arg-type]
    pairs = _angles(first[:, None], second)  # type: ignore[arg-type]
    return torch.pi / 2 - means, torch.pi / 2 - pairs


@array_function
def spacing(ends_m: Float[Array, "n 2 3"]) -> Float[Array, " n-1"]:
    """Distance (m) between neighbours in an ordered family of n nearly parallel segments.

    It is the mean distance of the four end points of a pair from the line through the other segment.
    """
    direction = ends_m[:, 1] - ends_m[:, 0]
    direction = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)

    def distance(points: Tensor, onto: Tensor, along: Tensor) -> Tensor:
        return torch.linalg.cross(points - onto[:, :1], along[:, None].expand_as(points)).norm(dim=-1).mean(-1)

    forward = distance(ends_m[:-1], ends_m[1:], direction[1:])  # type: ignore[arg-type]
    backward = distance(ends_m[1:], ends_m[:-1], direction[:-1])  # type: ignore[arg-type]
    return 0.5 * (forward + backward)
