"""Rendered photos of boards with tags through wide lenses, whole, cropped and covered, with the true corners."""

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch

from calib_patterns import Detection, pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import render_target
from camera_models._model import CameraModel
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.scaramuzza import Scaramuzza

CAMERAS: dict[str, tuple[CameraModel, float]] = {
    "fisheye-190": (OpenCVFisheye([286.0, 286.0, 639.5, 479.5, -0.01, 0.003, -0.001, 0.0001], (1280, 960)), 85.0),
    "scaramuzza": (Scaramuzza.examples()[0], 80.0),
}


@dataclass(frozen=True)
class View:
    """One photo and where its corners truly are, by id; `visible` are those a person sees clearly, `hidden` those nobody can."""

    image: np.ndarray
    truth: np.ndarray
    visible: np.ndarray
    hidden: np.ndarray

    def cropped(self, share: float, axis: int) -> "View":
        """Cut through the board at a share of its extent along an axis of the photo; the far side stays."""
        low, high = self.truth[:, axis].min(), self.truth[:, axis].max()
        at = int(low + share * (high - low))
        image = np.ascontiguousarray(self.image[:, at:] if axis == 0 else self.image[at:])
        truth = self.truth - np.where(np.arange(2) == axis, float(at), 0.0)
        return View(image, truth, truth[:, axis] > 6.0, truth[:, axis] < -0.5)

    def covered(self, share: float, angle_rad: float, seed: int) -> "View":
        """A textured sheet over one side of a line across the board."""
        normal = np.array([math.cos(angle_rad), math.sin(angle_rad)])
        along = self.truth @ normal
        edge = along.min() + share * (along.max() - along.min())
        height, width = self.image.shape
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        cover = np.clip(u * normal[0] + v * normal[1] - edge + 0.5, 0.0, 1.0)
        rng = np.random.default_rng(seed)
        texture = 120.0 + 300.0 * cv2.GaussianBlur(rng.normal(0.0, 1.0, self.image.shape), (0, 0), 6.0)
        image = np.clip(self.image * (1.0 - cover) + texture * cover, 0, 255).astype(np.uint8)
        return View(image, self.truth, along < edge - 6.0, along > edge + 0.5)

    def errors_px(self, found: Detection) -> np.ndarray:
        """Distances of the found corners from the truth of their ids."""
        return np.linalg.norm(found.pixels - self.truth[found.ids], axis=1)


@lru_cache(maxsize=4)
def views(specification: str, camera: str, count: int, min_spacing_px: float, blur_px: float = 0.5) -> tuple[View, ...]:
    """Photos with a little noise, boards out to the rim."""
    board, (model, max_angle_deg) = pattern(specification), CAMERAS[camera]
    poses = random_board_poses(board, model, count, math.radians(max_angle_deg), min_spacing_px=min_spacing_px, seed=11)
    result = []
    for index in range(count):
        image = render_target(board, model, poses[index], blur_px=blur_px, noise_grey=2.0, vignetting=0.2, seed=index)
        pixels, valid = model.project(poses[index].transform(torch.as_tensor(board.points_m)))
        assert valid.all()
        everything = np.ones(len(board.points_m), dtype=bool)
        result.append(View(image, pixels.numpy(), everything, ~everything))
    return tuple(result)


def check_partial(found: Detection, view: View, may_miss: int) -> None:
    """Every clearly visible corner but a few next to the edge, right ids, none invented, none off by more than 1 px."""
    assert view.visible.sum() >= 8 and view.hidden.sum() >= 8
    missed = np.setdiff1d(np.flatnonzero(view.visible), found.ids)
    assert len(missed) <= may_miss, missed
    assert not view.hidden[found.ids].any()
    errors = view.errors_px(found)
    assert errors.max() < 1.0 and np.sqrt((errors**2).mean() / 2) < 0.1
