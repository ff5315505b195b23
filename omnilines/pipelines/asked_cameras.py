"""Whether lines, and points of structure from motion, bear out the calibration that they were found with.

Poses take up most of what a wrong camera does, and the slack of matching the rest: lines then fit, and are off by many of their
standard deviations. So a part of them is adjusted once more with poses and cameras free. Where that moves a camera by d, with
the covariance V of lines and of its file,

    d' V^-1 d

is chi-square, with as many degrees of freedom as it has parameters, if the camera is right (A. Wald, 1943).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import stats
from torch import Tensor

from camera_models import Calibration, GeometryError
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.lines import adjust_lines, drop_unknown, lost_lines
from omnilines.adjustment.start import scaled_loss
from omnilines.adjustment.state import LinesAndPoses
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.lines.least_drift import least_drift
from omnilines.calibration.lines.scores import pseudo_inverse
from omnilines.calibration.uncertainty import projection_jacobian, supported_grid
from omnilines.geometry.line import PlueckerLines
from omnilines.least_squares import Outcome
from omnilines.pipelines.calibration_errors import charts_of, known_calibration, whole_lines
from omnilines.pipelines.kept_lines import shared_lines, shown_lines
from omnilines.pipelines.options import AdviceOptions, SceneOptions
from omnilines.posing.photo_poses import CameraByPoints
from omnilines.records import ImagePoses, Lines

MOST_ARCS = 2500
"""Of the lines that are adjusted: so many tell a camera well enough."""
LEAST_OF_PHOTO = 20
"""Of these arcs, a photo: fewer do not tell its pose beside the cameras, which only takes time."""
MOST_PHOTOS = 60
"""That are asked, of more than MOST_ARCS are enough for: the cameras are the same in all."""
LEAST_PHOTOS = 3
"""Of these that show a line: two planes always meet in one."""
ITERATIONS = 30
"""Of lines and poses at most, before cameras are free."""
STEPS = 5
"""With cameras: whether they move, and about how far, is seen long before they settle."""


@dataclass(frozen=True)
class AskedCamera:
    """How far lines move a camera from its calibration."""

    name: str
    by: str
    """What asks: "lines", or "points" of structure from motion."""
    drift_px: float
    """Root mean square motion of the image, after a common rotation."""
    sigma_px: float
    """Of which so much is noise, of what asks and of the calibration."""
    least_px: float
    """The least such motion that is left possible; 0 where the camera is borne out."""


def asked_cameras(
    lines: Lines,
    arcs: MatchedArcs,
    track: Int[np.ndarray, " n"],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
) -> tuple[AskedCamera, ...]:
    """Of every camera that has parameters and is seen to be used; none where cameras were refined.

    The tracks of `arcs` are rows of `lines`; rows of one `track` are stretches of one line. Of so many photos that MOST_ARCS are
    too few for them some are asked that share lines. Nothing is asked where photos show fewer than LEAST_OF_PHOTO.
    """
    if "intrinsics" in options.refine or not any(model.calibration_basis().shape[1] for model in cameras.values()):
        return ()
    if not lines.known.any():
        return ()
    inner, rows = _some_lines(lines, arcs, track)
    if len(inner) < LEAST_OF_PHOTO * len(torch.unique(inner.image)):
        return ()
    known, frames = known_calibration(poses, cameras, options)
    chart = charts_of(lines, rows)
    loss = scaled_loss(options.loss, options.cost, inner, LinesAndPoses(poses.cam_from_world, chart), options.adjustment)
    adjust = partial(adjust_lines, cost=options.cost, loss=loss, cautious=True, options=options.adjustment)
    try:
        held = partial(adjust, cam_from_world=frames, rig=known.mounted, max_iterations=ITERATIONS)
        inner, found = _determined(held, inner, chart.lines())
        state = found.state
        free = partial(adjust, cam_from_world=state.rig_from_world, rig=state.rig, models=known.models, max_iterations=STEPS)
        inner, found = _determined(free, inner, state.chart.lines())
    except GeometryError:
        # So few or such lines leave poses open: they do not tell a camera.
        return ()
    assert inner.observed is not None
    moved = zip(cameras.items(), found.state.models, found.camera_covariance, strict=True)
    asked = []
    for k, ((name, model), other, covariance) in enumerate(moved):
        pixels = inner.observed.pixels[inner.observed.camera == k].flatten(0, 1)
        if len(pixels) and model.calibration_basis().shape[1] and bool(covariance.isfinite().all()):
            change, angle_rad = (other.parameters - model.parameters).detach(), float(angles_off_axis(model, pixels).max())
            asked.append(_asked(name, "lines", cameras, change, covariance, angle_rad, options.advice))
    return tuple(asked)


def asked_by_points(found: Mapping[str, CameraByPoints], cameras: Calibration, options: SceneOptions) -> tuple[AskedCamera, ...]:
    """Of every camera that points of structure from motion ask something of; none where cameras were refined."""
    if "intrinsics" in options.refine:
        return ()
    return tuple(
        _asked(
            name,
            "points",
            cameras,
            torch.as_tensor(one.change),
            torch.as_tensor(one.covariance),
            one.max_angle_rad,
            options.advice,
        )
        for name, one in found.items()
    )


def _determined(adjust: Callable[..., Adjusted], arcs: MatchedArcs, lines: PlueckerLines) -> tuple[MatchedArcs, Adjusted]:
    """The adjustment without the lines that do not stay determined, and their arcs: one leaves the rest without covariances.
    Raises GeometryError where no line is left."""
    while True:
        found = adjust(arcs, lines)
        lost = list(lost_lines(arcs, found.state).values()) if found.outcome is Outcome.DEGENERATE else []
        if not any(bool(some.any()) for some in lost):
            return arcs, found
        arcs, tracks = drop_unknown(arcs, ~torch.stack(lost).any(0))
        lines = lines[tracks]


def _some_lines(lines: Lines, arcs: MatchedArcs, track: Int[np.ndarray, " n"]) -> tuple[MatchedArcs, Int[np.ndarray, " k"]]:
    """Arcs of some of the lines, all stretches of a line in one, and a row of each line."""
    inner, rows, first, _ = whole_lines(lines, arcs, track)
    if LEAST_OF_PHOTO * len(torch.unique(inner.image)) > MOST_ARCS:
        inner = _of_photos_together(inner)
    # Every so manieth of the lines, by how many arcs they have: those with the most show some of the photos only.
    counts = torch.bincount(inner.track, minlength=inner.tracks)
    some = torch.zeros(inner.tracks, dtype=torch.bool)
    some[torch.argsort(-counts, stable=True)[: int((counts > 0).sum()) : 1 + len(inner) // MOST_ARCS]] = True
    kept, tracks = drop_unknown(inner, some)
    return kept, rows[first[tracks.numpy()]]


def _of_photos_together(arcs: MatchedArcs) -> MatchedArcs:
    """The arcs of MOST_PHOTOS photos, one after the other that which shares most lines with those before, of lines that enough of
    them show."""
    image, track = arcs.image.numpy(), arcs.track.numpy()
    shows = shown_lines(image, track, int(image.max()) + 1, arcs.tracks)
    shared = shared_lines(shows)
    photos = shared.shape[0]
    chosen, with_chosen = np.zeros(photos, dtype=bool), np.zeros(photos)
    photo = int(shared.diagonal().argmax())
    for _ in range(min(MOST_PHOTOS, photos)):
        chosen[photo] = True
        with_chosen += shared[[photo]].toarray()[0]
        photo = int(np.where(chosen, -1.0, with_chosen).argmax())
    enough = shows.T @ chosen >= LEAST_PHOTOS
    return arcs.rows(torch.as_tensor(chosen[image] & enough[track]))


def _asked(
    name: str,
    by: str,
    cameras: Calibration,
    change: Float[Tensor, " p"],
    covariance: Float[Tensor, "p p"],
    angle_rad: float,
    options: AdviceOptions,
) -> AskedCamera:
    """Of a change of the parameters with its covariance, to which that of the calibration comes; seen up to an angle."""
    model, estimate = cameras[name], cameras.estimates.get(name)
    if estimate is not None and estimate.covariance is not None:
        covariance = covariance + torch.as_tensor(estimate.covariance)
    basis = model.calibration_basis()
    inverse = torch.linalg.pinv(basis)
    own = inverse @ covariance @ inverse.mT
    # In standard deviations: parameters are of all sizes.
    unit = own.diagonal().clamp_min(1e-300).sqrt()
    moved = inverse @ change / unit
    grid = supported_grid(model, angle_rad)
    jacobian, valid = projection_jacobian(model, grid, grid)
    moving = jacobian[valid] @ basis * unit
    motion = torch.einsum("nik,nil->kl", moving, moving) / len(moving)
    correlation, eye = own / (unit[:, None] * unit), torch.eye(len(own), dtype=own.dtype)
    limit = options.calibration_noise**2 * float(stats.chi2.isf(options.significance, len(own)))
    return AskedCamera(
        name,
        by,
        drift_px=math.sqrt(max(float(moved @ motion @ moved), 0.0)),
        sigma_px=math.sqrt(max(float((motion * correlation).sum()), 0.0)),
        least_px=least_drift(-moved, pseudo_inverse(correlation), eye, motion, limit),
    )
