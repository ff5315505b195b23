"""The turn about the axis that the affine terms of OCamCalib's model hold, and that no other camera model can.

With A = [1 e; d c] = M R(phi), tan(phi) = (d - e) / (1 + c), M is symmetric, and the camera of M / k, k = M_00, with
a_j' = k^(1 - j) a_j sees what the first one sees, in a frame that is turned by phi about z.
"""

import math

import torch

from camera_models.pose import Pose
from camera_models.scaramuzza import Scaramuzza


def turn_rad(camera: Scaramuzza) -> float:
    """phi."""
    c, d, e = camera.parameters.detach()[2:5].tolist()
    return math.atan2(d - e, 1 + c)


def turned(camera: Scaramuzza) -> tuple[Scaramuzza, Pose]:
    """The camera with e = d, and the pose that takes the frame of the given one to its own."""
    cx, cy, c, d, e, *a = camera.parameters.detach().tolist()
    phi = turn_rad(camera)
    cosine, sine = math.cos(phi), math.sin(phi)
    k = cosine - e * sine
    off = (sine + e * cosine) / k
    coefficients = [value * k ** (1 - order) for value, order in zip(a, (0, *range(2, camera.degree + 1)), strict=True)]
    model = Scaramuzza([cx, cy, (d * sine + c * cosine) / k, off, off, *coefficients], camera.image_size)
    rotation = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return model, Pose(rotation, torch.zeros(3, dtype=torch.float64))
