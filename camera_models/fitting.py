"""One camera model fitted to another over a field of view, both in the same camera frame.

The parameters minimise the distance in pixels between the images of the source's bearings, over a grid of the source's pixels,
from the target's own start (Levenberg-Marquardt, J. More 1978). No rotation is fitted: a
bearing keeps its direction, so poses and lines stay what they are.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from torch import Tensor

from camera_models import model_class
from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.typed import typed

FITTED, MEASURED = 60, 180
"""Pixels of the source along the longer side of the image at which the target is fitted, and at which its error is measured."""
AXIAL = 32
"""Azimuths over which the source's radial curve is averaged for the start."""
TIED_PX = 1e-9
"""Fits whose RMS distances differ by less are equally good; the first is taken."""
LEAST_PIXELS = 50
"""A field of view in which fewer pixels of the grid lie holds too little of the image to fit a model to."""
NARROW = math.radians(60)
"""Angle off axis up to which the grid covers only the part of the image that the field of view fills."""
TIGHT = 1e-12
"""Relative change of the sum of squares and of the parameters at which a fit ends."""
AFFINE = ("skew", "c", "d", "e")
"""Parameters that a calibration may hold or tie to each other, because its free poses absorb them; given bearings decide them."""
RING_DEG = 5.0
"""Width of the rings of the field of view for which errors are stated."""


@dataclass(frozen=True)
class RingError:
    """The error of a conversion between two angles from the bearing of the centre pixel."""

    from_deg: float
    to_deg: float
    pixels: int
    """Pixels of the source that were compared."""
    rms_px: float
    max_px: float
    rms_deg: float
    max_deg: float


@dataclass(frozen=True)
class Conversion:
    """The fitted model, and how far it is from the source over the pixels of the source's image within `fov_deg`."""

    model: CameraModel
    rms_px: float
    """sqrt(mean of squared distances between a pixel and the target's image of its bearing)."""
    max_px: float
    rms_deg: float
    """The same for the angle between the two bearings of a pixel."""
    max_deg: float
    fov_deg: float
    """Twice the largest angle off axis that was compared."""
    rings: tuple[RingError, ...] = ()
    """The same errors ring by ring, from the centre outwards; rings without a pixel are left out."""
    holds_deg: int | None = None
    """The field of view that the target was fitted within, where it holds less than was to be fitted; else None."""


@typed
def convert(
    model: CameraModel,
    target_name: str,
    fov_deg: float | int | None = None,
    held: Mapping[str, float] | None = None,
    tied: Sequence[str] = (),
    **options: Any,
) -> Conversion:
    """The camera of another model that is nearest to `model`, within `fov_deg` across and inside the image.

    Without `fov_deg` it is all that the image of the source sees, or as much of it as the target holds. Parameters of the target
    named in `held` keep the values given there, those in `tied` have one value. `options` go to the target (`degree`,
    `coefficients`).

    Raises InputError for an unknown model, a field of view out of range or one that the target cannot hold: beyond its largest
    angle, a mirror where the target has none, a model without parameters to fit.
    """
    fit = widest(model, target_name, fov_deg, held, tied, **options)
    if fov_deg is not None and fit.holds_deg is not None:
        why = f"the best fit holds {fit.holds_deg} degrees at most"
        raise InputError(_cannot_hold(target_name, 0.5 * math.radians(fov_deg), why))
    return fit


def widest(
    model: CameraModel,
    target_name: str,
    fov_deg: float | int | None = None,
    held: Mapping[str, float] | None = None,
    tied: Sequence[str] = (),
    **options: Any,
) -> Conversion:
    """As `convert`, within as much of `fov_deg` as the target holds.

    A fit that leaves pixels out is fitted anew within the field of view up to the first of them, until it leaves out none.
    """
    target = model_class(target_name)
    _require_known(target_name, options, target.variant_options())
    axis = model.unproject(model.centre_px)[0].detach()
    holds_deg = None
    while True:
        within = fov_deg if holds_deg is None else holds_deg
        fitted = _fitted(model, target, axis, within, held, tied, options)
        pixels, bearings, half = _seen(model, axis, MEASURED, within)
        angle_deg = torch.rad2deg(_angle(bearings, axis.expand_as(bearings)))
        projected, imaged = fitted.project(bearings)
        again, seen = fitted.unproject(pixels)
        lost = ~(imaged & seen)
        if not bool(lost.any()):
            break
        # Whole degrees, which a user can give; always fewer, so that the search ends.
        holds_deg = min(math.floor(2 * float(angle_deg[lost].min())), math.ceil(2 * math.degrees(half)) - 1)
    off_px = (projected - pixels).norm(dim=-1)
    off_deg = torch.rad2deg(_angle(again, bearings))
    whole = _error(0.0, math.degrees(half), off_px, off_deg)
    return Conversion(
        model=fitted,
        rms_px=whole.rms_px,
        max_px=whole.max_px,
        rms_deg=whole.rms_deg,
        max_deg=whole.max_deg,
        fov_deg=2 * whole.to_deg,
        rings=_rings(angle_deg, off_px, off_deg),
        holds_deg=holds_deg,
    )


def _fitted(
    model: CameraModel,
    target: type[CameraModel],
    axis: Float[Tensor, "3"],
    fov_deg: float | int | None,
    held: Mapping[str, float] | None,
    tied: Sequence[str],
    options: dict[str, Any],
) -> CameraModel:
    """The target nearest to the pixels within the field of view; whether it holds them all is not looked at."""
    pixels, bearings, half = _seen(model, axis, FITTED, fov_deg)
    if half >= target.LARGEST_ANGLE:
        raise InputError(_cannot_hold(target.NAME, half, f"it ends below {2 * math.degrees(target.LARGEST_ANGLE):.0f}"))
    # A model is its own start, with all its coefficients, unless options ask for others.
    own = type(model) is target and target.CALIBRATED and not options
    start = model if own else _start(model, target, float(axis[2]) < 0, half, options)
    _require_known(target.NAME, (*(held or ()), *tied), start.PARAMETER_NAMES)
    fitted = refine(start, bearings, pixels, held, tied)
    for rival in fitted.rivals(half):
        other = refine(rival, bearings, pixels, held, tied)
        # Where both are exact, rounding must not decide.
        if _rms_px(other, bearings, pixels) < _rms_px(fitted, bearings, pixels) - TIED_PX:
            fitted = other
    return fitted


def _require_known(model: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raises InputError where a parameter or an option is named that the model has not."""
    unknown = [name for name in given if name not in known]
    if unknown:
        raise InputError(
            f"Camera model {model} has {' '.join(sorted(known)) or 'no options'}, found '{unknown[0]}'; leave it out."
        )


def refine(
    start: CameraModel,
    bearings: Float[Tensor, "n 3"],
    pixels: Float[Tensor, "n 2"],
    held: Mapping[str, float] | None = None,
    tied: Sequence[str] = (),
) -> CameraModel:
    """The camera with the least squared distances (px) between the images of bearings and their pixels, from a start.

    Parameters named in `held` keep the values given there, those in `tied` have one value. A bearing outside the domain counts
    from the edge that stands for it.
    """
    held = held or {}
    values = start.named_parameters() | {name: held[name] for name in start.PARAMETER_NAMES if name in held}
    names = list(values)
    stands_for = torch.tensor([names.index(tied[0] if name in tied else name) for name in names])
    start = start.with_parameters(list(values.values()))
    basis = _directions(start, held, stands_for)

    def moved(step: np.ndarray) -> CameraModel:
        return start.with_parameters((start.parameters + basis @ torch.as_tensor(step))[stands_for])

    def residual(step: np.ndarray) -> np.ndarray:
        return (moved(step).project(bearings)[0] - pixels).flatten().numpy()

    def jacobian(step: np.ndarray) -> np.ndarray:
        by_parameter = moved(step).project_with_jacobians(bearings)[3]
        return (by_parameter @ basis).flatten(0, 1).numpy()

    zero = np.zeros(basis.shape[1])
    return moved(
        least_squares(residual, zero, jacobian, method="lm", x_scale="jac", ftol=TIGHT, xtol=TIGHT, gtol=TIGHT, max_nfev=100).x
    )


def _error(from_deg: float, to_deg: float, off_px: Float[Tensor, " n"], off_deg: Float[Tensor, " n"]) -> RingError:
    rms_px, rms_deg = (float((off**2).mean().sqrt()) for off in (off_px, off_deg))
    return RingError(
        from_deg=from_deg,
        to_deg=to_deg,
        pixels=len(off_px),
        rms_px=rms_px,
        max_px=float(off_px.max()),
        rms_deg=rms_deg,
        max_deg=float(off_deg.max()),
    )


def _rings(angle_deg: Float[Tensor, " n"], off_px: Float[Tensor, " n"], off_deg: Float[Tensor, " n"]) -> tuple[RingError, ...]:
    ring = (angle_deg / RING_DEG).to(torch.int64)
    return tuple(
        _error(RING_DEG * k, min(RING_DEG * (k + 1), 180.0), off_px[ring == k], off_deg[ring == k])
        for k in ring.unique().tolist()
    )


def _rms_px(model: CameraModel, bearings: Float[Tensor, "n 3"], pixels: Float[Tensor, "n 2"]) -> float:
    return float((model.project(bearings)[0] - pixels).square().sum(-1).mean().sqrt())


def _cannot_hold(target: str, half: float, why: str) -> str:
    return (
        f"Camera model {target} was expected to hold a field of view of {2 * math.degrees(half):.0f} degrees, found that {why}; "
        "give a smaller one or another model."
    )


def _angle(a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def _seen(
    model: CameraModel, axis: Float[Tensor, "3"], count: int, fov_deg: float | int | None
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 3"], float]:
    """Pixels on a grid over the image, corners included, with a bearing within the field of view; the largest angle (rad)."""
    if fov_deg is not None and not 0 < fov_deg <= 360:
        raise InputError(
            f"A field of view above 0 and up to 360 degrees was expected, found {fov_deg:g}; give one in this range."
        )
    widest = math.pi if fov_deg is None else 0.5 * math.radians(fov_deg)
    low, high = _box(model, axis, widest)
    sides = (high - low).clamp_min(1e-9)
    steps = [max(2, round(count * float(side / sides.max()))) for side in sides]
    rows = [torch.linspace(float(a), float(b), step, dtype=torch.float64) for a, b, step in zip(low, high, steps, strict=True)]
    pixels = torch.stack(torch.meshgrid(*rows, indexing="xy"), -1).reshape(-1, 2)
    with torch.no_grad():
        bearings, valid = model.unproject(pixels)
    angle = _angle(bearings, axis.expand_as(bearings))
    use = valid & (angle <= widest)
    if int(use.sum()) < LEAST_PIXELS:
        raise InputError(
            f"A field of view that covers part of the image was expected, found {int(use.sum())} of {len(pixels)} grid pixels "
            "within it; give a wider one."
        )
    return pixels[use], bearings[use], float(angle[use].max())


def _box(model: CameraModel, axis: Float[Tensor, "3"], angle: float) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Least and largest pixel of the image that can lie within `angle` of the axis."""
    image = torch.tensor([[0.0, 0.0], [side - 1.0 for side in model.image_size]], dtype=torch.float64)
    if angle > NARROW:
        return image[0], image[1]
    azimuth = torch.linspace(0, 2 * math.pi, 181, dtype=torch.float64)
    s = math.sin(angle)
    ring = torch.stack(
        [s * torch.cos(azimuth), s * torch.sin(azimuth), float(axis[2]) * math.cos(angle) * azimuth.new_ones(181)], -1
    )
    with torch.no_grad():
        rim, seen = model.project(ring)
    if not bool(seen.all()):
        return image[0], image[1]
    low, high = (torch.minimum(torch.maximum(edge, image[0]), image[1]) for edge in (rim.amin(0), rim.amax(0)))
    return low, high


def _start(model: CameraModel, target: type[CameraModel], mirror: bool, half: float, options: dict[str, Any]) -> CameraModel:
    """The target's start from the radial curve of the source, averaged over the azimuth."""
    theta = torch.linspace(0, min(half, 0.999 * model.max_angle), 101, dtype=torch.float64)[1:]
    azimuth = torch.linspace(0, 2 * math.pi, AXIAL + 1, dtype=torch.float64)[:-1, None]
    # Half a step off the axes: there lie the poles of a panorama.
    azimuth = azimuth + math.pi / AXIAL
    s, z = torch.sin(theta), (-1.0 if mirror else 1.0) * torch.cos(theta)
    ring = torch.stack([s * torch.cos(azimuth), s * torch.sin(azimuth), z.expand(AXIAL, -1)], -1)
    with torch.no_grad():
        rho = (model.project(ring)[0] - model.centre_px).norm(dim=-1).mean(0)
        centre = model.centre_px.detach()
    try:
        return target.from_radial_curve(rho, theta, centre, model.image_size, mirror=mirror, **options)
    except InputError as error:
        if mirror and target.CALIBRATED:
            raise InputError(_cannot_hold(target.NAME, half, "the camera is a mirror that looks along -z")) from error
        raise


def _directions(model: CameraModel, held: Mapping[str, float], stands_for: Int[Tensor, " p"]) -> Float[Tensor, "p q"]:
    """The directions that a calibration estimates, and one for each affine parameter that these leave open; none moves `held`,
    and each parameter moves as the one does that stands for it."""
    names = model.PARAMETER_NAMES
    units = torch.eye(len(names), dtype=torch.float64)
    free = torch.tensor([[0.0 if name in held else 1.0] for name in names], dtype=torch.float64)
    basis = units[:, :0]
    affine = units[:, [index for index, name in enumerate(names) if name in AFFINE]]
    for direction in (free * torch.cat([model.calibration_basis(), affine], -1))[stands_for].unbind(-1):
        wider = torch.cat([basis, direction[:, None]], -1)
        if int(torch.linalg.matrix_rank(wider)) > basis.shape[1]:
            basis = wider
    return basis
