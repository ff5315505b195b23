"""omnilines experiment house: line triangulation and adjustment on the Oxford model house."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from omnilines.commands.result import CommandResult
from omnilines.files import write_lines, write_ply, write_poses
from omnilines.files.folders import check_results
from omnilines.files.sets import claimed
from omnilines.pages.house import house_data, house_sections, house_summaries
from omnilines.progress import ProgressCallback, silent
from omnilines.report import write_report
from omnilines.studies.distances import write_distance_figures
from omnilines.studies.house import house_study

FILES = ("figures.csv", "lines.csv", "lines.ply", "poses.csv", "report.html")


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
    check_results(out, FILES, [data])
    study = house_study(data, averaging, progress)
    scene = study.shown
    with claimed(out, FILES, [data], by="experiment house") as folder:
        files = tuple(folder / name for name in FILES)
        write_distance_figures(files[0], study.figures)
        write_lines(files[1], scene.lines)
        write_ply(files[2], scene.lines, camera_centres_m=scene.poses.cam_from_world.centre.numpy())
        write_poses(files[3], scene.poses)
        write_report(files[4], "The model house", house_sections(study))
    return CommandResult(house_summaries(study), house_data(study), study.checks, files, files[4])
