"""What limits the calibration of a camera or a rig, as it was measured, and what to do about it."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from camera_models.wording import rounded
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.image_field import ImageField
from omnilines.calibration.lines.camera import LineCamera, focal_length
from omnilines.calibration.model_misfit import ModelMisfit
from omnilines.calibration.next_pose import TEN, NextViews
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.links import Link
from omnilines.calibration.rig.result import RigCalibration
from omnilines.pipelines.copies import is_copy
from omnilines.records import Advice, Corners, ViewResult
from omnilines.report.numbers import figure

NAMED = 3
"""Photos that a sentence names."""
STANDS_OUT = 3.0
"""Residual of a photo, in those of the median one, from which on it is named."""
MANY_UNUSED = 0.25
"""Share of the photos from which on those that are not used are spoken of."""
UNEXPLAINED = 2.0
"""Residuals in those that the noise of corners explains, from which on they are spoken of."""
ROUGH_FOCAL = 0.005
"""Relative standard deviation of a focal length from which on it is spoken of."""
SHORT_REACH = 0.9
"""Of the way to the rim of the lens or the corners of the image, in angle: edges that reach less far are spoken of."""


def named(names: Sequence[str]) -> str:
    """The first few of some photos, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def board_advice(fit: CameraCalibration, views: NextViews | None, corners: Corners, *, compared: bool) -> tuple[Advice, ...]:
    """Of a camera that was calibrated with a board: what changes between photos, places without corners, the noise of
    corners, photos that stand out, and photos without use. `compared`: the model is the best of several."""
    unused = unused_advice([v for v in fit.views if not v.used], len(fit.views))
    if fit.change is not None:
        # What else is said of the camera is that of one which no photo has.
        return (Advice(f"{fit.change.limit}.", fit.change.remedy), *unused)
    if fit.misfit is not None:
        # Where to hold the board next, and the noise of corners, are figures of a camera that is not this one.
        return (_of_misfit(f"{fit.model.NAME} model", fit.misfit, compared), *unused)
    found = []
    noise = _of_noise(fit.views, fit.board_terms, compared)
    stated_px = None if corners.sigma_px is None else float(np.sqrt(np.mean(corners.sigma_px[fit.kept] ** 2)))
    if views is not None:
        of_place = views.limits[: -1 if views.noisy else None]
        if of_place:
            found.append(Advice(" ".join(of_place), next_photo(views)))
        if views.noisy:
            found.insert(0, Advice(views.limits[-1], noise))
    if stated_px and not (views is not None and views.noisy) and fit.corner_sigma_px > UNEXPLAINED * stated_px:
        found.append(_unexplained("", fit.corner_sigma_px / stated_px, stated_px, noise))
    other = () if fit.unmodelled is None else (Advice(f"{fit.unmodelled.limit}.", fit.unmodelled.remedy),)
    return (*other, *found, *_standing_out(fit.views), *unused)


def _of_misfit(what: str, misfit: ModelMisfit, compared: bool) -> Advice:
    """A model that does not follow the lens."""
    off = rounded(misfit.largest_px)
    limit = f"The {what} does not follow this lens: corners lie off by up to {off} px in all photos alike."
    if compared:
        do = f"No model that was compared follows it better: rely on it to {off} px at best."
    else:
        do = "Try `model` auto, which compares all."
    return Advice(limit, do)


def next_photo(views: NextViews, start: str = "") -> str:
    """The pose of the board that helps most; where none helps, or none is needed, that."""
    if not views.poses or views.worst_px <= views.corner_sigma_px:
        return views.conclusion
    return _sentence(f"{start}{views.sentences[0]}")


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _unexplained(camera: str, ratio: float, stated_px: float, do: str) -> Advice:
    """Residuals that the detector's own noise does not explain."""
    whose = f"{camera}: corners" if camera else "Corners"
    return Advice(
        f"{whose} lie {rounded(ratio)} times as far off as the {rounded(stated_px)} px of noise in the photos explain.", do
    )


def _of_noise(views: Sequence[ViewResult], board_terms: Mapping[str, float], compared: bool) -> str:
    """Where to look for it: in single photos, or in what all of them share."""
    px, median, worst = _far_off(views)
    if worst:
        return (
            f"Look at {named(worst)} first: half of the photos have less than {rounded(median)} px. Shoot again what is blurred."
        )
    least, most = rounded(min(px, default=0.0)), rounded(max(px, default=0.0))
    alike = f"All photos fit alike ({least} to {most} px), so that no single one is at fault"
    tries = [*([] if board_terms else ["`refine_board` aspect,surface"]), *([] if compared else ["`model` auto"])]
    return f"{alike}: try {', and '.join(tries)}." if tries else f"{alike}, but what they share, such as the board."


def _standing_out(views: Sequence[ViewResult]) -> tuple[Advice, ...]:
    """Photos that fit much worse than the others."""
    _, median, worst = _far_off(views)
    if not worst:
        return ()
    fits = "fits" if len(worst) == 1 else "fit"
    said = f"{named(worst)} {fits} worse than the others, of which half have less than {rounded(median)} px."
    return (Advice(said, "Look at it in the report, and leave it out where it is blurred or the board moved."),)


def _far_off(views: Sequence[ViewResult]) -> tuple[list[float], float, list[str]]:
    """Residuals of the views that are used, the median one, and the views that have many times that, the worst first."""
    found = sorted(((v.rms_px_per_point, v.image) for v in views if v.used and v.rms_px_per_point is not None), reverse=True)
    px = [value for value, _ in found]
    median = float(np.median(px)) if px else 0.0
    return px, median, [f"{image} ({rounded(value)} px)" for value, image in found if value > STANDS_OUT * median]


def unused_advice(unused: Sequence[ViewResult], total: int) -> tuple[Advice, ...]:
    """Photos that are not used, where they are many of all: the most frequent reason, and what to do about each. Copies are
    counted, but not missed."""
    lost = [view for view in unused if not is_copy(view.reason)]
    if len(lost) <= MANY_UNUSED * total:
        return ()
    alike: dict[str, list[tuple[str, str]]] = {}
    for view in lost:
        found, remedy = _found_and_remedy(view.reason or "")
        alike.setdefault(remedy, []).append((view.image, found))
    remedies = sorted(alike.items(), key=lambda one: -len(one[1]))
    reasons = [found for _, found in remedies[0][1]]
    first = "" if len(set(reasons)) == 1 else ", the first"
    why = f"; of {len(reasons)} it is said{first}: {reasons[0]}" if reasons[0] else ""
    copied = len(unused) - len(lost)
    copy = f", {copied} of them as {'a copy' if copied == 1 else 'copies'}" if copied else ""
    do = " ".join(f"{remedy[:1].upper()}{remedy[1:]}: {named([image for image, _ in photos])}." for remedy, photos in remedies)
    return (Advice(f"{len(unused)} of {total} photos are not used{copy}{why}.", do),)


def _found_and_remedy(reason: str) -> tuple[str, str]:
    """What a reason says of a photo, and what to do about it, which stands behind its semicolon; else it is to be shot again."""
    found, _, remedy = reason.rstrip(".").rpartition("; ")
    return (found, remedy) if found else (remedy, "shoot again")


def line_advice(fit: LineCamera, rim_px: float | None = None) -> tuple[Advice, ...]:
    """Of a camera that was calibrated from straight lines: what they leave open, its focal length, and how far they reach. Beyond
    `rim_px` from the centre pixel its photos are dark; None: they show the world up to the border."""
    count, frames = len(fit.photos), sum(photo.frame for photo in fit.photos)
    corner = "three sets of edges at right angles, as the corner of a room or a building has them"
    found = []
    if fit.open_terms:
        found.append(Advice(f"Lines leave open {'; '.join(fit.open_terms)}.", f"Add photos that show {corner}."))
    focal, by_parameters = focal_length(fit.model)
    share = math.sqrt(float(by_parameters @ torch.as_tensor(fit.covariance) @ by_parameters)) / abs(focal)
    left_open = bool(fit.open_terms) and not frames
    if share > ROUGH_FOCAL and not left_open:
        seen = f"{frames} of {count} photos show lines at right angles, which tell it"
        known = f"The focal length is known to {rounded(100 * share)} percent only: {seen}."
        if frames:
            after = 100 * share * math.sqrt(frames / (frames + TEN))
            do = f"Add photos that show {corner}: {TEN} more like these would bring it to about {rounded(after)} percent."
        else:
            do = f"Add photos that show {corner}, or of a board."
        found.append(Advice(known, do))
    edge_deg = math.degrees(float(torch.max(angles_off_axis(fit.model, ImageField(fit.model, rim_px).edge_px))))
    if fit.max_angle_deg < SHORT_REACH * edge_deg:
        far = f"No edge lies beyond {fit.max_angle_deg:.0f} degrees off axis, where the image reaches to {edge_deg:.0f}."
        found.append(Advice(far, "Add photos with long edges along the rim of the image."))
    return tuple(found)


def rig_advice(result: RigCalibration, views: dict[str, NextViews]) -> tuple[Advice, ...]:
    """Of a rig: cameras that are not of it, those that fit worse than alone, its weakest link, and its least known camera."""
    found = []
    for name, reason in result.left_out.items():
        do = f"Hold a board where {name} and {result.members[0].name} see it at the same instant, in a few frames."
        found.append(Advice(f"Camera {name} is not of the rig: {reason.rstrip('.')}.", do))
    for member in result.members:
        if member.misfit is not None:
            one = _of_misfit(member.follows, member.misfit, bool(member.chosen))
            found.append(Advice(f"{member.name}: {one.limit}", REFINE if member.held else one.do))
        elif member.other is not None:
            found.append(Advice(f"{member.name}: {member.other.limit}.", REFINE))
    found += [Advice(note, SEEN_ALONE) for note in result.against_alone.notes]
    if result.unmodelled is not None:
        found.append(Advice(f"{result.unmodelled.limit}.", result.unmodelled.remedy))
    if all(member.other is None for member in result.members):
        found += _worse_than_alone(result) or _noise_of_the_worst(result)
    if result.weakest is not None:
        found.append(_of_link(result, result.weakest))
    if views:
        name, least = max(views.items(), key=lambda one: one[1].worst_px)
        found.append(Advice(f"{name}: {' '.join(least.limits)}", next_photo(least, f"with {name}, ")))
    return tuple(found)


REFINE = (
    "Leave `hold` out, so that it is refined, or calibrate the camera anew: its zoom or focus may be another, or its model "
    "may not suit."
)

SEEN_ALONE = (
    "Calibrate each camera alone and compare. Check that frames of one name are of the same instant, or give videos, by which "
    "clocks are compared."
)


def _worse_than_alone(result: RigCalibration) -> list[Advice]:
    ratio = {m.name: m.rms_px_per_point / m.alone_rms_px_per_point for m in result.members if m.worse}
    worst = max(ratio, key=lambda name: ratio[name], default=None)
    if worst is None:
        return []
    member = result.member(worst)
    px = f"{rounded(member.rms_px_per_point)} px for {rounded(member.alone_rms_px_per_point)}"
    board = "" if result.board_terms else " try `refine_board` surface, which tells a bent board;"
    do = f"See the causes in the notes;{board} look at the photos of {worst} with the largest residuals."
    return [Advice(f"{worst} fits {rounded(ratio[worst])} times worse in the rig than alone ({px}).", do)]


def _noise_of_the_worst(result: RigCalibration) -> list[Advice]:
    """The camera whose corners lie farthest off for what is stated of them."""
    corners = result.corners
    if corners.sigma_px is None or corners.cameras is None:
        return []
    camera = np.array(corners.cameras)[corners.view]
    stated = {m.name: float(np.sqrt(np.mean(corners.sigma_px[result.kept & (camera == m.name)] ** 2))) for m in result.members}
    ratio = {m.name: m.rms_px_per_axis / stated[m.name] for m in result.members if stated[m.name] > 0}
    worst = max(ratio, key=lambda name: ratio[name], default="")
    if not worst or ratio[worst] < UNEXPLAINED:
        return []
    do = _of_noise([view for view in result.views if view.camera == worst], result.board_terms, bool(result.member(worst).chosen))
    return [_unexplained(worst, ratio[worst], stated[worst], do)]


def _of_link(result: RigCalibration, link: Link) -> Advice:
    """The weakest link, and what as many frames more would do for it."""
    first, second = (result.members[k].name for k in (link.first, link.second))
    mm, left = 1e3 * link.translation_sigma_m, math.sqrt(link.frames / (link.frames + TEN))
    limit = (
        f"{first} - {second} is the weakest link: {link.corners} common corners in {link.frames} frames tell where one stands "
        f"from the other to {figure(mm, '.2g', 'mm')} and {figure(link.rotation_sigma_deg, '.2g', 'degrees')}."
    )
    do = (
        f"Hold the board where both see it: {TEN} more frames like these would bring that to about "
        f"{figure(mm * left, '.2g', 'mm')}."
    )
    return Advice(limit, do)
