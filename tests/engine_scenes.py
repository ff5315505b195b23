"""A row of cameras with lines that a few neighbours see, for tests of the compiled engine."""

from dataclasses import dataclass

import torch

from camera_models import OpenCVFisheye
from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.geometry.line import PlueckerLines

CAMERA = OpenCVFisheye([320.0, 322.0, 510.0, 390.0, 0.02, -0.01, 0.002, 0.0], (1032, 778))


@dataclass(frozen=True)
class Row:
    """Noisy arcs with a disturbed start."""

    arcs: MatchedArcs
    lines: PlueckerLines
    poses: Pose


def row(cameras: int = 10, lines: int = 60, reach: int = 5, seed: int = 0, noise_px: float = 0.4) -> Row:
    """Cameras 0.6 m apart; a line is seen by most of `reach` neighbours, some lines twice in one photo, in any order."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    turn = 0.1 * normal(cameras, 3)
    rotation = Pose.exp(torch.cat([turn, torch.zeros_like(turn)], -1)).rotation
    step = torch.arange(cameras, dtype=torch.float64)[:, None] * torch.tensor([0.6, 0.0, 0.0])
    centre = step + 0.1 * normal(cameras, 3)
    true = Pose(rotation, -(rotation @ centre[..., None])[..., 0])
    first = torch.randint(0, cameras - reach + 1, (lines,), generator=generator)
    middle = torch.stack([0.6 * (first + 0.5 * reach), 0.7 * normal(lines), 3 + torch.rand(lines, generator=generator)], -1)
    way = torch.stack([0.3 * normal(lines), 1 + torch.rand(lines, generator=generator), 0.3 * normal(lines)], -1)
    way[::2] = way[::2][:, [1, 0, 2]] * torch.tensor([0.7, 2.0, 1.0])
    ends = torch.stack([middle - 0.5 * way, middle + 0.5 * way], 1).double()
    track = torch.arange(lines).repeat_interleave(reach)
    image = (first[:, None] + torch.arange(reach)).flatten()
    keep = torch.rand(len(track), generator=generator) < 0.9
    again = torch.arange(len(track))[:: 3 * reach]
    chosen = torch.cat([torch.nonzero(keep).flatten(), again])
    chosen = chosen[torch.randperm(len(chosen), generator=generator)]
    image, track = image[chosen], track[chosen]
    pixels, valid = CAMERA.project(true[image].transform(ends[track]))
    assert bool(valid.all())
    pixels = pixels + noise_px * normal(*pixels.shape)
    bearings, _ = CAMERA.unproject(pixels)
    spread = 0.3 * torch.rand(len(track), 2, generator=generator, dtype=torch.float64)
    covariance = torch.diag_embed(noise_px**2 * (1 + torch.stack([spread, spread.flip(-1)], -1)))
    arcs = MatchedArcs(image, track, cameras, lines, bearings, CAMERA.unproject_jacobian(pixels), covariance, True)
    start = ends + 0.02 * normal(lines, 2, 3)
    poses = Pose.exp(normal(cameras, 6) * torch.tensor([0.003] * 3 + [0.02] * 3)) @ true
    return Row(arcs, PlueckerLines.from_points(start[:, 0], start[:, 1]), poses)
