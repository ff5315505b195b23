"""Whether the lines of a scene bear out the calibration that they were found with: what they ask of its cameras.

Poses take up most of what a wrong camera does, and the slack of matching the rest: lines then fit, and are off by many of their
standard deviations. So a part of them is adjusted once more with poses and cameras free. Where that moves a camera by d, with
the covariance V of lines and of its file,

    d' V^-1 d

is chi-square, with as many degrees of freedom as it has parameters, if the camera is right (A. Wald, 1943).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import stats
from torch import Tensor

from camera_models import Calibration, CameraEstimate, CameraModel, GeometryError
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.start import scaled_loss
from omnilines.adjustment.state import LinesAndPoses
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.lines.scores import pseudo_inverse
from omnilines.calibration.uncertainty import projection_jacobian, supported_grid
from omnilines.pipelines.calibration_errors import charts_of, known_calibration
from omnilines.pipelines.options import AdviceOptions, SceneOptions
from omnilines.records import ImagePoses, Lines

MOST_ARCS = 2500
"""Of the lines that are adjusted, those with the most arcs first: they tell a camera well enough."""
ITERATIONS = 30
"""Of lines and poses at most, before cameras are free."""
STEPS = 5
"""With cameras: whether they move, and about how far, is seen long before they settle."""


@dataclass(frozen=True)
class AskedCamera:
    """How far lines move a camera from its calibration."""

    name: str
    drift_px: float
    """Root mean square motion of the image, after a common rotation."""
    sigma_px: float
    """Of which so much is noise, of lines and of the calibration."""
    statistic: float
    """d' V^-1 d."""
    freedom: int

    def contradicted(self, options: AdviceOptions) -> bool:
        """Whether chance does not make it, were the noise `calibration_noise` times what is stated."""
        limit = float(stats.chi2.isf(options.significance, self.freedom))
        return self.statistic > options.calibration_noise**2 * limit


def asked_cameras(
    lines: Lines,
    arcs: MatchedArcs,
    track: Int[np.ndarray, " n"],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
) -> tuple[AskedCamera, ...]:
    """Of every camera that has parameters and is seen to be used; none where cameras were refined.

    The tracks of `arcs` are rows of `lines`; rows of one `track` are stretches of one line.
    """
    if "intrinsics" in options.refine or not any(model.calibration_basis().shape[1] for model in cameras.values()):
        return ()
    inner, rows = _most_seen(lines, arcs, track)
    if not len(rows):
        return ()
    known, frames = known_calibration(poses, cameras, options)
    chart = charts_of(lines, rows)
    loss = scaled_loss(options.loss, options.cost, inner, LinesAndPoses(poses.cam_from_world, chart), options.adjustment)
    try:
        first = adjust_lines(
            inner, chart.lines(), frames, cost=options.cost, rig=known.mounted, loss=loss, cautious=True,
            options=options.adjustment, max_iterations=ITERATIONS,
        ).state  # fmt: skip
        found = adjust_lines(
            inner, first.chart.lines(), first.rig_from_world, cost=options.cost, rig=first.rig, models=known.models, loss=loss,
            cautious=True, options=options.adjustment, max_iterations=STEPS,
        )  # fmt: skip
    except GeometryError:
        # So few or such lines leave poses open: they do not tell a camera.
        return ()
    assert inner.observed is not None
    moved = zip(cameras.items(), found.state.models, found.camera_covariance, strict=True)
    asked = []
    for k, ((name, model), other, covariance) in enumerate(moved):
        pixels = inner.observed.pixels[inner.observed.camera == k].flatten(0, 1)
        if len(pixels) and model.calibration_basis().shape[1]:
            asked.append(_asked(name, model, other, covariance, pixels, cameras.estimates))
    return tuple(asked)


def _most_seen(lines: Lines, arcs: MatchedArcs, track: Int[np.ndarray, " n"]) -> tuple[MatchedArcs, Int[np.ndarray, " k"]]:
    """Arcs of the lines with the most of them, all stretches of a line in one, and a row of each line."""
    rows = np.flatnonzero(lines.known)
    _, first, line = np.unique(track[rows], return_index=True, return_inverse=True)
    line_of_row = np.full(len(lines), -1)
    line_of_row[rows] = line
    own = line_of_row[arcs.track.numpy()]
    counts = np.bincount(own[own >= 0], minlength=len(first))
    order = np.argsort(-counts, kind="stable")
    kept = np.sort(order[np.cumsum(counts[order]) <= max(MOST_ARCS, counts.max(initial=0))])
    place = np.full(len(first) + 1, -1)
    place[kept] = np.arange(len(kept))
    of_arc = torch.as_tensor(place[own])
    return replace(arcs, track=of_arc, tracks=len(kept)).rows(of_arc >= 0), rows[first[kept]]


def _asked(
    name: str,
    model: CameraModel,
    other: CameraModel,
    covariance: Float[Tensor, "p p"],
    pixels: Float[Tensor, "n 2"],
    estimates: Mapping[str, CameraEstimate],
) -> AskedCamera:
    estimate = estimates.get(name)
    if estimate is not None and estimate.covariance is not None:
        covariance = covariance + torch.as_tensor(estimate.covariance)
    change, inverse = (other.parameters - model.parameters).detach(), torch.linalg.pinv(model.calibration_basis())
    own = inverse @ change
    grid = supported_grid(model, float(angles_off_axis(model, pixels).max()))
    jacobian, valid = projection_jacobian(model, grid, grid)
    motion, spread = jacobian @ change, torch.einsum("nip,pq,niq->n", jacobian, covariance, jacobian)
    return AskedCamera(
        name,
        drift_px=math.sqrt(float(motion[valid].square().sum(-1).mean())),
        sigma_px=math.sqrt(max(float(spread[valid].mean()), 0.0)),
        statistic=float(own @ pseudo_inverse(inverse @ covariance @ inverse.mT) @ own),
        freedom=len(own),
    )
