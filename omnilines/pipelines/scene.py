"""A line scene: lines and poses with their uncertainty, what they came from, and the files that hold them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, CameraEstimate, save
from camera_models.formats.calibration_data import RigCamera
from camera_models.typed import typed
from omnilines.adjustment.scene import AdjustedScene
from omnilines.files import write_covariance, write_lines, write_ply, write_poses, write_segments
from omnilines.files.obj import write_obj
from omnilines.files.scene_folder import UNIT_KEY, UP_KEY, Z_UP
from omnilines.files.sets import claimed
from omnilines.pipelines.asked_cameras import AskedCamera
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.pages import claimed_report
from omnilines.pipelines.supposed_errors import SupposedErrors
from omnilines.provenance import provenance
from omnilines.records import Advice, Check, Detail, ImagePoses, Lines, PhotoCount, Segments, StageCount
from omnilines.structure.families import Families

SCENE = "scene"
"""The set that the files of a scene are."""
SCENE_FILES = ("calibration.yaml", "poses.csv", "segments.csv", "lines.csv", "covariance.npz", "lines.ply")


@dataclass(frozen=True)
class FromPhotos:
    """What is known of a scene whose lines were matched in photos."""

    folder: Path | None
    """That names of photos are relative to; None of photos in memory."""
    given: int
    """Number of photos, those that were skipped included."""
    skipped: Mapping[str, str]
    """Why photos could not be used, by name."""
    stages: tuple[StageCount, ...]
    """What every stage kept and dropped."""
    photos: tuple[PhotoCount, ...]
    """What became of the arcs of each photo."""
    tolerance_px: float
    """Standard deviation that arcs were given beyond their own, for errors of poses and calibration."""
    bow_share: float
    """That they were given besides, over their length, for edges that are not quite straight."""
    families: Families
    """Of parallel lines."""
    still_share: float
    """Share of the arcs in no line that do not move in the image, while the lines do; NaN where that cannot be told, and where
    poses are found from all that photos show."""
    rig_stood_still: bool
    """Whether the instants of a rig, whose poses are found so, are at one place."""


@dataclass(frozen=True)
class Scene:
    """3D lines with the poses and cameras that see them."""

    adjusted: AdjustedScene
    """Lines and poses with their residuals and noise, and the lines as they were triangulated."""
    segments: Segments
    """The arcs, with the line of each."""
    cameras: Calibration
    """As they were refined."""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What the scene was made from."""
    told: tuple[str, ...] = ()
    """What a person should know of how it was made, one sentence each."""
    details: tuple[Detail, ...] = ()
    """And of photos that could not be used."""
    from_photos: FromPhotos | None = None
    options: SceneOptions = SceneOptions()
    checks: tuple[Check, ...] = ()
    """Figures beside their limits: where one does not hold, the lines are not those of the photos."""
    advice: tuple[Advice, ...] = ()
    """What photos and stages of matching lose, or which photos segments do not fit, and what to do."""
    asked: tuple[AskedCamera, ...] = ()
    """What lines, and points of structure from motion, ask of the cameras that they were found with; nothing where cameras were
    refined."""
    supposed: SupposedErrors | None = None
    """What errors of the calibration would make of uncertainties that lack them, where its file states none."""
    up: tuple[float, float, float] = Z_UP
    """The direction (unit) of the world that is up; z where neither photos nor the scene that poses are of say it."""

    def __repr__(self) -> str:
        return f"Scene({self.lines}, {self.poses}, {self.segments})"

    @property
    def contradicted(self) -> tuple[AskedCamera, ...]:
        """Cameras that lines or points contradict."""
        own = self.options.advice
        slack_px = own.detector_error_px if self.from_photos is None else self.from_photos.tolerance_px
        return tuple(one for one in self.asked if one.least_px > own.calibration_slack * slack_px)

    @property
    def lines(self) -> Lines:
        """`ends_m` (n, 2, 3), `covariance` (n, 4, 4) in the line chart, `sigma_m`, `status`, ..."""
        return self.adjusted.lines

    @property
    def poses(self) -> ImagePoses:
        """`cam_from_world` of the photos, with `covariance` (n, 6, 6) where poses were refined."""
        return self.adjusted.poses

    @property
    def stages(self) -> tuple[StageCount, ...]:
        """What every stage kept and dropped; nothing where segments were matched already."""
        return () if self.from_photos is None else self.from_photos.stages

    @property
    def photos(self) -> tuple[PhotoCount, ...]:
        """What became of the arcs of each photo; nothing where segments were matched already."""
        return () if self.from_photos is None else self.from_photos.photos

    @property
    def families(self) -> Families | None:
        """Families of parallel lines, where they were looked for."""
        return None if self.from_photos is None else self.from_photos.families

    @property
    def camera_stood_still(self) -> bool:
        """Whether the camera stood still while a board was moved that its poses come from, or the rig while photos were taken."""
        of_photos = self.from_photos
        return of_photos is not None and (of_photos.rig_stood_still or of_photos.still_share > self.options.advice.still)

    @property
    def notes(self) -> tuple[str, ...]:
        """All that a person should know of the scene, one sentence each."""
        from omnilines.pages.scene import scene_summary

        summary = scene_summary(self)
        said = (f"{one.limit} {one.do}" for one in summary.advice)
        return (*(one.text for one in self.details), *self.told, *said, *summary.notes)

    @property
    def provenance(self) -> dict[str, Any]:
        """Software, what the scene was made from, the unit of its lengths and which way is up."""
        return {**provenance(self.inputs), UNIT_KEY: self.lines.unit.sign, UP_KEY: list(self.up)}

    def median_sigma_m(self) -> float:
        """Median of the largest standard deviation of a line's ends across it; NaN where none is known."""
        known = self.lines.sigma_m[np.isfinite(self.lines.sigma_m)]
        return float(np.median(known)) if len(known) else float("nan")

    def median_calibration_sigma_m(self) -> float:
        """What of that is for errors of the calibration; 0 where they are not known."""
        sigma = self.lines.calibration_sigma_m
        known = np.zeros(0) if sigma is None else sigma[np.isfinite(sigma)]
        return float(np.median(known)) if len(known) else 0.0

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write the scene folder (docs/reconstruction.md) but for the report; the files written. Raises InputError where one
        cannot be."""
        with claimed(folder, self.file_names, by=SCENE) as out:
            paths = [out / name for name in self.file_names]
            save(paths[0], replace(self.cameras, provenance=self.provenance))
            write_poses(paths[1], self.poses)
            write_segments(paths[2], self.segments)
            write_lines(paths[3], self.lines)
            write_covariance(paths[4], self.poses, self.lines)
            write_ply(paths[5], self.lines, camera_centres_m=self.poses.cam_from_world.centre.numpy())
            if self.from_photos is not None:
                write_obj(paths[6], self.lines)
        return tuple(paths)

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        return SCENE_FILES if self.from_photos is None else (*SCENE_FILES, "lines.obj")

    @typed
    def report(self, path: str | Path, *, plots: str | Path | None = None) -> Path:
        """Write the report, one self-contained HTML file; its path. Its figures
        are written as PNG and SVG into the folder `plots`, where one is given."""
        from omnilines.pages.scene import scene_sections
        from omnilines.report import write_report

        with claimed_report(path, plots):
            return write_report(path, "Line scene", scene_sections(self))


def refined_calibration(scene: AdjustedScene, cameras: Calibration) -> Calibration:
    """The calibration with the cameras and the rig as they were refined, and with their uncertainty."""
    models, estimates, rig = dict(cameras.cameras), dict(cameras.estimates), dict(cameras.rig)
    for name, model, covariance in zip(models, scene.cameras, scene.adjusted.camera_covariance, strict=False):
        models[name] = model
        sigma = covariance.diagonal().clamp_min(0).sqrt().tolist()
        named = dict(zip(model.PARAMETER_NAMES, sigma, strict=True))
        # The residuals of a calibration are those of its own corners.
        known = replace(estimates.get(name, CameraEstimate()), rms_px_per_axis=None, rms_px_per_point=None)
        estimates[name] = replace(known, sigma=named, covariance=covariance.numpy())
    if scene.cam_from_rig is not None and scene.adjusted.rig_covariance is not None:
        sigmas = scene.adjusted.rig_covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt().numpy()
        rig = {name: RigCamera(scene.cam_from_rig[k], sigmas[k]) for k, name in enumerate(rig)}
    return Calibration(models, estimates, rig, cameras.views)
