"""Edges of photos drawn with known noise, for tests of cameras from lines."""

import math

import numpy as np
import torch

from camera_models import CameraModel, OpenCVFisheye
from camera_models.pose import rotation_from_vector
from omnilines.calibration.lines.options import LineOptions
from omnilines.geometry.chains import Chains

FISHEYE = OpenCVFisheye([230.0, 230.8, 321.0, 238.0, -0.01, 0.002, -0.0015, 0.0001], (640, 480))
OPTIONS = LineOptions()
SIGMA_PX = 0.1


def true_chains(
    model: CameraModel,
    seed: int,
    photos: int = 6,
    lines: int = 60,
    axes: int = 3,
    off_rad: float = 0.0,
    spread: float = 9.0,
    world: np.ndarray | None = None,
    tilt_rad: float = 0.0,
    stray_rad: float = 0.0,
) -> Chains:
    """Edges along three axes at right angles (or fewer, or with the angles between them off) and at random, seen from random
    turns (or from turns within `spread` radians; or along the columns of `world`, upright but for a tilt), each of which
    strays from its axis; a point each 1.5 px or so, with noise across the edge that all points have alone."""
    rng = np.random.default_rng(seed)
    image, chain, pixels, normals = [], [], [], []
    for photo in range(photos):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        if spread < math.pi:
            turn = rotation_from_vector(torch.as_tensor([0.4, 0.5, 0.1] + spread * rng.normal(size=3))).numpy()
        turn = turn @ (np.eye(3) + 0.5 * off_rad * np.array([[0.0, 1.0, -1.0], [1.0, 0.0, 1.0], [-1.0, 1.0, 0.0]]))
        if world is not None:
            tilt = torch.as_tensor([tilt_rad, 0.0, tilt_rad]) * torch.as_tensor(rng.normal(size=3))
            heading = torch.tensor([0.0, rng.uniform(0.0, 2.0 * math.pi), 0.0], dtype=torch.float64)
            turn = (rotation_from_vector(tilt.double()) @ rotation_from_vector(heading)).numpy() @ world
        for k in range(lines):
            way = turn[:, k % axes] if k % 4 else rng.normal(size=3)
            way = way / np.linalg.norm(way) + (stray_rad * rng.normal(size=3) if stray_rad else 0.0)
            middle = rng.normal(size=3)
            middle *= rng.uniform(2.0, 5.0) / np.linalg.norm(middle)
            place = middle + np.linspace(-1.0, 1.0, 60)[:, None] * way
            if np.linalg.norm(place, axis=-1).min() < 0.5:
                continue
            seen, valid = model.project(place)
            inside = valid & (seen >= 0).all(-1) & (seen < np.array(model.image_size)).all(-1)
            inside &= place[:, 2] > math.cos(math.radians(95.0)) * np.linalg.norm(place, axis=-1)
            if inside.sum() < 12 or not inside[np.flatnonzero(inside)[0] : np.flatnonzero(inside)[-1]].all():
                continue
            along = np.gradient(seen, axis=0)[inside]
            across = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
            image.append(photo)
            chain.append(np.full(len(across), len(image) - 1))
            pixels.append(seen[inside] + SIGMA_PX * rng.normal(size=(len(across), 1)) * across)
            normals.append(across)
    points = np.concatenate(chain)
    return Chains(
        tuple(f"{k}.png" for k in range(photos)),
        model.image_size,
        np.array(image),
        points,
        np.concatenate(pixels),
        np.concatenate(normals),
        np.full(len(points), SIGMA_PX),
    )


def level_chains(model: CameraModel, seed: int, walls_deg: float, tilt_rad: float = 0.0) -> Chains:
    """Four photos of verticals, and of horizontals along walls at an angle to one another, from any side."""
    angle = math.radians(walls_deg)
    walls = np.array([[1.0, math.cos(angle), 0.0], [0.0, 0.0, 1.0], [0.0, math.sin(angle), 0.0]])
    return true_chains(model, seed, photos=4, lines=90, world=walls, tilt_rad=tilt_rad)


def disturbed(model: CameraModel, **changes: float) -> CameraModel:
    values = model.named_parameters()
    return model.with_parameters([value + changes.get(name, 0.0) for name, value in values.items()])
