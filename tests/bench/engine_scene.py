"""A street of any length, or a grid of streets, for the engine's benchmarks; a few neighbours see each line (or point)."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

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


def _determined_lines(
    rng: np.random.Generator, centre: np.ndarray, windows: np.ndarray, lines: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras of the window and ends of lines that stand at an angle to the path and pass no camera closely.

    The first and the last camera of a window are its ends.
    """
    count, window = windows.shape
    middle = centre[windows].mean(1) + np.stack([np.zeros(count), rng.uniform(-2, 2, count), rng.uniform(6, 14, count)], 1)
    ends = middle[:, None] + rng.uniform(-1.5, 1.5, (count, 2, 3))
    planes = [np.cross(*(ends - centre[windows[:, k], None]).transpose(1, 0, 2)) for k in (0, window - 1)]
    sine = np.linalg.norm(np.cross(*planes), axis=1) / np.prod([np.linalg.norm(plane, axis=1) for plane in planes], 0)
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    nearest = np.min([_distance(ends, centre[windows[:, k]]) for k in range(window)], 0)
    kept = np.flatnonzero((sine > np.sin(LEAST_ANGLE_RAD)) & (length > 1) & (nearest > LEAST_DISTANCE_M))[:lines]
    assert len(kept) == lines
    return windows[kept], ends[kept]


def _distance(ends: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Of points from endless lines."""
    along = ends[:, 1] - ends[:, 0]
    return np.linalg.norm(np.cross(along, centre - ends[:, 0]), axis=1) / np.linalg.norm(along, axis=1)


def street(cameras: int, lines: int, views: int, seed: int = 0) -> Street:
    """Cameras SPACING_M apart that look across the street, lines of a few metres 6 to 14 m away."""
    rng = np.random.default_rng(seed)
    window = min(NEIGHBOURS, cameras)
    centre = np.stack([SPACING_M * np.arange(cameras), 0.3 * rng.standard_normal(cameras), np.zeros(cameras)], 1)
    windows = rng.integers(0, cameras - window + 1, 6 * lines)[:, None] + np.arange(window)
    return _disturbed(rng, centre, windows, lines, views)


def grid(streets: int, between: int, lines: int, views: int, seed: int = 0) -> Street:
    """So many streets each way with `between` cameras from crossing to crossing, before a wall that they all look at."""
    rng = np.random.default_rng(seed)
    along, across = np.arange((streets - 1) * between + 1), between * np.arange(streets)
    places = np.concatenate([np.stack(np.meshgrid(*pair), -1).reshape(-1, 2) for pair in ((along, across), (across, along))])
    places = np.unique(places, axis=0)
    centre = np.concatenate([SPACING_M * places + 0.1 * rng.standard_normal(places.shape), np.zeros((len(places), 1))], 1)
    _, windows = cKDTree(centre).query(centre[rng.integers(0, len(centre), 6 * lines)], NEIGHBOURS)
    # Its ends are those farthest along either street.
    windows = np.take_along_axis(windows, centre[windows, :2].sum(-1).argsort(1), 1)
    return _disturbed(rng, centre, windows, lines, views)


def _disturbed(rng: np.random.Generator, centre: np.ndarray, windows: np.ndarray, lines: int, views: int) -> Street:
    """Lines before cameras that look along z, each seen by some of a window, and a disturbed start."""
    cameras = len(centre)
    chosen, ends = _determined_lines(rng, centre, windows, lines)
    picked = np.sort(rng.random(chosen.shape).argsort(1)[:, :views], 1)
    image = np.sort(np.take_along_axis(chosen, picked, 1), 1)
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
