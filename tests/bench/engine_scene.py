"""A street of any length for the engine's benchmarks: cameras on a path, every line (or point) seen by a few neighbours."""

from dataclasses import dataclass

import numpy as np
import torch

from camera_models import Pinhole
from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.geometry.line import PlueckerLines

NEIGHBOURS = 24
"""Cameras in a row from which the views of a line are drawn: random views of the whole path would make the system dense."""
SPACING_M = 0.5
FOCAL_PX, SIZE = 400.0, (1280, 960)
NOISE_PX = 0.5
LEAST_ANGLE_RAD = 0.35
"""Between the planes of a line from both ends of its window."""
LEAST_DISTANCE_M = 3.0
"""Of the endless line from any camera of its window."""
TURN_RAD, SHIFT_M, END_M = 0.003, 0.02, 0.03
"""Of the disturbed start."""


@dataclass(frozen=True)
class Street:
    """Observed end points with the disturbed poses and lines that an adjustment starts from."""

    rotation: np.ndarray
    translation: np.ndarray
    ends_m: np.ndarray
    """(t, 2, 3)."""
    image: np.ndarray
    track: np.ndarray
    ends_px: np.ndarray
    """(n, 2, 2)."""

    def save(self, path: str) -> None:
        """For the peers."""
        np.savez(path, **vars(self), focal_px=FOCAL_PX, size=SIZE)

    @property
    def poses(self) -> Pose:
        """Disturbed."""
        return Pose(torch.from_numpy(self.rotation), torch.from_numpy(self.translation))

    @property
    def lines(self) -> PlueckerLines:
        """Disturbed."""
        return PlueckerLines.from_points(torch.from_numpy(self.ends_m[:, 0]), torch.from_numpy(self.ends_m[:, 1]))

    def arcs(self) -> MatchedArcs:
        """Bearings of all observations, as `arcs_from_segments` makes them but for what integrals and refined cameras need."""
        width, height = SIZE
        camera = Pinhole.from_mapping({"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": (width - 1) / 2, "cy": (height - 1) / 2}, SIZE)
        n = len(self.image)
        pixels = torch.from_numpy(self.ends_px)
        bearings, by_pixel = torch.empty(n, 2, 3).double(), torch.empty(n, 2, 3, 2).double()
        for low in range(0, n, 1 << 16):
            part = slice(low, low + (1 << 16))
            bearings[part], by_pixel[part] = camera.unproject(pixels[part])[0], camera.unproject_jacobian(pixels[part])
        covariance = NOISE_PX**2 * torch.eye(2).double().expand(n, 2, 2, 2)
        image, track = torch.from_numpy(self.image), torch.from_numpy(self.track)
        return MatchedArcs(image, track, len(self.rotation), len(self.ends_m), bearings, by_pixel, covariance, True)


def _determined_lines(rng: np.random.Generator, centre: np.ndarray, window: int, lines: int) -> tuple[np.ndarray, np.ndarray]:
    """First camera of the window and ends of lines that stand at an angle to the path and pass no camera closely."""
    first = rng.integers(0, len(centre) - window + 1, 6 * lines)
    middle = np.stack([SPACING_M * (first + 0.5 * window), rng.uniform(-2, 2, len(first)), rng.uniform(6, 14, len(first))], 1)
    ends = middle[:, None] + rng.uniform(-1.5, 1.5, (len(first), 2, 3))
    planes = [np.cross(*(ends - centre[first + k, None]).transpose(1, 0, 2)) for k in (0, window - 1)]
    sine = np.linalg.norm(np.cross(*planes), axis=1) / np.prod([np.linalg.norm(plane, axis=1) for plane in planes], 0)
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    nearest = np.min([_distance(ends, centre[first + k]) for k in range(window)], 0)
    kept = np.flatnonzero((sine > np.sin(LEAST_ANGLE_RAD)) & (length > 1) & (nearest > LEAST_DISTANCE_M))[:lines]
    assert len(kept) == lines
    return first[kept], ends[kept]


def _distance(ends: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Of points from endless lines."""
    along = ends[:, 1] - ends[:, 0]
    return np.linalg.norm(np.cross(along, centre - ends[:, 0]), axis=1) / np.linalg.norm(along, axis=1)


def street(cameras: int, lines: int, views: int, seed: int = 0) -> Street:
    """Cameras SPACING_M apart that look across the street, lines of a few metres 6 to 14 m away."""
    rng = np.random.default_rng(seed)
    window = min(NEIGHBOURS, cameras)
    centre = np.stack([SPACING_M * np.arange(cameras), 0.3 * rng.standard_normal(cameras), np.zeros(cameras)], 1)
    first, ends = _determined_lines(rng, centre, window, lines)
    image = first[:, None] + np.sort(rng.random((lines, window)).argsort(1)[:, :views], 1)
    tilt = Pose.exp(torch.from_numpy(np.concatenate([0.05 * rng.standard_normal((cameras, 3)), np.zeros((cameras, 3))], 1)))
    rotation = tilt.rotation.numpy()
    track, image = np.repeat(np.arange(lines), views), image.ravel()
    seen = np.einsum("nij,nkj->nki", rotation[image], ends[track] - centre[image, None])
    assert (seen[..., 2] > 1).all()
    centre_px = (np.array(SIZE) - 1) / 2
    pixels = FOCAL_PX * seen[..., :2] / seen[..., 2:] + centre_px + NOISE_PX * rng.standard_normal((len(track), 2, 2))
    true = Pose(tilt.rotation, torch.from_numpy(-np.einsum("nij,nj->ni", rotation, centre)))
    off = torch.from_numpy(rng.standard_normal((cameras, 6)) * np.array([TURN_RAD] * 3 + [SHIFT_M] * 3))
    start = Pose.exp(off) @ true
    disturbed = ends + END_M * rng.standard_normal(ends.shape)
    return Street(start.rotation.numpy(), start.translation.numpy(), disturbed, image, track, pixels)
