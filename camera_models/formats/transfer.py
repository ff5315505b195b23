"""A calibration made fit for a file format: cameras that it cannot hold are fitted to the nearest model that it can.

    fit = transfer(calibration, format_named("colmap"), Path("cameras.txt"))
    fit.calibration     # what the format holds exactly
    fit.conversions     # camera name -> how far the fitted camera is from the original

What the format has no place for, and where its own tool ends, is in `notes`: nothing is lost without a word.
"""

import math
from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from camera_models import model_class
from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.fitting import Conversion, convert, widest
from camera_models.formats.calibration_data import Calibration, CameraEstimate, RigCamera
from camera_models.formats.contract import CalibrationFormat, Nearly, is_folder
from camera_models.formats.forms import Form
from camera_models.formats.turn import turn_rad, turned
from camera_models.pose import Pose
from camera_models.scaramuzza import Scaramuzza
from camera_models.wording import listed

LEAST_TURN_RAD = 1e-9
"""Turn of an image about its axis that is nothing."""


@dataclass(frozen=True)
class Transfer:
    """What goes to a file, and how it differs from what was given."""

    calibration: Calibration
    forms: dict[str, Form]
    """How the format writes each camera."""
    conversions: dict[str, Conversion]
    """Of the cameras that were fitted; the others are as given. Errors of a turned camera are those in its turned frame."""
    dropped: tuple[str, ...]
    """What the file has no place for."""
    nearly: dict[str, Nearly]
    """What the file states only nearly beside exact parameters, of the cameras where that is off."""
    notes: tuple[str, ...]
    """The same and the limits of the format as sentences."""


def transfer(
    calibration: Calibration,
    target: CalibrationFormat,
    path: Path,
    model: str | None = None,
    fov_deg: float | int | None = None,
) -> Transfer:
    """The calibration as a format can hold it at a path, each camera of the camera model `model` where one is named.

    Cameras are fitted within `fov_deg` across; where it is None, as far as the data of the calibration reach, or, where that is
    not known, all that the image sees, of which a note says what the fitted model does not hold. Raises InputError where the
    format has no such model, or no model that it has holds `fov_deg`.
    """
    if fov_deg is not None and not 0 < fov_deg <= 360:
        raise InputError(
            f"A field of view above 0 and up to 360 degrees was expected, found {fov_deg:g}; give one in this range."
        )
    allowed = _forms(target, target.forms_at(path, calibration), model)
    original, notes = _turned(calibration, allowed, "rig" in target.keeps(path, calibration))
    exact = {name: next((form for form in allowed if form.why_not(camera) is None), None) for name, camera in original.items()}
    fitting = [form for form in allowed if model is not None or not form.on_request]
    conversions = _nearest(original, [name for name in original if exact[name] is None], fitting, target, fov_deg)
    cameras = {name: conversions[name].model if name in conversions else camera for name, camera in original.items()}
    estimates = {
        name: _of_other_model(estimate, cameras[name]) if name in conversions else estimate
        for name, estimate in original.estimates.items()
    }
    fitted = replace(original, cameras=cameras, estimates=estimates)
    forms = {name: exact[name] or target.exact_form(camera) for name, camera in cameras.items()}
    dropped = _dropped(calibration, fitted, target, path)
    notes += [f"Not kept: {'; '.join(dropped)}."] if dropped else []
    nearly = target.nearly(fitted)
    notes += [*_ends(original, conversions), *_limits(fitted, forms, target), *_off(nearly, target)]
    return Transfer(fitted, forms, conversions, tuple(dropped), nearly, tuple(notes))


def _forms(target: CalibrationFormat, allowed: Sequence[Form], model: str | None) -> list[Form]:
    if model is None:
        return list(allowed)
    model_class(model)
    forms = [form for form in allowed if form.model == model]
    if not forms:
        known = listed(dict.fromkeys(form.model for form in allowed))
        raise InputError(
            f"{target.TITLE} was expected to hold `model` {model}, found that it holds {known}; choose one of these."
        )
    return forms


def _turned(calibration: Calibration, allowed: Sequence[Form], poses_are_kept: bool) -> tuple[Calibration, list[str]]:
    """Cameras that will be fitted, without the turn that only OCamCalib's model holds: it goes to the poses in the file."""
    turns: list[str] = []
    to_poses = bool(calibration.rig) and poses_are_kept
    for name, camera in calibration.items():
        fits = all(form.why_not(camera) is not None for form in allowed)
        if not (fits and isinstance(camera, Scaramuzza)) or abs(turn_rad(camera)) < LEAST_TURN_RAD:
            continue
        turns.append(f"{name} by {math.degrees(turn_rad(camera)):.3g}")
        if to_poses:
            straight, turn = turned(camera)
            pose = turn @ calibration.rig[name].cam_from_rig
            views = tuple(
                replace(view, cam_from_board=turn @ view.cam_from_board) if view.camera == name and view.cam_from_board else view
                for view in calibration.views
            )
            calibration = replace(
                calibration,
                cameras={**calibration.cameras, name: straight},
                # What is known of the pose is known in the frame that it had.
                rig={**calibration.rig, name: RigCamera(pose)},
                views=views,
            )
    said = f"d and e turn the image about the axis ({listed(turns)} degrees), which no other model does"
    what = (
        "here the frames of the cameras are turned instead, in their poses"
        if to_poses
        else "the error of the fit includes that turn"
    )
    return calibration, [f"{said}; {what}."] if turns else []


def _nearest(
    calibration: Calibration,
    names: Sequence[str],
    allowed: Sequence[Form],
    target: CalibrationFormat,
    fov_deg: float | int | None,
) -> dict[str, Conversion]:
    """The best fit of each camera. Cameras of one model get one model in the file where one holds them all."""
    fits = {}
    for name in names:
        fits[name] = _fits(name, calibration, allowed, target, fov_deg)
    chosen = {}
    for kind in dict.fromkeys(calibration[name].NAME for name in names):
        alike = [name for name in names if calibration[name].NAME == kind]
        common = set.intersection(*(set(fits[name]) for name in alike))
        total = {model: sum(fits[name][model].rms_px ** 2 for name in alike) for model in fits[alike[0]] if model in common}
        for name in alike:
            best = min(total, key=total.__getitem__) if total else min(fits[name], key=lambda model: fits[name][model].rms_px)
            chosen[name] = fits[name][best]
    return {name: chosen[name] for name in names}


def _fits(
    name: str, calibration: Calibration, allowed: Sequence[Form], target: CalibrationFormat, fov_deg: float | int | None
) -> dict[str, Conversion]:
    """Fits of the forms with the most parameters of each model, by model; of those that end within the image only if there is
    no other, and of models that hold less than the whole only the widest, if none holds it."""
    camera = calibration[name]
    # A later form of the same model has more parameters.
    longest = {form.model: form for form in allowed if model_class(form.model).CALIBRATED}
    reach_deg = calibration.estimates.get(name, CameraEstimate()).max_angle_deg
    half_deg = _reach_deg(calibration, name) if fov_deg is None else min(seen_deg(camera), fov_deg / 2)
    across = fov_deg if fov_deg is not None or reach_deg is None else 2 * reach_deg
    # What the user asks for is fitted or refused; what we chose may be less.
    fit = widest if fov_deg is None else convert
    reasons: list[str] = []
    for reaches in (True, False):
        found: dict[str, Conversion] = {}
        for form in longest.values():
            if (form.ends_deg >= half_deg) is not reaches:
                continue
            try:
                fitted = fit(camera, form.model, across, form.held, form.tied, **form.options)
            except InputError as error:
                # What was found, of "expected ..., found that ...; do ...".
                said = str(error)
                reasons.append(f"{form.model}: {said.partition('found that ')[2].partition(';')[0] or said.rstrip('.')}")
                continue
            if form.why_not(fitted.model) is None:
                found[form.model] = fitted
        if found:
            held = {model: math.inf if fitted.holds_deg is None else fitted.holds_deg for model, fitted in found.items()}
            return {model: fitted for model, fitted in found.items() if held[model] == max(held.values())}
    raise InputError(
        f"{target.TITLE} was expected to hold camera {name} ({camera.NAME}) or a camera model near it, found that "
        f"{target.why_not(camera) or 'it does not'} ({', '.join(reasons) or 'and nothing can be fitted'}); give a smaller "
        "`fov_deg` or another format."
    )


def _of_other_model(estimate: CameraEstimate, model: CameraModel) -> CameraEstimate:
    """What is still true of a camera after another model was fitted to it; how well the first fitted its data is not."""
    sign = estimate.sign_source if model.AXIS_SIGN_OPEN else None
    return CameraEstimate(max_angle_deg=estimate.max_angle_deg, min_angle_deg=estimate.min_angle_deg, sign_source=sign)


def _dropped(given: Calibration, fitted: Calibration, target: CalibrationFormat, path: Path) -> list[str]:
    """What is in the calibration and will not be in the file."""
    kept = target.keeps(path, given)
    dropped = []
    parts: tuple[tuple[Any, Mapping[str, Any], Mapping[str, Any], str], ...] = (
        (CameraEstimate, given.estimates, fitted.estimates, ""),
        (RigCamera, given.rig, fitted.rig, " in the rig"),
    )
    for kind, before, after, where in parts:
        for item in fields(kind):
            known = [name for name, old in before.items() if not _empty(getattr(old, item.name), item.default)]
            lost = [name for name in known if item.name not in kept or _empty(getattr(after[name], item.name), item.default)]
            if lost and item.name != "cam_from_rig":
                dropped.append(f"{item.name} of {listed(lost)}{where}")
    if given.rig and "rig" not in kept:
        dropped.append(f"where {listed(given.rig)} stand in the rig")
    for item in fields(Calibration):
        value = getattr(given, item.name)
        if item.name not in ("cameras", "estimates", "rig", *kept) and not _empty(value, None):
            dropped.append(f"{len(value)} {item.name}" if isinstance(value, tuple) else item.name)
    alone = is_folder(path) and not target.FOLDERS
    names = list(given) if alone else target.names(given)
    if len(given) > 1 and names != list(given):
        dropped.append(f"the names {listed(given)}, which are {listed(names)} there")
    return dropped


def _empty(value: Any, default: Any) -> bool:
    """Whether a field says nothing."""
    if isinstance(value, int | float | str):
        return bool(value == default)
    return value is None or (isinstance(value, Sized) and not isinstance(value, Pose) and not len(value))


def seen_deg(model: CameraModel) -> float:
    """Largest angle (degrees) from the bearing of the centre pixel that the rim of the image sees."""
    w, h = model.image_size
    u, v = torch.linspace(0, w - 1, 101, dtype=torch.float64), torch.linspace(0, h - 1, 101, dtype=torch.float64)
    zero = torch.zeros(101, dtype=torch.float64)
    rim = [torch.stack(pair, -1) for pair in ((u, zero), (u, zero + h - 1), (zero, v), (zero + w - 1, v))]
    with torch.no_grad():
        bearings, valid = model.unproject(torch.cat(rim))
        axis = model.unproject(model.centre_px)[0]
    angle = torch.atan2(torch.linalg.cross(bearings, axis.expand_as(bearings)).norm(dim=-1), (bearings * axis).sum(-1))
    # Where the rim lies outside the domain, the domain ends within the image.
    return math.degrees(float(angle.max()) if bool(valid.all()) else model.max_angle)


def _reach_deg(calibration: Calibration, name: str) -> float:
    """Largest angle (degrees) off axis that the image sees and the data of the calibration reach."""
    reach_deg = calibration.estimates.get(name, CameraEstimate()).max_angle_deg
    seen = seen_deg(calibration[name])
    return seen if reach_deg is None else min(seen, reach_deg)


def _ends(original: Calibration, conversions: dict[str, Conversion]) -> list[str]:
    """What fitted models do not hold of what their cameras saw, one sentence for each."""
    return [
        f"{fit.model.NAME} fits {name} within {fit.holds_deg} of the {2 * _reach_deg(original, name):.0f} degrees that it sees; "
        "what lies beyond is missing or wrong there."
        for name, fit in conversions.items()
        if fit.holds_deg is not None
    ]


def _limits(calibration: Calibration, forms: dict[str, Form], target: CalibrationFormat) -> list[str]:
    """Where the tool itself sees less than its files say, one sentence for each form."""
    beyond: dict[str, list[str]] = {}
    for name in calibration:
        seen = _reach_deg(calibration, name)
        if seen > forms[name].ends_deg:
            sentence = f"{target.TITLE} itself ends {forms[name].ends_deg:g} degrees off axis with {forms[name].name}"
            beyond.setdefault(sentence, []).append(f"{name} (up to {seen:.0f} degrees)")
    return [
        f"{sentence}: what {listed(names)} sees beyond is missing or wrong there, though the parameters are right."
        for sentence, names in beyond.items()
    ]


def _off(nearly: dict[str, Nearly], target: CalibrationFormat) -> list[str]:
    """What tools that take the near statement see, one sentence for each camera."""
    sentences = []
    for name, item in nearly.items():
        if item.begins:
            assert item.angles_deg is not None
            sentences.append(
                f"The {item.what} of {name}, where {target.TITLE}'s tools begin to invert the first, is {item.off_px:.2g} px off "
                f"at most up to {item.angles_deg[1]:.0f} degrees off axis; a tool that takes no steps from there is off as much."
            )
            continue
        where = "over the image"
        if item.angles_deg is not None:
            where = "from {:.0f} to {:.0f} degrees off axis, where the data of the calibration lie, and wrong beyond".format(
                *item.angles_deg
            )
        sentences.append(f"{target.TITLE} itself projects {name} by its {item.what}, {item.off_px:.2g} px off at most {where}.")
    return sentences
