"""pylimap 2.0.0, run in its own environment (.venv-peers, made by `make bench`) by `bench/peer_pylimap.py`, and scenes for it."""

import functools
import json
import math
import pathlib
import subprocess
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from camera_models import CameraModel, OpenCVFisheye
from camera_models.pose import Pose
from omnilines.adjustment.scene import AdjustedScene, reconstruct_lines
from omnilines.geometry.line import PlueckerLines
from omnilines.records import ImagePoses, Lines, Segments
from omnilines.synthetic.lines import LineWorld

HERE = pathlib.Path(__file__).resolve().parent
PEERS = HERE.parent / ".venv-peers" / "bin" / "python"
STAGES = ("two_view", "multi_view", "adjusted", "least_squares")
"""Of `bench/peer_pylimap.py`."""
SIZE = (1280, 960)
FISHEYE = OpenCVFisheye([300.0, 300.0, 640.0, 480.0, 0.02, -0.004, 0.001, -0.0001], SIZE)
PAIR_LINES = 100
RIM_DEG = (60.0, 80.0)
"""Off the axis of both cameras of the pair: in the image from 320 to 430 px from its centre, of 480."""
CLEAR_DEG = 15.0
"""Between the two planes of a line of the pair."""


@dataclass(frozen=True)
class PeerResult:
    """What pylimap gives for one scene: two points of each line (t 2 3) at each stage, NaN where it gives none."""

    ends_m: dict[str, torch.Tensor]
    seconds: dict[str, float]
    refused: str | None
    """Why its adjustment raised."""


@functools.cache
def why_absent() -> str | None:
    """Why pylimap cannot be run here; None where it can."""
    if not PEERS.is_file():
        return f"pylimap is compared in an environment of its own, which is absent: {PEERS}; `make bench` installs it"
    found = subprocess.run([PEERS, "-c", "import limap"], capture_output=True, text=True)
    return f"pylimap cannot be imported by {PEERS}: {found.stderr.strip().splitlines()[-1]}" if found.returncode else None


def colmap_camera(camera: CameraModel) -> dict[str, Any]:
    """A pinhole without distortion or a fisheye as COLMAP names it. Both count pixels from the same origin as our data."""
    values = camera.named_parameters()
    model = "OPENCV_FISHEYE" if isinstance(camera, OpenCVFisheye) else "PINHOLE"
    lens = ("fx", "fy", "cx", "cy") + (("k1", "k2", "k3", "k4") if model == "OPENCV_FISHEYE" else ())
    assert all(value == 0 for name, value in values.items() if name not in lens)
    width, height = camera.image_size
    return {"model": model, "params": [values[name] for name in lens], "width": width, "height": height}


def run_pylimap(scenes: list[tuple[CameraModel, Pose, Segments]], start: str = "multi_view") -> list[PeerResult]:
    """All scenes in one process of the peers' environment; `start` is the triangulation that its adjustment starts from."""
    request = [
        {
            **colmap_camera(camera),
            "start": start,
            "rotation": poses.rotation.tolist(),
            "translation": poses.translation.tolist(),
            "image": segments.image.tolist(),
            "track": segments.track.tolist(),
            "ends_px": segments.endpoints_px.tolist(),
        }
        for camera, poses, segments in scenes
    ]
    command = [PEERS, HERE / "bench" / "peer_pylimap.py"]
    done = subprocess.run(command, input=json.dumps(request), check=True, capture_output=True, text=True)
    missing = [[math.nan] * 3] * 2
    results = []
    for answer in json.loads(done.stdout.splitlines()[-1]):
        ends = {
            stage: torch.tensor([line or missing for line in answer[stage]], dtype=torch.float64)
            for stage in STAGES
            if stage in answer
        }
        results.append(PeerResult(ends, answer["seconds"], answer["refused"]))
    assert len(results) == len(scenes)
    return results


def pair_of_fisheyes(camera: CameraModel = FISHEYE, seed: int = 0) -> LineWorld:
    """Lines near the rim of two parallel cameras 1 m apart, without noise; `camera` may be another one in the same places."""
    rng = np.random.default_rng(seed)
    centres = torch.tensor([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]], dtype=torch.float64)
    poses = Pose(torch.eye(3, dtype=torch.float64).expand(2, 3, 3).clone(), -centres)
    samples = 20_000
    low, high = np.deg2rad(RIM_DEG)
    off_axis, azimuth = rng.uniform(low, high, samples), rng.uniform(0, 2 * math.pi, samples)
    around = np.stack([np.sin(off_axis) * np.cos(azimuth), np.sin(off_axis) * np.sin(azimuth), np.cos(off_axis)], -1)
    first = rng.uniform(2.0, 4.0, (samples, 1)) * around
    ends = torch.as_tensor(np.stack([first, first + rng.uniform(-1.0, 1.0, first.shape)], 1))
    seen = ends[:, None] - centres[:, None]
    angle = torch.rad2deg(torch.atan2(seen[..., :2].norm(dim=-1), seen[..., 2]))  # (lines, cameras, ends)
    normal = torch.linalg.cross(seen[:, :, 0], seen[:, :, 1])
    sine = torch.linalg.cross(normal[:, 0], normal[:, 1]).norm(dim=-1) / normal.norm(dim=-1).prod(-1)
    good = ((angle > RIM_DEG[0]) & (angle < RIM_DEG[1])).all(-1).all(-1) & (sine > math.sin(math.radians(CLEAR_DEG)))
    good &= (ends[:, 0] - ends[:, 1]).norm(dim=-1) > 0.5
    ends = ends[good][:PAIR_LINES]
    assert len(ends) == PAIR_LINES
    pixels, valid = camera.project(poses.transform(ends.reshape(-1, 3).expand(2, -1, -1)))
    assert bool(valid.all())
    image, track = torch.arange(2).repeat_interleave(PAIR_LINES), torch.arange(PAIR_LINES).repeat(2)
    return LineWorld(camera, poses, ends, image, track, pixels.reshape(-1, 2, 2))


def of_images(segments: Segments, images: int) -> Segments:
    """The segments of the first images only."""
    kept = segments.image < images
    sigma = None if segments.sigma_px is None else segments.sigma_px[kept]
    return Segments(
        segments.image[kept], segments.images, segments.track[kept], segments.tracks, segments.endpoints_px[kept], sigma
    )


def ours(world: LineWorld, segments: Segments, triangulation: str = "dual", cost: str = "sector") -> AdjustedScene:
    """Triangulated and adjusted lines, the poses held."""
    poses: ImagePoses = world.poses()
    return reconstruct_lines(segments, poses, {"cam0": world.camera}, triangulation=triangulation, cost=cost)


def through(ends_m: torch.Tensor) -> PlueckerLines:
    """Lines through two points each."""
    return PlueckerLines.from_points(ends_m[:, 0], ends_m[:, 1])


def lines_of(table: Lines) -> PlueckerLines:
    """Lines of a table of ours."""
    return through(torch.as_tensor(table.ends_m))


def distances_m(lines: PlueckerLines, ends_m: torch.Tensor) -> torch.Tensor:
    """(t, 2) distances of two points of every line."""
    return torch.stack([lines.distance_to(ends_m[:, end]) for end in range(2)], -1)


def rms(values: torch.Tensor) -> float:
    """Root mean square."""
    return float(values.square().mean().sqrt())


def direction_error_deg(lines: PlueckerLines, world: LineWorld) -> torch.Tensor:
    """(t,) angles between the lines and the true ones."""
    return torch.rad2deg(lines.angle_to(through(world.ends_m)))
