"""omnilines experiment board: the dissertation's fisheye experiment on photos of one's own.

Calibrate from the photos, take the rows and columns of the board as lines, perturb the poses, triangulate, adjust, and compare
with the board before and after.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camera_models import CameraModel, InputError, save
from camera_models.pose import Pose
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import adjust_lines, drop_unknown
from omnilines.calibration.board_lines import board_lines
from omnilines.calibration.record import calibration_record
from omnilines.calibration.single import CameraCalibration, calibrate_camera
from omnilines.commands.result import CommandResult
from omnilines.files import (
    read_corners,
    read_photo,
    write_corners,
    write_lines,
    write_ply,
    write_poses,
    write_segments,
)
from omnilines.files.folders import output_folder
from omnilines.least_squares import Progress
from omnilines.pages.board import board_checks, board_data, board_sections, board_summaries, scene_tables
from omnilines.pipelines.detect import PhotoCorners, detect
from omnilines.progress import ProgressCallback, silent
from omnilines.records import ImagePoses
from omnilines.report import write_report
from omnilines.studies.board_figures import BoardExperiment, measure
from omnilines.triangulation import triangulate
from omnilines.triangulation.observations import PlaneObservations

DEGREE = 4
"""Of the polynomial, as in the dissertation."""


def experiment_board(
    data: str | Path,
    out: str | Path,
    *,
    pattern_spec: str = "checkerboard:8x6:32.5mm",
    model: str = "scaramuzza",
    perturb_deg: float = 1.0,
    perturb_m: float = 0.01,
    seed: int = 0,
    triangulation: str = "dual",
    triangulation_options: Mapping[str, Any] | None = None,
    cost: str = "sector",
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Run the experiment on a folder of photos of a plane target, or on a folder that holds a corners.csv of one.

    In the latter `pattern_spec` is not used: the board is that of the table. Its photos are looked for in `images`, its image
    size in `reference.json` (key image_size) or in the photos. Every pose is turned by `perturb_deg` about a random axis through
    its camera and its camera shifted by `perturb_m` in a random direction.

    Raises InputError for unusable data or options and GeometryError where boards or lines determine nothing.
    """
    if not (math.isfinite(perturb_deg) and math.isfinite(perturb_m) and perturb_deg >= 0 and perturb_m >= 0):
        raise InputError(f"A perturbation of at least 0 degrees and 0 m was expected, found {perturb_deg} and {perturb_m}.")
    found = _corners_of(Path(data), pattern_spec, progress)
    inputs = {"data": data, "pattern": pattern_spec, "perturb_deg": perturb_deg, "perturb_m": perturb_m}

    def tell(step: Progress) -> None:
        progress("refining the camera", step.iteration, 0)

    options = {"degree": DEGREE} if model == "scaramuzza" else {}
    calibration = calibrate_camera(found.corners, found.image_size, model, options=options, callback=tell)
    calibration = replace(calibration, views=calibration.views + found.skipped)
    experiment = run_experiment(
        found,
        calibration,
        perturb_deg=perturb_deg,
        perturb_m=perturb_m,
        seed=seed,
        triangulation=triangulation,
        triangulation_options=triangulation_options,
        cost=cost,
        progress=progress,
    )
    folder = output_folder(out)
    files = _write(folder, experiment, inputs, seed)
    progress("writing the report", 0, 0)
    photo_folder = found.photo_folder if found.photo_folder and found.photo_folder.is_dir() else None
    page = write_report(
        folder / "report.html", "Board lines before and after adjustment", board_sections(experiment, photo_folder)
    )
    warnings = tuple(f"{view.image}: {view.reason}" for view in calibration.views if not view.used) + experiment.notes
    return CommandResult(
        board_summaries(experiment), board_data(experiment, seed), board_checks(experiment), (*files, page), page, warnings
    )


def run_experiment(
    found: PhotoCorners,
    calibration: CameraCalibration,
    *,
    perturb_deg: float,
    perturb_m: float,
    seed: int,
    triangulation: str = "dual",
    triangulation_options: Mapping[str, Any] | None = None,
    cost: str = "sector",
    progress: ProgressCallback = silent,
) -> BoardExperiment:
    """Perturb, triangulate, adjust and measure; raises as `experiment_board`."""
    board = board_lines(found.corners, calibration.kept)
    poses = _poses(calibration)
    perturbed = replace(poses, cam_from_world=perturbed_poses(poses.cam_from_world, perturb_deg, perturb_m, seed))
    cameras: dict[str, CameraModel] = {"cam0": calibration.model}
    table = arcs_from_segments(board.segments, perturbed, cameras)
    progress("triangulating", 0, 0)
    start = perturbed.cam_from_world
    planes = PlaneObservations.from_arcs(table.arcs.bearings, start[table.arcs.image], table.arcs.track, table.arcs.tracks)
    first = triangulate(triangulation, planes, **(triangulation_options or {}))
    arcs, tracks = drop_unknown(table.arcs, first.known)
    ends, column = torch.as_tensor(board.ends_m)[tracks], torch.as_tensor(board.column)[tracks]
    if min(int(column.sum()), int((~column).sum())) < 2:
        raise InputError(
            f"At least 2 rows and 2 columns with a line were expected, found {int((~column).sum())} and {int(column.sum())}; "
            "perturb the poses less or give more photos."
        )

    def tell(step: Progress) -> None:
        progress("adjusting lines and poses", step.iteration, 0)

    adjusted = adjust_lines(arcs, first.lines[tracks], start, cost=cost, callback=tell)
    return BoardExperiment(
        found.corners,
        calibration,
        board,
        perturbed,
        first.status_names,
        arcs,
        tracks,
        adjusted,
        measure(arcs, first.lines[tracks], start, ends, column),
        measure(arcs, adjusted.state.chart.lines(), adjusted.state.cam_from_world, ends, column),
        cost,
    )


def perturbed_poses(cam_from_world: Pose, angle_deg: float, shift_m: float, seed: int) -> Pose:
    """Cameras turned about random axes through their centres and shifted in random directions, by fixed amounts."""
    rng = np.random.default_rng(seed)
    random = torch.as_tensor(rng.standard_normal((2, len(cam_from_world), 3)))
    axis, direction = (random / random.norm(dim=-1, keepdim=True)).unbind(0)
    turn = Pose.exp(torch.cat([math.radians(angle_deg) * axis, torch.zeros_like(axis)], -1)).rotation
    rotation = turn @ cam_from_world.rotation
    centre: Tensor = cam_from_world.centre + shift_m * direction
    return Pose(rotation, -(rotation @ centre[..., None])[..., 0])


def _poses(calibration: CameraCalibration) -> ImagePoses:
    used = [(view.image, view.cam_from_board) for view in calibration.views if view.used and view.cam_from_board is not None]
    return ImagePoses(tuple(image for image, _ in used), Pose.stack([pose for _, pose in used]), ("cam0",) * len(used))


def _corners_of(data: Path, pattern_spec: str, progress: ProgressCallback) -> PhotoCorners:
    """Corners from `corners.csv` where there is one, else from the photos."""
    path = data / "corners.csv" if data.is_dir() else data
    if path.name.endswith(".csv") and path.is_file():
        corners = read_corners(path)
        folder = path.parent / "images"
        return PhotoCorners(corners, _image_size(path, folder / corners.images[0]), (), folder)
    return detect([data], pattern_spec, progress=progress)


def _image_size(corners_csv: Path, photo: Path) -> tuple[int, int]:
    reference = corners_csv.parent / "reference.json"
    if reference.is_file():
        try:
            width, height = json.loads(reference.read_text(encoding="utf-8"))["image_size"]
            return int(width), int(height)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f'{reference}: "image_size": [width, height] was expected, found none; add it.') from error
    if not photo.is_file():
        raise InputError(
            f"The image size of {corners_csv} was expected in reference.json or from the photo {photo}, found neither; give one."
        )
    image = read_photo(photo)
    return image.shape[1], image.shape[0]


def _write(folder: Path, experiment: BoardExperiment, inputs: dict[str, Any], seed: int) -> tuple[Path, ...]:
    """All files but the report; adjusted lines and poses in the frame of the board."""
    names = "calibration.yaml corners.csv segments.csv poses_perturbed.csv poses.csv lines.csv lines.ply".split()
    paths = tuple(folder / name for name in names)
    lines, poses = scene_tables(experiment)
    record = calibration_record(experiment.calibration, False, inputs)
    save(paths[0], replace(record, provenance={**record.provenance, "seed": seed}))
    write_corners(paths[1], experiment.corners)
    write_segments(paths[2], experiment.board.segments)
    write_poses(paths[3], experiment.perturbed)
    write_poses(paths[4], poses)
    write_lines(paths[5], lines)
    family = experiment.board.column.astype(np.int64)
    write_ply(paths[6], lines, family, poses.cam_from_world.centre.numpy())
    return paths
