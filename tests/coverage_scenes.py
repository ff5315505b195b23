"""How often stated ellipsoids hold the truth, over seeds of noise: lines, poses and rigs, for every cost, prior and lens."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from rig_scene import RigScene
from scipy.special import chdtri
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs, Observed
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.state import Rig
from omnilines.adjustment.weighting import weighting
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss
from omnilines.synthetic.lines import circle_world, room_world

NOISE_PX = 0.5
OUTLIERS, OUTLIER_PX = 0.03, (10.0, 40.0)
PRIOR_RAD, PRIOR_M = math.radians(0.1), 0.005
NOISES = ("stated", "unstated", "stated, outliers", "unstated, outliers")
LENSES = ("pinhole", "190 degrees")


@dataclass(frozen=True)
class Truth:
    """A scene with its exact observations."""

    cameras: tuple[CameraModel, ...]
    camera: Tensor
    """Of every photo."""
    image: Tensor
    track: Tensor
    ends_px: Tensor
    ends_m: Tensor
    rig_from_world: Pose
    rig: Rig | None

    @property
    def lines(self) -> PlueckerLines:
        return PlueckerLines.from_points(self.ends_m[:, 0], self.ends_m[:, 1])

    def arcs(self, noise: str, seed: int) -> MatchedArcs:
        """Noise of NOISE_PX on every coordinate; of arcs that are outliers both ends move across by so many pixels more."""
        rng = np.random.default_rng([seed, len(self.image)])
        pixels = self.ends_px.numpy() + NOISE_PX * rng.standard_normal(self.ends_px.shape)
        if noise.endswith("outliers"):
            wrong = rng.random(len(pixels)) < OUTLIERS
            angle = rng.uniform(0, 2 * math.pi, (len(pixels), 2))
            shift = rng.uniform(*OUTLIER_PX, (len(pixels), 2))[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
            pixels = np.where(wrong[:, None, None], pixels + shift, pixels)
        stated = noise.startswith("stated")
        covariance = (NOISE_PX if stated else 1.0) ** 2 * torch.eye(2, dtype=torch.float64).expand(len(pixels), 2, 2, 2)
        empty = torch.zeros(len(pixels), 2, 3, dtype=torch.float64)
        images, observed = len(self.camera), Observed(torch.as_tensor(pixels), self.camera[self.image])
        plain = MatchedArcs(
            self.image,
            self.track,
            images,
            len(self.ends_m),
            empty,
            empty[..., None].expand(-1, -1, 3, 2),
            covariance,
            stated,
            None,
            observed,
        )
        return plain.seen_by(self.cameras)


def world_of(lens: str, lines: int | None = None, views: int | None = None) -> Truth:
    """The wide circle of ordinary cameras, or the room seen by a fisheye; the first `lines` and `views` of them."""
    world = circle_world("wide", 1) if lens == "pinhole" else room_world(1)
    lines, views = lines or world.lines, views or world.images
    kept = (world.track < lines) & (world.image < views)
    image, track = world.image[kept], world.track[kept]
    names, track = torch.unique(track, return_inverse=True)
    own = torch.zeros(views, dtype=torch.long)
    poses = world.cam_from_world[torch.arange(views)]
    return Truth((world.camera,), own, image, track, world.ends_px[kept], world.ends_m[names], poses, None)


def rig_of(frames: int = 8, lines: int = 30) -> Truth:
    """Frames of a pinhole and a fisheye on one rig."""
    scene = RigScene(frames=frames, lines=lines)
    exact = scene.arcs()
    assert exact.observed is not None
    return Truth(
        tuple(scene.models),
        scene.rig.camera,
        scene.image,
        scene.track,
        exact.observed.pixels,
        scene.ends,
        scene.rig_from_world,
        scene.rig,
    )


def adjusted(
    truth: Truth, cost: str, noise: str, prior: bool, seed: int, refine_poses: bool = True, refine_rig: bool = False
) -> Adjusted:
    """One draw. Without a prior two frames are held at the truth, with one all are given with its errors."""
    arcs, poses = truth.arcs(noise, seed), truth.rig_from_world
    frames = len(poses)
    held, given = torch.zeros(frames, dtype=torch.bool), None
    if prior:
        sigma = torch.tensor([PRIOR_RAD] * 3 + [PRIOR_M] * 3, dtype=torch.float64)
        random = torch.randn(frames, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        poses = Pose.exp(random * sigma) @ poses
        given = PosePrior(poses, sigma[0].expand(frames), sigma[3].expand(frames))
    else:
        held[[0, frames // 2]] = True
    loss = None
    if noise.endswith("outliers"):
        # The scale that is right for the noise, as `reconstruct_lines` finds it.
        photos = poses if truth.rig is None else truth.rig.cam_from_rig[truth.rig.camera] @ poses[truth.rig.frame]
        normal = truth.lines[truth.track].projection_normal(photos[truth.image])
        level = 1.0 if noise.startswith("stated") else NOISE_PX
        unit = math.sqrt(weighting(cost, arcs, normal, Loss(), level).expected / (2 * len(arcs)))
        loss = Loss("cauchy", 2.0 * unit)
    return adjust_lines(
        arcs,
        truth.lines,
        poses,
        cost=cost,
        refine_poses=refine_poses,
        held=held,
        rig=truth.rig,
        refine_rig=refine_rig,
        prior=given,
        loss=loss,
    )


def chart_errors(found: LineChart, true: PlueckerLines) -> Tensor:
    """Chart coordinates (t, 4) of the true lines as seen from the found ones, to first order."""
    sign = torch.sign((true.direction * found.S[:, :, 0]).sum(-1))[:, None]
    true = PlueckerLines(sign * true.direction, sign * true.moment)
    lines = found.lines()
    off = torch.cat([true.direction - lines.direction, true.moment - lines.moment], -1)
    return (torch.linalg.pinv(found.jacobian()) @ off[..., None])[..., 0]


def squares(error: Tensor, covariance: Tensor) -> Tensor:
    """e' C^-1 e of every item."""
    return (error[:, None] @ torch.linalg.solve(covariance, error[..., None]))[:, 0, 0]


def line_squares(truth: Truth, result: Adjusted) -> Tensor:
    return squares(chart_errors(result.state.chart, truth.lines), result.line_covariance)


def frame_squares(truth: Truth, result: Adjusted) -> Tensor:
    """Of all photos whose frame may move."""
    true = truth.rig_from_world
    if truth.rig is not None:
        true = truth.rig.cam_from_rig[truth.rig.camera] @ true[truth.rig.frame]
    error = (result.state.cam_from_world @ true.inverse()).log()
    free = result.pose_covariance.diagonal(dim1=1, dim2=2).sum(-1) > 0
    return squares(error[free], result.pose_covariance[free])


def rig_squares(truth: Truth, result: Adjusted) -> Tensor:
    assert truth.rig is not None and result.state.rig is not None and result.rig_covariance is not None
    error = (result.state.rig.cam_from_rig @ truth.rig.cam_from_rig.inverse()).log()
    return squares(error[1:], result.rig_covariance[1:])


def covered(values: list[Tensor], dim: int) -> float:
    """Share within the ellipsoid of 95 percent."""
    return float((torch.cat(values) <= float(chdtri(dim, 0.05))).double().mean())
