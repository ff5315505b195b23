"""--plots DIR: every figure of the report of a command as a file for papers."""

from dataclasses import replace
from pathlib import Path

from camera_models.formats.disk import write_atomically
from omnilines.commands.result import CommandResult
from omnilines.files.sets import claimed
from omnilines.progress import ProgressCallback
from omnilines.report.paper import KINDS, paper_figures


def with_plots(result: CommandResult, folder: Path, progress: ProgressCallback) -> CommandResult:
    """The result with the figures of its report in a folder, each as PNG and SVG, among its files."""
    assert result.report is not None, "only commands with a report take --plots"
    figures = paper_figures(result.report)
    names = [f"{figure.name}.{kind}" for figure in figures for kind in KINDS]
    with claimed(folder, names, [result.report], by="plots") as out:
        for done, figure in enumerate(figures, 1):
            for kind in KINDS:
                write_atomically(out / f"{figure.name}.{kind}", figure.file(kind))
            progress("drawing figures", done, len(figures))
    return replace(result, files=(*result.files, *(folder / name for name in names)))
