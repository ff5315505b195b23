"""Parameters as the command line spells them: messages of the library name `min_views`, the command line says --min-views."""

import re
from collections.abc import Callable
from typing import Any

import typer
import typer.core

from camera_models.errors import InputError

MOST = 2**63 - 1
RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, MOST),
    "views": (1, 10_000),
    "trials": (1, 1_000_000),
    "degree": (2, 30),
    "noise": (0, 255),
    "blur": (0, 1000),
    "perturb_deg": (0, 180),
    "perturb_m": (0, 1e6),
    "hand_px": (0, 1000),
    "texture_m": (1e-3, 1e6),
    "tolerance_px": (0, 1000),
    "port": (0, 65535),
}
"""Of options with numbers, by their parameter, where a command would otherwise run for days or end in arithmetic."""
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
    """A command whose options are known while it runs, and within reason before."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Raises InputError where an argument is empty."""
        if "" in args:
            after = f" after {args[args.index('') - 1]}" if args.index("") else ""
            raise InputError(f"A value was expected{after}, found an empty one; fill it in, or leave the option out.")
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Raises InputError where a number is beyond reason."""
        for parameter in self.params:
            value = ctx.params.get(parameter.name)
            low, high = RANGES.get(parameter.name or "", (-MOST, MOST))
            if isinstance(value, int | float) and not isinstance(value, bool) and not low <= value <= high:
                raise InputError(f"{parameter.opts[0]} was expected to be a number from {low:g} to {high:g}, found {value:g}.")
        _flags.clear()
        _flags.update({parameter.name: parameter.opts[0] for parameter in self.params if parameter.name})
        return super().invoke(ctx)


class Application(typer.Typer):
    """All commands of which are such."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        return super().command(name, cls=_Command, **options)
