"""omnilines calibrate with several cameras: folders of photos or corners.csv -> calibration.yaml with the rig, report.html."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from camera_models import Calibration, CameraEstimate, CameraModel, InputError, load, model_class, save
from camera_models.formats.calibration_data import RigCamera
from omnilines.calibration.rig.alone import AUTO, CameraSetup
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.views import BOARDS
from omnilines.commands.calibrate import calibration_record, view_record
from omnilines.commands.result import CommandResult
from omnilines.files import write_corners
from omnilines.files.folders import check_output_folder, output_folder
from omnilines.least_squares import Loss, Progress
from omnilines.pages.rig import rig_data, rig_sections, rig_summaries
from omnilines.pipelines.rig_search import searched_with_rig
from omnilines.pipelines.rig_sources import RigSource, is_rig, rig_from_photos, rig_from_table
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.report import write_report

__all__ = ["RigOptions", "calibrate_rig_corners", "calibrate_rig_photos", "is_rig"]


@dataclass(frozen=True)
class RigOptions:
    """What a user can ask of the calibration of a rig. Mappings go by camera, "" standing for all others."""

    models: Mapping[str, str] = field(default_factory=lambda: {"": "scaramuzza"})
    degree: int | None = None
    coefficients: int | None = None
    loss: str = "cauchy"
    mirror: bool = False
    boards: str = "fixed"
    calibration: Path | None = None
    """Existing calibrations, by camera name, to begin from."""
    hold: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot work before any photo is looked at."""
        for name in self.models.values():
            if name != AUTO:
                model_class(name)
        Loss(self.loss)
        if self.boards not in BOARDS:
            raise InputError(f"--boards is one of {', '.join(BOARDS)}, found '{self.boards}'; choose one of these.")
        if self.hold and self.calibration is None:
            raise InputError("--hold holds the cameras of --calibration, found no --calibration; give the file.")
        if self.degree is not None and self.degree < 2:
            raise InputError(f"--degree was expected to be at least 2, found {self.degree}; leave it out to have it chosen.")

    def model_of(self, camera: str) -> str:
        """The camera model that is to be fitted."""
        return self.models.get(camera, self.models.get("", "scaramuzza"))

    def known(self, cameras: Sequence[str]) -> Mapping[str, CameraModel]:
        """The existing calibrations by camera. Raises InputError where they, or a model, are of none of the rig's cameras."""
        found: Mapping[str, CameraModel] = {} if self.calibration is None else load(self.calibration)
        for kind, names in (("--model", self.models), (str(self.calibration), found)):
            unknown = [name for name in names if name and name not in cameras]
            if unknown and not (kind != "--model" and set(names) & set(cameras)):
                raise InputError(
                    f"{kind}: cameras among {', '.join(cameras)} were expected, found '{unknown[0]}'; correct the name."
                )
        return found

    def setups(self, image_sizes: Mapping[str, tuple[int, int]]) -> dict[str, CameraSetup]:
        """What is to be done with every camera. Raises InputError where a name or an image size does not fit."""
        given = {"degree": self.degree, "coefficients": self.coefficients}
        options = {name: value for name, value in given.items() if value is not None}
        known = self.known(tuple(image_sizes))
        found = {}
        for name, size in image_sizes.items():
            start = known.get(name)
            if start is not None and start.image_size != size:
                raise InputError(
                    f"{self.calibration}: camera {name} was expected with images of {size[0]}x{size[1]} px, found "
                    f"{start.image_size[0]}x{start.image_size[1]} px; give the calibration of these photos."
                )
            found[name] = CameraSetup(size, self.model_of(name), options, start, self.hold and start is not None, self.mirror)
        return found


def calibrate_rig_photos(
    folder: Path,
    pattern_specs: Sequence[str],
    out: Path,
    options: RigOptions | None = None,
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate a rig from a folder with one sub-folder of photos per camera; photos of the same name are of the same instant.

    The rig then leads to corners and boards that were missed, and is calibrated once more with them.
    Raises InputError or GeometryError with one sentence.
    """
    options = options or RigOptions()
    if options.boards == "known":
        raise InputError(
            "--boards known was expected with a corners.csv that has all boards in one frame, found photos; give fixed or moving."
        )
    check_output_folder(out)
    cameras = [path.name for path in sorted(folder.iterdir()) if path.is_dir()]
    options.known(cameras)
    mirrors = [name for name in cameras if options.model_of(name) in (AUTO, "scaramuzza")]
    source = rig_from_photos(folder, pattern_specs, mirrors, options.mirror, progress)
    result = _calibrated(source, options, progress)
    again = searched_with_rig(source, result, progress)
    if again is not None:
        source, result = again, _calibrated(again, options, progress)
    return _written(source, result, out, progress)


def calibrate_rig_corners(
    corners_csv: Path,
    image_sizes: Mapping[str, tuple[int, int]],
    out: Path,
    options: RigOptions | None = None,
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate a rig from a table of corners with a column `camera` (and `frame`, `board`); `image_sizes` by camera, "" standing
    for all others.

    Raises InputError naming file, line and column where the table is malformed, and GeometryError where the rig is left open.
    """
    source = rig_from_table(corners_csv, image_sizes)
    return _written(source, _calibrated(source, options or RigOptions(), progress), out, progress)


def _calibrated(source: RigSource, options: RigOptions, progress: ProgressCallback) -> RigCalibration:
    def tell(stage: str, step: Progress) -> None:
        progress(stage, step.iteration, 0)

    return calibrate_rig(
        source.corners,
        options.setups(source.image_sizes),
        relation=options.boards,
        loss=options.loss,
        numberings=source.numberings,
        seen_from_front=source.seen_from_front,
        callback=tell,
    )


def _written(source: RigSource, result: RigCalibration, out: Path, progress: ProgressCallback) -> CommandResult:
    remarks = source.remarks
    views = tuple(
        replace(view, remarks=(*view.remarks, remarks[view.name])) if view.used and view.name in remarks else view
        for view in result.views
    )
    result = replace(result, views=views + source.skipped, notes=source.notes + result.notes)
    folder = output_folder(out)
    files = [folder / name for name in ("calibration.yaml", "corners.csv", "covariance.npz")]
    save(files[0], rig_record(result, source.inputs))
    write_corners(files[1], result.as_given()[0])
    np.savez(files[2], name=np.array(result.names), covariance=result.covariance)
    for name, single in result.left_out_alone.items():
        files.append(folder / f"calibration-{name}.yaml")
        save(files[-1], calibration_record(single, False, source.inputs))
    progress("writing the report", 0, 0)
    summaries = rig_summaries(result)
    title = f"Calibration of a rig of {len(result.members)} cameras"
    report = write_report(folder / "report.html", title, rig_sections(result, summaries, source.photo_folder))
    warnings = tuple(f"{view.camera} {view.name}: {view.reason}" for view in result.views if not view.used)
    warnings += tuple(f"{view.camera} {view.name}: {remark}" for view in result.views for remark in view.remarks) + result.notes
    return CommandResult(summaries, rig_data(result), files=(*files, report), report=report, warnings=warnings)


def rig_record(result: RigCalibration, inputs: Mapping[str, str | Path]) -> Calibration:
    """What `calibration.yaml` holds of a rig. Views of cameras that are not of the rig are left out."""
    estimates = {
        member.name: CameraEstimate(
            sigma=member.sigma,
            covariance=member.covariance,
            max_angle_deg=member.max_angle_deg,
            min_angle_deg=member.min_angle_deg,
            rms_px_per_axis=member.rms_px_per_axis,
            rms_px_per_point=member.rms_px_per_point,
            sign_source=member.sign_source,
        )
        for member in result.members
    }
    rig = {
        member.name: RigCamera(member.cam_from_rig, np.sqrt(np.diag(member.pose_covariance)), member.pose_covariance)
        for member in result.members
    }
    views = tuple(view_record(view) for view in result.as_given()[1] if view.camera in rig)
    models = {member.name: member.model for member in result.members}
    return Calibration(models, estimates, rig if len(rig) > 1 else {}, views, provenance(inputs))
