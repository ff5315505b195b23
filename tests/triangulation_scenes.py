"""Matched segments with a known truth: the dissertation's set-ups and a room seen through a 190 degree fisheye."""

from dataclasses import dataclass

import torch

from camera_models import CameraModel
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose, vector_from_rotation
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.triangulation import TRIANGULATIONS
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation

METHODS = [name for name, _ in TRIANGULATIONS]
VIEWS = 8
LINES = 40
"""Of one trial."""


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def unit(v: torch.Tensor) -> torch.Tensor:
    return v / v.norm(dim=-1, keepdim=True)


def upright(centres: torch.Tensor) -> Pose:
    return Pose(torch.eye(3, dtype=torch.float64).expand(len(centres), 3, 3), -centres)


def observe(ends: torch.Tensor, centres: torch.Tensor, track: torch.Tensor) -> PlaneObservations:
    """Exact arcs of segments (t, 2, 3) from a camera centre per row; cameras see in all directions."""
    return PlaneObservations.from_arcs(unit(ends[track] - centres[:, None]), upright(centres), track, len(ends))


def looking(centres: torch.Tensor, axis: torch.Tensor) -> Pose:
    """cam_from_world of cameras with given centres and optical axes, the image's y axis pointing down the world's z."""
    z = unit(axis)
    x = unit(torch.linalg.cross(z, torch.tensor([[0.0, 0.1, 1.0]], dtype=torch.float64).expand_as(z)))
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], -2)
    return Pose(rotation, -(rotation @ centres[..., None]).squeeze(-1))


@dataclass(frozen=True)
class LineSet:
    """Lines (t, 2, 3) all seen by the same cameras; pixels (t, views, 2, 2) without noise."""

    camera: CameraModel
    poses: Pose
    ends: torch.Tensor
    pixels: torch.Tensor

    @property
    def track(self) -> torch.Tensor:
        return torch.arange(len(self.ends)).repeat_interleave(len(self.poses))

    def noisy(self, sigma_px: float, seed: int) -> torch.Tensor:
        return self.pixels + sigma_px * torch.randn(self.pixels.shape, generator=generator(seed), dtype=torch.float64)

    def observe(self, pixels: torch.Tensor, sigma_px: float | None = None, in_pixels: bool = True) -> PlaneObservations:
        flat = pixels.flatten(0, 1)
        bearings, seen = self.camera.unproject(flat)
        assert bool(seen.all())
        poses = self.poses[torch.arange(len(self.poses)).repeat(len(self.ends))]
        by_pixel = self.camera.unproject_jacobian(flat) if in_pixels else None
        eye = torch.eye(2, dtype=torch.float64).expand(len(flat), 2, 2, 2)
        covariance = None if sigma_px is None else sigma_px**2 * eye
        return PlaneObservations.from_arcs(bearings, poses, self.track, len(self.ends), by_pixel, covariance_px2=covariance)


def _line_set(camera: CameraModel, poses: Pose, ends: torch.Tensor) -> LineSet:
    pixels, seen = camera.project(poses.transform(ends[:, None].expand(-1, len(poses), -1, -1)))
    assert isinstance(camera, Pinhole) or bool(seen.all())
    return LineSet(camera, poses, ends, pixels)


def circle(trials: int, step_deg: float = 45.0, seed: int = 20) -> LineSet:
    """40 lines a trial in [-1, 1]^3, 8 cameras on a circle of radius 4 m at height 3 m looking at the centre."""
    azimuth = torch.deg2rad(torch.arange(VIEWS, dtype=torch.float64) * step_deg)
    centres = torch.stack([4 * azimuth.cos(), 4 * azimuth.sin(), torch.full_like(azimuth, 3.0)], -1)
    ends = 2 * torch.rand(LINES * trials, 2, 3, generator=generator(seed), dtype=torch.float64) - 1
    return _line_set(Pinhole.examples()[3], looking(centres, -centres), ends)


def room(trials: int, seed: int = 30) -> LineSet:
    """40 lines a trial on the walls and in the upper half of a room of 6 x 5 x 3 m around 8 fisheyes that look up, about."""
    make = generator(seed)
    spread = torch.rand(VIEWS, 3, generator=make, dtype=torch.float64) - 0.5
    centres = spread * torch.tensor([3.0, 2.5, 0.6], dtype=torch.float64) + torch.tensor([0.0, 0.0, 0.9], dtype=torch.float64)
    axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64) + 0.1 * torch.randn(VIEWS, 3, generator=make, dtype=torch.float64)
    count = LINES * trials
    ends = torch.rand(2 * count, 2, 3, generator=make, dtype=torch.float64)
    ends = ends * torch.tensor([6.0, 5.0, 1.3], dtype=torch.float64) + torch.tensor([-3.0, -2.5, 1.7], dtype=torch.float64)
    # Half of the lines lie on a wall, a quarter of all is upright; those below half a metre are left out.
    wall = torch.arange(2 * count) % 4
    ends[wall == 0, :, 0], ends[wall == 1, :, 1] = -3.0, 2.5
    ends[wall == 0, 1, 1] = ends[wall == 0, 0, 1]
    long = (ends[:, 1] - ends[:, 0]).norm(dim=-1) > 0.5
    assert int(long.sum()) >= count
    return _line_set(OpenCVFisheye.examples()[0], looking(centres, axis), ends[long][:count])


SCENES = {"wide": lambda trials: circle(trials), "short": lambda trials: circle(trials, 9.0), "room": lambda trials: room(trials)}


def with_wrong_members(scene: LineSet, pixels: torch.Tensor, seed: int, most: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels of which 1 to `most` members of every track are those of other lines of the same trial; and which (t, views)."""
    make = generator(seed)
    tracks, views = pixels.shape[:2]
    count = torch.randint(1, most + 1, (tracks, 1), generator=make)
    wrong = torch.rand(tracks, views, generator=make).argsort(-1).argsort(-1) < count
    other = (torch.arange(tracks)[:, None] // LINES) * LINES
    shift = torch.randint(1, LINES, (tracks, views), generator=make)
    other = other + (torch.arange(tracks)[:, None] % LINES + shift) % LINES
    swapped = pixels[other, torch.arange(views)]
    return torch.where(wrong[..., None, None], swapped, pixels), wrong


def square_error(result: Triangulation, ends: torch.Tensor) -> torch.Tensor:
    """Mean squared distance (m^2) of both true ends from each line."""
    return torch.stack([result.lines.distance_to(ends[:, e]) for e in range(2)]).square().mean(0)


def deviations(result: Triangulation, ends: torch.Tensor) -> torch.Tensor:
    """Truth minus estimate in the chart of each line (t, 4)."""
    chart = result.chart
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    sign = torch.where((truth.direction * result.lines.direction).sum(-1, keepdim=True) < 0, -1.0, 1.0).double()
    true = LineChart.from_lines(PlueckerLines(sign * truth.direction, sign * truth.moment), chart.centre, chart.scale)
    return torch.cat([vector_from_rotation(chart.S.mT @ true.S), (true.phi - chart.phi)[:, None]], -1)
