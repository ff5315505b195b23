"""Which camera model suits a lens: every model that applies is fitted, and judged by views that its fit has not seen.

Every model is fitted robustly to all corners. The one that all corners are nearest to, by one loss at one scale, says which
corners and views are good: what it rejects most models cannot fit, and what only stiffer models reject is their own fault. On
these common corners every model is fitted again by plain least squares, and judged by its held-out error: what remains of a view
by the camera of all other views (`held_out`). Of the models that are as good as the best (within one standard error and half a
percent) the one with the fewest parameters is taken. A model whose curve folds back before it has passed the data by a tenth is
not taken, unless those that do not fold back predict views worse by a tenth: they do not follow the lens then.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import MODELS, CameraModel, GeometryError, InputError, model_class
from camera_models.pose import Pose
from omnilines.calibration.diagnose import grows_beyond
from omnilines.calibration.held_out import HeldOut, held_out
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards, whitened
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.robust import RobustFit, nearest_fit
from omnilines.calibration.single import calibrate_from_fit, refine_with_rivals, robust_camera
from omnilines.calibration.start import CameraKind
from omnilines.calibration.thresholds import CalibrationThresholds, HeldOutThresholds
from omnilines.calibration.variants import CommonCorners
from omnilines.calibration.views import UsableCorners
from omnilines.least_squares import Progress
from omnilines.progress import one_torch_thread
from omnilines.records import Corners

T = TypeVar("T")
R = TypeVar("R")


@runtime_checkable
class Each(Protocol):
    """Does some work for each item, which have names: here, or elsewhere; work and items can be pickled."""

    def __call__(self, work: Callable[[T], R], items: Sequence[T], names: Sequence[str]) -> list[R]:
        """The results, in the order of the items."""
        ...


@dataclass(frozen=True)
class Candidate:
    """A camera model with the options that decide the number of its parameters."""

    model: str
    options: Mapping[str, Any]

    @property
    def label(self) -> str:
        """For people: `scaramuzza degree 4`."""
        return " ".join([self.model, *(f"{name} {value}" for name, value in self.options.items())])


@dataclass(frozen=True)
class Trial:
    """How a candidate did; errors are RMS per point, of weighted residuals, over the corners that all are judged by."""

    candidate: Candidate
    failure: str | None
    """Why it could not be fitted."""
    fit: RobustFit | None = None
    """Fitted to the common corners; the poses are of all usable views."""
    monotone: bool = True
    """Whether its curve grows on for a while beyond the data."""
    holds: bool = True
    """Whether it grows up to the end of the data."""
    in_sample_px: float = float("nan")
    error: HeldOut | None = None

    @property
    def held_out_px(self) -> float:
        """NaN where there is none."""
        return float("nan") if self.error is None else self.error.rms_px

    @property
    def parameters(self) -> int:
        """Number of parameters that are estimated."""
        return 0 if self.error is None else self.error.parameters


@dataclass(frozen=True)
class Selection:
    """All trials in the order of the registry, the one taken and why, in one sentence, and the calibration with its model."""

    trials: tuple[Trial, ...]
    chosen: Trial
    reason: str
    result: CameraCalibration


def all_candidates() -> tuple[Candidate, ...]:
    """Every variant of every model that can be calibrated, in the order of the registry."""
    kinds = [model_class(name) for name, _ in MODELS]
    return tuple(Candidate(kind.NAME, options) for kind in kinds if kind.CALIBRATED for options in kind.VARIANTS)


def _here(work: Callable[[T], R], items: Sequence[T], names: Sequence[str]) -> list[R]:
    """One after another."""
    with one_torch_thread():
        return [work(item) for item in items]


def select_model(
    corners: Corners,
    image_size: tuple[int, int],
    *,
    loss: str = "cauchy",
    mirror: bool = False,
    candidates: Sequence[Candidate] | None = None,
    thresholds: CalibrationThresholds = CalibrationThresholds(),
    each: Each = _here,
    callback: Callable[[Progress], None] | None = None,
) -> Selection:
    """Fit all candidates and take one, as the module's header says.

    `each` fits and judges them, one candidate an item; `callback`, which is not for another process, is told of each step.
    Raises InputError for too few views to compare models by, and the first failure where no candidate can be fitted.
    """
    candidates = all_candidates() if candidates is None else tuple(candidates)
    labels = [candidate.label for candidate in candidates]
    usable = UsableCorners.of(corners, thresholds.views)
    fit_one = partial(
        _fit, usable=usable, image_size=image_size, mirror=mirror, loss=loss, thresholds=thresholds, callback=callback
    )
    fits = each(fit_one, candidates, labels)
    found = [fit for fit in fits if isinstance(fit, RobustFit)]
    if not found:
        assert not isinstance(fits[0], RobustFit)
        raise fits[0]
    judge = nearest_fit(found, usable.points, usable.weight)
    if loss == "none":
        judge = replace(judge, kept=torch.ones_like(judge.kept))
    common = CommonCorners.of(usable.points, usable.weight, judge.kept, thresholds.views.least_corners)
    if len(common.views) < thresholds.held_out.least_views:
        raise InputError(
            f"At least {thresholds.held_out.least_views} usable views were expected to choose a camera model by held-out views, "
            f"found {len(common.views)}; add photos or name a `model`: pinhole for an ordinary lens, opencv-fisheye for a "
            "fisheye, scaramuzza for a mirror."
        )
    judged = partial(_trial, judge=judge, usable=usable, common=common, thresholds=thresholds, callback=callback)
    trials = each(judged, list(zip(candidates, fits, strict=True)), labels)
    while True:
        chosen, reason = _choose(trials, len(common.views), thresholds.held_out)
        assert chosen.fit is not None
        try:
            result = calibrate_from_fit(usable, chosen.fit, loss=loss, thresholds=thresholds)
        except (GeometryError, InputError) as error:
            trials[trials.index(chosen)] = Trial(chosen.candidate, str(error))
            if all(trial.error is None for trial in trials):
                raise
        else:
            return Selection(tuple(trials), chosen, reason, result)


def fit_boards(
    model: CameraModel, points: BoardPoints, weight: Float[Tensor, " n"] | None = None
) -> tuple[Pose, Float[Tensor, "n 2"]]:
    """`cam_from_board` of views by a camera that is held, by least squares, and the residuals (projected minus observed, px)."""
    bearings, _ = model.unproject(points.pixels)
    problem = BoardProblem(points, torch.zeros(len(model.parameters), 0, dtype=torch.float64), weight)
    state = problem.solve(CameraAndBoards(model, resect_boards(points, bearings))).state
    return state.cam_from_board, state.residual_px(points)


def _fit(
    candidate: Candidate,
    usable: UsableCorners,
    image_size: tuple[int, int],
    *,
    mirror: bool,
    loss: str,
    thresholds: CalibrationThresholds,
    callback: Callable[[Progress], None] | None,
) -> RobustFit | GeometryError | InputError:
    """One candidate fitted robustly to all corners, or why it cannot be."""
    try:
        kind = CameraKind(image_size, candidate.model, mirror, candidate.options)
        return robust_camera(usable.points, usable.weight, kind, loss, thresholds, stated_px=usable.stated_px, callback=callback)
    except (GeometryError, InputError) as error:
        return error


def _trial(
    fitted: tuple[Candidate, RobustFit | GeometryError | InputError],
    judge: RobustFit,
    usable: UsableCorners,
    common: CommonCorners,
    thresholds: CalibrationThresholds,
    callback: Callable[[Progress], None] | None,
) -> Trial:
    """One candidate fitted to the common corners, without a loss."""
    candidate, fit = fitted
    if not isinstance(fit, RobustFit):
        return Trial(candidate, str(fit))
    poses = _nearer_poses(fit, judge, usable)
    start = CameraAndBoards(fit.state.model, poses[common.views])
    whole = BoardProblem(common.points, start.model.calibration_basis(), common.weight, start.shape)
    solution = refine_with_rivals(whole, start, thresholds.noise.tied_variances, callback)[0]
    model = solution.state.model
    problem = BoardProblem(common.points, model.calibration_basis(), common.weight)
    rotation, translation = poses.rotation.clone(), poses.translation.clone()
    rotation[common.views] = solution.state.cam_from_board.rotation
    translation[common.views] = solution.state.cam_from_board.translation
    state = CameraAndBoards(model, Pose(rotation, translation))
    return Trial(
        candidate=candidate,
        failure=None,
        fit=RobustFit(state, common.rows, judge.scale_px, judge.limit_px),
        monotone=grows_beyond(model, common.points.pixels, thresholds.held_out.beyond_factor),
        holds=grows_beyond(model, common.points.pixels, 1.0),
        in_sample_px=(solution.cost / len(common.points.view)) ** 0.5,
        error=held_out(problem, solution.state),
    )


def _nearer_poses(fit: RobustFit, judge: RobustFit, usable: UsableCorners) -> Pose:
    """The pose of every view by a fit or, where that does not fit the view, by the judge."""
    own, other = (
        whitened(CameraAndBoards(fit.state.model, source.state.cam_from_board).residual_px(usable.points), usable.weight)
        for source in (fit, judge)
    )
    cost = [usable.points.mean_by_view(torch.log1p(residual.square().sum(-1) / judge.scale_px**2)) for residual in (own, other)]
    nearer = cost[0] <= cost[1]
    mine, theirs = fit.state.cam_from_board, judge.state.cam_from_board
    rotation = torch.where(nearer[:, None, None], mine.rotation, theirs.rotation)
    return Pose(rotation, torch.where(nearer[:, None], mine.translation, theirs.translation))


def _choose(trials: Sequence[Trial], views: int, thresholds: HeldOutThresholds) -> tuple[Trial, str]:
    sound = [(trial, trial.error) for trial in trials if trial.error is not None]
    compared, growing = _compared(sound, thresholds.folding_factor)
    best, least = min(compared, key=lambda pair: pair[1].rms_px)
    if math.isinf(least.rms_px):
        raise GeometryError(
            f"Views of which one can be left out were expected to compare models, found {views} that leave every model open "
            "without one of them; add photos of the board at other angles, or name a model."
        )
    tied = [trial for trial, error in compared if error.as_good_as(least, thresholds.no_worse_factor)]
    chosen = min(tied, key=lambda trial: (trial.parameters, trial.held_out_px))
    figures = f"{chosen.held_out_px:.3f} px per point ({views} views, each held out in turn)"
    left_out = [(trial, error.rms_px) for trial, error in sound if all(trial is not one for one, _ in compared)]
    nearer_px = {trial.candidate.label: px for trial, px in left_out if px < least.rms_px}
    folds_within = any(not trial.monotone for trial, _ in compared)
    if chosen is best:
        which = "hold the data" if folds_within else "do not fold back"
        of_which = f" of the models that {which}" if nearer_px else ""
        reason = f"{chosen.candidate.label} was taken: it has the least error of held-out views{of_which}, {figures}"
    else:
        reason = (
            f"{chosen.candidate.label} was taken: with a held-out error of {figures} it is as good as the best "
            f"({best.candidate.label}, {best.held_out_px:.3f} px) and has {chosen.parameters} parameters instead of "
            f"{best.parameters}"
        )
    if not chosen.monotone and growing:
        other, error = min(growing, key=lambda pair: pair[1].rms_px)
        reason += (
            f"; it folds back just beyond the data and holds up to there, where the best that does not fold back "
            f"({other.candidate.label}, {error.rms_px:.3f} px) does not follow the lens"
        )
    if left_out:
        where = "within" if folds_within else "just beyond"
        reason += f"; {', '.join(trial.candidate.label for trial, _ in left_out)} would fold back {where} the data"
    if nearer_px:
        nearest = min(nearer_px, key=lambda label: nearer_px[label])
        reason += f", up to where {nearest} predicts views better ({nearer_px[nearest]:.3f} px)"
    return chosen, reason + "."


Judged = list[tuple[Trial, HeldOut]]


def _compared(sound: Judged, folding_factor: float) -> tuple[Judged, Judged]:
    """The trials of which one is taken, and those that do not fold back just beyond the data: these alone, or all that hold the
    data, where none of these predicts views nearly as well."""
    growing = [pair for pair in sound if pair[0].monotone]
    holding = [pair for pair in sound if pair[0].monotone or pair[0].holds]
    if not growing:
        return holding or sound, growing
    least, least_holding = (min(error.rms_px for _, error in pairs) for pairs in (growing, holding))
    return (holding if least > folding_factor * least_holding else growing), growing
