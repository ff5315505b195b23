"""Arguments, progress and messages of the `omnilines` command; no arithmetic.

torch and cv2 are imported by the commands themselves, so that `--help` answers at once.
"""

import sys

import typer

from camera_models.errors import OmnilinesError
from omnilines.cli._shared import app
from omnilines.cli._stopping import stoppable
from omnilines.cli.spelling import with_flags

# The order of the commands in the help is the order of these imports.
from omnilines.cli import targets, extraction, scenes, cameras, lines, experiments  # isort: skip

__all__ = ["app", "cameras", "experiments", "extraction", "lines", "main", "scenes", "targets"]


def main(arguments: list[str] | None = None) -> None:
    """Entry point: an error that the user can mend is one sentence on standard error and exit status 2; so is a signal that ends
    the command, with the status 128 + its number."""
    try:
        with stoppable():
            app(arguments, standalone_mode=True)
    except OmnilinesError as error:
        typer.echo(f"omnilines: {with_flags(str(error))}", err=True)
        sys.exit(2)
    except OSError as error:
        typer.echo(f"omnilines: {error.filename or 'a file'} cannot be read or written ({error.strerror}).", err=True)
        sys.exit(2)
