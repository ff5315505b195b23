"""Photos of buildings or rooms -> a calibrated camera, without a board: `calibrate_lines`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from jaxtyping import Float

from camera_models import Calibration, CameraEstimate, CameraModel, GeometryError, InputError, model_class, save
from camera_models.formats.calibration_data import ViewRecord
from camera_models.typed import typed
from omnilines.calibration.lines.camera import LineAdjustment, LineCamera, in_mirror, line_camera
from omnilines.calibration.lines.select import LineSelection, LineTrial, candidates_of, chosen_camera, chosen_trial, trial_of
from omnilines.calibration.options import AUTO, CalibrationOptions
from omnilines.calibration.select import Candidate
from omnilines.files import Photo, PhotoRef, Photos, photo_folder, photos_of
from omnilines.files.masks import Mask, with_masks
from omnilines.files.sets import claimed
from omnilines.pipelines.arc_chains import arc_chains_of
from omnilines.pipelines.boards_beside import contradiction, off_boards, prior_of_boards, require_global_shutter
from omnilines.pipelines.calibrate import GUIDE, CalibrationResult
from omnilines.pipelines.chain_starts import CameraStart, start_from_chains
from omnilines.pipelines.chains import PhotoChains, chains_of
from omnilines.pipelines.line_camera import adjusted_camera, is_camera, readjusted_camera
from omnilines.pipelines.line_options import LinesOptions
from omnilines.pipelines.line_scale import with_scale_of_all, without_doubtful_angles
from omnilines.pipelines.next_views import seen_rim_px
from omnilines.pipelines.pages import claimed_report
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import Detail

CALIBRATION = "calibration.yaml"
NO_BETTER = 0.99
"""A start camera is taken before one that is listed earlier where it leaves less than this share of its misfit."""

ROUGHLY_SETTLED_SIGMAS = 2.0
"""Of the camera that goes out for arcs."""


class LineFields(TypedDict, total=False):
    """Fields of `CalibrationOptions` that a call may give by name."""

    model: str
    degree: int | None
    coefficients: int | None
    mirror: bool


@dataclass(frozen=True, eq=False)
class LineResult:
    """A camera calibrated from straight lines, how certain it is, and what it was made from."""

    fit: LineCamera
    """All figures."""
    calibration: Calibration
    """The camera with its uncertainty and provenance: what `calibration.yaml` holds."""
    selection: LineSelection
    """How camera models, or variants of the one that was asked for, compare."""
    skipped: tuple[Detail, ...]
    """Photos that were left out, and why."""
    photo_folder: Path | None = None
    boards: CalibrationResult | None = None
    """What was known of the camera from boards, where it counts."""
    rim_px: float | None = None
    """Distance from the centre pixel beyond which photos are dark; None where they show the world up to the border, or are not
    at hand."""

    def __repr__(self) -> str:
        lines = sum(photo.straight for photo in self.fit.photos)
        return f"LineResult({self.camera}, photos={len(self.fit.photos)}, straight_lines={lines})"

    @property
    def camera(self) -> CameraModel:
        """The camera."""
        return self.fit.model

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation of each parameter."""
        return self.fit.sigma

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Of the parameters in the order of `camera.PARAMETER_NAMES`."""
        return self.fit.covariance

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of the calibration, one sentence each."""
        several = len(self.selection.trials) > 1
        return (*self.fit.notes, *((self.selection.reason,) if several else ()))

    @property
    def details(self) -> tuple[Detail, ...]:
        """Photos that were left out, and those in which no line counts."""
        none = (photo.image for photo in self.fit.photos if not photo.straight)
        return (*self.skipped, *(Detail.of(image, "no edge in it is a straight line") for image in none))

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        return (CALIBRATION,)

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write `calibration.yaml` into a folder, which is made if absent; returns the files."""
        with claimed(folder, self.file_names, by="calibrate") as out:
            save(out / CALIBRATION, self.calibration)
        return (out / CALIBRATION,)

    @typed
    def report(self, path: str | Path, *, plots: str | Path | None = None) -> Path:
        """Write the page that shows all of it, and return its path. Its figures
        are written as PNG and SVG into the folder `plots`, where one is given."""
        from omnilines.pages.calibration_lines import write_line_calibration_page

        with claimed_report(path, plots):
            return write_line_calibration_page(self, path)


def calibrate_lines(
    photos: Photos,
    options: CalibrationOptions = CalibrationOptions(),
    lines: LinesOptions = LinesOptions(),
    *,
    boards: CalibrationResult | None = None,
    mask: Mask | None = None,
    work: str | Path | None = None,
    progress: ProgressCallback = silent,
    **fields: Unpack[LineFields],
) -> LineResult:
    """`calibrate_one.calibrate` of the straight lines of photos of buildings or rooms, without a board or a guess.

    Edges are followed without a camera; the curve of the lens under which they are straight, and the scale at which directions of
    lines are at right angles, start it. Then camera, lines and directions are adjusted together, and again with the arcs that the
    camera finds. Of `options`, `model`, `degree`, `coefficients` and `mirror` count: where variants of the model are open, and
    with `model` "auto", they are compared by photos that a fit has not seen. Lines do not tell a mirror from a lens: `mirror`
    says it.

    `boards` is a calibration of the same camera from a target, of some of the photos or of others: its model is
    kept, its corners count with their covariance in the one adjustment, and edges on the board of a photo do not count again.
    Edges are followed where `mask` says, as in `extract`. What each photo shows is kept in the folder `work`, where one is given,
    and read from there by another run that would find the same.

    Raises InputError for options out of range and where no photo can be used, and GeometryError where too few edges are straight.

        >>> result = ol.calibrate("room/", "lines", model="opencv-fisheye")
        >>> result.camera.NAME, result.fit.rms_px < 0.2
        ('opencv-fisheye', True)
    """
    options = replace(options, **fields)
    options.require_of_models([options.model])
    _require_mirror(options, boards)
    refs = with_masks(photos_of(photos), mask)
    if boards is not None:
        if options.model != boards.camera.NAME and "model" in fields:
            raise InputError(
                f"The model of the boards, {boards.camera.NAME}, was expected, found {options.model}; calibrate them with it."
            )
        require_global_shutter(boards)
        return _with_boards(refs, boards, lines, options, work, progress)
    followed = chains_of(refs, options=lines.chains, work=work, progress=progress)
    chains, skipped = followed.chains, followed.skipped
    candidates = candidates_of(options.model, options.of_model, mirror=options.mirror)
    guide = _guide(candidates, options.model)
    start, done = _started(followed, guide, lines, progress)
    images = chains.images
    for _ in range(max(1, lines.adjustment.searches)):
        used = [one for one in refs if one.name in set(images)]
        arcs, _ = arc_chains_of(used, done.model, lines.extraction, work=work, progress=progress)
        before = done.model
        done = adjusted_camera(before, arcs, lines.adjustment, lines.directions, prior=done.prior, progress=progress)
        start, done = with_scale_of_all(start, done, arcs, guide, lines, progress)
    start, guided, lines, doubts = without_doubtful_angles(start, done, arcs, guide, lines, progress)
    trials = [_trial(one, guide, start, guided, lines, options, progress) for one in candidates]

    def adjusted(trial: LineTrial) -> LineAdjustment:
        """The camera of a trial by itself."""
        if trial.candidate == guide:
            return guided
        assert trial.model is not None
        sigma = guided.prior.scale_sigma
        return adjusted_camera(trial.model, arcs, lines.adjustment, lines.directions, scale_sigma=sigma, progress=progress)

    selection, done = chosen_camera(trials, options.held_out, adjusted, lines.adjustment.open_share)
    fit = line_camera(done, images, lines.adjustment)
    fit = replace(fit, notes=(*doubts, *fit.notes))
    if options.mirror:
        fit = in_mirror(fit)
    inputs = {"photos": photo_folder(refs), "pattern": "lines", "model": options.model}
    rim = seen_rim_px(refs, fit.model, fit.pixels)
    return LineResult(fit, line_record(fit, inputs, options.mirror), selection, skipped, _folder(refs), rim_px=rim)


def _guide(candidates: Sequence[Candidate], model: str) -> Candidate:
    """The camera that edges are found, weighed and put together by: of the variants of a model the middle one, of two the
    smaller. Where its terms make up for one another it does not settle, and a comparison with others begins in its favour."""
    return Candidate(GUIDE, {}) if model == AUTO else candidates[(len(candidates) - 1) // 2]


def _require_mirror(options: CalibrationOptions, boards: CalibrationResult | None) -> None:
    """Raises InputError for a mirror of a model that has none, and beside boards."""
    if not options.mirror:
        return
    if boards is not None:
        raise InputError("A lens was expected with boards beside lines, found `mirror`; calibrate mirrors with either alone.")
    if options.model != AUTO and not model_class(options.model).AXIS_SIGN_OPEN:
        raise InputError(f"A camera model that may be a mirror was expected, found {options.model}; use `model` scaramuzza.")


def _with_boards(
    refs: Sequence[Photo],
    boards: CalibrationResult,
    lines: LinesOptions,
    options: CalibrationOptions,
    work: str | Path | None,
    progress: ProgressCallback,
) -> LineResult:
    """Corners and lines in one adjustment, from the camera of the corners."""
    model, prior, doubts = boards.camera, None, tuple[str, ...]()
    for _ in range(max(1, lines.adjustment.searches)):
        arcs, skipped = arc_chains_of(refs, model, lines.extraction, work=work, progress=progress)
        arcs = off_boards(arcs, boards, lines.adjustment.board_margin_squares)
        if prior is None:
            prior, doubts = prior_of_boards(boards, arcs, lines), contradiction(boards, arcs, lines, progress)
        done = adjusted_camera(model, arcs, lines.adjustment, lines.directions, prior=prior, progress=progress)
        model = done.model
    trial = trial_of(
        Candidate(model.NAME, dict(model.variant)), done, options.held_out.beyond_factor, lines.adjustment.open_share
    )
    fit = line_camera(done, arcs.images, lines.adjustment)
    low, high = min(fit.min_angle_deg, boards.fit.min_angle_deg), max(fit.max_angle_deg, boards.fit.max_angle_deg)
    # What they say of the camera (a term held at 0, standard deviations) is not so of the one adjusted to lines too.
    of_boards = [f"From corners alone: {note}" for note in boards.notes]
    fit = replace(fit, min_angle_deg=low, max_angle_deg=high, notes=(*of_boards, *doubts, *fit.notes))
    inputs = {**boards.found.inputs, "photos": photo_folder(refs), "lines": True, "model": model.NAME}
    rim = seen_rim_px(refs, fit.model, fit.pixels)
    chosen = chosen_trial([trial], options.held_out)
    return LineResult(fit, line_record(fit, inputs), chosen, skipped, _folder(refs), boards, rim)


def _folder(refs: Any) -> Path | None:
    """Of the photos, where they are files of one."""
    folders = {ref.path.parent for ref in refs if isinstance(ref, PhotoRef)}
    return folders.pop() if len(folders) == 1 else None


def _started(
    followed: PhotoChains, guide: Candidate, lines: LinesOptions, progress: ProgressCallback
) -> tuple[CameraStart, LineAdjustment]:
    """The start camera that leads to the straightest lines, and where."""
    chains = followed.chains
    starts = start_from_chains(
        chains,
        followed.circle,
        start=lines.adjustment.start,
        directions=lines.directions,
        right_angles=lines.right_angles,
        progress=progress,
    )
    # Arcs follow, and settle it.
    rough = replace(lines.adjustment, settled_sigmas=max(lines.adjustment.settled_sigmas, ROUGHLY_SETTLED_SIGMAS))
    best: tuple[CameraStart, LineAdjustment] | None = None
    failure: GeometryError | None = None
    passed, sigmas = list[CameraModel](), lines.adjustment.settled_sigmas
    for start in starts[: lines.adjustment.most_starts]:
        way = list[CameraModel]()
        met = partial(_passed_before, passed, way, sigmas)
        try:
            camera = start.camera(guide.model, **guide.options)
            done = adjusted_camera(camera, chains, rough, lines.directions, met=met, progress=progress)
        except GeometryError as error:
            failure = error
            continue
        if best is None or (not met(done) and done.chains.misfit < NO_BETTER * best[1].chains.misfit):
            best = start, done
        passed += way
    if best is None:
        raise failure or GeometryError("Edges that are straight in the world were expected, found none; add photos.")
    return best


def _passed_before(passed: Sequence[CameraModel], way: list[CameraModel], sigmas: float, done: LineAdjustment) -> bool:
    """Whether an earlier start came through this camera: this one would go on, and end, as that did. The `way` is added to."""
    way.append(done.model)
    return any(is_camera(done, one, sigmas) for one in passed)


def _trial(
    candidate: Candidate,
    guide: Candidate,
    start: CameraStart,
    done: LineAdjustment,
    lines: LinesOptions,
    options: CalibrationOptions,
    progress: ProgressCallback,
) -> LineTrial:
    progress(f"fitting {candidate.label}", 0, 0)
    beyond, share = options.held_out.beyond_factor, lines.adjustment.open_share
    if candidate == guide:
        return trial_of(candidate, done, beyond, share)
    try:
        readjusted = readjusted_camera(start.camera(candidate.model, **candidate.options), done, lines.adjustment)
        return trial_of(candidate, readjusted, beyond, share)
    except (GeometryError, InputError) as error:
        return LineTrial(candidate, str(error))


def line_record(fit: LineCamera, inputs: Mapping[str, Any], mirror: bool = False) -> Calibration:
    """What `calibration.yaml` holds of a camera calibrated from lines."""
    estimate = CameraEstimate(
        sigma=fit.sigma,
        covariance=fit.covariance,
        max_angle_deg=fit.max_angle_deg,
        min_angle_deg=fit.min_angle_deg,
        rms_px_per_axis=fit.rms_px,
        sign_source=("mirror" if mirror else "assumed") if fit.model.AXIS_SIGN_OPEN else None,
    )
    views = tuple(
        ViewRecord(photo.image, "cam0", photo.straight > 0, None if photo.straight else "no edge in it is a straight line")
        for photo in fit.photos
    )
    return Calibration({"cam0": fit.model}, {"cam0": estimate}, views=views, provenance=provenance(inputs))
