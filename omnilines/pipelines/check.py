"""Is a calibration still right? Photos of anything with straight lines say it: `check`."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from camera_models import Calibration, CameraModel, GeometryError, InputError
from camera_models.typed import typed
from camera_models.wording import listed, rounded
from omnilines.calibration.lines.check import LineCheck, line_check
from omnilines.files import Photos, photo_folder, photos_of
from omnilines.files.masks import Mask, check_masks, with_masks
from omnilines.files.sets import claimed
from omnilines.files.tables import name_cells, number_cells, write_table
from omnilines.options import require_ranges
from omnilines.pipelines.arc_chains import arc_chains_of
from omnilines.pipelines.arcs import calibration_of, cameras_of_photos, known_angles_rad
from omnilines.pipelines.check_options import CheckOptions
from omnilines.pipelines.line_scale import asked_by_lines
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Detail

CHECK = "check.csv"


@dataclass(frozen=True, eq=False)
class CheckResult:
    """What the lines of photos say of a calibration."""

    found: LineCheck
    """All figures."""
    holds: bool
    """Whether the calibration is borne out: chance explains what lines ask for, or it is too little to mind."""
    options: CheckOptions
    images: tuple[str, ...]
    """Photos that were used."""
    skipped: tuple[Detail, ...]
    """Photos that were left out, and why."""
    inputs: Mapping[str, Any]
    """What it was made from."""
    notes: tuple[str, ...] = ()
    """What a person should know."""

    def __repr__(self) -> str:
        return f"CheckResult(holds={self.holds}, photos={len(self.images)}, {self.verdict!r})"

    @property
    def hardly_known(self) -> bool:
        """Whether lines leave so much of the camera open that its drift has only a least size."""
        return not self.found.sigma_px <= _most_sigma_px(self.found.model, self.options)

    @property
    def verdict(self) -> str:
        """One sentence."""
        found = self.found
        freedom = f"{found.freedom} and {found.samples:.0f} degrees of freedom"
        chance = f"probability {found.probability:.1g} of so much by chance, Hotelling's T^2 {found.statistic:.0f} with {freedom}"
        allowed = f"{self.options.tolerance_px:g} px"
        if not self.holds:
            return (
                f"The calibration is not right any more: over the image (root mean square) it is off by {self._drift_words}; "
                f"{allowed} are allowed ({chance})."
            )
        if found.probability < self.options.significance:
            return (
                f"These photos bear out a calibration within {allowed} of this one, which over the image (root mean square) is "
                f"off by {self._drift_words} ({chance})."
            )
        return f"The calibration is right as far as these photos tell, to {rounded(found.sigma_px)} px over the image ({chance})."

    @property
    def confidence(self) -> str:
        """With which the camera is off by the least drift or more."""
        return f"{100 * (1 - self.options.significance):g} percent confidence"

    @property
    def _drift_words(self) -> str:
        """What is sure of the drift first: its noise is that of what lines tell least, which may hide what they tell best."""
        found = self.found
        least = f"at least {rounded(found.least_drift_px)} px with {self.confidence}"
        if self.hardly_known:
            return f"{least} (how much more, these photos leave open)"
        if found.drift_px > max(found.least_drift_px, found.sigma_px):
            return f"{least}, most likely by {rounded(found.drift_px)} px (known to {rounded(found.sigma_px)} px)"
        return f"{least} (how much more, these photos tell to {rounded(found.sigma_px)} px only)"

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        return (CHECK,)

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write check.csv, a row for each ninth of the image, into a folder, which is made; the files written."""
        regions = self.found.regions
        with claimed(folder, self.file_names, by="check") as out:
            path = out / CHECK
            columns = {"region": name_cells([one.name for one in regions], None, path, "region")}
            columns["edges"] = [str(one.edges) for one in regions]
            for name in ("rms_px", "drift_px", "sigma_px", "least_px"):
                values = np.array([getattr(one, name) for one in regions])
                columns[name] = ["" if math.isnan(v) else number_cells(np.array([v]), path, name)[0] for v in values]
            write_table(path, columns)
        return (Path(folder) / CHECK,)


@typed
def check(
    photos: Photos,
    camera: CameraModel | Calibration,
    options: CheckOptions = CheckOptions(),
    *,
    mask: Mask | None = None,
    work: str | Path | None = None,
    progress: ProgressCallback = silent,
) -> CheckResult:
    """Whether photos of buildings, rooms or anything else with straight lines bear out the calibration of one camera.

    Lines have to be straight over the whole image, parallel ones to meet, and right angles to be right. Only what `mask`
    shows is looked at, as in `extract`. Of a calibration of several cameras, the one is checked that a folder of the photos is
    named like. The edges of each photo are kept in the folder `work`, where one is given. Where the calibration states a
    covariance, what it allows is no contradiction.

    Raises InputError for photos of several cameras or of none that is known, a camera without parameters, and where no photo can
    be used, and GeometryError where too few edges are straight, or lines leave more open than `most_sigma_share` of the image.

        >>> ol.check("room/", ol.load("room/calibration.yaml")).holds
        True
    """
    require_ranges(options)
    cameras, given = calibration_of(camera), photos_of(photos)
    shown = dict.fromkeys(cameras_of_photos(given, cameras).values())
    if len(shown) != 1:
        raise InputError(f"Photos of one camera were expected, found those of {listed(shown)}; check each with its own photos.")
    (name,) = shown
    model = cameras[name]
    if not model.CALIBRATED:
        raise InputError(f"A camera model with parameters was expected, found {model.NAME}; there is nothing to check.")
    refs, estimate = with_masks(given, mask), cameras.estimates.get(name)
    check_masks(refs, {photo.name: model.image_size for photo in refs})
    lines = options.lines
    known_rad = known_angles_rad(estimate)
    chains, skipped = arc_chains_of(refs, model, lines.extraction, known_rad=known_rad, work=work, progress=progress)
    asked, notes = asked_by_lines(model, chains, lines, progress)
    known = None if estimate is None or estimate.covariance is None else torch.as_tensor(estimate.covariance)
    found = line_check(model.calibrated_form(), asked, known, significance=options.significance)
    inputs = {"photos": photo_folder(refs), "check": options}
    holds = not found.refused(options.significance, options.tolerance_px)
    result = CheckResult(found, holds, options, chains.images, skipped, inputs, notes)
    # What chance does not leave open refuses a camera, however little of it lines tell.
    contradicted = not holds and found.least_drift_px > options.tolerance_px
    if result.hardly_known and not contradicted:
        why = f" {notes[0]}" if notes else " Give more photos, with long edges in several directions all over the image."
        raise GeometryError(
            f"Lines that tell where the camera projects to {rounded(_most_sigma_px(model, options))} px were expected, found "
            f"that they leave {rounded(found.sigma_px)} px open, of which nothing follows.{why}"
        )
    return result


def _most_sigma_px(model: CameraModel, options: CheckOptions) -> float:
    """That lines may leave open."""
    return options.most_sigma_share * math.hypot(*model.image_size)
