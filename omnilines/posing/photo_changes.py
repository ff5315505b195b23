"""What changes between photos while cameras are held: rows read one after the other (rolling shutter), the focal length, crops.

Each photo is given terms of its own beside its pose, for one kind at a time, and points and poses follow: one linear step of
least squares from where they were adjusted, with the weights of the robust loss. What all photos of a camera share, such as an
error of its calibration, is taken up by terms that are the same in all. Where points scatter far less with terms of each photo
than with these, beyond chance (F test), that is said.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse, stats
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose_fit import LOSS_SIGMAS, by_pose
from omnilines.posing.bearing_residual import bearing_residual, placed
from omnilines.posing.growth import Grown
from omnilines.posing.options import GrowthOptions
from omnilines.posing.tracks import Observations

OPEN = 1e-9
"""Eigenvalues below this share of the largest, unknowns scaled, are those of what nothing determines: the frame, the scale."""
POSE = 6
"""Columns of a pose."""
HOLD_STILL = "Hold the camera still for each photo, or use one with a global shutter."
ROLLING = ("rows of a photo were read one after the other while the camera moved (rolling shutter)", HOLD_STILL)
"""Of columns, where the camera was turned: which of both it is points hardly tell."""
ONE_SETTING = "Give photos of one setting as the camera took them, and a calibration of that setting."
MEANT = {
    "rows": ROLLING,
    "columns": ROLLING,
    "focal": ("each photo had a focal length of its own (zoom, focus)", ONE_SETTING),
    "centre": ("each photo were shifted (crops, image stabilisation)", ONE_SETTING),
}
"""What the terms of each photo mean, and what to do."""


class _Kind(NamedTuple):
    """How points scatter, standard deviations of a residual."""

    alike: float
    """With what all photos of a camera share."""
    each: float
    """With terms of each photo."""
    chance: float
    """Of so much less (F test)."""
    score: float
    """Schwarz's criterion, least for what explains the residuals best for its number of terms."""


def change_doubts(
    grown: Grown, models: Mapping[str, CameraModel], cameras: Sequence[str], options: GrowthOptions = GrowthOptions()
) -> tuple[str, ...]:
    """What is to be said of photos that changes between them explain better; `cameras` are those of the photos."""
    seen = _of_first_photos(grown.seen, options.most_changing)
    if len(seen) == 0:
        return ()
    given = _given(seen, grown)
    tried = {kind: _tried(kind, given, models, cameras) for kind in MEANT}
    kind, best = min(tried.items(), key=lambda one: one[1].score)
    if best.alike <= options.change_doubt * best.each or best.chance >= options.change_significance:
        return ()
    meant, remedy = MEANT[kind]
    return (
        f"Photos contradict each other: points would scatter {best.alike / best.each:.2f} times less if {meant}. Poses and lines "
        f"are off by more than is stated. {remedy}",
    )


def _of_first_photos(seen: Observations, most: int) -> Observations:
    """What the first photos see of points that two of them see."""
    own = seen.chosen(torch.isin(seen.photo, torch.unique(seen.photo)[:most]))
    return own.chosen(torch.bincount(own.point)[own.point] > 1) if len(own) else own


class _Given(NamedTuple):
    """What is the same for all kinds: residuals and their derivatives, weighted, with the points to be eliminated."""

    seen: Observations
    photo: Int[np.ndarray, " n"]
    """Of each observation, numbered anew."""
    weight: Float[Tensor, "n 1"]
    of_pose: Float[Tensor, "n 2 6"]
    """Derivatives by the poses, without the weight."""
    vector: Float[np.ndarray, " r"]
    """The residuals."""
    by_points: sparse.csr_array
    inverse: sparse.bsr_array
    """Of the normal matrix of the points."""


def _given(seen: Observations, grown: Grown) -> _Given:
    photo, point = (torch.unique(numbers, return_inverse=True)[1].numpy() for numbers in (seen.photo, seen.point))
    poses, points = grown.cam_from_world[seen.photo], int(point.max()) + 1
    at = placed(poses, grown.points[seen.point])
    residual, by_place = bearing_residual(seen.bearings, seen.rows, at)
    weight = (1 + residual.square().sum(-1) / (LOSS_SIGMAS * grown.scale) ** 2).rsqrt()[:, None]
    by_point = by_place @ poses.rotation * weight[..., None]
    blocks = np.zeros((points, 3, 3))
    np.add.at(blocks, point, (by_point.mT @ by_point).numpy())
    inverse = sparse.bsr_array((np.linalg.pinv(blocks, rcond=OPEN, hermitian=True), np.arange(points), np.arange(points + 1)))
    of_pose, vector = by_pose(by_place, at), (residual * weight).numpy().ravel()
    return _Given(seen, photo, weight, of_pose, vector, _in_blocks(by_point.numpy(), point), inverse)


def _in_blocks(values: Float[np.ndarray, "n 2 m"], block: Int[np.ndarray, " n"]) -> sparse.csr_array:
    """A row for each residual, whose columns are those of the block of its observation."""
    width, rows = values.shape[-1], np.arange(2 * len(values)).reshape(-1, 2, 1)
    column = (block[:, None, None] * width + np.arange(width)).repeat(2, 1)
    where = (np.broadcast_to(rows, values.shape).ravel(), column.ravel())
    return sparse.csr_array((values.ravel(), where), (rows.size, (int(block.max()) + 1) * width))


def _tried(kind: str, given: _Given, models: Mapping[str, CameraModel], cameras: Sequence[str]) -> _Kind:
    terms = _by_terms(kind, given.seen, given.of_pose, [models[name] for name in cameras])
    own = [cameras[photo] for photo in torch.unique(given.seen.photo).tolist()]
    of_camera = np.array([[name == one for one in dict.fromkeys(own)] for name in own], float)
    return _compared(given, torch.cat([given.of_pose, terms], -1) * given.weight[..., None], of_camera)


def _by_terms(kind: str, seen: Observations, of_pose: Float[Tensor, "n 2 6"], models: Sequence[CameraModel]) -> Tensor:
    """Derivatives of residuals by the terms of their photo, (n, 2, m)."""
    found = of_pose.new_zeros(len(seen), 2, {"focal": 1, "centre": 2}.get(kind, POSE))
    for photo in torch.unique(seen.photo).tolist():
        own, model = seen.photo == photo, models[photo]
        pixels, _ = model.project(seen.bearings[own])
        if kind in ("rows", "columns"):
            axis = 1 if kind == "rows" else 0
            found[own] = of_pose[own] * ((pixels[:, axis] + 0.5) / model.image_size[axis] - 0.5)[:, None, None]
        else:
            by_pixel = seen.rows[own] @ model.unproject_jacobian(pixels)
            found[own] = by_pixel if kind == "centre" else by_pixel @ (pixels - model.centre_px)[..., None]
    return found


def _compared(given: _Given, columns: Float[Tensor, "n 2 k"], of_camera: Float[np.ndarray, "v c"]) -> _Kind:
    """Of terms that are the same in all photos of a camera, and of each; points are eliminated."""
    k, views, points = columns.shape[-1], len(of_camera), given.inverse.shape[0] // 3
    kept, gone, inverse, vector = _in_blocks(columns.numpy(), given.photo), given.by_points, given.inverse, given.vector
    left = vector - gone @ (inverse @ (gone.T @ vector))
    coupling = gone.T @ kept
    normal, right = (kept.T @ kept - coupling.T @ (inverse @ coupling)).toarray(), kept.T @ left
    own = np.eye(k * views).reshape(k * views, views, k)
    poses, terms = own[..., :POSE].reshape(k * views, -1), own[..., POSE:]
    shared = np.einsum("ivt,vc->ict", terms, of_camera).reshape(k * views, -1)
    alike = _left(normal, right, np.concatenate([poses, shared], 1))
    each = _left(normal, right, np.eye(k * views))
    squares, freedom = float(vector @ left), vector.size - 3 * points
    (gain, unknowns), (gain_each, unknowns_each) = alike, each
    more, rest = unknowns_each - unknowns, freedom - unknowns_each
    if more <= 0 or rest <= 0:
        return _Kind(1.0, 1.0, 1.0, math.inf)
    statistic = (gain_each - gain) / more / ((squares - gain_each) / rest)
    sigma = (math.sqrt((squares - gain) / (freedom - unknowns)), math.sqrt((squares - gain_each) / rest))
    score = vector.size * math.log(squares - gain_each) + unknowns_each * math.log(vector.size)
    return _Kind(*sigma, float(stats.f.sf(statistic, more, rest)), score)


def _left(normal: np.ndarray, right: np.ndarray, along: np.ndarray) -> tuple[float, int]:
    """By how much squares fall along some columns, and how many unknowns that are."""
    normal, right = along.T @ normal @ along, along.T @ right
    scale = 1 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    value, vector = np.linalg.eigh(scale[:, None] * normal * scale)
    known = value > OPEN * value[-1]
    step = vector.T @ (scale * right)
    return float((step[known] ** 2 / value[known]).sum()), int(known.sum())
