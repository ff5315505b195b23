"""Which camera model suits a lens: every model that applies is fitted, and judged by views that its fit has not seen.

The corners are split by views into folds. Of each fold a camera is fitted to the other views by plain least squares, held, and
only the board poses of the fold are fitted; what then remains of the fold's corners is the held-out error. Of the models whose
held-out error is within one standard error of the best (paired over the views; L. Breiman et al. 1984) the one with the fewest
parameters is taken. All models are judged by the same corners. A model whose curve folds back before it has passed the data
by a tenth is not taken.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import MODELS, CameraModel, GeometryError, InputError, model_class
from camera_models.pose import Pose
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.single import CameraCalibration, calibrate_camera
from omnilines.calibration.views import board_points, corner_weights
from omnilines.records import Corners

FOLDS = 5
LEAST_VIEWS = 5
BEYOND = 1.1
"""The curve must grow up to this many times the radius of the outermost corner."""
AZIMUTHS = 72


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
    """How a candidate did; errors are RMS per point over the corners that all candidates are judged by."""

    candidate: Candidate
    result: CameraCalibration | None
    failure: str | None
    """Why it could not be fitted."""
    parameters: int = 0
    monotone: bool = True
    in_sample_px: float = float("nan")
    held_out_px: float = float("nan")
    squares_by_view: Float[np.ndarray, " v"] | None = None
    """Mean squared held-out distance of each view."""


@dataclass(frozen=True)
class Selection:
    """All trials in the order of the registry, the one taken and why, in one sentence."""

    trials: tuple[Trial, ...]
    chosen: Trial
    reason: str

    @property
    def result(self) -> CameraCalibration:
        """The calibration with the model that was taken, from all views."""
        assert self.chosen.result is not None
        return self.chosen.result


def all_candidates() -> tuple[Candidate, ...]:
    """Every variant of every model that can be calibrated, in the order of the registry."""
    kinds = [model_class(name) for name, _ in MODELS]
    return tuple(Candidate(kind.NAME, options) for kind in kinds if kind.CALIBRATED for options in kind.VARIANTS)


def select_model(
    corners: Corners,
    image_size: tuple[int, int],
    *,
    loss: str = "cauchy",
    mirror: bool = False,
    candidates: Sequence[Candidate] | None = None,
    folds: int = FOLDS,
    callback: Callable[[str, int, int], None] | None = None,
) -> Selection:
    """Fit all candidates and take one, as the module's header says.

    `callback` is told (label, done, total). Raises InputError for fewer than LEAST_VIEWS views, and the first failure where no
    candidate can be fitted.
    """
    candidates = all_candidates() if candidates is None else tuple(candidates)
    fitted: list[CameraCalibration | GeometryError | InputError] = []
    for done, candidate in enumerate(candidates):
        if callback is not None:
            callback(candidate.label, done, len(candidates))
        try:
            fitted.append(
                calibrate_camera(corners, image_size, candidate.model, loss=loss, mirror=mirror, options=candidate.options)
            )
        except (GeometryError, InputError) as error:
            fitted.append(error)
    results = [fit for fit in fitted if isinstance(fit, CameraCalibration)]
    if not results:
        failure = fitted[0]
        assert not isinstance(failure, CameraCalibration)
        raise failure
    # A model that does not fit rejects the corners that say so: the judges are those of the model that keeps the most.
    judge = max(results, key=lambda result: (int(result.kept.sum()), -result.rms_px_per_point))
    judged = _Judged.of(corners, judge, folds)
    trials = tuple(judged.trial(candidate, fit) for candidate, fit in zip(candidates, fitted, strict=True))
    chosen, reason = _choose(trials, judged)
    return Selection(trials, chosen, reason)


def fit_boards(
    model: CameraModel, points: BoardPoints, weight: Float[Tensor, " n"] | None = None
) -> tuple[Pose, Float[Tensor, "n 2"]]:
    """`cam_from_board` of views by a camera that is held, by least squares, and the residuals (projected minus observed, px)."""
    bearings, _ = model.unproject(points.pixels)
    problem = BoardProblem(points, torch.zeros(len(model.parameters), 0, dtype=torch.float64), weight)
    state = problem.solve(CameraAndBoards(model, resect_boards(points, bearings))).state
    return state.cam_from_board, state.residual_px(points)


@dataclass(frozen=True)
class _Judged:
    """The corners that all candidates are judged by, split by views."""

    points: BoardPoints
    weight: Float[Tensor, " n"] | None
    rows: Bool[np.ndarray, " m"]
    names: tuple[str, ...]
    folds: int

    @staticmethod
    def of(corners: Corners, judge: CameraCalibration, folds: int) -> "_Judged":
        """The corners that one calibration kept. Raises InputError for fewer than LEAST_VIEWS views."""
        views = [v for v, view in enumerate(judge.views) if view.used]
        if len(views) < LEAST_VIEWS:
            raise InputError(
                f"At least {LEAST_VIEWS} usable views were expected to choose a camera model by held-out views, found "
                f"{len(views)}; add photos or name a model with --model."
            )
        names = tuple(corners.view_names[v] for v in views)
        points = board_points(corners, judge.kept, views)
        return _Judged(points, corner_weights(corners, judge.kept), judge.kept, names, min(folds, len(views)))

    def trial(self, candidate: Candidate, fit: CameraCalibration | GeometryError | InputError) -> Trial:
        """In-sample and held-out error of one candidate over the common corners."""
        if not isinstance(fit, CameraCalibration):
            return Trial(candidate, None, str(fit))
        basis = fit.model.calibration_basis()
        poses = {view.name: view.cam_from_board for view in fit.views}
        missing = [name for name in self.names if poses.get(name) is None]
        if missing:
            return Trial(candidate, fit, f"it does not fit view {missing[0]}, which other models fit", basis.shape[1])
        # Views that have a pose; the common corners are fitted anew without a loss.
        start = CameraAndBoards(fit.model, Pose.stack([pose for name in self.names if (pose := poses[name]) is not None]))
        whole = BoardProblem(self.points, basis, self.weight).solve(start).state
        squares = torch.zeros(len(self.points.view), dtype=torch.float64)
        for fold in range(self.folds):
            held = torch.arange(self.points.views) % self.folds == fold
            rows = held[self.points.view]
            train, test = torch.nonzero(~held).flatten().tolist(), torch.nonzero(held).flatten().tolist()
            own = None if self.weight is None else self.weight[~rows]
            problem = BoardProblem(self.points.of_views(train), basis, own)
            model = problem.solve(CameraAndBoards(whole.model, whole.cam_from_board[train])).state.model
            other = None if self.weight is None else self.weight[rows]
            squares[rows] = (fit_boards(model, self.points.of_views(test), other)[1] ** 2).sum(-1)
        inside = (whole.residual_px(self.points) ** 2).sum(-1)
        by_view = self.points.mean_by_view(squares[:, None])[:, 0].numpy()
        return Trial(
            candidate,
            fit,
            None,
            basis.shape[1],
            grows_beyond(fit.model, self.points.pixels),
            float(inside.mean().sqrt()),
            float(squares.mean().sqrt()),
            by_view,
        )


def grows_beyond(model: CameraModel, pixels: Float[Tensor, "n 2"], share: float = BEYOND) -> bool:
    """Whether the model is one-to-one over the part of the image up to `share` times the radius of the outermost pixel."""
    radius = share * float((pixels - model.centre_px).norm(dim=-1).max())
    azimuth = 2 * torch.pi * torch.arange(AZIMUTHS, dtype=torch.float64) / AZIMUTHS
    ring = model.centre_px + radius * torch.stack([torch.cos(azimuth), torch.sin(azimuth)], -1)
    limit = torch.tensor(model.image_size, dtype=torch.float64)
    ring = torch.minimum(ring.clamp_min(-0.5), limit - 0.5)
    return bool(model.unproject(ring)[1].all())


def _choose(trials: Sequence[Trial], judged: _Judged) -> tuple[Trial, str]:
    sound = [trial for trial in trials if trial.squares_by_view is not None]
    growing = [trial for trial in sound if trial.monotone] or sound
    best = min(growing, key=lambda trial: trial.held_out_px)
    tied = [trial for trial in growing if _within_one_error(trial, best)]
    chosen = min(tied, key=lambda trial: (trial.parameters, trial.held_out_px))
    figures = f"{chosen.held_out_px:.3f} px per point held out ({len(judged.names)} views in {judged.folds} folds)"
    if chosen is best:
        reason = f"{chosen.candidate.label} was taken: it has the least error of held-out views, {figures}"
    else:
        reason = (
            f"{chosen.candidate.label} was taken: with {figures} it is within one standard error of the best "
            f"({best.candidate.label}, {best.held_out_px:.3f} px) and has {chosen.parameters} parameters instead of "
            f"{best.parameters}"
        )
    folding = [trial.candidate.label for trial in sound if not trial.monotone]
    if folding:
        reason += f"; {', '.join(folding)} would fold back just beyond the data"
    return chosen, reason + "."


def _within_one_error(trial: Trial, best: Trial) -> bool:
    """Whether the mean difference from the best over the views is at most its standard error."""
    assert trial.squares_by_view is not None and best.squares_by_view is not None
    difference = trial.squares_by_view - best.squares_by_view
    return bool(difference.mean() <= difference.std(ddof=1) / np.sqrt(len(difference)))
