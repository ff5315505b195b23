"""What the uncertainty of a calibration leaves uncertain of lines and poses.

It is common to all arcs of a camera, so that no residual shows it. A calibration with the covariance C = L L' is moved by one
standard deviation in each direction L v in which it moves the pixels of the arcs, the v being the right singular vectors of their
motion; poses and lines follow as they would have been found with that camera, and the squares of their motions add up:

    Cov = sum (x(theta + L v) - x(theta)) (x(theta + L v) - x(theta))'
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.formats.calibration_data import CameraEstimate, RigCamera
from camera_models.pose import Pose, vector_from_rotation
from camera_models.pose_fit import LEAST_SCALE_PX, LOSS_SIGMAS, by_pose, robust_scale_px
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.state import Rig, moved_poses
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss
from omnilines.records import PosePoints

LEAST_SHARE = 1e-4
"""Of the squared motion of the pixels: directions that move them less are left out."""
STEP = 0.25
"""Standard deviations that a calibration is moved by, so that what follows is linear."""
SEEN = 2000
"""Pixels of a camera that tell in which directions it is uncertain."""
MOST_ITERATIONS = 30
"""Of the lines and poses that follow so small a step: most come to rest after three, beside arcs that a loss leaves out some need
ten and more."""


@dataclass(frozen=True)
class KnownCalibration:
    """Cameras with what is known of their errors, and the photos that they took."""

    models: tuple[CameraModel, ...]
    estimates: tuple[CameraEstimate | None, ...]
    """Of each camera."""
    camera: Int[Tensor, " images"]
    """Of each photo."""
    mounted: Rig | None = None
    """Where the photos are of a rig that is held."""
    mounts: tuple[RigCamera, ...] = ()
    """Of each camera of the rig."""


@dataclass(frozen=True)
class Followed:
    """What is adjusted, and how."""

    arcs: MatchedArcs
    lines: PlueckerLines
    rig_from_world: Pose
    """Of every frame; without a rig of every photo."""
    refine_poses: bool
    cost: str
    loss: Loss
    points: Mapping[int, PosePoints]
    """Of photos whose pose was found from points, where poses are held."""
    prior: PosePrior | None = None
    iterations: int = MOST_ITERATIONS

    def with_calibration(self, known: KnownCalibration) -> tuple[PlueckerLines, Pose]:
        """The lines, and `cam_from_world` of all photos, as they are found with other cameras."""
        arcs, rig, poses = self.arcs.seen_by(known.models), known.mounted, self.rig_from_world
        if rig is not None and not self.refine_poses:
            poses, rig = rig.cam_from_rig[rig.camera] @ poses[rig.frame], None
        if self.points:
            poses = followed_poses(poses, self.points, known)
        found = adjust_lines(
            arcs, self.lines, poses, cost=self.cost, refine_poses=self.refine_poses, rig=rig, prior=self.prior,
            loss=self.loss, max_iterations=self.iterations,
        )  # fmt: skip
        return found.state.chart.lines(), found.state.cam_from_world


@dataclass(frozen=True)
class CalibrationErrors:
    """Covariances from the errors of the calibration alone."""

    lines: Float[Tensor, "n 4 4"]
    """Of each line in its chart; NaN where it follows no camera."""
    poses: Float[Tensor, "images 6 6"]
    """Of the left perturbation of each pose; zero for those that do not follow."""


def calibration_errors(
    followed: Followed, known: KnownCalibration, chart: LineChart, track: Int[Tensor, " n"]
) -> CalibrationErrors:
    """What errors of the calibration leave uncertain of lines in these charts, and of poses; `track` is the number of each line
    in `followed`."""
    lines, poses = followed.with_calibration(known)
    of_lines, of_poses = (torch.zeros(len(one), k, k, dtype=torch.float64) for one, k in ((chart, 4), (poses, 6)))
    for moved in motions(known, followed.arcs):
        now, there = followed.with_calibration(moved)
        away, apart = _motion(chart, lines[track], now[track]) / STEP, (there @ poses.inverse()).log() / STEP
        of_lines += away[:, :, None] * away[:, None, :]
        of_poses += apart[:, :, None] * apart[:, None, :]
    return CalibrationErrors(of_lines, of_poses)


def _motion(chart: LineChart, start: PlueckerLines, end: PlueckerLines) -> Float[Tensor, "n 4"]:
    """How lines moved, in the charts of lines that are nearly the same as where they started."""
    first, last = (LineChart.from_lines(lines, chart.centre, chart.scale) for lines in (start, end))
    turn = first.S @ vector_from_rotation(first.S.mT @ last.S)[..., None]
    return torch.cat([(chart.S.mT @ turn)[..., 0], (last.phi - first.phi)[:, None]], -1)


def motions(known: KnownCalibration, arcs: MatchedArcs) -> Iterator[KnownCalibration]:
    """The calibration, moved by STEP standard deviations in each direction in which it is uncertain."""
    assert arcs.observed is not None
    for k, (model, estimate) in enumerate(zip(known.models, known.estimates, strict=True)):
        pixels = arcs.observed.pixels[arcs.observed.camera == k].flatten(0, 1)
        if estimate is None or estimate.covariance is None or not len(pixels):
            continue
        for step in camera_steps(model, estimate.covariance, pixels[:: 1 + len(pixels) // SEEN]):
            moved, _ = _moved(model, STEP * step)
            yield replace(known, models=(*known.models[:k], moved, *known.models[k + 1 :]))
    if known.mounted is None:
        return
    for k, mount in enumerate(known.mounts):
        if mount.covariance is None:
            continue
        variance, axes = np.linalg.eigh(mount.covariance)
        for step in (axes * np.sqrt(variance.clip(0.0)))[:, variance > 0.0].T:
            placed = moved_poses(known.mounted.cam_from_rig, torch.tensor([k]), torch.as_tensor(STEP * step)[None])
            yield replace(known, mounted=replace(known.mounted, cam_from_rig=placed))


def camera_steps(
    model: CameraModel, covariance: Float[np.ndarray, "p p"], pixels: Float[Tensor, "n 2"]
) -> Float[np.ndarray, "k p"]:
    """One standard deviation of the parameters in each direction that moves pixels, those that move them most first."""
    variance, axes = np.linalg.eigh(covariance)
    root = (axes * np.sqrt(variance.clip(0.0)))[:, variance > 0.0]
    bearings, seen = model.unproject(pixels)
    bearings = bearings[seen]
    here, _ = model.project(bearings)
    motion = [
        sign / STEP * (moved.project(bearings)[0] - here).flatten() for moved, sign in (_moved(model, STEP * s) for s in root.T)
    ]
    if not motion:
        return np.zeros((0, len(covariance)))
    by_step = torch.stack(motion, -1).numpy()
    _, size, turn = np.linalg.svd(by_step[np.isfinite(by_step).all(-1)], full_matrices=False)
    steps: Float[np.ndarray, "k p"] = (root @ turn.T).T[size**2 > LEAST_SHARE * (size**2).sum()]
    return steps


def _moved(model: CameraModel, step: Float[np.ndarray, " p"]) -> tuple[CameraModel, float]:
    """The camera with other parameters, and 1; to the other side, and -1, where there is none on this one."""
    parameters = model.parameters.detach()
    try:
        return model.with_parameters(parameters + torch.as_tensor(step)), 1.0
    except InputError:
        return model.with_parameters(parameters - torch.as_tensor(step)), -1.0


def followed_poses(poses: Pose, points: Mapping[int, PosePoints], known: KnownCalibration) -> Pose:
    """Poses that fit the points of their photos best with these cameras, near those given: one step with the weights of
    `refit_pose`."""
    steps = []
    for image, seen in points.items():
        model, pose = known.models[int(known.camera[image])], poses[image]
        there = pose.transform(torch.as_tensor(seen.points_m))
        pixels, valid, by_point, _ = model.project_with_jacobians(there)
        residual = torch.as_tensor(seen.pixels) - pixels
        loss_px = LOSS_SIGMAS * max(robust_scale_px(residual[valid].numpy()), LEAST_SCALE_PX)
        weight = (valid / (1.0 + residual.square().sum(-1) / loss_px**2)).sqrt()[:, None]
        by_twist = weight[..., None] * by_pose(by_point, there)
        steps.append(torch.linalg.lstsq(by_twist.flatten(0, 1), (weight * residual).flatten()[:, None]).solution[:, 0])
    return moved_poses(poses, torch.tensor(list(points)), torch.stack(steps))
