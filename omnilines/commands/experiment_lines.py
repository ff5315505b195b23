"""omnilines experiment wide, short and room: every triangulation and every cost against noise, with the Cramer-Rao bound."""

from pathlib import Path

from omnilines.commands.result import CommandResult
from omnilines.files.folders import check_results
from omnilines.files.sets import claimed
from omnilines.pages.line_study import beyond_share, study_about, study_data, study_sections, study_summaries, write_figures
from omnilines.progress import ProgressCallback, silent
from omnilines.report import write_report
from omnilines.studies.line_experiments import TITLES, LineStudyOptions, line_experiment

FILES = ("figures.csv", "report.html")


def experiment_lines(
    study: str,
    out: str | Path,
    options: LineStudyOptions = LineStudyOptions(),
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Run the study `wide`, `short` or `room`; writes figures.csv and report.html.

    Raises InputError for an unknown study and GeometryError where the scene does not determine its lines.
    """
    check_results(out, FILES)
    found, checks = line_experiment(study, options, progress)
    about = (*study_about(found), ("poses disturbed by", f"{options.perturb_deg:g} degrees and {options.perturb_m:g} m"))
    summaries = study_summaries(found, TITLES[study], about)
    with claimed(out, FILES, by="experiment lines") as folder:
        table = folder / FILES[0]
        write_figures(table, found)
        page = write_report(folder / FILES[1], TITLES[study], study_sections(found, summaries, checks))
    asked = {"study": study, "perturb_deg": options.perturb_deg, "perturb_m": options.perturb_m}
    data = {**asked, "beyond_90_deg": beyond_share(found.world), **study_data(found, options.seed)}
    return CommandResult(summaries, data, checks, (table, page), page)
