"""omnilines experiment book: poses from a sheet of paper, lines of the books around it, in rendered photos."""

from dataclasses import replace
from pathlib import Path

from camera_models import load
from omnilines.commands.result import CommandResult
from omnilines.files import find_photos, write_lines, write_ply, write_poses
from omnilines.files.folders import check_results, check_work_folder
from omnilines.files.sets import claimed
from omnilines.pages.book import book_data, book_sections, book_summaries
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.progress import ProgressCallback, silent
from omnilines.report import write_report
from omnilines.studies.book import COLUMNS, MODEL, NARROW_DEG, VIEWS, BookOptions, book_checks, book_study
from omnilines.studies.distances import write_distance_figures

FILES = ("figures.csv", "lines.csv", "lines.ply", "poses.csv", "report.html")
TITLE = "A sheet of paper and books"


def experiment_book(
    out: str | Path,
    model: str = MODEL,
    rendering: RenderOptions = RenderOptions(views=VIEWS),
    options: BookOptions = BookOptions(),
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Render the table, and do with its photos what `book_study` says.

    Writes the photos, figures.csv, report.html and, as the sector cost adjusts the lines that were found, lines.csv, lines.ply
    and poses.csv. Raises InputError for options out of range and GeometryError where too few photos show the sheet.
    """
    if model == MODEL and rendering.fov_deg is None:
        rendering = replace(rendering, fov_deg=NARROW_DEG)
    folder = Path(out)
    shown = folder / "photos"
    check_results(folder, FILES)
    check_work_folder(folder / "work")
    rendered = render_scene("books", model, rendering, progress=progress)
    rendered.save(shown, progress)
    photos, cameras = find_photos([shown]), load(shown / "calibration.yaml")
    settings = book_study(rendered, photos, cameras, folder / "work", options, progress=progress)
    files = tuple(folder / name for name in FILES)
    found = settings[0].after
    with claimed(folder, FILES, by="experiment book"):
        write_distance_figures(files[0], [f for setting in settings for f in setting.figures], COLUMNS)
        write_lines(files[1], found.lines)
        write_ply(files[2], found.lines, camera_centres_m=found.poses.cam_from_world.centre.numpy())
        write_poses(files[3], found.poses)
        write_report(files[4], TITLE, book_sections(rendered, settings, shown))
    checks = book_checks(rendered, settings)
    return CommandResult(book_summaries(rendered, settings), book_data(rendered, settings), checks, files, files[4])
