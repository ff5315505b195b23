"""--plots DIR: every figure of the report of a command as a file for papers."""

from dataclasses import replace
from pathlib import Path

from omnilines.commands.result import CommandResult
from omnilines.pipelines.pages import write_figures
from omnilines.progress import ProgressCallback


def with_plots(result: CommandResult, folder: Path, progress: ProgressCallback) -> CommandResult:
    """The result with the figures of its report in a folder, each as PNG and SVG, among its files."""
    assert result.report is not None, "only commands with a report take --plots"
    figures = write_figures(result.report, folder, progress)
    none = () if figures else ("the report has no figures for --plots to write: its pictures lie with the other results.",)
    return replace(result, files=(*result.files, *figures), warnings=(*result.warnings, *none))
