"""Chains of edge points and a start camera -> the camera that makes them straight, and lets parallel ones meet."""

from collections.abc import Callable
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel, GeometryError
from omnilines.calibration.lines.camera import LineAdjustment, counted, focal_length
from omnilines.calibration.lines.options import LineOptions
from omnilines.calibration.lines.prior import CameraPrior
from omnilines.calibration.lines.problem import AngleSigmas, CameraAndCircles, Families, LineProblem
from omnilines.calibration.lines.readings import EdgeReadings, fitted_circles, offsets
from omnilines.calibration.lines.right_angles import angle_sigmas
from omnilines.calibration.lines.scores import LineScores
from omnilines.calibration.lines.select import SEEN_SHARE
from omnilines.calibration.lines.turning import Turning
from omnilines.calibration.lines.weighting import WeightedChains, longest, weighed, weighted_chains
from omnilines.geometry.chains import Chains
from omnilines.least_squares import Outcome, solve
from omnilines.pipelines.line_families import families_of, with_strays
from omnilines.progress import ProgressCallback, silent
from omnilines.structure.options import DirectionsOptions

MOST_ITERATIONS = 30
TOLERANCE = 1e-9
"""Of the cost, in a round; families and weights change it by more."""
HELD_SHARE = 1e-3
"""Standard deviation that the focal length is left about that of the start where lines do not tell it, as a share of it."""
CHECK_TOLERANCE = 1e-5
"""Of the cost, in a check: what is left of the way to the minimum is in the scores."""


def adjusted_camera(
    start: CameraModel,
    chains: Chains,
    options: LineOptions = LineOptions(),
    directions: DirectionsOptions = DirectionsOptions(),
    *,
    prior: CameraPrior | None = None,
    scale_sigma: float | None = None,
    met: Callable[[LineAdjustment], bool] = lambda _: False,
    progress: ProgressCallback = silent,
) -> LineAdjustment:
    """Rounds of families, weights and least squares from `start` until the camera stays where it is, or `met` says of a round
    that there is no need for more.

    `prior` is that of an earlier start, where this one comes of it; `scale_sigma` is the standard deviation of the logarithm of
    the focal length of `start`, where something beside these chains tells it. Raises GeometryError where too few are straight.
    """
    model, basis = start.calibrated_form(), start.calibration_basis()
    _require(chains.count, options)
    readings = longest(EdgeReadings.of(chains), options.most_chains)
    if prior is None:
        prior = _prior(model, basis, readings, options)
    if scale_sigma is not None:
        prior = _with_scale(prior, model, scale_sigma, told=True)
    angles: AngleSigmas | None = None
    held = None if prior.held is None else prior
    if prior.scale_sigma is None:
        prior = replace(prior, held=None)
    for number in range(options.rounds):
        progress("adjusting the camera to lines", number, options.rounds)
        weighted = weighted_chains(model, readings, options)
        _require(int((weighted.weight > 0).sum()), options)
        families = families_of(model, weighted, options, directions, progress)
        scaled = held if held is not None and not families.frames else prior
        done = _solved(model, weighted, families, angles, scaled, options)
        model, angles = done.model, _angles(done)
        opens = scaled.held is None and done.leaves_scale_open(options.open_share)
        if opens:
            held = _with_scale(prior, done.model, HELD_SHARE, told=False)
        if met(done) or (done.settled and not opens):
            break
    return done


def is_camera(done: LineAdjustment, other: CameraModel, sigmas: float) -> bool:
    """Whether an adjustment is at another camera of its model, to so many of its standard deviations (root mean square)."""
    return _sigmas(done.prior.basis.mT @ (done.model.parameters - other.parameters), done.scores) < sigmas


def readjusted_camera(start: CameraModel, like: LineAdjustment, options: LineOptions) -> LineAdjustment:
    """Another camera adjusted to the same pieces of edges, with the same weights and families. Raises GeometryError where it does
    not see them."""
    model, basis, chains = start.calibrated_form(), start.calibration_basis(), like.chains
    normal, at = fitted_circles(model, chains.blocks)
    own = counted(chains)
    seen = float((at.valid & own).sum() / own.sum())
    if seen < SEEN_SHARE:
        raise GeometryError(f"it sees {100 * seen:.0f} percent of the edges.")
    prior = _prior(model, basis, chains.blocks, options)
    if like.prior.scale_sigma is not None:
        prior = _with_scale(prior, model, like.prior.scale_sigma, told=True)
    here = replace(chains, at=at)
    turning = Turning.of(model, here, like.families.direction, like.families.of_chain)
    stray = like.families.stray_rad.clone()
    # As many pixels as under the other camera.
    stray[like.problem.members] *= turning.rad_per_px / like.problem.turning.rad_per_px
    families = replace(like.families, stray_rad=stray)

    def solved(prior: CameraPrior) -> LineAdjustment:
        """With what is known of the camera before."""
        problem = LineProblem(here, families, basis, like.problem.angles, turning, prior)
        begin = CameraAndCircles.right(model, normal, families)
        solution = solve(problem, begin, max_iterations=MOST_ITERATIONS, tolerance=TOLERANCE)
        at = offsets(solution.state.model, chains.blocks, solution.state.normal)
        moved = replace(chains, normal=solution.state.normal, at=at)
        scores = LineScores.of(problem, solution.state)
        settled = solution.outcome is Outcome.CONVERGED
        return LineAdjustment(moved, families, problem, solution.state, scores, prior, settled)

    done = solved(prior)
    if not done.leaves_scale_open(options.open_share):
        return done
    return solved(_with_scale(prior, done.model, HELD_SHARE, told=False))


def asked_camera(
    model: CameraModel,
    chains: Chains,
    options: LineOptions,
    directions: DirectionsOptions,
    progress: ProgressCallback = silent,
) -> LineAdjustment:
    """The camera that lines ask for in the place of a given one, with the families that are found under that one. How straight
    chains are and how far lines stray is by the camera that is asked for: what a wrong one makes of them is no noise."""
    model, basis = model.calibrated_form(), model.calibration_basis()
    _require(chains.count, options)
    readings = longest(EdgeReadings.of(chains), options.most_chains)
    weighted, prior = weighted_chains(model, readings, options), _prior(model, basis, readings, options)
    _require(int((weighted.weight > 0).sum()), options)
    families = families_of(model, weighted, options, directions, progress)
    first = _solved(model, weighted, families, None, prior, options, CHECK_TOLERANCE)
    weighted = weighed(first.model, weighted.blocks, options)
    _require(int((weighted.weight > 0).sum()), options)
    families = with_strays(first.model, weighted, replace(families, direction=first.state.direction), options)
    return _solved(first.model, weighted, families, _angles(first), prior, options, CHECK_TOLERANCE)


def _solved(
    model: CameraModel,
    weighted: WeightedChains,
    families: Families,
    angles: AngleSigmas | None,
    prior: CameraPrior,
    options: LineOptions,
    tolerance: float = TOLERANCE,
) -> LineAdjustment:
    """Least squares from `model`, with weights and families as they are."""
    basis = prior.basis
    turning = Turning.of(model, weighted, families.direction, families.of_chain)
    problem = LineProblem(weighted, families, basis, angles or AngleSigmas.of_strays(families), turning, prior)
    begin = CameraAndCircles.right(model, weighted.normal, families)
    solution = solve(problem, begin, max_iterations=MOST_ITERATIONS, tolerance=tolerance)
    scores = LineScores.of(problem, solution.state)
    step = basis.mT @ (solution.state.model.parameters - model.parameters)
    settled = solution.outcome is Outcome.CONVERGED and _sigmas(step, scores) < options.settled_sigmas
    return LineAdjustment(weighted, families, problem, solution.state, scores, prior, settled)


def _with_scale(prior: CameraPrior, model: CameraModel, sigma: float, *, told: bool) -> CameraPrior:
    """The focal length stays about what it is at the start. Where lines say next to nothing of it, what a model cannot follow of
    a factor on z would draw it along a valley, to where it seems to be known well."""
    focal_px, by_parameter = focal_length(model)
    return prior.with_scale(by_parameter, focal_px, sigma, told=told)


def _angles(done: LineAdjustment) -> AngleSigmas | None:
    """By how much right angles are off; where no photo shows a frame, nothing is known of them."""
    return angle_sigmas(done.problem, done.state, done.scores) if done.families.frames else None


def prior_with_boards(model: CameraModel, covariance: Float[Tensor, "p p"], chains: Chains, options: LineOptions) -> CameraPrior:
    """What boards say of a camera, for an adjustment to chains: to first order both count as in one adjustment."""
    model, readings = model.calibrated_form(), longest(EdgeReadings.of(chains), options.most_chains)
    return _prior(model, model.calibration_basis(), readings, options).with_boards(model, covariance)


def _prior(model: CameraModel, basis: Float[Tensor, "p q"], readings: EdgeReadings, options: LineOptions) -> CameraPrior:
    return CameraPrior.of(
        model,
        basis,
        readings.pixels,
        options.prior_share,
        aspect_sigma=options.aspect_sigma,
        centre_share=options.centre_share,
    )


def _require(straight: int, options: LineOptions) -> None:
    if straight < options.start.least_chains:
        raise GeometryError(
            f"At least {options.start.least_chains} edges that are straight in the world were expected, found {straight}; add "
            "photos of buildings or rooms."
        )


def _sigmas(step: Float[Tensor, " q"], scores: LineScores) -> float:
    """Root mean square of a step of the camera, in its standard deviations."""
    return float((step @ scores.camera_information @ step / len(step)).clamp_min(0).sqrt())
