"""A camera adjusted to straight lines: how certain it is, what it rests on, and what the lines leave open."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel
from camera_models.wording import rounded
from omnilines.calibration.diagnose import supported_angles_deg
from omnilines.calibration.intervals import SHARE, linear_intervals
from omnilines.calibration.lines.options import LineOptions
from omnilines.calibration.lines.prior import CameraPrior
from omnilines.calibration.lines.problem import CameraAndCircles, Families, LineProblem
from omnilines.calibration.lines.scores import LineScores, pseudo_inverse
from omnilines.calibration.lines.weighting import WeightedChains, residual_px
from omnilines.least_squares.variance import VarianceFactor

SMALL_RAD = 1e-4
"""Over which the scale of the image at its centre is taken."""


@dataclass(frozen=True)
class LinePhoto:
    """What one photo gave to a calibration from lines."""

    image: str
    chains: int
    straight: int
    """Chains that count."""
    members: int
    """Of these, lines along a direction."""
    directions: int
    frame: bool
    """Whether three of the directions are at right angles."""
    rms_px: float
    """Distance of edges from their lines; NaN where none counts."""
    leverage: float
    """Share of the camera's parameters that this photo decides: the shares of all photos add up to less than 1."""


@dataclass(frozen=True)
class LineAdjustment:
    """Where the adjustment ended."""

    chains: WeightedChains
    families: Families
    problem: LineProblem
    state: CameraAndCircles
    scores: LineScores
    prior: CameraPrior
    settled: bool

    @property
    def model(self) -> CameraModel:
        """The camera."""
        return self.state.model

    @property
    def scale_told(self) -> bool:
        """By right angles, by boards, or beforehand. Straight lines and parallel ones do not: any factor on z keeps them."""
        return self.families.frames > 0 or self.prior.boards or self.prior.scale_sigma is not None

    @cached_property
    def covariance(self) -> Float[Tensor, "q q"]:
        """Of the camera along the basis. What a model cannot follow of a factor on z would pin the scale where nothing tells it,
        by the form of the model alone: it is as uncertain as before."""
        if self.scale_told:
            return self.scores.covariance
        along = self.by_focal_length
        return self.scores.covariance + along[:, None] * along / (along @ self.prior.information @ along)

    @cached_property
    def by_focal_length(self) -> Float[Tensor, " q"]:
        """How the camera moves with its focal length while lines stay as straight as they can, along the basis, per pixel."""
        row, information = self.focal_row, self.scores.camera_information
        if self.prior.held is not None:
            information = information - self.prior.held[:, None] * self.prior.held
        gain = pseudo_inverse(information) @ row
        return gain / (row @ gain)

    @property
    def focal_row(self) -> Float[Tensor, " q"]:
        """Derivative of the focal length along the basis."""
        return focal_length(self.model)[1] @ self.problem.basis

    def leaves_scale_open(self, share: float) -> bool:
        """Whether lines say next to nothing of the scale, which remains as uncertain as before but for `share`."""
        along, prior = self.by_focal_length, self.prior.information
        known = self.scores.camera_information - self.scores.known_before + prior
        return not self.scale_told and float(along @ known @ along) * share**2 < float(along @ prior @ along)


@dataclass(frozen=True)
class LineCamera:
    """A camera calibrated from straight lines."""

    model: CameraModel
    covariance: Float[np.ndarray, "p p"]
    """Of the parameters in their order, as chains and photos scatter."""
    rms_px: float
    """Distance of edges from their lines, averaged along them over pieces."""
    photos: tuple[LinePhoto, ...]
    pixels: Float[np.ndarray, "n 2"]
    """Pieces of edges that the estimate rests on."""
    residual_px: Float[np.ndarray, "n 2"]
    """From each to its line."""
    photo: Int[np.ndarray, " n"]
    """Of each, in `photos`."""
    min_angle_deg: float
    max_angle_deg: float
    """How far from the bearing of the centre pixel edges reach."""
    open_terms: tuple[str, ...]
    """Directions of the parameters, in words, that lines do not tell: they are where the start has them."""
    notes: tuple[str, ...]

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation of each parameter."""
        return dict(zip(self.model.PARAMETER_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def interval_95(self) -> Float[np.ndarray, "p 2"]:
        """Lowest and highest value of each parameter, which hold it in 95 of 100 cases: Student's, with the photos that count
        less one as freedom, as the scatter of photos is in the covariance."""
        freedom = max(sum(photo.straight > 0 for photo in self.photos) - 1, 1)
        sigmas = VarianceFactor(1.0, float(freedom)).sigmas(SHARE)
        return linear_intervals(self.model.parameters, torch.as_tensor(self.covariance), sigmas).numpy()


def line_camera(done: LineAdjustment, images: Sequence[str], options: LineOptions) -> LineCamera:
    """The result of an adjustment."""
    model, basis, chains = done.model, done.problem.basis, done.chains
    covariance = basis @ done.covariance @ basis.mT
    own = counted(chains)
    pixels = chains.blocks.pixels[own]
    low, high = supported_angles_deg(model, pixels)
    distance = residual_px(chains)
    open_terms = open_terms_of(done, options.open_share)
    return LineCamera(
        model=model,
        covariance=(0.5 * (covariance + covariance.mT)).numpy(),
        rms_px=float(distance.square().mean().sqrt()),
        photos=_photos(done, images),
        pixels=pixels.numpy(),
        residual_px=(chains.at.px[own, None] * chains.blocks.normals[own]).numpy(),
        photo=chains.blocks.photo[chains.blocks.chain[own]].numpy(),
        min_angle_deg=low,
        max_angle_deg=high,
        open_terms=open_terms,
        notes=(*_notes(done, open_terms, options.right_angles), *_on_right_angles(done)),
    )


def in_mirror(fit: LineCamera) -> LineCamera:
    """The same camera looking along -z: a reflection of all bearings keeps great circles, and the angles between directions, so
    that lines do not tell a mirror from a lens."""
    model = fit.model.reversed()
    sign = torch.where(model.parameters * fit.model.parameters < 0, -1.0, 1.0).numpy()
    return replace(fit, model=model, covariance=sign[:, None] * fit.covariance * sign)


def focal_length(model: CameraModel) -> tuple[float, Float[Tensor, " p"]]:
    """Pixels per radian at the centre pixel, to its right, and its derivatives by the parameters: fx of `pinhole`, fx / (1 + xi)
    of `unified` and `double-sphere`, of which fx and xi alone are hardly known where little of the field is seen."""
    centre, _ = model.unproject(model.centre_px)
    right = model.unproject_jacobian(model.centre_px)[:, 0]
    near = centre + SMALL_RAD * right / right.norm()
    pixels, _, _, by_parameters = model.project_with_jacobians(torch.stack([centre, near]))
    return float(pixels[1, 0] - pixels[0, 0]) / SMALL_RAD, (by_parameters[1, 0] - by_parameters[0, 0]) / SMALL_RAD


def counted(chains: WeightedChains) -> Bool[Tensor, " n"]:
    """Pieces of edges that count."""
    return chains.at.valid & (chains.weight[chains.blocks.chain] > 0)


def _photos(done: LineAdjustment, images: Sequence[str]) -> tuple[LinePhoto, ...]:
    chains, families, scores = done.chains, done.families, done.scores
    photo, straight = chains.blocks.photo, chains.weight > 0
    count = torch.bincount(photo, minlength=len(images))
    used = torch.bincount(photo[straight], minlength=len(images))
    members = torch.bincount(photo[straight & (families.of_chain >= 0)], minlength=len(images))
    directions = torch.bincount(families.photo, minlength=len(images))
    frames = set(families.photo[: 3 * families.frames].tolist())
    own = counted(chains)
    of_block = photo[chains.blocks.chain[own]]
    squares = torch.zeros(len(images), dtype=torch.float64).index_add_(0, of_block, chains.at.px[own].square())
    rms = (squares / torch.bincount(of_block, minlength=len(images))).sqrt()
    inverse = pseudo_inverse(scores.camera_information)
    leverage = (scores.photo_information(done.problem, done.state) * inverse).sum((-2, -1)) / scores.camera
    return tuple(
        LinePhoto(
            image,
            int(count[k]),
            int(used[k]),
            int(members[k]),
            int(directions[k]),
            k in frames,
            float(rms[k]),
            float(leverage[k]),
        )
        for k, image in enumerate(images)
    )


def open_terms_of(done: LineAdjustment, share: float) -> tuple[str, ...]:
    """Directions in which the camera remains about as uncertain as it was at the start, by the parameters that move most."""
    root = torch.linalg.pinv(done.prior.wide)
    left = done.prior.wide @ done.covariance @ done.prior.wide.mT
    values, vectors = torch.linalg.eigh(left)
    names = done.model.PARAMETER_NAMES
    weight = done.prior.information.diagonal().sqrt()
    found = []
    for k in torch.nonzero(values.sqrt() > share).flatten().tolist():
        direction = done.problem.basis @ (weight * (root @ vectors[:, k]))
        size = direction.abs() / direction.abs().max()
        found.append(" ".join(names[i] for i in torch.nonzero(size > 0.5).flatten().tolist()))
    return tuple(found)


def _on_right_angles(done: LineAdjustment) -> tuple[str, ...]:
    """Where right angles that are off make most of the variance of the focal length."""
    if not done.families.frames:
        return ()
    row = done.focal_row
    weight = pseudo_inverse(done.scores.camera_information) @ row
    share = float(weight @ done.scores.angles_before @ weight) / float(row @ done.covariance @ row)
    if share < 0.5:
        return ()
    off = math.degrees(math.hypot(done.problem.angles.own, max(done.problem.angles.shared)))
    return (
        f"Right angles of what was photographed are off by about {rounded(off, 1)} degrees, as far as its lines tell: "
        f"{100 * share:.0f} "
        "percent of the variance of the focal length is of that, and more photos of the same do not lower it; add photos of "
        "other buildings or rooms, or of a board.",
    )


def _notes(done: LineAdjustment, open_terms: tuple[str, ...], right_angles: bool) -> tuple[str, ...]:
    notes: tuple[str, ...] = ()
    if right_angles and not done.families.frames and not done.prior.boards:
        notes += (
            "No photo shows lines in three directions at right angles, which tell the focal length and the ratio of its parts: "
            "these are a guess, as their standard deviations say, and only the straightness of lines is calibrated; add photos "
            "of buildings or rooms.",
        )
    elif open_terms:
        notes += (
            f"Lines leave open {'; '.join(open_terms)}: there the camera is where it was at the start, and its standard "
            "deviation says so; add photos that show lines in three directions at right angles in all parts of the image.",
        )
    if not done.settled:
        notes += ("The families of lines and the camera have not settled: each leads the other on; add photos.",)
    left_out = int((done.chains.weight == 0).sum())
    if left_out:
        notes += (
            f"{left_out} of {len(done.chains.weight)} edges are curved in the world, or are more than one: they are left out.",
        )
    return notes
