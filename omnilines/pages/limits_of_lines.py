"""What limits a line scene, arcs, directions and the check of a calibration, as it was measured, and what to do about it."""

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.stats import binom

from camera_models import CameraModel
from camera_models.wording import rounded
from omnilines.calibration.lines.check import LineCheck
from omnilines.pages.limits import named
from omnilines.pages.noise_notes import MANY, WORTH_SAYING
from omnilines.pipelines.advice import more_views, weak_photos
from omnilines.pipelines.check import CheckResult
from omnilines.pipelines.copies import is_copy
from omnilines.pipelines.directions import PhotoDirections
from omnilines.pipelines.photo_arcs import PhotoArcs
from omnilines.pipelines.same_place import is_same_place
from omnilines.pipelines.scene import Scene
from omnilines.pipelines.supposed_errors import SUPPOSED_PX
from omnilines.records import Advice, LengthUnit
from omnilines.report.numbers import figure

STANDS_OUT = 3.0
"""Standard deviation of a camera's place, in those of the median one, from which on its photo is named."""
MANY_WEAK = 0.05
"""Share of the lines from which on those that are weak are spoken of."""
SAMPLE = 2000
"""Lines and photos that are looked at, at most."""
FEW_SHARE = 0.25
"""Of the arcs of the median photo: one with fewer is named."""
MANY_TIMES = 10
"""The photos at hand, of the same kind: so many more are not asked for."""
TO_REFINE = "`refine` lines,poses"
CHECK_IT = "Check the calibration with the same photos: omnilines check."
NOTHING_TO_CHECK = (
    "Stitched panoramas have no calibration to check: give the images of the single lenses with theirs, where there are such."
)


def _check_it(cameras: Iterable[CameraModel]) -> str:
    """How to check the calibration, where there is one."""
    return CHECK_IT if any(camera.CALIBRATED for camera in cameras) else NOTHING_TO_CHECK


def scene_advice(scene: Scene) -> tuple[Advice, ...]:
    """Of lines: whether they are to be trusted, what photos and stages lose, the noise, the scale, weak lines and photos."""
    found = [Advice(f"{check.name[0].upper()}{check.name[1:]}: {figure(check.value, '.3g', check.unit)}, where "
    f"{check.limit:.3g} is "
                    "the limit.", "Check that poses and calibration are of these photos.")
             for check in scene.checks if not check.holds]  # fmt: skip
    of_photos = scene.from_photos
    # Of a rig that stood still, those that are skipped show what others do from the same place: none is to be taken again.
    if of_photos is not None and not of_photos.rig_stood_still:
        found += _skipped(of_photos.skipped, of_photos.given)
    found += [*_contradicted(scene), *_supposed(scene), *scene.advice, *_other_lines(scene)]
    noise, refined = scene.adjusted.adjusted.noise, "poses" in scene.options.refine
    # Of matched segments, advice names photos at fault: until they are put right, residuals say nothing of the calibration.
    single = scene.from_photos is None and bool(scene.advice)
    if noise.stated and not noise.holds and noise.measured > WORTH_SAYING and not single:
        do = _check_it(scene.cameras.cameras.values()) if refined else f"Try {TO_REFINE}."
        limit = (
            f"Arcs lie {rounded(noise.measured)} times as far from their lines as their noise lets expect: poses "
            f"or calibration are off."
        )
        found.append(Advice(limit, do))
    if scene.lines.unit is LengthUnit.OPEN and len(scene.poses) > 1:
        a, b = _farthest_apart(scene)
        scaled = (
            "scale the positions of the poses by it" if scene.from_photos is None else f"give it: `scale_from` {a},{b}:METRES"
        )
        do = f"Measure how far apart {a} and {b} were taken, and {scaled}."
        found.append(Advice("Photos alone do not tell how large the scene is.", do))
    if not scene.camera_stood_still:
        found += [*_weak_lines(scene), *_least_sure_photo(scene)]
    return tuple(found) or _of_number(scene)


def _contradicted(scene: Scene) -> list[Advice]:
    """Cameras that lines or points contradict."""
    moved: dict[str, list[str]] = {}
    for one in scene.contradicted:
        moved.setdefault(one.by, []).append(f"{one.name} {rounded(one.drift_px)} px ({rounded(one.least_px)} at least)")
    if not moved:
        return []
    by = [f"{of}, the cameras move the image by {named(cameras)}" for of, cameras in moved.items()]
    limit = (
        f"{' and '.join(moved).capitalize()} contradict the calibration: adjusted beside {'; beside '.join(by)}. Lines and poses "
        "are off by that, which no standard deviation holds."
    )
    wrong = " If the check bears it out, poses may be wrong, as of photos of repeating things." if "points" in moved else ""
    return [Advice(limit, f"{CHECK_IT} Or refine it: `refine` lines,poses,intrinsics.{wrong}")]


def sigma_with_supposed_m(scene: Scene) -> float:
    """The median sigma of a line with errors of a calibration that states none, where these are more than all that is stated; NaN
    elsewhere."""
    times = 1.0 if scene.supposed is None else scene.supposed.of_lines
    return times * scene.median_sigma_m() if times**2 > 2.0 else math.nan


def _supposed(scene: Scene) -> list[Advice]:
    """Errors of a calibration that states none, where they are more than all that is stated."""
    with_them, unit = sigma_with_supposed_m(scene), scene.lines.unit
    of_photos = None if scene.supposed is None else scene.supposed.of_photos
    lacking = []
    if not math.isnan(with_them):
        lacking.append(f"the sigma of a line is {length(with_them, unit)} in place of {length(scene.median_sigma_m(), unit)}")
    if of_photos is not None and of_photos**2 > 2.0:
        lacking.append(f"places of photos are {rounded(of_photos)} times as uncertain as stated")
    if not lacking:
        return []
    said = (
        f"Uncertainties lack errors of the calibration, which states none: if it is off by {SUPPOSED_PX:g} px (RMS), "
        f"{' and '.join(lacking)}, and more photos do not lower that."
    )
    do = (
        "Calibrate the camera with omnilines calibrate, which states its errors, or state them: "
        "`--set scene.calibration_error_px=PIXELS`."
    )
    return [Advice(said, do)]


def _other_lines(scene: Scene) -> list[Advice]:
    """Of matched segments: far more observations stand out than chance makes, and none was left out."""
    count, every, chance = len(scene.adjusted.suspect), len(scene.segments), scene.options.adjustment.significance
    if scene.from_photos is not None or scene.advice or scene.adjusted.wrong or count <= MANY * every:
        return []
    if binom.sf(count - 1, every, chance) >= chance:
        return []
    said = (
        f"{count} of {every} observations lie farther from their line than {100 * (1 - chance):g} percent should, where chance "
        f"makes {rounded(chance * every)}: they belong to other lines, and draw their line away."
    )
    return [Advice(said, "Give `robust`, which finds observations of other lines and leaves them out.")]


def _farthest_apart(scene: Scene) -> tuple[str, str]:
    """Two photos whose poses are not in doubt, as those of photos are that lines hardly explain, where there are two."""
    images = np.array(scene.poses.images)
    weak = [one.image for one in weak_photos(scene.photos, scene.options.advice.hardly_explained)] if scene.photos else []
    sure = np.flatnonzero(~np.isin(images, weak))
    rows = sure if len(sure) > 1 else np.arange(len(images))
    rows = rows[:: 1 + len(rows) // SAMPLE]
    centres = scene.poses.cam_from_world.centre[rows]
    a, b = divmod(int(torch.cdist(centres, centres).argmax()), len(rows))
    return str(images[rows[a]]), str(images[rows[b]])


def _weak_lines(scene: Scene) -> tuple[Advice, ...]:
    """Lines that cameras see under small angles only, and the photos that show most of them."""
    lines, weak = scene.lines, np.array([status == "weak" for status in scene.lines.status], dtype=bool)
    sure = lines.known & ~weak
    if weak.sum() <= MANY_WEAK * lines.known.sum() or not sure.any():
        return ()
    low, usual = (float(np.median(plane_angles_deg(scene, np.flatnonzero(rows)))) for rows in (weak, sure))
    if not low < usual:
        return ()
    line = line_of_segments(scene)
    image = scene.segments.image[(line >= 0) & weak[line]]
    if not len(image):
        return ()
    most = scene.segments.images[int(np.bincount(image).argmax())]
    said = (
        f"{int(weak.sum())} of {int(lines.known.sum())} lines are weak: their photos see them from within "
        f"{low:.0f} degrees, the others from within {usual:.0f}."
    )
    aside = f"Take a photo far to the side of {most}, or above or below it, which shows most of them"
    return (Advice(said, f"{more_views(scene.poses, aside)}."),)


def line_of_segments(scene: Scene) -> Int[np.ndarray, " s"]:
    """The row of the line that each segment shows; -1 where it shows none."""
    place = {track: k for k, track in enumerate(scene.lines.tracks)}
    of_track = np.array([place.get(track, -1) for track in scene.segments.tracks] + [-1])
    return of_track[scene.segments.track]


def plane_angles_deg(scene: Scene, rows: Int[np.ndarray, " n"]) -> Float[np.ndarray, " k"]:
    """The largest angle between the planes in which two photos see a line: of some lines, a sample where they are many."""
    lines, segments, poses = scene.lines, scene.segments, scene.poses
    rows = rows[:: 1 + len(rows) // SAMPLE]
    row = {image: k for k, image in enumerate(poses.images)}
    of_photo = np.array([row.get(image, -1) for image in segments.images])
    centres = poses.cam_from_world.centre.numpy()
    angle = np.zeros(len(rows))
    photo, shown = of_photo[segments.image], line_of_segments(scene)
    order = np.argsort(shown, kind="stable")
    begins, ends = (np.searchsorted(shown[order], rows, side=side) for side in ("left", "right"))
    for k, (line, begin, end) in enumerate(zip(rows, begins, ends, strict=True)):
        seen = np.unique(photo[order[begin:end]])
        to_ends = lines.ends_m[line] - centres[seen[seen >= 0], None]
        normal = np.cross(to_ends[:, 0], to_ends[:, 1])
        unit = normal / np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-300)
        angle[k] = math.degrees(math.acos(float(np.abs(unit @ unit.T).min(initial=1.0).clip(0.0, 1.0))))
    return angle


def _least_sure_photo(scene: Scene) -> tuple[Advice, ...]:
    """The photo whose place is much less sure than that of the others."""
    covariance = scene.poses.covariance
    if covariance is None or len(scene.poses) < 3:
        return ()
    known = np.isfinite(covariance).all((1, 2))
    back = scene.poses.cam_from_world.rotation.mT.numpy()
    spread = back @ np.nan_to_num(covariance[:, 3:, 3:]) @ back.swapaxes(-1, -2)
    sigma = np.where(known, np.sqrt(np.linalg.eigvalsh(spread)[:, -1].clip(min=0)), 0.0)
    worst, median = int(sigma.argmax()), float(np.median(sigma[known])) if known.any() else 0.0
    if not sigma[worst] > STANDS_OUT * median > 0:
        return ()
    apart = (scene.poses.cam_from_world.centre - scene.poses.cam_from_world.centre[worst]).norm(dim=-1)
    instants = np.array(scene.poses.instants)
    apart[torch.as_tensor(instants == instants[worst])] = math.inf
    if not bool(apart.isfinite().any()):
        return ()
    image, beside = scene.poses.images[worst], scene.poses.images[int(apart.argmin())]
    ratio = sigma[worst] / median
    said = f"{image} is placed {rounded(ratio)} times less surely than half of the photos."
    return (Advice(said, f"Take photos between {image} and {beside}, the nearest to it."),)


def _of_number(scene: Scene) -> tuple[Advice, ...]:
    """Where nothing else limits: what as many photos again would do, or a better calibration."""
    sigma, views, common = scene.median_sigma_m(), scene.lines.views[scene.lines.known], scene.median_calibration_sigma_m()
    if not len(views) or math.isnan(sigma):
        return ()
    if 2.0 * common**2 > sigma**2:
        said = (
            f"Errors of the calibration leave {length(common, scene.lines.unit)} of the {length(sigma, scene.lines.unit)} of the "
            "sigma of a line: more photos do not lower them."
        )
        return (Advice(said, "Calibrate the camera with more photos of a board: its report says where to hold it."),)
    said = (
        f"Nothing stands out but the noise of arcs and the number of photos: half of the lines are seen by "
        f"{np.median(views):.0f} or fewer."
    )
    after = length(math.sqrt(max(0.5 * (sigma**2 - common**2), 0.0) + common**2), scene.lines.unit)
    again = f"As many photos again, from places in between, would bring the sigma of a line to about {after}"
    return (Advice(said, f"{more_views(scene.poses, again)}."),)


def length(value: float, unit: LengthUnit) -> str:
    """In millimetres, or in units where metres are not known."""
    scale = 1e3 if unit is LengthUnit.METRES else 1.0
    return figure(scale * value, ".2g", unit.thousandth if unit is LengthUnit.METRES else unit.sign)


def arcs_advice(arcs: PhotoArcs) -> tuple[Advice, ...]:
    """Of arcs: photos that have far fewer than the others, and photos that were skipped."""
    found = [*_skipped(arcs.skipped, len(arcs.photos))]
    median = float(np.median([len(one) for one in arcs.used])) if arcs.used else 0.0
    few = [f"{one.photo.name} ({len(one)})" for one in sorted(arcs.used, key=len) if len(one) < FEW_SHARE * median]
    if few:
        said = f"{named(few)} {'has' if len(few) == 1 else 'have'} few arcs, where half of the photos have {median:.0f} or more."
        do = "Look at the pictures: what is dark, blurred or without straight edges gives none. Take it again or leave it out."
        found.append(Advice(said, do))
    return tuple(found)


def _skipped(skipped: Mapping[str, str], given: int) -> tuple[Advice, ...]:
    """Photos of those given that could not be used, with the reason of each; copies, and what shows the same from the same place,
    are not missed."""
    skipped = {name: reason for name, reason in skipped.items() if not (is_copy(reason) or is_same_place(reason))}
    if not skipped:
        return ()
    name, reason = next(iter(skipped.items()))
    are, them = ("is", "it") if len(skipped) == 1 else ("are", "them")
    said = f"{len(skipped)} of {given} photos {are} skipped; of {name} it is said: {reason.rstrip('.')}."
    return (Advice(said, f"Give {named(list(skipped))} anew, or leave {them} out."),)


def directions_advice(found: PhotoDirections) -> tuple[Advice, ...]:
    """Of directions: photos in which none stands out, and lines that are less parallel than their noise explains."""
    told = []
    some, none = ([one for one in found.photos if bool(len(one)) is has] for has in (True, False))
    if none:
        arcs = [float(np.median([len(one.arcs) for one in rows])) if rows else 0.0 for rows in (none, some)]
        few = bool(some) and arcs[0] < FEW_SHARE * arcs[1]
        count = f"they have {arcs[0]:.0f} arcs (median)" + (f", the others {arcs[1]:.0f}" if some else "")
        do = (
            "Take sharper or larger photos of the same."
            if few
            else "Take photos that show more edges of what is built: their lines do not meet."
        )
        photos = named([one.arcs.photo.name for one in none])
        told.append(
            Advice(f"No {found.wanted.value} stands out in {len(none)} of {len(found.photos)} photos: {photos}; {count}.", do)
        )
    if some:
        stray = math.degrees(float(np.median([one.meeting.stray_rad for one in some])))
        sigma = math.degrees(float(np.median(np.concatenate([one.meeting.sigma_rad for one in some]))))
        if stray > sigma:
            said = (
                f"Lines differ from their direction by {rounded(stray)} degrees (median) beyond what their arcs' noise explains."
            )
            check = _check_it(found.arcs.cameras[one.arcs.camera] for one in some)
            told.append(Advice(said, f"{check} If that is not the cause, what was photographed is not more parallel."))
    return tuple(told)


def check_advice(result: CheckResult, given: Sequence[str] = ()) -> tuple[Advice, ...]:
    """Of a check: where the camera is off most surely, or what the photos could not tell. `given` as in `check_summaries`."""
    found = result.found
    if not result.holds:
        worst = max(found.regions, key=lambda one: one.least_px if math.isfinite(one.least_px) else -1.0)
        ratio = np.abs(found.change) / np.where(found.change_sigma > 0, found.change_sigma, np.inf)
        name = found.model.PARAMETER_NAMES[int(ratio.argmax())]
        clearest = f"parameter {name} is off most clearly, by {rounded(ratio.max())} sigma."
        where = f"It is off most surely at the {worst.name} of the image, by at least {rounded(worst.least_px)} px"
        said = f"{where}; the {clearest}" if worst.least_px > 0 else f"The {clearest}"
        again = _calibrate_again(found.model, given or (str(result.inputs.get("photos") or "PHOTOS"),))
        return (Advice(said, f"Calibrate the camera again, with a board, or from these photos by: {again}"),)
    told = []
    if not found.frames:
        said = "No photo shows lines at right angles: nothing tells whether the focal length still holds."
        told.append(Advice(said, "Add photos of the corner of a room or a building, where edges meet at right angles."))
    if found.sigma_px > result.options.tolerance_px:
        need = math.ceil(len(result.images) * (found.sigma_px / result.options.tolerance_px) ** 2)
        asked = f"where {result.options.tolerance_px:g} px are asked for"
        said = f"{len(result.images)} photos tell the camera to {rounded(found.sigma_px)} px only, {asked}."
        few = need <= MANY_TIMES * len(result.images)
        told.append(Advice(said, f"About {need} photos like these would tell it." if few else _other_photos(found)))
    unseen = [one.name for one in found.regions if not one.edges]
    if unseen:
        told.append(
            Advice(f"No edges lie at the {named(unseen)} of the image: nothing tells of it.", "Add photos with long edges there.")
        )
    return tuple(told)


def _calibrate_again(model: CameraModel, given: Sequence[str]) -> str:
    """The command that calibrates a camera of the same model from the lines of the photos given."""
    looks_back = model.AXIS_SIGN_OPEN and float(model.unproject(model.centre_px)[0][2]) < 0
    mirror = ("--mirror",) if looks_back else ()
    words = ("omnilines", "calibrate", *given, "--pattern", "lines", "--model", model.NAME, *mirror, "--out", "calibrated_again")
    return shlex.join(words)


def _other_photos(found: LineCheck) -> str:
    """Of which kind photos are that help where more of the same do not."""
    seen = [one for one in found.regions if math.isfinite(one.sigma_px)]
    least = max(seen, key=lambda one: one.sigma_px)
    known = f"least is known at the {least.name} of the image ({rounded(least.sigma_px)} px)"
    return (
        f"More photos like these hardly help: {known}. Add photos with long edges there, and of corners of buildings or rooms "
        "with the camera tilted, so that edges in three directions at right angles are seen."
    )
