"""Which camera model suits a lens, by photos that its fit has not seen: `calibration.select` with lines for boards.

All candidates are adjusted to the same pieces of edges with the same weights and families, those of the camera that led to them.
What remains of a photo by the camera of all others (`calibration.held_out`) has its circles and directions fitted anew.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from camera_models import CameraModel, GeometryError, model_class
from omnilines.calibration.diagnose import grows_beyond
from omnilines.calibration.held_out import HeldOut, ViewTerms
from omnilines.calibration.lines.camera import LineAdjustment, counted, open_terms_of
from omnilines.calibration.options import AUTO
from omnilines.calibration.select import Candidate, all_candidates
from omnilines.calibration.thresholds import HeldOutThresholds

SEEN_SHARE = 0.995
"""Of the pieces of edges, those that a model has to see."""


@dataclass(frozen=True)
class LineTrial:
    """How a candidate did; errors are root mean squares of what the fit makes small, in px: distances across edges by their
    weight, and strays of lines from their directions. `LineCamera.rms_px` takes all pieces of edges alike, and no strays."""

    candidate: Candidate
    failure: str | None
    """Why it could not be adjusted."""
    model: CameraModel | None = None
    error: HeldOut | None = None
    in_sample_px: float = math.nan
    unit_px: float = math.nan
    """Standard deviation of a piece of an edge, in which errors are."""
    monotone: bool = True
    open_terms: tuple[str, ...] = ()
    """Directions of its parameters that lines do not tell (`LineCamera.open_terms`)."""

    @property
    def held_out_px(self) -> float:
        """NaN where there is none."""
        return math.nan if self.error is None else self.error.rms_px * self.unit_px

    @property
    def parameters(self) -> int:
        """Number of parameters that are estimated."""
        return 0 if self.error is None else self.error.parameters


@dataclass(frozen=True)
class LineSelection:
    """All trials, the one taken and why, in one sentence."""

    trials: tuple[LineTrial, ...]
    chosen: LineTrial
    reason: str


def candidates_of(model: str, given: dict[str, int], *, mirror: bool = False) -> tuple[Candidate, ...]:
    """What is compared: all models (that may be a mirror), the variants of one, or the one that is given."""
    if model == AUTO:
        return tuple(one for one in all_candidates() if not mirror or model_class(one.model).AXIS_SIGN_OPEN)
    if given:
        return (Candidate(model, given),)
    return tuple(Candidate(model, dict(options)) for options in model_class(model).VARIANTS)


def trial_of(candidate: Candidate, done: LineAdjustment, beyond_factor: float, open_share: float) -> LineTrial:
    """The figures of a candidate that was adjusted; `open_share` is that of `LineOptions`."""
    chains, scores = done.chains, done.scores
    at = done.problem.linearise(done.state)
    photo = chains.blocks.photo[done.problem.structure.index]
    squares = torch.zeros(scores.photos, dtype=torch.float64).index_add_(0, photo, at.residual[:, 0].square())
    own = counted(chains)
    count = torch.bincount(chains.blocks.photo[chains.blocks.chain[own]], minlength=scores.photos).double()
    seen = count > 0
    information, known = scores.photo_information(done.problem, done.state), (scores.known_before, scores.pull_before)
    terms = ViewTerms(information[seen], scores.by_photo[seen], squares[seen], count[seen], known)
    unit = float((count.sum() / chains.information[own].sum()).sqrt())
    in_sample = math.sqrt(float(squares.sum() / count.sum())) * unit
    grows = grows_beyond(done.model, chains.blocks.pixels[own], beyond_factor)
    left_open = open_terms_of(done, open_share)
    return LineTrial(candidate, None, done.model, terms.held_out(), in_sample, unit, grows, left_open)


def chosen_trial(trials: Sequence[LineTrial], thresholds: HeldOutThresholds) -> LineSelection:
    """The model with the fewest parameters of those that predict photos as well as the best, of which lines leave the least open.

    Models that leave more open are not compared where others are worse by next to nothing: beta of `extended-unified` is what
    nothing depends on in a lens without distortion, where alpha is 0. A larger variant of a model is not taken for what chance
    makes, however much that is: its further terms make up for one another.

    Raises GeometryError where none could be adjusted.
    """
    sound = [(trial, trial.error) for trial in trials if trial.error is not None]
    if not sound:
        raise GeometryError(f"A camera model that follows the lines was expected, found none: {trials[0].failure}")
    growing = [(trial, error) for trial, error in sound if trial.monotone] or sound
    best, least = min(growing, key=lambda pair: pair[0].held_out_px)
    if len(sound) == 1 or math.isinf(least.rms_px):
        return LineSelection(tuple(trials), best, f"{best.candidate.label} was taken: photos do not tell more.")
    near = [
        (trial, error)
        for trial, error in growing
        if error.rms_px <= thresholds.no_worse_factor * least.rms_px
        or (trial.candidate.model == best.candidate.model and not error.beaten_by(least, thresholds.significance))
    ]
    least_open = min(len(trial.open_terms) for trial, _ in near)
    clear = [(trial, error) for trial, error in near if len(trial.open_terms) == least_open]
    best, least = min(clear, key=lambda pair: pair[0].held_out_px)
    tied = [trial for trial, error in clear if not error.beaten_by(least, thresholds.significance)]
    chosen = min(tied, key=lambda trial: (trial.parameters, trial.held_out_px))
    figures = f"{chosen.held_out_px:.4f} px by the weights of the fit (each photo held out in turn)"
    if chosen is best:
        reason = f"{chosen.candidate.label} was taken: it has the least error of held-out photos, {figures}."
    else:
        reason = (
            f"{chosen.candidate.label} was taken: with a held-out error of {figures} it is as good as the best, but for chance "
            f"({best.candidate.label}, {best.held_out_px:.4f} px), and has {chosen.parameters} parameters instead of "
            f"{best.parameters}{_held_words(chosen, best)}."
        )
    left = [trial for trial, _ in near if len(trial.open_terms) > least_open]
    more = "".join(
        f" {one.candidate.label} predicts as well, but lines leave open its {'; '.join(one.open_terms)}." for one in left
    )
    return LineSelection(tuple(trials), chosen, reason + more)


def _held_words(chosen: LineTrial, best: LineTrial) -> str:
    """Which terms of a larger variant are held in the smaller one."""
    if chosen.candidate.model != best.candidate.model:
        return ""
    held = [name for name in _estimated(best) if name not in _estimated(chosen)]
    return f": {' '.join(held)} {'is' if len(held) == 1 else 'are'} held at 0"


def _estimated(trial: LineTrial) -> list[str]:
    """Names of the parameters."""
    assert trial.model is not None
    moved = trial.model.calibration_basis().any(-1).tolist()
    return [name for name, one in zip(trial.model.PARAMETER_NAMES, moved, strict=True) if one]


def chosen_camera(
    trials: Sequence[LineTrial],
    thresholds: HeldOutThresholds,
    adjusted: Callable[[LineTrial], LineAdjustment],
    open_share: float,
) -> tuple[LineSelection, LineAdjustment]:
    """`chosen_trial`, and its camera adjusted with weights and families of its own. Where lines then leave more of it open than
    they did in the trial, that counts, and another may be taken."""
    while True:
        selection = chosen_trial(trials, thresholds)
        done = adjusted(selection.chosen)
        left_open = open_terms_of(done, open_share)
        if len(left_open) <= len(selection.chosen.open_terms):
            return selection, done
        trials = [replace(one, open_terms=left_open) if one is selection.chosen else one for one in trials]
