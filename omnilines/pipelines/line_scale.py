"""The scale of a camera that lines made straight, from the right angles of all photos together.

An adjustment ends at the scale next to the one it began with: frames that are not at right angles there are not found, and one
that happens to be nearly so holds it. Any factor on z keeps lines straight, and the directions in which they meet
(`structure/right_angles.py`), so that all scales are compared by the directions that are found with any one.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from camera_models.wording import rounded
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.lines.camera import LineAdjustment
from omnilines.calibration.select import Candidate
from omnilines.geometry.chains import Chains
from omnilines.pipelines.chain_starts import CameraStart
from omnilines.pipelines.line_camera import adjusted_camera, asked_camera
from omnilines.pipelines.line_families import chain_circles
from omnilines.pipelines.line_options import LinesOptions
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.structure.meeting import Meeting, meeting_directions
from omnilines.structure.told_scale import ToldScale, told_scale

AZIMUTHS = 16
ANGLES = 100
LARGEST_SLACK_RAD = 1e-3
MIDDLE_RAD = 1e-3
"""Off axis, where the focal length in the middle of the image is read."""


def with_scale_of_all(
    start: CameraStart,
    done: LineAdjustment,
    arcs: Chains,
    guide: Candidate,
    lines: LinesOptions,
    progress: ProgressCallback = silent,
) -> tuple[CameraStart, LineAdjustment]:
    """The adjustment from the scale at which the directions of all photos are at right angles, where that is another one; and the
    start with it."""
    found = scale_of_all(done, lines, progress)
    if found.here or not found.decisive:
        return start, done
    reach = float(angles_off_axis(done.model, done.chains.blocks.pixels).max())
    other = scaled(done.model, found.factor, reach, **guide.options)
    start = replace(start, focal_px=_middle_focal_px(other), focal_sigma=found.sigma)
    return start, adjusted_camera(other, arcs, lines.adjustment, lines.directions, progress=progress)


def scaled(model: CameraModel, factor: float, reach_rad: float, **options: Any) -> CameraModel:
    """The nearest camera of the same model (`options`: which variant of it) whose bearings have z times `factor`, as far as
    `reach_rad` off the axis of the model given."""
    theta = torch.linspace(0.0, min(reach_rad, 0.999 * model.max_angle), ANGLES + 1, dtype=torch.float64)[1:]
    other = torch.atan2(torch.sin(theta), factor * torch.cos(theta))
    seen = other < model.LARGEST_ANGLE - LARGEST_SLACK_RAD
    rho = _radii_px(model, theta)
    return model.from_radial_curve(rho[seen], other[seen], model.centre_px.detach(), model.image_size, **options)


def _radii_px(model: CameraModel, theta: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """From the centre, the mean over all azimuths."""
    azimuth = (2.0 * math.pi / AZIMUTHS) * (torch.arange(AZIMUTHS, dtype=torch.float64)[:, None] + 0.5)
    side = torch.sin(theta)
    rays = torch.stack([side * torch.cos(azimuth), side * torch.sin(azimuth), torch.cos(theta).expand(AZIMUTHS, -1)], -1)
    with torch.no_grad():
        return (model.project(rays)[0] - model.centre_px).norm(dim=-1).mean(0)


def _middle_focal_px(model: CameraModel) -> float:
    angle = torch.tensor([MIDDLE_RAD], dtype=torch.float64)
    return float(_radii_px(model, angle)) / math.tan(MIDDLE_RAD)


def without_doubtful_angles(
    start: CameraStart,
    done: LineAdjustment,
    arcs: Chains,
    guide: Candidate,
    lines: LinesOptions,
    progress: ProgressCallback = silent,
) -> tuple[CameraStart, LineAdjustment, LinesOptions, tuple[str, ...]]:
    """The adjustment as it is where right angles tell its scale, or boards do; else one to straightness and parallels alone, at
    the scale that right angles and other angles tell together, where they do. With the start and the options for it, and what a
    person should know."""
    if not done.families.frames or done.prior.boards:
        return start, done, lines, ()
    found = scale_of_all(done, lines, progress)
    if found.decisive and found.here:
        return start, done, lines, ()
    lines = _without_right_angles(lines)
    if not found.told:
        done = adjusted_camera(done.model, arcs, lines.adjustment, lines.directions, prior=done.prior, progress=progress)
        note = "The focal length stays near that of the start, and its standard deviation says so; add photos from other sides, "
        return start, done, lines, (f"{doubt(found)} {note}with the camera tilted, or of a board.",)
    reach = float(angles_off_axis(done.model, done.chains.blocks.pixels).max())
    other = scaled(done.model, found.either, reach, **guide.options)
    start = replace(start, focal_px=_middle_focal_px(other), focal_sigma=found.either_sigma)
    sigma = found.either_sigma
    done = adjusted_camera(other, arcs, lines.adjustment, lines.directions, scale_sigma=sigma, progress=progress)
    note = f"All of these together tell the focal length to {rounded(100 * sigma)} percent, and no more is taken from them."
    return start, done, lines, (f"{doubt(found)} {note}",)


def asked_by_lines(
    model: CameraModel, arcs: Chains, lines: LinesOptions, progress: ProgressCallback = silent
) -> tuple[LineAdjustment, tuple[str, ...]]:
    """The camera that lines ask for in the place of a given one, without right angles where these tell no scale, and what a
    person should know. Where they tell another scale they count: the given camera is wrong by them."""
    asked = asked_camera(model, arcs, lines.adjustment, lines.directions, progress)
    if not asked.families.frames:
        return asked, ()
    found = scale_of_all(asked, lines, progress)
    if found.decisive:
        return asked, ()
    lines = _without_right_angles(lines)
    lines = replace(lines, adjustment=replace(lines.adjustment, prior_share=lines.right_angles.held_share))
    asked = asked_camera(model, arcs, lines.adjustment, lines.directions, progress)
    note = "A wrong focal length is not found so; add photos from other sides, or with the camera tilted."
    return asked, (f"{doubt(found)} {note}",)


def _without_right_angles(lines: LinesOptions) -> LinesOptions:
    return replace(lines, adjustment=replace(lines.adjustment, right_angles=False))


def doubt(found: ToldScale) -> str:
    """Why right angles do not count."""
    walls = "right angles" if found.rival_angle_rad is None else f"walls at {math.degrees(found.rival_angle_rad):.0f} degrees"
    far, way = 100 * abs(found.rival_factor - 1), "longer" if found.rival_factor > 1 else "shorter"
    other = f"by a focal length {far:.0f} percent {way} with {walls}"
    if abs(math.log(found.rival_factor)) <= found.sigma:
        other = f"by {walls} and about the same focal length"
    return (
        "Right angles are not used, as these photos do not decide that they are there: the directions of their lines are "
        f"explained about as well in other ways, as {other}."
    )


def scale_of_all(done: LineAdjustment, lines: LinesOptions, progress: ProgressCallback) -> ToldScale:
    """What the right angles of all photos of an adjustment tell of its scale."""
    told = lines.right_angles
    directions = replace(lines.directions, false_directions=told.told_directions, min_lines=told.told_lines)
    return told_scale(*directions_of_all(done, replace(lines, directions=directions), progress), told)


def directions_of_all(
    done: LineAdjustment, lines: LinesOptions, progress: ProgressCallback
) -> tuple[list[Meeting], Float[np.ndarray, " photos"]]:
    """The directions in which the lines of each photo of an adjustment meet, and the weights of photos."""
    chains = done.chains
    with torch.no_grad():
        circles = chain_circles(done.model, chains)
    photo, counted, times = chains.blocks.photo.numpy(), chains.weight.numpy() > 0, chains.blocks.times.numpy()
    rows = [np.flatnonzero((photo == one) & counted) for one in np.unique(photo[counted])]

    def look(own: Int[np.ndarray, " n"]) -> Meeting:
        """The directions of one photo."""
        return meeting_directions(circles.rows(own), lines.directions)

    found = on_all_cores(look, rows, "finding directions", progress)
    return found, np.array([float((1.0 / times[own]).mean()) for own in rows])
