"""Parameters as the command line spells them: messages of the library name `min_views`, the command line says --min-views."""

import os.path
import re
from collections import Counter
from collections.abc import Callable
from typing import Any

import typer
import typer.core

from camera_models.errors import InputError
from omnilines.cli.counts import call_of, require_counting
from omnilines.cli.jobs import jobs

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
    "yaw_deg": (-3600, 3600),
    "pitch_deg": (-3600, 3600),
    "pose_sigma_deg": (0, 180),
    "pose_sigma_m": (0, 1e6),
    "min_views": (3, 1_000_000),
    "subset": (2, 20),
    "bandwidth": (1e-9, 10),
    "lines": (1, 10_000),
    "partition": (0, 1_000_000),
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
_jobs: list[str] = []


def running_jobs() -> tuple[str, ...]:
    """The jobs of the command that runs."""
    return tuple(_jobs)


def with_flags(text: str) -> str:
    """A text with the options, of the command that runs, for the parameters that it names in backticks."""
    return re.sub("`([a-z_]+)`", lambda name: name[0] if (flag := flag_of(name[1])) == name[1] else flag, text)


def flag_of(name: str) -> str:
    """The option of the command that runs for a parameter; the parameter where there is none."""
    return _flags.get(name, _flags.get(ALIASES.get(name, ""), name))


def from_home(argument: str) -> str:
    """An argument with the home of the user for a ~ at the beginning of a path, also in --out=~/results, where most shells leave
    it: results would go to a folder of the name ~."""
    option, equals, path = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    return option + equals + (os.path.expanduser(path) if path.partition("/")[0] == "~" else path)


class _Command(typer.core.TyperCommand):
    """A command whose options are known while it runs, and within reason before."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Raises InputError where an argument is empty, an option stands in the place of a value, or is given twice."""
        args = [from_home(argument) for argument in args]
        if ctx.resilient_parsing:  # a shell asks how a command that is being written may go on
            return super().parse_args(ctx, args)
        takers = {name for option in self.params if _takes_value(option) for name in option.opts}
        flags = {name for option in self.params if not isinstance(option, typer.core.TyperArgument) for name in option.opts}
        for before, after in zip(["", *args], args, strict=False):
            if not after.strip() or (before in takers and after in flags):
                place = f" after {before}" if before else ""
                found = f"the option {after}" if after.strip() else "an empty one"
                raise InputError(f"A value was expected{place}, found {found}; fill it in, or leave the option out.")
        _, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for option, count in Counter(order).items():
            if count > 1 and _takes_value(option) and not option.multiple:
                raise InputError(f"{option.opts[0]} was expected once, found it {count} times; give one value.")
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Raises InputError where a number is beyond reason, or an option does nothing in this mode of the command."""
        _flags.clear()
        _flags.update({parameter.name: parameter.opts[0] for parameter in self.params if parameter.name})
        for parameter in self.params:
            value = ctx.params.get(parameter.name)
            low, high = RANGES.get(parameter.name or "", (-MOST, MOST))
            if isinstance(value, int | float) and not isinstance(value, bool) and not low <= value <= high:
                raise InputError(f"{parameter.opts[0]} was expected to be a number from {low:g} to {high:g}, found {value:.12g}.")
        given = [name for name in ctx.params if ctx.get_parameter_source(name).name == "COMMANDLINE"]
        call = call_of(ctx.params, given)
        require_counting(self.name or "", call)
        _jobs[:] = jobs(self.name or "", call)
        return super().invoke(ctx)


def _takes_value(parameter: Any) -> bool:
    return isinstance(parameter, typer.core.TyperOption) and not parameter.is_flag


class Application(typer.Typer):
    """All commands of which are such."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        return super().command(name, cls=_Command, **options)
