"""Arcs of a room with known lines in any camera: which arc shows which line, with noise, colours, pieces and poses as asked."""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from camera_models import CameraModel
from camera_models.equirectangular import Equirectangular
from camera_models.pose import Pose
from omnilines.geometry.line import PlueckerLines
from omnilines.matching.arcs import ViewedArcs
from omnilines.synthetic.lines import room_world
from omnilines.synthetic.targets import example_camera

SAMPLES = 300
LONGEST_RAD, SHORTEST_RAD = 2.5, math.radians(3.0)
SIZE = np.array([6.0, 5.0, 3.0])
VIEWS = {"fisheye": 12, "scaramuzza": 12, "panorama": 8, "pinhole": 30}


def camera_named(name: str) -> tuple[CameraModel, float]:
    """A camera and half of its field of view (rad)."""
    if name == "panorama":
        return Equirectangular([], (1600, 800)), math.pi
    model, degrees = {"fisheye": ("opencv-fisheye", 190.0), "scaramuzza": ("scaramuzza", 220.0), "pinhole": ("pinhole", 100.0)}[
        name
    ]
    return example_camera(model, degrees, (1280, 960), 5), math.radians(degrees / 2)


@dataclass(frozen=True)
class MatchingScene:
    """Exact ends of n arcs, sorted by photo, of t lines; row k of `line` is the line of arc k."""

    camera: CameraModel
    poses: Pose
    ends_m: torch.Tensor
    image: np.ndarray
    line: np.ndarray
    pixels: torch.Tensor

    def truth(self) -> PlueckerLines:
        return PlueckerLines.from_points(self.ends_m[:, 0], self.ends_m[:, 1])

    def views_of_lines(self) -> np.ndarray:
        pairs = np.unique(self.line * len(self.poses) + self.image)
        return np.bincount(pairs // len(self.poses), minlength=len(self.ends_m))

    def arcs(self, sigma_px: float, seed: int, colours: bool = False, poses: Pose | None = None) -> ViewedArcs:
        """The arcs with noise, their ends in random order; colours are those of two sides of each line, with a gain and noise."""
        rng = np.random.default_rng(seed)
        pixels = self.pixels.numpy() + sigma_px * rng.standard_normal(self.pixels.shape)
        turned = rng.random(len(pixels)) < 0.5
        pixels[turned] = pixels[turned][:, ::-1]
        seen_as = np.full((len(pixels), 2, 3), np.nan)
        if colours:
            of_lines = rng.uniform(math.log(20.0), math.log(250.0), (len(self.ends_m), 2, 3))
            along = self.truth().direction[self.line] * self._world_chord()
            against = (along.sum(-1).numpy() < 0) ^ turned
            gain = 0.15 * rng.standard_normal(len(self.poses))[self.image]
            own = of_lines[self.line]
            seen_as = np.where(against[:, None, None], own[:, ::-1], own) + gain[:, None, None]
            seen_as = seen_as + 0.08 * rng.standard_normal(own.shape)
        return viewed(self.camera, self.poses if poses is None else poses, self.image, torch.as_tensor(pixels), sigma_px, seen_as)

    def _world_chord(self) -> torch.Tensor:
        bearings, _ = self.camera.unproject(self.pixels)
        return ((bearings[:, 1] - bearings[:, 0])[:, None] @ self.poses.rotation[torch.as_tensor(self.image)])[:, 0]

    def cut(self, seed: int) -> "MatchingScene":
        """Every arc in one to three pieces with gaps, as an edge detector leaves them."""
        rng = np.random.default_rng(seed)
        bearings, _ = self.camera.unproject(self.pixels)
        normal = torch.linalg.cross(bearings[:, 0], bearings[:, 1])
        side = torch.linalg.cross(normal / normal.norm(dim=-1, keepdim=True), bearings[:, 0])
        angle = torch.atan2((bearings[:, 1] * side).sum(-1), (bearings[:, 1] * bearings[:, 0]).sum(-1))
        pieces = rng.integers(1, 4, len(self.image))
        row = np.repeat(np.arange(len(pieces)), pieces)
        number = np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        low = (number + rng.uniform(0.0, 0.15, len(row))) / pieces[row]
        high = (number + 1 - rng.uniform(0.0, 0.15, len(row))) / pieces[row]
        at = angle[row, None] * torch.as_tensor(np.stack([low, high], -1))
        ends = bearings[row, :1] * at.cos()[..., None] + side[row, None] * at.sin()[..., None]
        pixels, valid = self.camera.project(ends)
        assert bool(valid.all())
        return replace(self, image=self.image[row], line=self.line[row], pixels=pixels)


def viewed(
    camera: CameraModel, poses: Pose, image: np.ndarray, pixels: torch.Tensor, sigma_px: float, colours: np.ndarray
) -> ViewedArcs:
    bearings, seen = camera.unproject(pixels)
    assert bool(seen.all())
    by_pixel = camera.unproject_jacobian(pixels)
    covariance = np.broadcast_to(max(sigma_px, 0.01) ** 2 * np.eye(2), (len(image), 2, 2, 2)).copy()
    return ViewedArcs(image, poses, bearings.numpy(), by_pixel.numpy(), covariance, colours)


def every_neighbour(photos: int) -> np.ndarray:
    return ~np.eye(photos, dtype=bool)


def looking(centres: np.ndarray, axes: np.ndarray) -> Pose:
    z = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    x = np.cross(z, np.array([0.0, 0.1, 1.0]))
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    rotation = torch.as_tensor(np.stack([x, np.cross(z, x), z], -2))
    return Pose(rotation, -(rotation @ torch.as_tensor(centres)[..., None]).squeeze(-1))


def seen_ends(camera: CameraModel, half_rad: float, poses: Pose, ends_m: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels (k, t, 2, 2) of both ends of the longest part that each camera sees of each line, and whether it sees one (k, t)."""
    share = torch.linspace(0.0, 1.0, SAMPLES, dtype=torch.float64)[:, None]
    points = ends_m[:, :1] + share * (ends_m[:, 1:] - ends_m[:, :1])
    in_camera = poses.transform(points.reshape(-1, 3).expand(len(poses), -1, -1)).unflatten(1, points.shape[:2])
    pixels, valid = camera.project(in_camera)
    size = torch.tensor(camera.image_size, dtype=torch.float64)
    # Room for the noise: an end beyond the border has no bearing.
    inside = ((pixels >= 4.0) & (pixels <= size - 5.0)).all(-1)
    if camera.PERIODIC:
        inside = (pixels[..., 1] >= 4.0) & (pixels[..., 1] <= size[1] - 5.0)
    theta = torch.atan2(in_camera[..., :2].norm(dim=-1), in_camera[..., 2])
    seen = valid & inside & (theta <= half_rad)
    first, last = torch.zeros(seen.shape[:2], dtype=torch.int64), torch.full(seen.shape[:2], -1)
    start = torch.zeros_like(first)
    for place in range(SAMPLES):
        start = torch.where(seen[..., place], start, place + 1)
        longer = (place - start) > (last - first)
        first, last = torch.where(longer, start, first), torch.where(longer, place, last)
    both = torch.stack([first, last.clamp_min(0)], -1)
    ends = torch.gather(in_camera, 2, both[..., None].expand(*both.shape, 3))
    unit = ends / ends.norm(dim=-1, keepdim=True)
    angle = torch.atan2(
        torch.linalg.cross(unit[..., 0, :], unit[..., 1, :]).norm(dim=-1), (unit[..., 0, :] * unit[..., 1, :]).sum(-1)
    )
    used = (last > first) & (angle > SHORTEST_RAD) & (angle < LONGEST_RAD)
    return torch.gather(pixels, 2, both[..., None].expand(*both.shape, 2)), used


@functools.cache
def room(name: str, seed: int = 1, views: int | None = None) -> MatchingScene:
    """The lines of `room_world` seen by a number of cameras at random places that look any way."""
    camera, half_rad = camera_named(name)
    rng = np.random.default_rng(seed + 100)
    count = VIEWS[name] if views is None else views
    centres = rng.uniform(0.2, 0.8, (count, 3)) * SIZE
    axes = rng.standard_normal((count, 3)) * np.array([1.0, 1.0, 0.4])
    return from_views(camera, half_rad, looking(centres, axes), room_world(seed).ends_m)


def from_views(camera: CameraModel, half_rad: float, poses: Pose, ends_m: torch.Tensor) -> MatchingScene:
    pixels, used = seen_ends(camera, half_rad, poses, ends_m)
    image, line = torch.nonzero(used, as_tuple=True)
    return MatchingScene(camera, poses, ends_m, image.numpy(), line.numpy(), pixels[used])


def shaken(poses: Pose, degrees: float, millimetres: float, seed: int) -> Pose:
    """Poses with errors of that standard deviation about each axis, and of each coordinate of the centre."""
    rng = np.random.default_rng(seed)
    turn = np.concatenate([math.radians(degrees) * rng.standard_normal((len(poses), 3)), np.zeros((len(poses), 3))], -1)
    centre = poses.centre + torch.as_tensor(0.001 * millimetres * rng.standard_normal((len(poses), 3)))
    rotation = Pose.exp(torch.as_tensor(turn)).rotation @ poses.rotation
    return Pose(rotation, -(rotation @ centre[..., None]).squeeze(-1))


def random_arcs(name: str, views: int, each: int, seed: int) -> ViewedArcs:
    """Arcs of no common lines: every photo sees lines of its own."""
    camera, half_rad = camera_named(name)
    rng = np.random.default_rng(seed)
    poses = looking(rng.uniform(0.2, 0.8, (views, 3)) * SIZE, rng.standard_normal((views, 3)))
    image, pixels = [], []
    for k in range(views):
        ends_m = torch.as_tensor(rng.uniform(0.0, 1.0, (12 * each, 2, 3)) * SIZE)
        found, used = seen_ends(camera, half_rad, poses[k : k + 1], ends_m)
        own = found[used][:each]
        image.append(np.full(len(own), k))
        pixels.append(own)
    where = np.concatenate(image)
    return viewed(camera, poses, where, torch.cat(pixels), 0.3, np.full((len(where), 2, 3), np.nan))


@dataclass(frozen=True)
class Score:
    """How found tracks compare with the true ones."""

    purity: float
    """Share of the arcs in tracks whose line is that of most arcs of their track."""
    completeness: float
    """Mean share of the arcs of a true line (seen in enough photos) that its largest track holds."""
    found: float
    """Share of those lines of which a pure track of enough photos holds at least half of the arcs."""
    tracks: int


def score(scene: MatchingScene, track: np.ndarray, least_views: int = 4) -> Score:
    member = track >= 0
    count = int(track.max(initial=-1)) + 1
    table = np.zeros((count, len(scene.ends_m)), dtype=np.int64)
    np.add.at(table, (track[member], scene.line[member]), 1)
    total = np.bincount(scene.line, minlength=len(scene.ends_m))
    eligible = scene.views_of_lines() >= least_views
    largest = table.max(0, initial=0)[eligible] / total[eligible]
    return Score(table.max(1).sum() / max(int(member.sum()), 1), float(largest.mean()), float((largest >= 0.5).mean()), count)


CAMERAS = list(VIEWS)


def some(arcs: ViewedArcs, count: int, seed: int = 0) -> ViewedArcs:
    """So many of the arcs, drawn at random, in their order."""
    return arcs.rows(np.sort(np.random.default_rng(seed).permutation(len(arcs))[:count]))
