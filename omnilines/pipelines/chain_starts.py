"""Start cameras from chains of edge points, from no guess: `start_from_chains`.

Straightness tells the curve of the lens up to a factor on z (`calibration/lines/start.py`); the directions in which the lines of
each photo meet, and those of them that are at right angles, tell the factor (`structure/right_angles.py`).
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models import CameraModel, model_class
from omnilines.calibration.lines.start import ShapeStart, shape_starts, usual_focal
from omnilines.calibration.lines.straight import ChainNodes, planes_of
from omnilines.calibration.thresholds import LineStartThresholds
from omnilines.geometry.chains import Chains
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.structure.circles import Circles
from omnilines.structure.meeting import Meeting, meeting_directions
from omnilines.structure.options import DirectionsOptions, RightAngleOptions
from omnilines.structure.right_angles import scale_peaks

SAMPLES = 200
END_SHARE = 0.42
"""Variance of a fitted line at its outermost nodes over that of a node."""
ROUNDS = 3
SETTLED = 0.01
LARGEST_SLACK_RAD = 1e-3


@dataclass(frozen=True)
class CameraStart:
    """A radial camera that chains start from."""

    shape: ShapeStart
    focal_px: float
    """In the middle of the image."""
    focal_sigma: float
    """Standard deviation of its logarithm; infinite where no right angle tells it and a usual projection is taken."""
    gain: float
    """log likelihood of straightness and right angles over that of chance."""
    image_size: tuple[int, int]

    def curve(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Radii (px) as far as edges reach, and angles off axis."""
        unit = self.shape.shape.unit_px
        rho = np.linspace(0.0, self.shape.reach_px, SAMPLES)[1:]
        return rho, np.arctan2(rho, self.focal_px * self.shape.shape.height(rho / unit)[0])

    def camera(self, model: str, **options: Any) -> CameraModel:
        """The nearest camera of a model, as far as the model can see."""
        kind = model_class(model)
        rho, theta = (torch.as_tensor(one) for one in self.curve())
        seen = theta < kind.LARGEST_ANGLE - LARGEST_SLACK_RAD
        return kind.from_radial_curve(
            rho[seen], theta[seen], torch.as_tensor(self.shape.shape.centre), self.image_size, **options
        )


def start_from_chains(
    chains: Chains,
    circle: tuple[float, float, float] | None = None,
    *,
    start: LineStartThresholds = LineStartThresholds(),
    directions: DirectionsOptions = DirectionsOptions(),
    right_angles: RightAngleOptions = RightAngleOptions(),
    progress: ProgressCallback = silent,
) -> list[CameraStart]:
    """Cameras from which a calibration by these chains can start, the most likely first.

    `circle` is the centre and radius (px) of the image circle, where photos have one: its centre is tried beside that of the
    image. Raises GeometryError where there are too few chains.
    """
    nodes = ChainNodes.of(chains, start.most_chains, start.min_radius_share * 0.5 * math.hypot(*chains.image_size))
    centres = [0.5 * (np.array(chains.image_size) - 1.0), *([np.array(circle[:2])] if circle is not None else [])]
    shapes = shape_starts(nodes, chains.image_size, centres, start)
    ask = _Ask(start, directions, right_angles, progress)
    found = [one for shape in shapes for one in _scaled(nodes, shape, chains.image_size, ask)]
    return sorted(found, key=lambda one: -one.gain)


@dataclass(frozen=True)
class _Ask:
    """How directions and their right angles are looked for."""

    start: LineStartThresholds
    directions: DirectionsOptions
    right_angles: RightAngleOptions
    progress: ProgressCallback


def _scaled(nodes: ChainNodes, shape: ShapeStart, image_size: tuple[int, int], ask: _Ask) -> list[CameraStart]:
    """A shape with the scales that right angles tell; with that of a usual projection where they do not."""
    scale = usual_focal(shape, ask.start)
    usual = CameraStart(shape, scale * shape.shape.unit_px, math.inf, shape.gain, image_size)
    found = [usual]
    for _ in range(ROUNDS):
        photos = _meetings(nodes, shape, scale, ask)
        peaks = [peak for peak in scale_peaks(*photos, ask.right_angles) if peak.stands]
        if not peaks:
            return found
        found = [
            replace(
                usual,
                focal_px=scale * peak.factor * shape.shape.unit_px,
                focal_sigma=peak.sigma,
                gain=shape.gain + peak.gain,
            )
            for peak in peaks
        ]
        scale *= peaks[0].factor
        if abs(math.log(peaks[0].factor)) < SETTLED:
            break
    return found


def _meetings(
    nodes: ChainNodes, shape: ShapeStart, scale: float, ask: _Ask
) -> tuple[list[Meeting], Float[np.ndarray, " photos"]]:
    """The directions in which the straight chains of the photos with the most of them meet, and the photos' weights."""
    photos, counts = np.unique(nodes.image[shape.straight], return_counts=True)
    photos = np.sort(photos[np.argsort(-counts, kind="stable")[: ask.start.most_photos]])
    chosen = [shape.straight & (nodes.image == photo) for photo in photos]
    circles = [_circles(nodes, shape, scale, one) for one in chosen]
    weights = np.array([float(nodes.weight[one].mean()) for one in chosen])

    def look(one: Circles) -> Meeting:
        """The directions of one photo."""
        return meeting_directions(one, ask.directions)

    return on_all_cores(look, circles, "finding directions", ask.progress), weights


def _circles(nodes: ChainNodes, shape: ShapeStart, scale: float, chosen: Bool[np.ndarray, " chains"]) -> Circles:
    """Great circles of chains under a shape and its scale."""
    own = nodes.rows(chosen)
    stretch = np.array([1.0, 1.0, scale])
    normal = planes_of(own, shape.shape).normal / stretch
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    ends, across = own.pixels[:, [0, -1]], own.normals[:, [0, -1]]
    x = (ends - shape.shape.centre) / shape.shape.unit_px
    h, slope = shape.shape.height(np.linalg.norm(x, axis=-1))
    ray = np.concatenate([x, h[..., None]], -1) * stretch
    by_pixel = np.concatenate([across, (slope * (across * x).sum(-1))[..., None]], -1) * stretch / shape.shape.unit_px
    length = np.linalg.norm(ray, axis=-1, keepdims=True)
    rate = np.abs(np.einsum("nkp,np->nk", by_pixel, normal)) / length[..., 0]
    bearing = ray / length
    bearing -= np.einsum("nkp,np->nk", bearing, normal)[..., None] * normal[:, None]
    bearing /= np.linalg.norm(bearing, axis=-1, keepdims=True)
    columns = np.zeros((len(own), 2, 3, 2))
    columns[..., 0] = rate[..., None] * normal[:, None]
    variance = END_SHARE * np.square(own.sigma_px) + shape.stray_px**2
    return Circles.of_arcs(bearing, columns, np.broadcast_to(variance[:, None, None, None] * np.eye(2), (len(own), 2, 2, 2)))
