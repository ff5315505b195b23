"""omnilines experiment board: the dissertation's fisheye experiment on photos of one's own."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import save
from omnilines.calibration.record import calibration_record
from omnilines.commands.result import CommandResult
from omnilines.files import write_corners, write_lines, write_ply, write_poses, write_segments
from omnilines.files.folders import check_results
from omnilines.files.sets import claimed
from omnilines.pages.board import board_data, board_sections, board_summaries, scene_tables
from omnilines.pipelines.calibrate import view_details
from omnilines.progress import ProgressCallback, silent
from omnilines.report import write_report
from omnilines.studies.board import MODEL, BoardOptions, board_calibration, board_corners, board_experiment
from omnilines.studies.board_figures import BoardExperiment

PATTERN = "checkerboard:8x6:32.5mm"
FILES = "calibration.yaml corners.csv segments.csv poses_perturbed.csv poses.csv lines.csv lines.ply".split()
NAMES = (*FILES, "report.html")


def experiment_board(
    data: str | Path,
    out: str | Path,
    pattern_spec: str = PATTERN,
    model: str = MODEL,
    options: BoardOptions = BoardOptions(),
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Run the experiment on a folder of photos of a plane target, or on a folder that holds a corners.csv of one.

    Raises InputError for unusable data and GeometryError where boards or lines determine nothing.
    """
    check_results(out, NAMES, _read(Path(data)))
    found = board_corners(data, pattern_spec, progress)
    calibration = board_calibration(found, model, progress)
    experiment = board_experiment(found, calibration, options, progress)
    inputs = {"data": data, "pattern": pattern_spec, "perturb_deg": options.perturb_deg, "perturb_m": options.perturb_m}
    with claimed(out, NAMES, _read(Path(data)), by="experiment board") as folder:
        files = _write(folder, experiment, inputs, options.seed)
        progress("writing the report", 0, 0)
        photo_folder = found.photo_folder if found.photo_folder and found.photo_folder.is_dir() else None
        sections = board_sections(experiment, photo_folder)
        page = write_report(folder / "report.html", "Board lines before and after adjustment", sections)
    lost = view_details([view for view in calibration.views if not view.used])
    data_out = board_data(experiment, options.seed)
    return CommandResult(
        board_summaries(experiment),
        data_out,
        experiment.checks,
        (*files, page),
        page,
        experiment.notes,
        lost,
        len(calibration.views),
    )


def _read(data: Path) -> list[Path]:
    return [data, *data.glob("*.csv")]


def _write(folder: Path, experiment: BoardExperiment, inputs: Mapping[str, Any], seed: int) -> tuple[Path, ...]:
    """All files but the report; adjusted lines and poses in the frame of the board."""
    paths = tuple(folder / name for name in FILES)
    lines, poses = scene_tables(experiment)
    record = calibration_record(experiment.calibration, False, inputs)
    save(paths[0], replace(record, provenance={**record.provenance, "seed": seed}))
    write_corners(paths[1], experiment.corners)
    write_segments(paths[2], experiment.board.segments)
    write_poses(paths[3], experiment.perturbed)
    write_poses(paths[4], poses)
    write_lines(paths[5], lines)
    write_ply(paths[6], lines, experiment.board.column.astype(np.int64), poses.cam_from_world.centre.numpy())
    return paths
