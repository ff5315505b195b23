"""How the board moves while cameras with clocks of their own look at it: a polynomial in time for each run of frames.

A run is some consecutive frames of every camera. With tau the time since the middle of the run, the middle m of the board goes
along a polynomial of the rig frame and the board turns about it by a rotation vector that is one too:

    m(tau) = m_0 + sum p_k tau^k,    R(tau) = exp(sum w_k tau^k) R_0,    k = 1 ... degree

Camera c has the clock t_c = t + offset_c, so that its frame of the time t_c shows the board at tau = (t_c - offset_c) / unit. Of
as many frames as coefficients and no offset these are the poses of the frames, each by itself: offsets are all that is added.

The time of a frame is that of its middle row. Where camera c has a rolling shutter, a corner that is seen y rows below the middle
is seen line_delay_c y later (O. Ait-Aider et al. 2006); y is where it is found, so that nothing has to be solved for it.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose, adjoint, rotation_from_vector, vector_from_rotation


@dataclass(frozen=True, eq=False)
class ViewTimes:
    """When views were taken, and how finely their runs are followed."""

    time_s: Float[Tensor, " v"]
    """By the clock of the view's camera, since the middle of its run by that of the first."""
    unit_s: float
    """Of tau: about half the length of a run."""
    degree: int
    middle_m: Float[Tensor, "3"]
    """Of the board, in its own frame."""
    free: Bool[Tensor, " c"]
    """Whether the offset of each camera is estimated; that of the first is 0."""
    delayed: Bool[Tensor, " c"]
    """Whether the line delay of each camera is estimated."""
    row_px: Float[Tensor, " v"] | None = None
    """How far beyond the middle of the image, in the order in which it is read; None for whole views."""

    def tau(self, path: "Path", camera: Int[Tensor, " v"]) -> Float[Tensor, " v"]:
        """Of every view, of these cameras with the clocks of a path."""
        since = self.time_s - path.offset_s[camera]
        return (since if self.row_px is None else since + path.line_delay_s[camera] * self.row_px) / self.unit_s


@dataclass(frozen=True, eq=False)
class Path:
    """The motion of the board in each run, beside its pose in the middle, and the clocks of the cameras."""

    rates: Float[Tensor, "runs degree 6"]
    """Of each power of tau (rotation_rad, translation_m)."""
    offset_s: Float[Tensor, " c"]
    line_delay_s: Float[Tensor, " c"]
    """From one row of the image to the next; 0 where all are of one instant."""


@dataclass(frozen=True, eq=False)
class PathDerivatives:
    """Of the left perturbation of `rig_from_target` at an instant."""

    by_run: Float[Tensor, "v 6 e"]
    """By the pose in the middle (a turn about the middle of the board, a shift of it), then by the rates, power by power."""
    by_offset: Float[Tensor, "v 6 1"]
    """By the offset of the camera's clock, in seconds."""


def _powers(tau: Float[Tensor, " v"], degree: int) -> Float[Tensor, "v degree"]:
    return tau[:, None] ** torch.arange(1, degree + 1, dtype=torch.float64)


def pose_along(base: Pose, rates: Float[Tensor, "v degree 6"], tau: Float[Tensor, " v"], middle_m: Float[Tensor, "3"]) -> Pose:
    """`rig_from_target` at an instant from that in the middle of the run, for each row."""
    moved = (_powers(tau, rates.shape[1])[:, :, None] * rates).sum(1)
    return _about_middle(base, moved, middle_m)


def _about_middle(pose: Pose, moved: Float[Tensor, "v 6"], middle_m: Float[Tensor, "3"]) -> Pose:
    """The board turned about its middle and shifted, in the axes of the rig."""
    place = (pose.rotation @ middle_m) + pose.translation + moved[:, 3:]
    rotation = rotation_from_vector(moved[:, :3]) @ pose.rotation
    return Pose(rotation, place - rotation @ middle_m)


def moved_run(base: Pose, path: Path, step: Float[Tensor, "runs e"], middle_m: Float[Tensor, "3"]) -> tuple[Pose, Path]:
    """Pose in the middle and rates after a step of each run."""
    rates = path.rates + step[:, 6:].reshape(path.rates.shape)
    return _about_middle(base, step[:, :6], middle_m), replace(path, rates=rates)


def path_derivatives(
    base: Pose, rates: Float[Tensor, "v degree 6"], tau: Float[Tensor, " v"], times: ViewTimes
) -> PathDerivatives:
    """Around the paths of each row."""
    degree = rates.shape[1]
    powers = _powers(tau, degree)
    turn = (powers[:, :, None] * rates[..., :3]).sum(1)
    number = torch.arange(1, degree + 1, dtype=torch.float64)
    slopes = (number * torch.cat([torch.ones_like(tau)[:, None], powers[:, :-1]], 1))[:, :, None] * rates
    speed = slopes.sum(1)
    pose = pose_along(base, rates, tau, times.middle_m)
    place = pose.rotation @ times.middle_m + pose.translation
    still = torch.eye(3, dtype=torch.float64).expand(len(tau), 3, 3)
    # A twist in the axes of the rig about the middle of the board, as a left perturbation in the rig.
    outwards = adjoint(Pose(still, place))
    across = _left_jacobian(turn)
    blocks = [_diagonal(rotation_from_vector(turn), still)]
    blocks += [powers[:, k, None, None] * _diagonal(across, still) for k in range(degree)]
    by_offset = -_diagonal(across, still) @ speed[..., None] / times.unit_s
    return PathDerivatives(outwards @ torch.cat(blocks, -1), outwards @ by_offset)


def _diagonal(turn: Float[Tensor, "v 3 3"], shift: Float[Tensor, "v 3 3"]) -> Float[Tensor, "v 6 6"]:
    zero = torch.zeros_like(turn)
    return torch.cat([torch.cat([turn, zero], -1), torch.cat([zero, shift], -1)], -2)


def _left_jacobian(w: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3 3"]:
    """J with exp(w + d) = exp(J d) exp(w) to first order: what the exponential of SE(3) has across its translations."""
    columns = [Pose.exp(torch.cat([w, torch.eye(3, dtype=torch.float64)[k].expand_as(w)], -1)).translation for k in range(3)]
    return torch.stack(columns, -1)


def followed(
    seen: Pose, run: Int[Tensor, " v"], tau: Float[Tensor, " v"], runs: int, degree: int, middle_m: Float[Tensor, "3"]
) -> tuple[Pose, Float[Tensor, "runs degree 6"]]:
    """Pose in the middle and rates of each run that are nearest to the poses seen in its views; runs without a view stand at the
    origin."""
    eye = torch.eye(3, dtype=torch.float64)
    rotation, translation = eye.repeat(runs, 1, 1), torch.zeros(runs, 3, dtype=torch.float64)
    rates = torch.zeros(runs, degree, 6, dtype=torch.float64)
    place = seen.rotation @ middle_m + seen.translation
    for number in torch.unique(run).tolist():
        own = torch.nonzero(run == number).flatten()
        first = own[int(tau[own].abs().argmin())]
        turn = vector_from_rotation(seen.rotation[own] @ seen.rotation[first].mT)
        design = torch.cat([torch.ones(len(own), 1, dtype=torch.float64), _powers(tau[own], degree)], 1)
        found = torch.linalg.lstsq(design, torch.cat([turn, place[own]], -1), driver="gelsd").solution
        rotation[number] = rotation_from_vector(found[0, :3]) @ seen.rotation[first]
        translation[number] = found[0, 3:] - rotation[number] @ middle_m
        rates[number] = found[1:]
    return Pose(rotation, translation), rates
