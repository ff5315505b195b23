"""Poses in which a person could show the board to a camera, and what each would tell of the camera's parameters."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.stats import qmc
from torch import Tensor

from camera_models.pose import Pose, hat, rotation_from_vector
from omnilines.calibration.image_field import ImageField
from omnilines.calibration.thresholds import ShootingThresholds

PLACES = 48
"""Of the grid of places, along the longer side of the image."""
THINNED = 100
"""Corners of a board, drawn at random, that stand for all of it where there are more."""
TILTS_DEG = 15.0
"""Tilts are multiples of it, and turns of the axis about which a board is tilted multiples of three times it."""


@dataclass(frozen=True)
class SeenBoards:
    """How the board was shown so far, which bounds what is asked for next."""

    board_m: Float[Tensor, "n 3"]
    """Corners of the whole board."""
    nearest_m: float
    farthest_m: float
    """From the camera to the middle of the board."""
    spacing_px: float
    """Least distance of neighbouring corners that were found."""
    share: float
    """Of the corners of the board, those that were found in the median view."""

    @staticmethod
    def of(
        board_m: Float[Tensor, "n 3"],
        poses: Pose,
        view: Int[Tensor, " m"],
        pixels: Float[Tensor, "m 2"],
    ) -> "SeenBoards":
        """Of corners by view; rows of `poses` are the views."""
        middle = board_m.mean(0, keepdim=True)
        distance = poses.transform(middle.expand(len(poses), 1, 3))[:, 0].norm(dim=-1)
        spacing, counts = [], torch.bincount(view, minlength=len(poses))
        for own in range(len(poses)):
            seen = pixels[view == own].numpy()
            if len(seen) > 1:
                spacing.append(float(_to_nearest(seen).min()))
        return SeenBoards(
            board_m, float(distance.min()), float(distance.max()), min(spacing), float(counts.median()) / len(board_m)
        )


@dataclass(frozen=True)
class Candidates:
    """Poses of the board, all of which the camera would see well."""

    poses: Pose
    tilt_deg: Float[Tensor, " k"]
    nearer: Float[Tensor, "k 3"]
    """Direction in the camera frame, across the ray to the middle, of the side of the board that is nearest."""
    places_px: Float[Tensor, "k 2"]
    """The middle of the board in the image."""

    def __len__(self) -> int:
        return len(self.places_px)

    def __getitem__(self, rows: Tensor) -> "Candidates":
        return Candidates(self.poses[rows], self.tilt_deg[rows], self.nearer[rows], self.places_px[rows])


def candidates(field: ImageField, seen: SeenBoards, thresholds: ShootingThresholds) -> Candidates:
    """Boards spread evenly over places in the image, distances, tilts and turns (Halton's sequence: the same ones every time),
    of which those are kept that show most of their corners, none too near to the next or at too flat an angle."""
    shares = torch.as_tensor(qmc.Halton(5, scramble=False).random(thresholds.candidates + 1)[1:])
    grid = field.grid(PLACES)
    places = grid[(shares[:, 0] * len(grid)).long()]
    model, board = field.model, seen.board_m
    ray, _ = model.unproject(places)
    right = model.unproject_jacobian(places)[..., 0]
    right = right / right.norm(dim=-1, keepdim=True)
    below = torch.linalg.cross(ray, right)
    nearest_m = thresholds.nearest_share * seen.nearest_m
    distance = nearest_m * (seen.farthest_m / nearest_m) ** shares[:, 1]
    steps = round(thresholds.most_tilt_deg / TILTS_DEG) + 1
    tilt_deg = TILTS_DEG * (shares[:, 2] * steps).floor()
    lean = math.radians(3 * TILTS_DEG) * (shares[:, 3] * 8).floor()
    roll = 0.5 * math.pi * (shares[:, 4] * 2).floor()
    x = roll.cos()[:, None] * right + roll.sin()[:, None] * below
    untilted = torch.stack([x, torch.linalg.cross(ray, x), ray], -1)
    axis = lean.cos()[:, None] * right + lean.sin()[:, None] * below
    rotation = rotation_from_vector(axis * torch.deg2rad(tilt_deg)[:, None]) @ untilted
    poses = Pose(rotation, distance[:, None] * ray - rotation @ board.mean(0))
    found = Candidates(poses, tilt_deg, torch.linalg.cross(axis, ray), places)
    return found[_seen_well(field, seen, found, thresholds)]


def _seen_well(field: ImageField, seen: SeenBoards, boards: Candidates, thresholds: ShootingThresholds) -> Bool[Tensor, " k"]:
    points = boards.poses.transform(seen.board_m.expand(len(boards), -1, -1))
    pixels, valid = field.model.project(points)
    spacing_px = min(thresholds.resolved_px, seen.spacing_px)
    # The squares round a corner are seen too.
    shown = valid & field.shows(pixels, 0.5 * spacing_px)
    # The angle between the ray and the normal, from the front.
    straight = (points * boards.poses.rotation[:, None, :, 2]).sum(-1) / points.norm(dim=-1).clamp_min(1e-300)
    least = torch.where(shown, straight, torch.ones_like(straight)).amin(-1)
    enough = shown.to(torch.float64).mean(-1) >= min(thresholds.shown_share, seen.share)
    board = seen.board_m.numpy()
    pairs = cKDTree(board).query_pairs(1.01 * _to_nearest(board).max(), output_type="ndarray")
    first, second = torch.as_tensor(pairs).unbind(-1)
    apart = (pixels[:, first] - pixels[:, second]).norm(dim=-1)
    resolved = torch.where(shown[:, first] & shown[:, second], apart, torch.inf).amin(-1) >= spacing_px
    return enough & (least >= math.cos(math.radians(thresholds.steepest_deg))) & resolved


def _to_nearest(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    return np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1]


def view_information(field: ImageField, poses: Pose, board_m: Float[Tensor, "n 3"]) -> Float[Tensor, "k p p"]:
    """What corners of unit variance tell of the parameters in each pose, the pose unknown: S_v of `calibration.held_out`."""
    chosen = board_m[np.sort(np.random.default_rng(0).permutation(len(board_m))[:THINNED])]
    points = poses.transform(chosen.expand(len(poses), -1, -1))
    pixels, valid, by_point, by_parameter = field.model.project_with_jacobians(points)
    weight = (valid & field.shows(pixels)).to(torch.float64)[..., None, None] * math.sqrt(len(board_m) / len(chosen))
    by_pose = torch.cat([-by_point @ hat(points), by_point], -1) * weight
    rows = torch.cat([by_pose, by_parameter * weight], -1).flatten(1, 2)
    gram = rows.mT @ rows
    own, coupling = gram[:, :6, :6], gram[:, :6, 6:]
    return gram[:, 6:, 6:] - coupling.mT @ torch.linalg.solve(own, coupling)
