"""What points ask of the cameras that they were found with: the change with which they fit best, poses and points going along.

Poses take up most of what a wrong camera does, and points then scatter hardly more than they would. So one Gauss-Newton step is
taken from there, in pixels, over poses, points and parameters d of all cameras at once,

    minimise  sum_i |pixel_i(d, pose, point) - seen_i|^2 / sigma_i^2,

linear about what is known, without the observations that are gross errors. Poses and points are eliminated (Schur complement);
what is left is the change of the cameras with its covariance. It says nothing where squares do not fall by what it promises: of
poses that are wrong altogether, or where what is hardly seen takes it too far.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose_fit import by_pose
from omnilines.least_squares.schur import LEAST_PIVOT
from omnilines.posing.bearing_residual import placed
from omnilines.posing.features import off_axis_rad
from omnilines.posing.options import ResectionOptions
from omnilines.posing.photo_poses import CameraByPoints
from omnilines.posing.point_adjustment import Frames, PointEngine, PosesAndPoints, adjust_points
from omnilines.posing.tracks import Observations, compact

SQUARES = 1e6
"""The bend of a loss, in standard deviations, beyond any residual: a sum of squares."""
UNSEEN = 1e-12
"""Of the largest eigenvalue: what points say less of they say nothing of."""
CONFIRMED = 0.5
"""Of the promised decrease of the squares, what has to come."""


def cameras_by_points(
    seen: Observations,
    frames: Frames,
    known: PosesAndPoints,
    cameras: Mapping[str, CameraModel],
    camera_of: Sequence[str],
    options: ResectionOptions = ResectionOptions(),
) -> dict[str, CameraByPoints]:
    """Of every camera that has parameters and saw points, from poses and points adjusted to these observations; `camera_of` are
    the names of the photos' cameras. Nothing where poses are not determined, or the step does not hold what it promises."""
    seen, known = _fair(seen, frames, known, options)
    image = _imaged(seen, cameras, camera_of)
    columns = _columns(seen, image, cameras)
    reduced = _reduced(seen, image, frames, known, cameras, columns) if columns else None
    if reduced is None:
        return {}
    inverse = _inverse(reduced.information)
    step = -inverse @ reduced.gradient
    promised = -float(step @ reduced.gradient)
    others = {name: cameras[name].with_parameters(cameras[name].parameters + one.of(step)) for name, one in columns.items()}
    by_squares = options._replace(loss_scale=SQUARES)
    after = adjust_points(_through(seen, image, {**cameras, **others}), frames, known, by_squares)
    if not reduced.squares - float(after.residual.square().sum()) >= CONFIRMED * promised:
        return {}
    unknowns = 3 * len(known.points) + 6 * reduced.frames + len(step)
    covariance = (reduced.squares - promised) / max(1, 2 * len(seen) - unknowns) * inverse
    return {name: _of_camera(cameras[name], one, step, covariance, seen) for name, one in columns.items()}


@dataclass(frozen=True)
class _Imaged:
    """The observations in their images."""

    pixels: Float[Tensor, "n 2"]
    over_sigma: Float[Tensor, " n"]
    """One over the standard deviation of each coordinate."""
    rows: dict[str, Int[Tensor, " _"]]
    """Of each camera that took photos."""


@dataclass(frozen=True)
class _Columns:
    """The parameters of a camera among those of all."""

    first: int
    basis: Float[Tensor, "p q"]
    """Of what a column changes, about a pixel each over what was seen."""
    rows: Int[Tensor, " n"]
    """Of the observations, those of this camera."""

    @property
    def own(self) -> slice:
        return slice(self.first, self.first + self.basis.shape[1])

    def of(self, step: Float[np.ndarray, " q"]) -> Float[Tensor, " p"]:
        """The change of the camera's parameters."""
        return self.basis @ torch.from_numpy(step[self.own])


@dataclass(frozen=True)
class _Reduced:
    """The normal equations of the cameras without poses and points."""

    information: Float[np.ndarray, "q q"]
    gradient: Float[np.ndarray, " q"]
    squares: float
    """Of the residuals."""
    frames: int
    """That were eliminated."""


def _fair(
    seen: Observations, frames: Frames, known: PosesAndPoints, options: ResectionOptions
) -> tuple[Observations, PosesAndPoints]:
    """Without what is a gross error, adjusted by squares."""
    first = adjust_points(seen, frames, known, options)
    fair = torch.nonzero(first.residual <= options.gross_sigmas * first.scale).flatten()
    seen, points = compact(seen.chosen(fair), first.state.points)
    second = adjust_points(seen, frames, replace(first.state, points=points), options._replace(loss_scale=SQUARES))
    return seen, second.state


def _imaged(seen: Observations, cameras: Mapping[str, CameraModel], camera_of: Sequence[str]) -> _Imaged:
    names = np.array(camera_of)[seen.photo.numpy()]
    rows = {name: torch.from_numpy(np.flatnonzero(names == name)) for name in dict.fromkeys(camera_of)}
    pixels, over_sigma = torch.zeros(len(seen), 2).double(), torch.zeros(len(seen)).double()
    for name, own in rows.items():
        pixels[own], _ = cameras[name].project(seen.bearings[own])
        # Rows across a bearing undo d bearing / d pixel, over the standard deviation of the pixel.
        over_sigma[own] = (seen.rows[own] @ cameras[name].unproject_jacobian(pixels[own])).square().sum((1, 2)).div(2.0).sqrt()
    return _Imaged(pixels, over_sigma, rows)


def _columns(seen: Observations, image: _Imaged, cameras: Mapping[str, CameraModel]) -> dict[str, _Columns]:
    found, first = dict[str, _Columns](), 0
    for name, rows in image.rows.items():
        basis = cameras[name].calibration_basis()
        if len(rows) and basis.shape[1]:
            _, _, _, by_parameter = cameras[name].project_with_jacobians(seen.bearings[rows])
            moves = (by_parameter @ basis).square().sum(1).mean(0).sqrt()
            found[name] = _Columns(first, basis / moves.clamp_min(1e-300), rows)
            first += basis.shape[1]
    return found


def _reduced(
    seen: Observations,
    image: _Imaged,
    frames: Frames,
    known: PosesAndPoints,
    cameras: Mapping[str, CameraModel],
    columns: Mapping[str, _Columns],
) -> _Reduced | None:
    """Points are eliminated from each row, poses by the system of the engine; None where these are not determined."""
    engine = PointEngine(seen, frames, len(known.points), SQUARES)
    of_poses = engine.reduce(known, 0.0)
    if of_poses is None:
        return None
    residual, by_frame, by_point, by_cameras = _derivatives(seen, image, frames, known, cameras, columns)
    right = torch.cat([by_cameras, residual[..., None]], -1)
    own = _summed(seen.point, by_point.mT @ by_point, len(known.points))
    values = torch.linalg.eigvalsh(own)
    told = values[:, 0] > LEAST_PIVOT * values[:, 2]
    own = torch.where(told[:, None, None], own, torch.eye(3, dtype=own.dtype))
    shared = _summed(seen.point, by_point.mT @ right, len(known.points))
    rest = right - by_point @ torch.linalg.solve(own, shared)[seen.point]
    # Points without a distance take no part, as in the engine.
    rest = torch.where(told[seen.point][:, None, None], rest, 0.0)
    place = torch.full((int(frames.of_photo.max()) + 1,), -1)
    place[torch.from_numpy(engine.free)] = torch.arange(len(engine.free))
    of_frames = _summed(place[frames.of_photo[seen.photo]], by_frame.mT @ rest, len(engine.free)).flatten(0, 1).numpy()
    whole = (by_cameras.mT @ rest).sum(0).numpy() - of_frames[:, :-1].T @ of_poses.system.solve(of_frames)
    return _Reduced(whole[:, :-1], whole[:, -1], float(residual.square().sum()), len(engine.free))


def _derivatives(
    seen: Observations,
    image: _Imaged,
    frames: Frames,
    known: PosesAndPoints,
    cameras: Mapping[str, CameraModel],
    columns: Mapping[str, _Columns],
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 6"], Float[Tensor, "n 2 3"], Float[Tensor, "n 2 q"]]:
    """Residuals in standard deviations, and their derivatives by the left perturbation of rig_from_world, by points and by the
    columns of the cameras."""
    cam_from_world = frames.photos(known.rig_from_world)[seen.photo]
    at = placed(cam_from_world, known.points[seen.point])
    residual, by_place = torch.zeros(len(seen), 2).double(), torch.zeros(len(seen), 2, 3).double()
    by_cameras = torch.zeros(len(seen), 2, sum(one.basis.shape[1] for one in columns.values())).double()
    for name, rows in image.rows.items():
        expected, valid, by_point, by_parameter = cameras[name].project_with_jacobians(at[rows])
        weight = torch.where(valid, image.over_sigma[rows], 0.0)[:, None]
        residual[rows] = weight * torch.where(valid[:, None], expected - image.pixels[rows], 0.0)
        by_place[rows] = weight[..., None] * by_point
        if name in columns:
            by_cameras[rows, :, columns[name].own] = weight[..., None] * (by_parameter @ columns[name].basis)
    cam_from_rig = frames.cam_from_rig[seen.photo]
    in_rig, by_rig = placed(cam_from_rig.inverse(), at), by_place @ cam_from_rig.rotation
    return residual, by_pose(by_rig, in_rig), by_place @ cam_from_world.rotation, by_cameras


def _through(seen: Observations, image: _Imaged, cameras: Mapping[str, CameraModel]) -> Observations:
    """The observations through other cameras: the same pixels, as precise there; as they were where these see nothing."""
    bearings, rows = seen.bearings.clone(), seen.rows.clone()
    for name, own in image.rows.items():
        there, valid = cameras[name].unproject(image.pixels[own])
        own = own[valid]
        across = torch.linalg.pinv(cameras[name].unproject_jacobian(image.pixels[own]))
        bearings[own], rows[own] = there[valid], image.over_sigma[own, None, None] * across
    return replace(seen, bearings=bearings, rows=rows)


def _summed(index: Int[Tensor, " n"], values: Float[Tensor, "n a b"], count: int) -> Float[Tensor, "m a b"]:
    """The sums of the rows that have one index."""
    return torch.zeros(count, *values.shape[1:], dtype=values.dtype).index_add_(0, index, values)


def _inverse(information: Float[np.ndarray, "q q"]) -> Float[np.ndarray, "q q"]:
    """Its inverse, very large along what nothing is seen of."""
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    inverse: Float[np.ndarray, "q q"] = (vectors / np.maximum(values, UNSEEN * values[-1])) @ vectors.T
    return inverse


def _of_camera(
    model: CameraModel,
    columns: _Columns,
    step: Float[np.ndarray, " q"],
    covariance: Float[np.ndarray, "q q"],
    seen: Observations,
) -> CameraByPoints:
    basis, own = columns.basis.numpy(), columns.own
    angle_rad = off_axis_rad(model, seen.bearings[columns.rows])
    return CameraByPoints(columns.of(step).numpy(), basis @ covariance[own, own] @ basis.T, float(angle_rad.max()))
