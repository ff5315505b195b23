"""omnilines rectify: photos resampled into perspective, cylindrical, panoramic and cube views, with their cameras and poses."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, InputError
from camera_models.views import views
from camera_models.wording import listed, rounded
from omnilines.commands.camera_videos import Sizes, cameras_of_videos
from omnilines.commands.result import CommandResult
from omnilines.extraction import ExtractionOptions
from omnilines.files import PhotoRef, find_photos, read_poses
from omnilines.files.cameras import calibration_files, read_cameras
from omnilines.files.colmap_scene import check_colmap_folder
from omnilines.files.folders import WORK, check_output_folder, check_results, check_work_folder
from omnilines.files.photos import require_distinct_stems
from omnilines.files.sets import claimed
from omnilines.pipelines.arcs import SHORT_ARCS
from omnilines.pipelines.pose_tables import require_readable
from omnilines.pipelines.poses import estimate_poses, from_photos, kind_of, require_body
from omnilines.pipelines.rectified import COLMAP_VIEWS, LEVELS, RectifiedViews
from omnilines.pipelines.rectify import rectify as pipeline
from omnilines.pipelines.upright import Level
from omnilines.posing.tools import TITLES
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Detail, ImagePoses, Summary
from omnilines.structure.options import DirectionsOptions


def rectify(
    photos: Sequence[str | Path],
    calibration: str | Path,
    out: str | Path,
    *,
    view: str = "perspective",
    poses: str | Path | None = None,
    body: Path | None = None,
    fov_deg: float | None = None,
    size: tuple[int, int] | None = None,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    distance_m: float | None = None,
    upright: bool = False,
    extraction: ExtractionOptions = SHORT_ARCS,
    options: DirectionsOptions = DirectionsOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write views of photos (PNG) into `out`, with calibration.yaml, where poses are given poses.csv of the views, and of upright
    ones upright.csv: how each is turned, by arcs that are kept in `out/work`.

    `body` is where cameras sit on the body of a trajectory that gives the poses.
    Perspective and cube views with poses are also written as a COLMAP text model, in the folder `colmap`. Raises InputError as
    `pipelines.rectify.rectify` does.
    """
    refs = find_photos(photos)
    cameras = read_cameras(calibration, refs)
    require_distinct_stems(refs)
    table, refs, unposed = _posed(poses, body, refs, cameras)
    asked = {"fov_deg": fov_deg, "yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "distance_m": distance_m}
    folder = Path(out)
    check_output_folder(folder)
    if table is not None and view in COLMAP_VIEWS:
        check_colmap_folder(folder / "colmap", [photo.name for photo in refs])
    read = [*photos, *(photo.path for photo in refs), *calibration_files(calibration)]
    read += [file for file in (poses, body) if file is not None]
    if upright:
        check_results(folder, ["calibration.yaml", LEVELS], read)
        check_work_folder(folder / WORK, read)
    inputs: dict[str, Any] = {"calibration": calibration, "poses": poses, "view": view, **asked}
    if upright:
        inputs |= {"upright": True, "extraction": extraction, "directions": options}
    made = pipeline(
        refs, cameras, view, poses=table, fov_deg=fov_deg, size=size, yaw_deg=yaw_deg, pitch_deg=pitch_deg,
        distance_m=distance_m, upright=upright, work=folder / WORK, extraction=extraction, options=options, inputs=inputs,
        progress=progress,
    )  # fmt: skip
    with claimed(folder, made.names_in(folder), read, by="rectify", kept=made.views_that_stay(folder)):
        result = _result(made, made.save(folder, progress), folder)
    return replace(result, details=(*unposed, *made.left_out), photos=len(refs) + len(unposed))


def _posed(
    given: str | Path | None, body: Path | None, photos: list[PhotoRef], cameras: Calibration
) -> tuple[ImagePoses | None, list[PhotoRef], tuple[Detail, ...]]:
    """The poses given, if any, the photos of which views are made, and of a COLMAP model or another tool's file the photos that
    it could not place."""
    _require_poses(given, body)
    if given is None:
        return None, photos, ()
    if not Path(given).exists() or kind_of(str(given)) == "table":
        return read_poses(given), photos, ()
    posed = estimate_poses(photos, cameras, given, body=body)
    lost = tuple(Detail(name, f"{name} is left out: {why}") for name, why in posed.left_out.items())
    return posed.poses, [photo for photo in photos if photo.name not in posed.left_out], lost


def _require_poses(given: str | Path | None, body: Path | None) -> None:
    """Raises InputError where poses are still to be found in photos, and where a body is given with poses of no trajectory."""
    if given is None and body is not None:
        raise InputError("`body` was expected with `poses` of a trajectory and only there, found no `poses`; leave it out.")
    if given is None:
        return
    if from_photos(str(given)):
        raise InputError(
            f"`poses` was expected as a poses.csv, a COLMAP model's folder, {TITLES}, found {given}, which looks for poses: run "
            f"omnilines reconstruct with --poses {given} first, and give the poses.csv that it writes."
        )
    if Path(given).exists():
        require_body(str(given), body)


def check_videos(
    sizes: Sizes,
    calibration: str | Path,
    view: str,
    *,
    poses: Path | None,
    body: Path | None,
    size: tuple[int, int] | None,
    fov_deg: float | None,
    yaw_deg: float,
    pitch_deg: float,
) -> Calibration:
    """The calibration of videos; refuses a view that is none, and poses that cannot be read, before any frame of them is read.
    Raises InputError."""
    views(view, size, fov_deg, yaw_deg, pitch_deg)
    cameras = cameras_of_videos(calibration, sizes)
    _require_poses(poses, body)
    if poses is not None:
        require_readable(poses)
    return cameras


def _result(made: RectifiedViews, files: tuple[Path, ...], folder: Path) -> CommandResult:
    camera, shown, levels = made.camera, made.shown_share, _levels(made)
    covered = float(np.mean(list(shown.values())))
    rows = (
        ("view", made.view),
        ("camera model", camera.NAME),
        ("image size", f"{'x'.join(map(str, camera.image_size))} px"),
        ("photos", f"{len(made.photos)}, {len(made)} views"),
        ("shown by the photos", f"{100 * covered:.1f} percent of the views"),
        ("written to", str(folder)),
    )
    data = {
        "view": made.view,
        "model": camera.NAME,
        "image_size": list(camera.image_size),
        "parameters": camera.named_parameters(),
        "photos": len(made.photos),
        "views": [one.name for one in made.views],
        "shown_share": covered,
        "upright": [
            {
                "view": name,
                "tilt_deg": math.degrees(level.tilt_rad),
                "sigma_deg": math.degrees(level.sigma_rad),
                "arcs": level.arcs,
            }
            for name, level in levels.items()
        ],
    }
    empty = list(dict.fromkeys(one.target.name or made.view for one in made.views if shown[one.name] == 0))
    black = f"view {empty[0]}; it is" if len(empty) == 1 else f"views {listed(empty)}; they are"
    warnings = (f"The photos show nothing of the {black} black.",) if empty else ()
    turned = tuple((name, _row(level)) for name, level in levels.items())
    upright = (Summary("Upright", turned, (), of_photos=True),) if turned else ()
    return CommandResult((Summary("Views", rows), *upright), data, files=files, warnings=warnings)


def _levels(made: RectifiedViews) -> dict[str, Level]:
    """By the file of the first view of each photo, or instant, that was turned upright."""
    alike = {id(one.level): (one.name, one.level) for one in reversed(made.views) if one.level is not None}
    return dict(reversed(alike.values()))


def _row(level: Level) -> str:
    turn, sigma = math.degrees(level.tilt_rad), math.degrees(level.sigma_rad)
    return f"turned by {turn:.2f} degrees, known to {rounded(sigma)}, by {level.arcs} arcs"
