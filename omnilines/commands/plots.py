"""--plots DIR: every figure of the report of a command as a file for papers."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from camera_models import InputError
from omnilines.commands.result import CommandResult
from omnilines.files.folders import check_results
from omnilines.pipelines.pages import write_figures
from omnilines.progress import ProgressCallback


def check_plots(folder: Path, photos: Sequence[Path]) -> None:
    """Refuse, before any work, a folder that cannot be written to, or one among the photos. Raises InputError."""
    check_results(folder, ())
    among = next((path for path in photos if path.is_dir() and folder.resolve().is_relative_to(path.resolve())), None)
    if among is not None:
        raise InputError(
            f"Figures were expected outside of the photos, found {folder} in {among}, where they would be taken for photos the "
            "next time; give another `plots`."
        )


def with_plots(result: CommandResult, folder: Path, progress: ProgressCallback) -> CommandResult:
    """The result with the figures of its report in a folder, each as PNG and SVG, among its files."""
    assert result.report is not None, "only commands with a report take --plots"
    figures = write_figures(result.report, folder, progress)
    none = () if figures else ("the report has no figures for --plots to write: its pictures lie with the other results.",)
    return replace(result, files=(*result.files, *figures), warnings=(*result.warnings, *none))
