"""Features of a synthetic scene for any camera, and structure from motion of them against truth."""

from pathlib import Path

import numpy as np
import pytest
import torch

from camera_models import CameraModel
from camera_models.pose import Pose
from camera_models.rotations import similarity_alignment
from omnilines.posing import sfm
from omnilines.posing.features import Features
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.posing.sfm import sfm_poses
from omnilines.records import ImagePoses

NOISE_PX = 0.35


def described(model: CameraModel, pose: Pose, points: np.ndarray, words: np.ndarray, rng: np.random.Generator) -> Features:
    """What a photo shows of points: their bearings with noise, descriptors with some, in any order, and clutter."""
    pixels, valid = model.project(pose.transform(torch.as_tensor(points)))
    inside = valid & ((pixels > 0) & (pixels < torch.tensor(model.image_size) - 1.0)).all(-1)
    seen = rng.permutation(np.flatnonzero(inside.numpy() & (rng.uniform(size=len(points)) < 0.8)))
    clutter = rng.uniform(0, 1, (60, 2)) * (np.array(model.image_size) - 1)
    at = torch.as_tensor(np.concatenate([pixels[seen].numpy() + NOISE_PX * rng.normal(size=(len(seen), 2)), clutter]))
    bearings, good = model.unproject(at)
    own = np.concatenate([words[seen] + 6 * rng.normal(size=(len(seen), 128)), rng.uniform(0, 100, (60, 128))])
    descriptors = torch.as_tensor(np.clip(own, 0, 255).astype(np.uint8))
    jacobian = model.unproject_jacobian(at)
    sigma = NOISE_PX * torch.linalg.matrix_norm(jacobian, ord=2)
    return Features(bearings[good], torch.linalg.pinv(jacobian[good]) / NOISE_PX, sigma[good], descriptors[good])


def world(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the walls of a room of 5 x 4 x 3 m, and a descriptor for each."""
    rng = np.random.default_rng(seed)
    half = np.array([2.5, 2.0, 1.5])
    points = rng.uniform(-1, 1, (count, 3))
    wall = rng.integers(3, size=count)
    points[np.arange(count), wall] = np.sign(points[np.arange(count), wall])
    return points * half, rng.uniform(0, 100, (count, 128))


def places(count: int, seed: int, around_rad: float = 5.0) -> Pose:
    """Upright cameras in the room that look around by some angle."""
    rng = np.random.default_rng(seed)
    turn = Pose.exp(torch.as_tensor(np.stack([0.2 * rng.normal(size=6) * [1, 0, 1, 0, 0, 0] for _ in range(count)])))
    yaw = torch.zeros(count, 6, dtype=torch.float64)
    yaw[:, 1] = torch.linspace(0, around_rad, count, dtype=torch.float64)
    rotation = (turn @ Pose.exp(yaw)).rotation
    centre = torch.as_tensor(rng.uniform(-1, 1, (count, 3)) * [1.5, 1.2, 0.5])
    return Pose(rotation, -(rotation @ centre[..., None])[..., 0])


def errors(found: ImagePoses, truth: Pose, names: list[str], *, metric: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Errors of position (m) and rotation (degrees) after a similarity, or after a rigid motion."""
    true = truth[[names.index(name) for name in found.images]]
    scale, similarity = similarity_alignment(found.cam_from_world.centre, true.centre)
    if metric:
        assert float(scale) == pytest.approx(1.0, abs=5e-3)
    moved = moved_poses(found, float(scale), similarity).cam_from_world
    turned = (moved @ true.inverse()).log()[:, :3].norm(dim=-1)
    return (moved.centre - true.centre).norm(dim=-1).numpy(), np.degrees(turned.numpy())


def run_on(features: list[Features], monkeypatch, folder: Path, cameras, names: list[str], camera_of, **options) -> PhotoPoses:
    """Structure from motion of features that are given instead of photos."""
    monkeypatch.setattr(sfm, "_features", lambda *_: features)
    return sfm_poses(names, lambda _: np.zeros((1, 1), np.uint8), cameras, camera_of, folder, **options)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
