"""Where a calibration starts: several hypotheses from rays, none from the user, and the best of them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import GeometryError, model_class
from omnilines.calibration.initialise import BoardPoints, centre_candidates, equidistant_start, radial_start, resect_boards
from omnilines.calibration.refine import CameraAndBoards
from omnilines.calibration.thresholds import CalibrationThresholds


@dataclass(frozen=True)
class CameraKind:
    """What is to be calibrated: the image, the model with its options, and on which side of the mirror."""

    image_size: tuple[int, int]
    model: str
    mirror: bool = False
    options: Mapping[str, Any] | None = None

    @property
    def variant_open(self) -> bool:
        """Whether the options leave open which of the model's VARIANTS it is."""
        return model_class(self.model).variant_options().isdisjoint(self.options or {})


@dataclass(frozen=True)
class Start:
    """A camera with boards resected by it, and how far from the corners it is."""

    state: CameraAndBoards
    score: float
    """Mean of log(1 + residual in pixels): the less, the better; a few gross errors hardly change it."""
    typical_px: Float[Tensor, " v"]
    """Of each view: exp of that mean over its corners, minus 1."""


def ranked_starts(
    clean: BoardPoints, in_order: Bool[Tensor, " v"], kind: CameraKind, thresholds: CalibrationThresholds
) -> list[Start]:
    """Starts from the best to the worst: the closed form at each candidate for the centre, without the views that do not fit
    the others, and where none of these comes near the corners a few equidistant lenses.

    `clean` and `in_order` are what `smooth_corners` leaves. Raises GeometryError where the corners reach farther off axis than
    the model can.
    """
    limits, least_views = thresholds.start, thresholds.views.least_views
    if int(in_order.sum()) < least_views:
        in_order = torch.ones_like(in_order)
    found = _closed_forms(clean, in_order, kind)
    for _ in range(2):
        if not found:
            break
        typical = min(found, key=lambda start: start.score).typical_px
        fits = in_order & (typical <= limits.odd_view_factor * typical[in_order].median().clamp_min(1.0))
        if int(fits.sum()) < least_views or bool((fits == in_order).all()):
            break
        in_order = fits
        found += _closed_forms(clean, in_order, kind)
    if not found or min(start.score for start in found) > math.log1p(limits.good_start_share * max(kind.image_size)):
        found += _equidistant(clean, in_order, kind, limits.half_angles_deg)
    return sorted(found, key=lambda start: start.score)


def _closed_forms(points: BoardPoints, in_order: Bool[Tensor, " v"], kind: CameraKind) -> list[Start]:
    views = torch.nonzero(in_order).flatten().tolist()
    trusted = points.of_views(views)
    found = []
    for centre in centre_candidates(trusted, kind.image_size):
        start = radial_start(trusted, centre)
        if start is not None:
            _refuse_wide_angles(float(start.theta[-1]), kind.model)
            found.append(_start_from(points, in_order, (start.rho_px, start.theta), centre, kind))
    return found


def _equidistant(
    points: BoardPoints, in_order: Bool[Tensor, " v"], kind: CameraKind, half_angles_deg: tuple[float, ...]
) -> list[Start]:
    found = []
    for centre in centre_candidates(points, kind.image_size):
        reach = float((points.pixels - centre).norm(dim=-1).max())
        for angle in half_angles_deg:
            if math.radians(angle) < model_class(kind.model).LARGEST_ANGLE:
                curve = equidistant_start(points, centre, math.radians(angle), reach)
                found.append(_start_from(points, in_order, curve, centre, kind))
    return found


def _start_from(
    points: BoardPoints, in_order: Bool[Tensor, " v"], curve: tuple[Tensor, Tensor], centre: Float[Tensor, "2"], kind: CameraKind
) -> Start:
    """The model nearest to a radial curve, with boards resected by it; scored over the views that are in order."""
    options = dict(kind.options or {})
    camera = model_class(kind.model).from_radial_curve(*curve, centre, kind.image_size, mirror=kind.mirror, **options)
    bearings, seen = camera.unproject(points.pixels)
    state = CameraAndBoards(camera, resect_boards(points, bearings))
    error = state.residual_px(points).norm(dim=-1)
    # A corner that the start cannot even see is as bad as the image is large.
    error = torch.where(seen & torch.isfinite(error), error, float(max(kind.image_size)))
    by_view = points.mean_by_view(torch.log1p(error)[:, None])[:, 0]
    return Start(state, float(torch.log1p(error)[in_order[points.view]].mean()), torch.expm1(by_view))


def _refuse_wide_angles(angle: float, model: str) -> None:
    limit = model_class(model).LARGEST_ANGLE
    # The closed form is good to a degree or two.
    if angle > limit + math.radians(2):
        raise GeometryError(
            f"Camera model {model} holds angles below {math.degrees(limit):.0f} degrees off axis, found corners at about "
            f"{math.degrees(angle):.0f} degrees; use `model` scaramuzza or opencv-fisheye."
        )
