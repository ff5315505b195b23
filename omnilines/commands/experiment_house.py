"""omnilines experiment house: line triangulation and adjustment on the Oxford model house."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from omnilines.commands.result import CommandResult
from omnilines.files import write_lines, write_ply, write_poses
from omnilines.files.folders import output_folder
from omnilines.pages.house import house_data, house_sections, house_summaries
from omnilines.progress import ProgressCallback, silent
from omnilines.report import write_report
from omnilines.studies.distances import write_distance_figures
from omnilines.studies.house import house_study


def experiment_house(
    data: str | Path,
    out: str | Path,
    *,
    averaging: Mapping[str, Any] = MappingProxyType({}),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write figures.csv, report.html and, as the sector cost adjusts them, lines.csv, lines.ply and poses.csv of the house.

    `averaging` holds the options of that triangulation. Raises InputError for a folder that does not hold the data.
    """
    study = house_study(data, averaging, progress)
    folder = output_folder(out)
    files = tuple(folder / name for name in ("figures.csv", "lines.csv", "lines.ply", "poses.csv"))
    scene = study.shown
    write_distance_figures(files[0], study.figures)
    write_lines(files[1], scene.lines)
    write_ply(files[2], scene.lines, camera_centres_m=scene.poses.cam_from_world.centre.numpy())
    write_poses(files[3], scene.poses)
    page = write_report(folder / "report.html", "The model house", house_sections(study))
    return CommandResult(house_summaries(study), house_data(study), study.checks, (*files, page), page)
