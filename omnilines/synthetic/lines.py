"""Scenes of straight lines with known truth: the dissertation's two camera circles and a room seen through a wide fisheye.

Exact observations are made once; noise is drawn afterwards, so that one scene serves any number of trials.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, InputError, Pinhole
from camera_models.pose import Pose
from omnilines.geometry.sphere import angle_between
from omnilines.records import ImagePoses, Segments
from omnilines.synthetic.targets import example_camera, generator

CIRCLE_LINES, CIRCLE_CAMERAS = 40, 8
CIRCLE_RADIUS_M, CIRCLE_HEIGHT_M = 4.0, 3.0
CIRCLE_STEPS_DEG = {"wide": 45.0, "short": 9.0}
"""Between neighbouring cameras (Srestasathiern 2012, section 5.2)."""
ROOM_M = np.array([6.0, 5.0, 3.0])
ROOM_CAMERAS = 8
ROOM_FOV_DEG = 190.0
ROOM_IMAGE_SIZE = (1280, 960)
CLEARANCE_M = 0.6
"""Between cameras of the room and its walls, and between two of them along each axis of their grid."""
SAMPLES = 400
"""Points of a 3D segment that are tried for being seen."""
SHORTEST_ARC_RAD = math.radians(3.0)
NEAREST_M = 0.3
"""Of a line to a camera that observes it."""
FEWEST_VIEWS = 3


@dataclass(frozen=True)
class LineWorld:
    """Lines, cameras and where the cameras see the lines exactly; n observations."""

    camera: CameraModel
    cam_from_world: Pose
    ends_m: Float[Tensor, "t 2 3"]
    """Two points of each line, the ends of the part of it that is observed in any view."""
    image: Int[Tensor, " n"]
    track: Int[Tensor, " n"]
    ends_px: Float[Tensor, "n 2 2"]
    """Exact end points of the observed segments; those of a line need not be the same points in different views."""

    @property
    def lines(self) -> int:
        """Number of lines."""
        return len(self.ends_m)

    @property
    def images(self) -> int:
        """Number of views."""
        return len(self.cam_from_world)

    def poses(self, trials: int = 1) -> ImagePoses:
        """The true poses, once for every trial."""
        repeated = Pose(self.cam_from_world.rotation.repeat(trials, 1, 1), self.cam_from_world.translation.repeat(trials, 1))
        return ImagePoses(_names("trial", trials, "view", self.images), repeated)

    def segments(self, sigma_px: float, seed: int, trials: int = 1) -> Segments:
        """Observed segments of some trials, each with its own photos and tracks (view k of trial i is photo i views + k).

        Every coordinate of every end point has independent noise of `sigma_px`, drawn for each trial from the seed; at 0 px they
        are exact, and their noise counts as not known. Raises InputError for a noise that is not one.
        """
        if not (math.isfinite(sigma_px) and sigma_px >= 0):
            raise InputError(f"A noise of at least 0 px was expected, found {sigma_px}; give another one.")
        noise = [generator(seed, f"noise {sigma_px:g}", k).standard_normal(self.ends_px.shape) for k in range(trials)]
        pixels = self.ends_px.numpy() + sigma_px * np.stack(noise)
        trial = np.arange(trials)[:, None]
        return Segments(
            (trial * self.images + self.image.numpy()).ravel(),
            _names("trial", trials, "view", self.images),
            (trial * self.lines + self.track.numpy()).ravel(),
            _names("trial", trials, "line", self.lines),
            pixels.reshape(-1, 2, 2),
            np.full(trials * len(self.ends_px), sigma_px) if sigma_px > 0 else None,
        )


def _names(outer: str, outers: int, inner: str, inners: int) -> tuple[str, ...]:
    return tuple(f"{outer}{i}/{inner}{k}" for i in range(outers) for k in range(inners))


def circle_world(baseline: Literal["wide", "short"], seed: int) -> LineWorld:
    """40 lines through two random points each in the cube [-1, 1]^3, seen by 8 cameras on a circle of radius 4 m at a height of
    3 m that look at the centre of the cube, 45 (`wide`) or 9 (`short`) degrees apart.

    The borders of the image are ignored, as in the dissertation: every camera sees every line from end to end.
    """
    ends = torch.as_tensor(generator(seed, "lines").uniform(-1.0, 1.0, (CIRCLE_LINES, 2, 3)))
    azimuth = math.radians(CIRCLE_STEPS_DEG[baseline]) * torch.arange(CIRCLE_CAMERAS, dtype=torch.float64)
    centres = torch.stack(
        [
            CIRCLE_RADIUS_M * torch.cos(azimuth),
            CIRCLE_RADIUS_M * torch.sin(azimuth),
            torch.full_like(azimuth, CIRCLE_HEIGHT_M),
        ],
        -1,
    )
    poses = _looking_at(centres, torch.zeros_like(centres))
    camera = Pinhole([1520.4, 1525.9, 302.32, 246.87, *([0.0] * 9)], (640, 480), 0)
    pixels, _ = camera.project(poses.transform(ends.reshape(-1, 3).expand(CIRCLE_CAMERAS, -1, -1)))
    image = torch.arange(CIRCLE_CAMERAS).repeat_interleave(CIRCLE_LINES)
    track = torch.arange(CIRCLE_LINES).repeat(CIRCLE_CAMERAS)
    return LineWorld(camera, poses, ends, image, track, pixels.reshape(-1, 2, 2))


def room_world(seed: int) -> LineWorld:
    """A room of 6 x 5 x 3 m with lines all around, seen from 8 places inside it through a fisheye of 190 degrees.

    The edges of the room, frames on its walls, strips on floor and ceiling and the edges of four pieces of furniture; nothing
    hides anything. Of each line a camera sees the longest part within 95 degrees of its axis and within the image. Arcs shorter
    than 3 degrees, lines nearer than 0.3 m to the camera and lines seen fewer than 3 times are left out.
    """
    camera = example_camera("opencv-fisheye", ROOM_FOV_DEG, ROOM_IMAGE_SIZE, seed)
    poses = _room_cameras(generator(seed, "room poses"))
    segments = torch.as_tensor(_room_lines(generator(seed, "room lines")))
    share = torch.linspace(0.0, 1.0, SAMPLES, dtype=torch.float64)
    points = segments[:, :1] + share[:, None] * (segments[:, 1:] - segments[:, :1])
    first, last, seen = _longest_run(_visible(camera, poses, points))
    ends = torch.stack([first, last], -1)
    both = torch.gather(points.expand(ROOM_CAMERAS, *points.shape), 2, ends[..., None].expand(*ends.shape, 3))
    in_camera = poses.transform(both.flatten(1, 2)).unflatten(1, ends.shape[1:])
    bearing = in_camera / in_camera.norm(dim=-1, keepdim=True)
    seen &= angle_between(bearing[:, :, 0], bearing[:, :, 1]) >= SHORTEST_ARC_RAD
    seen &= (points - poses.centre[:, None, None]).norm(dim=-1).amin(-1) >= NEAREST_M
    kept = seen.sum(0) >= FEWEST_VIEWS
    seen, ends, in_camera = seen[:, kept], ends[:, kept], in_camera[:, kept]
    low = torch.where(seen, ends[..., 0], SAMPLES).amin(0)
    high = torch.where(seen, ends[..., 1], -1).amax(0)
    rows = torch.arange(int(kept.sum()))
    truth = torch.stack([points[kept][rows, low], points[kept][rows, high]], 1)
    image, track = torch.nonzero(seen, as_tuple=True)
    pixels, _ = camera.project(in_camera[seen])
    return LineWorld(camera, poses, truth, image, track, pixels)


def _looking_at(centres: Float[Tensor, "k 3"], targets: Float[Tensor, "k 3"]) -> Pose:
    """Cameras with their optical axis towards the targets and x level; +z of the world is up."""
    forward = targets - centres
    forward = forward / forward.norm(dim=-1, keepdim=True)
    right = torch.linalg.cross(forward, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand_as(forward))
    right = right / right.norm(dim=-1, keepdim=True)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], -2)
    return Pose(rotation, -(rotation @ centres[..., None])[..., 0])


def _room_cameras(rng: np.random.Generator) -> Pose:
    """One camera in each eighth of the room, looking 20 to 60 degrees up or down or level in directions all around."""
    octant = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    half = (ROOM_M - 3 * CLEARANCE_M) / 2
    centres = CLEARANCE_M + octant * (half + CLEARANCE_M) + rng.uniform(0.0, 1.0, (ROOM_CAMERAS, 3)) * half
    azimuth = 2 * math.pi * (rng.permutation(ROOM_CAMERAS) + rng.uniform(0, 1)) / ROOM_CAMERAS
    elevation = rng.uniform(-math.radians(60), math.radians(60), ROOM_CAMERAS)
    towards = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1)
    return _looking_at(torch.as_tensor(centres), torch.as_tensor(centres + towards))


def _box(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "2 3"]]:
    """The edges of an axis-parallel box: 12, or the 4 of a rectangle where it is flat."""
    corners = [np.where(np.array(bits, dtype=bool), high, low) for bits in np.ndindex(2, 2, 2)]
    pairs = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]
    edges = {tuple(sorted((tuple(corners[a]), tuple(corners[b])))) for a, b in pairs}
    return [np.array(edge) for edge in sorted(edges) if edge[0] != edge[1]]


def _room_lines(rng: np.random.Generator) -> Float[np.ndarray, "k 2 3"]:
    """End points (m) of the room's edges, two frames a wall, strips on floor and ceiling, and the edges of furniture."""
    lines = _box(np.zeros(3), ROOM_M)
    for axis in range(2):
        for wall in (0.0, ROOM_M[axis]):
            for part in range(2):
                low, high = np.full(3, wall), np.full(3, wall)
                width = ROOM_M[1 - axis] / 2
                low[1 - axis], high[1 - axis] = part * width + rng.uniform([0.15, 0.6], [0.4, 0.85]) * width
                low[2], high[2] = rng.uniform([0.2, 1.6], [1.2, 2.8])
                lines += _box(low, high)
    for height in (0.0, ROOM_M[2]):
        for _ in range(4):
            ends = rng.uniform(0.05, 0.95, (2, 2)) * ROOM_M[:2]
            lines.append(np.column_stack([ends, [height, height]]))
    for k in range(4):
        # A table, a cupboard, a chair: each in its quarter of the floor.
        quarter = np.array([k % 2, k // 2]) * ROOM_M[:2] / 2
        low = quarter + rng.uniform(0.1, 0.5, 2) * ROOM_M[:2] / 2
        size = rng.uniform(0.4, 1.2, 2)
        lines += _box(np.append(low, 0.0), np.append(low + size, rng.uniform(0.4, 2.0)))
    return np.stack(lines)


def _visible(camera: CameraModel, poses: Pose, points: Float[Tensor, "t s 3"]) -> Bool[Tensor, "k t s"]:
    """Which points each camera sees: within half the field of view of its axis, and in the image."""
    in_camera = poses.transform(points.reshape(-1, 3).expand(len(poses), -1, -1)).unflatten(1, points.shape[:2])
    pixels, seen = camera.project(in_camera)
    theta = torch.atan2(in_camera[..., :2].norm(dim=-1), in_camera[..., 2])
    limit = torch.tensor(camera.image_size, dtype=torch.float64) - 0.5
    inside = ((pixels >= -0.5) & (pixels <= limit)).all(-1)
    return seen & inside & (theta <= math.radians(ROOM_FOV_DEG / 2))


def _longest_run(
    visible: Bool[Tensor, "*batch s"],
) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """First and last index of the longest run of true values along the last axis, and whether it has two or more."""
    place = torch.arange(visible.shape[-1])
    # Length of the run that ends at each place: its distance from the last false value.
    before = torch.cummax(torch.where(visible, -1, place), -1).values
    length = torch.where(visible, place - before, 0)
    longest, last = length.max(-1)
    return (last - longest + 1).clamp(0, visible.shape[-1] - 1), last, longest >= 2
