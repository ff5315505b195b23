"""Parameters as the command line spells them: messages of the library name `min_views`, the command line says --min-views."""

import re
from collections.abc import Callable
from typing import Any

import typer
import typer.core

ALIASES = {
    "camera": "calibration",
    "start": "calibration",
    "mirrored": "mirror",
    "models": "model",
    "patterns": "pattern",
}
"""Parameters of the library that an option of another name gives."""
_flags: dict[str, str] = {}
"""The options of the command that runs, by the names of their parameters."""


def with_flags(text: str) -> str:
    """A text with the options, of the command that runs, for the parameters that it names in backticks."""
    return re.sub("`([a-z_]+)`", lambda name: _flags.get(name[1], _flags.get(ALIASES.get(name[1], ""), name[0])), text)


class _Command(typer.core.TyperCommand):
    """A command whose options are known while it runs."""

    def invoke(self, ctx: Any) -> Any:
        _flags.clear()
        _flags.update({parameter.name: parameter.opts[0] for parameter in self.params if parameter.name})
        return super().invoke(ctx)


class Application(typer.Typer):
    """All commands of which are such."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        return super().command(name, cls=_Command, **options)
