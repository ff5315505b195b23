"""Parameters of a camera model that make up for one another, where the camera itself is well determined.

At xi = 0 the double-sphere model is such a place: the first derivative of its denominator by xi is a sum of those by alpha and
by the focal length, so that no linearisation can tell them apart, whatever the photos are. That is a property of the model
and not of the data: one of the parameters can be held, and the bearings keep all their freedom.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.uncertainty import bearing_jacobian

CANCELS = 1e-4
"""Where the parts of a bearing's motion cancel to less than this share of their sum, nothing moves."""
IN_PIXELS = ("fx", "fy", "cx", "cy", "skew")


def redundant_parameter(model: CameraModel, direction: Float[Tensor, " p"], pixels: Float[Tensor, "n 2"]) -> int | None:
    """Index of a parameter without unit that can be held because the direction of the parameters which a solution leaves open
    moves no bearing; None where bearings do move along it, so that it is the data which leave the camera open."""
    _, seen, by_parameter, _ = bearing_jacobian(model, pixels)
    parts = by_parameter[seen] * direction
    if float(parts.sum(-1).norm()) > CANCELS * float(parts.norm(dim=1).sum()):
        return None
    moved = parts.norm(dim=(0, 1))
    names = model.PARAMETER_NAMES
    shapes = [k for k in range(len(names)) if names[k] not in IN_PIXELS and float(moved[k]) > 0]
    return max(shapes, key=lambda k: float(moved[k])) if shapes else None


def basis_without(basis: Float[Tensor, "p q"], held: int) -> Float[Tensor, "p r"]:
    """The directions of `basis` along which parameter `held` does not move."""
    _, _, vt = torch.linalg.svd(basis[held : held + 1])
    return basis @ vt[1:].mT
