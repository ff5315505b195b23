"""omnilines view: the report of a folder of results in the browser, or its recording in the viewer of rerun."""

import os
import subprocess
import sys
import webbrowser
from pathlib import Path

from camera_models import InputError
from camera_models.formats.disk import read_bytes
from omnilines.commands.reconstruct import PAGE, RECORDING
from omnilines.commands.result import CommandResult
from omnilines.files.recording import rerun_module
from omnilines.records import Summary

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
"""Variables that say that a window, or a browser, can open; elsewhere than on Linux one always can."""


def view(folder: Path, *, rerun: bool = False) -> CommandResult:
    """Open a report, or with `rerun` a recording; where nothing can be opened, its path is all that is told.

    `folder` may be the file itself. Raises InputError where there is none, or the viewer is not installed.
    """
    wanted = RECORDING if rerun else PAGE
    path = folder / wanted if folder.is_dir() else folder
    if not path.is_file() or path.suffix != Path(wanted).suffix:
        way = "reconstruct with --recording" if rerun else "calibrate, reconstruct or another command that writes one"
        raise InputError(f"A folder with {wanted} was expected, found {folder}, which holds none; run {way}.")
    read_bytes(path, most=1)
    if rerun:
        rerun_module()
    opened = _has_display() and (_show_recording(path) if rerun else webbrowser.open(path.absolute().as_uri()))
    what, where = ("recording", "the viewer of rerun") if rerun else ("report", "the browser")
    told = where if opened else f"nowhere: no {where.removeprefix('the ')} opens here; open it on another machine"
    summary = Summary(f"View of {folder}", ((what, str(path)), ("opened in", told)))
    return CommandResult((summary,), {"path": str(path), "opened": opened})


def _has_display() -> bool:
    # On a terminal alone `webbrowser` would run one that takes it over.
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)


def _show_recording(path: Path) -> bool:
    """The viewer goes on when this command has ended."""
    quiet = subprocess.DEVNULL
    subprocess.Popen([sys.executable, "-m", "rerun", str(path)], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    return True
