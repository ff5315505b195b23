"""Radial cameras under which chains of edge points are lines of the world, up to the scale of the focal length, from no guess.

Lenses of the usual projections, from none to much distortion, are tried; the best are refined by robust Gauss-Newton steps in the
terms of the curve and the centre, planes eliminated. See `straight.py` for what is estimated, and what straight lines leave open.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from camera_models import GeometryError
from omnilines.calibration.lines.straight import ChainNodes, RadialShape, gain, log_ratio, planes_of
from omnilines.calibration.thresholds import LineStartThresholds

TERMS = 3
STEP = 1e-4
ROUNDS = 40
HALVINGS = 6
SETTLED = 1e-5
SAMPLES = 100


@dataclass(frozen=True)
class ShapeStart:
    """A radial camera up to scale, and how many chains it makes straight."""

    shape: RadialShape
    reach_px: float
    """From the centre to the farthest edge point."""
    gain: float
    """log likelihood of the chains over that of curves at random."""
    stray_px: float
    """Standard deviation of the distance of lines from their curves beside the noise."""
    straight: Bool[np.ndarray, " chains"]
    """Which of the nodes' chains are lines, more likely than not."""
    bend_sigma: float
    """Standard deviation of k1: how well the distortion is known."""


def shape_starts(
    nodes: ChainNodes,
    image_size: tuple[int, int],
    centres: list[Float[np.ndarray, "2"]],
    options: LineStartThresholds = LineStartThresholds(),
) -> list[ShapeStart]:
    """Shapes from the best to the worst, about candidates for the centre (px). Raises GeometryError where there are too few
    chains to tell one."""
    if len(nodes) < options.least_chains:
        raise GeometryError(
            f"At least {options.least_chains} smooth edges were expected in photos of straight things, found {len(nodes)}; give "
            "more photos of buildings or rooms."
        )
    unit = float(np.linalg.norm(nodes.pixels - 0.5 * (np.array(image_size) - 1.0), axis=-1).max())
    tried = []
    for centre in centres:
        reach = float(np.linalg.norm(nodes.pixels - centre, axis=-1).max()) / unit
        for terms in _tried_terms(reach, options):
            shape = RadialShape(centre, terms, unit)
            if shape.rises(reach):
                tried.append(_judged(nodes, shape, options))
    tried.sort(key=lambda start: -start.gain)
    # The mean of r is 1 by chance: a gain of x or more has the probability exp(-x) at most (Markov's inequality).
    if tried[0].gain < math.log(len(tried) * len(options.strays_px) / options.false_starts):
        raise GeometryError(
            f"Edges of straight lines were expected in the photos, found {len(nodes)} that bend as by chance; give photos of "
            "buildings or rooms."
        )
    refined = [_refined(nodes, start, options) for start in tried[: options.refined]]
    refined.sort(key=lambda start: -start.gain)
    apart: list[ShapeStart] = []
    for start in refined:
        if all(_farthest_px(start, other) > start.stray_px for other in apart):
            apart.append(start)
    return apart


def _farthest_px(start: ShapeStart, other: ShapeStart) -> float:
    """About how far a curve of one shape lies from one of another."""
    rho = np.linspace(0.0, start.reach_px, SAMPLES) / start.shape.unit_px
    bend = np.abs(start.shape.height(rho)[0] - other.shape.height(rho)[0]).max() * start.shape.unit_px
    return float(bend) + float(np.linalg.norm(start.shape.centre - other.shape.centre))


def _tried_terms(reach: float, options: LineStartThresholds) -> list[Float[np.ndarray, "3"]]:
    """Terms of the division model, and of equidistant and equisolid lenses of several fields of view, fitted within reach."""
    rho = np.linspace(0.0, reach, SAMPLES)[1:]
    found = [np.array([bend, 0.0, 0.0]) / reach**2 for bend in options.bends]
    for angle in np.radians(options.half_angles_deg):
        for theta in (angle * rho / reach, 2.0 * np.arcsin(np.sin(0.5 * angle) * rho / reach)):
            h = rho / np.tan(theta)
            columns = rho[:, None] ** np.array([0, 2, 4, 6])
            terms = np.linalg.lstsq(columns, h, rcond=None)[0]
            found.append(terms[1:] / terms[0])
    return found


def usual_focal(start: ShapeStart, options: LineStartThresholds = LineStartThresholds()) -> float:
    """Focal length, in units of the shape, with which the lens is nearest to an equidistant or an equisolid one; of a lens with
    little distortion, which is near to both with any, that with the usual field of view."""
    reach = start.reach_px / start.shape.unit_px
    rho = np.linspace(0.0, reach, SAMPLES)[1:]
    h = start.shape.height(rho)[0]
    if h[-1] > 1.0 - options.least_bend:
        return float(reach / (h[-1] * math.tan(math.radians(options.usual_half_angle_deg))))
    found = []
    for half_angle in np.radians(np.arange(20.0, 160.0, 1.0)):
        for theta in (half_angle * rho / reach, 2.0 * np.arcsin(np.sin(0.5 * half_angle) * rho / reach)):
            focal = float((rho / np.tan(theta)) @ h / (h @ h))
            found.append((float(np.square(np.arctan2(rho, focal * h) - theta).sum()), focal))
    return min(found)[1]


def _judged(nodes: ChainNodes, shape: RadialShape, options: LineStartThresholds, bend_sigma: float = math.inf) -> ShapeStart:
    """A shape with the stray that suits it best."""
    planes = planes_of(nodes, shape)
    ratios = [log_ratio(nodes, planes, stray) for stray in options.strays_px]
    gains = [gain(nodes, ratio, options.share) for ratio in ratios]
    best = int(np.argmax(gains))
    reach = float(np.linalg.norm(nodes.pixels - shape.centre, axis=-1).max())
    straight = ratios[best] + math.log(options.share / (1.0 - options.share)) > 0
    return ShapeStart(shape, reach, gains[best], options.strays_px[best], straight, bend_sigma)


def _refined(nodes: ChainNodes, start: ShapeStart, options: LineStartThresholds) -> ShapeStart:
    """Gauss-Newton steps in (k1, k2, k3, centre), each chain with the probability that it is a line. The centre, and where
    nothing tells it the curve, stay near where they began."""
    first, unit = np.concatenate([start.shape.terms, start.shape.centre / start.shape.unit_px]), start.shape.unit_px
    prior = np.array([options.term_sigma] * TERMS + [options.centre_sigma] * 2)

    def shape_of(values: Float[np.ndarray, "5"]) -> RadialShape:
        return RadialShape(values[TERMS:] * unit, values[:TERMS], unit)

    def objective(judged: ShapeStart, at: Float[np.ndarray, "5"]) -> float:
        return judged.gain - 0.5 * float(np.square((at - first) / prior).sum())

    best, values, sigma = start, first, math.inf
    for _ in range(ROUNDS):
        planes = planes_of(nodes, shape_of(values))
        ratio = log_ratio(nodes, planes, best.stray_px)
        likely = 1.0 / (1.0 + np.exp(-np.clip(ratio + math.log(options.share / (1.0 - options.share)), -50.0, 50.0)))
        variance = np.square(nodes.sigma_px[:, None]) + best.stray_px**2
        weight = (nodes.weight * likely)[:, None] * (1.0 / variance - 1.0 / (variance + np.square(nodes.bend_px)))
        columns = []
        for step in STEP * np.eye(len(values)):
            columns.append((planes_of(nodes, shape_of(values + step)).bend_px - planes.bend_px) / STEP)
        jacobian = np.stack(columns, -1)
        information = np.einsum("cnp,cn,cnq->pq", jacobian, weight, jacobian) + np.diag(1.0 / np.square(prior))
        gradient = np.einsum("cnp,cn->p", jacobian, weight * planes.bend_px) + (values - first) / np.square(prior)
        step = -np.linalg.solve(information, gradient)
        sigma = math.sqrt(float(np.linalg.inv(information)[0, 0]))
        for _ in range(HALVINGS):
            shape = shape_of(values + step)
            reach = float(np.linalg.norm(nodes.pixels - shape.centre, axis=-1).max()) / unit
            judged = _judged(nodes, shape, options, sigma) if shape.rises(reach) else None
            if judged is not None and objective(judged, values + step) > objective(best, values):
                break
            step = 0.5 * step
        else:
            break
        best, values = judged, values + step
        if float(np.abs(step).max()) < SETTLED:
            break
    return replace(best, bend_sigma=sigma)
