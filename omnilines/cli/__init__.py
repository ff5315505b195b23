"""Arguments, progress and messages of the `omnilines` command; no arithmetic.

torch and cv2 are imported by the commands themselves, so that `--help` answers at once.
"""

import contextlib
import os
import sys
from typing import Any, NoReturn

import typer

from camera_models.errors import OmnilinesError
from omnilines.cli._shared import app
from omnilines.cli._stopping import stoppable
from omnilines.cli.notes import bounded, printable
from omnilines.cli.spelling import with_flags

# The order of the commands in the help is the order of these imports.
from omnilines.cli import targets, extraction, scenes, cameras, lines, experiments  # isort: skip

UsageError: Any = typer.BadParameter.__bases__[0]
"""Of click, or of the copy of it that newer versions of typer bring."""

__all__ = ["app", "cameras", "experiments", "extraction", "lines", "main", "scenes", "targets"]


def _how_to_get(error: Any) -> str:
    """Where a file comes from that was not given."""
    missing = getattr(getattr(error, "param", None), "name", None) if type(error).__name__ == "MissingParameter" else None
    if missing != "calibration":
        return ""
    return (
        ": omnilines calibrate makes such a file from photos of a target, or with --pattern lines from photos of any straight "
        "lines; omnilines convert makes it from files of COLMAP, OpenCV, Kalibr and other tools"
    )


def main(arguments: list[str] | None = None) -> None:
    """Entry point: an error that the user can mend is one sentence on standard error and exit status 2; so is a signal that ends
    the command, with the status 128 + its number."""
    _take_closed_streams()
    try:
        with stoppable():
            status = app(arguments, standalone_mode=False)
    except OmnilinesError as error:
        _refuse(with_flags(str(error)))
    except UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()
            sys.exit(2)
        command = error.ctx.command_path if error.ctx else "omnilines"
        told = f"{' '.join(error.format_message().split()).rstrip('.')}{_how_to_get(error)}"
        _refuse(f"{told}; see {command} --help.")
    except OSError as error:
        _refuse(f"{error.filename or 'a file'} cannot be read or written ({error.strerror}).")
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "allocate memory" not in str(error):
            raise
        _refuse("more memory than there is was asked for; give fewer or smaller photos, or a smaller size.")
    sys.exit(status if isinstance(status, int) else 0)


def _take_closed_streams() -> None:
    """Where a standard stream is closed its number would go to the next file that is opened, and what compiled code prints into
    it, or what keeps a decoder quiet on it, would go to that file."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free


def _refuse(sentence: str) -> NoReturn:
    with contextlib.suppress(OSError):  # where standard error cannot be written either, the status says it
        typer.echo(f"omnilines: {bounded(printable(sentence))}", err=True)
    sys.exit(2)
