"""What the options of a stage decide: each at half and at double its value, the others as they are."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from camera_models import InputError, OmnilinesError
from omnilines.options import walk, with_settings
from omnilines.progress import ProgressCallback, silent

UNITS = ("px", "rad", "deg", "m", "mm", "s", "grey", "sigma", "sigmas", "square")
"""Last words of names whose values are no shares, whatever their size."""


@dataclass(frozen=True)
class Outcome:
    """What a stage made of its data with some options."""

    figures: Mapping[str, float]
    """By their names, in the order in which they are shown."""
    result: bytes
    """Of the results themselves: equal where nothing at all is different."""


@dataclass(frozen=True)
class Swept:
    """One option at other values than its own."""

    name: str
    default: Any
    tried: tuple[tuple[Any, Outcome | str], ...]
    """(value, what came of it or why nothing did) at half and at double; of what is true or false, the other one."""

    def effect(self, before: Outcome) -> float:
        """Largest relative change of a figure; infinite where a value ends the work."""
        if any(isinstance(outcome, str) for _, outcome in self.tried):
            return math.inf
        changes = [
            abs(outcome.figures[name] - known) / (abs(known) or 1.0)
            for _, outcome in self.tried
            if isinstance(outcome, Outcome)
            for name, known in before.figures.items()
            if not math.isnan(known)
        ]
        return max(changes, default=0.0)

    def changes_nothing(self, before: Outcome) -> bool:
        """Whether all results are those of the default."""
        return all(isinstance(outcome, Outcome) and outcome.result == before.result for _, outcome in self.tried)


@dataclass(frozen=True)
class Sweep:
    """All options of a stage."""

    default: Outcome
    swept: tuple[Swept, ...]
    left_out: tuple[str, ...] = field(default=())
    """Options that have no half and double: names, and 0."""

    @property
    def matter(self) -> list[Swept]:
        """Options that change anything, those that change most first."""
        rows = [row for row in self.swept if not row.changes_nothing(self.default)]
        return sorted(rows, key=lambda row: -row.effect(self.default))

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Options that change nothing at all."""
        return tuple(row.name for row in self.swept if row.changes_nothing(self.default))


def sweep(
    options: Any, run: Callable[[Any], Outcome], *, only: str = "", prefix: str = "", progress: ProgressCallback = silent
) -> Sweep:
    """Run a stage with every option whose name begins with `only` at half and at double its value.

    `run` is given options like those given. Raises InputError where no option has such a name; what `run` raises of
    OmnilinesError, ValueError and ArithmeticError is kept as the outcome.
    """
    known = [(name, value) for name, value, _ in walk(options, prefix) if name.startswith(only)]
    if not known:
        raise InputError(f"A name of options was expected, found '{only}', with which none begins; docs/options.md lists them.")
    before, swept, left_out = run(options), [], []
    for done, (name, value) in enumerate(known):
        progress("sweeping options", done, len(known))
        values = tuple(other for other in others(name, value) if other != value)
        if values:
            swept.append(Swept(name, value, tuple((other, _tried(options, name, other, run, prefix)) for other in values)))
        else:
            left_out.append(name)
    return Sweep(before, tuple(swept), tuple(left_out))


def _tried(options: Any, name: str, value: Any, run: Callable[[Any], Outcome], prefix: str) -> Outcome | str:
    text = ",".join(map(repr, value)) if isinstance(value, tuple) else str(value)
    try:
        return run(with_settings(options, [f"{name}={text}"], prefix))
    except (OmnilinesError, ValueError, ArithmeticError, IndexError) as error:
        return f"raises {type(error).__name__}"


def others(name: str, value: Any) -> Iterator[Any]:
    """Half and double a number, or the numbers of a tuple; the other one of true and false; nothing of what is no number."""
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (max(1, round(value / 2)), 2 * value) if value else ()
    elif isinstance(value, float):
        yield from (0.5 * value, _double(name, value)) if value and math.isfinite(value) else ()
    elif isinstance(value, tuple) and value and all(isinstance(part, int | float) for part in value):
        pairs = [tuple(others(name, part)) or (part, part) for part in value]
        yield tuple(half for half, _ in pairs)
        yield tuple(double for _, double in pairs)


def _double(name: str, value: float) -> float:
    """A share, which has no unit and lies between 0 and 1, is doubled at most to the middle between it and 1."""
    is_share = 0.0 < value < 1.0 and name.rpartition("_")[2].rpartition(".")[2] not in UNITS
    return min(2.0 * value, 0.5 * (1.0 + value)) if is_share else 2.0 * value


def table(found: Sweep) -> str:
    """A table in Markdown: every option that changes anything, what it changes most first; then the names of the others."""
    names = list(found.default.figures)
    lines = [
        f"| option | default | {' | '.join(names)} |",
        f"|---|---|{'---|' * len(names)}",
        f"| (all as they are) | | {' | '.join(_number(value) for value in found.default.figures.values())} |",
    ]
    for row in found.matter:
        cells = [_cell(row, name) for name in names]
        lines.append(f"| `{row.name}` | {_value(row.default)} | {' | '.join(cells)} |")
    nothing = ", ".join(f"`{name}`" for name in found.without_effect)
    lines += ["", f"No result changes with {nothing}." if nothing else "Every option changes something."]
    if found.left_out:
        lines.append(f"Without a half and a double: {', '.join(f'`{name}`' for name in found.left_out)}.")
    return "\n".join(lines) + "\n"


def _cell(row: Swept, figure: str) -> str:
    """A figure at half and at double."""
    return ", ".join(outcome if isinstance(outcome, str) else _number(outcome.figures[figure]) for _, outcome in row.tried)


def _number(value: float) -> str:
    return f"{value:.4g}"


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_value, value))
    return _number(value) if isinstance(value, float) else str(value)
