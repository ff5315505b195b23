"""The tables of the documents that the program itself decides: commands, camera models, file formats, names of the Python API.

    python docs/scripts/tables.py       # writes them anew, between the marks in the pages

A test compares them with what is written.
"""

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import million
import typer

import omnilines
from camera_models import MODELS, model_class
from camera_models.formats import FORMATS, format_named
from omnilines.cli import app

PAGES = Path(__file__).resolve().parents[1]


def leaf_commands(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every command of the command line, sub-commands written with a blank."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from leaf_commands(command, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", command


def commands() -> str:
    """A row for each command: its name and the first paragraph of its help."""
    rows = [(f"`{name}`", first_paragraph(command.help)) for name, command in leaf_commands(typer.main.get_command(app))]
    return table(("command", "what it does"), rows)


def command_options() -> str:
    """A section for each command: its arguments and options with what their help says."""
    parts = []
    for name, command in leaf_commands(typer.main.get_command(app)):
        rows = []
        for parameter in command.params:
            off = parameter.secondary_opts
            shown = "/".join([parameter.opts[0], *off]) if parameter.param_type_name == "option" else parameter.name
            if shown not in ("--json", "--set"):
                default = parameter.default
                told = str(default) if isinstance(default, str | int | float) and not isinstance(default, bool) else ""
                if off:
                    told = parameter.opts[0] if default else off[0]
                rows.append((f"`{shown}`", first_paragraph(parameter.help), told))
        parts.append(f"### {name}\n\n{table(('argument or option', '', 'default'), rows)}")
    return "\n".join(parts)


def models() -> str:
    """A row for each camera model: its name, its parameters, and what its module says it is."""
    rows = []
    for name, place in MODELS:
        model = model_class(name).examples()[0]
        more = " ..." if name == "scaramuzza" else ""
        said = first_paragraph(importlib.import_module(place.partition(":")[0]).__doc__)
        rows.append((f"[`{name}`](#{name})", " ".join(model.PARAMETER_NAMES) + more, said))
    return table(("`--model`", "parameters", "what it is"), rows)


def model_sections() -> str:
    """What the module of each camera model says: equations, paper, valid domain."""
    parts = []
    for name, place in MODELS:
        said = str(importlib.import_module(place.partition(":")[0]).__doc__).strip()
        parts.append(f"### {name}\n\n{said}\n")
    return "\n".join(parts)


def formats() -> str:
    """A row for each file format: names that are written in it, the models it holds, whether it holds rigs."""
    rows = []
    for entry in FORMATS:
        found = format_named(entry.name)
        held = list(dict.fromkeys(form.model for form in found.FORMS))
        shown = "all" if set(held) == {name for name, _ in MODELS} else " ".join(f"`{model}`" for model in held)
        rows.append((f"`{entry.name}`", ", ".join(f"`{name}`" for name in entry.files), shown, "yes" if found.RIGS else ""))
    return table(("format", "names that are written in it", "camera models held exactly, some up to a parameter", "rigs"), rows)


def api() -> str:
    """A directive of mkdocstrings for each public name of `omnilines`, in the order of the data flow: verbs first, then what they
    hand back, then options, whose fields have a page of their own."""
    kinds: dict[str, list[str]] = {"Verbs": [], "Results and tables": [], "Options": [], "Errors and progress": []}
    for name, place in omnilines._HOME_OF.items():
        if name[0].islower():
            kind = "Verbs"
        elif name.endswith("Options"):
            kind = "Options"
        elif place in ("camera_models.errors", "omnilines.progress"):
            kind = "Errors and progress"
        else:
            kind = "Results and tables"
        more = "    options:\n      members: false\n" if kind == "Options" else ""
        kinds[kind].append(f"::: {place}.{name}\n{more}")
    return "\n".join("\n".join([f"## {kind}\n", *names]) for kind, names in kinds.items())


TABLES: dict[str, dict[str, Callable[[], str]]] = {
    "commands.md": {"commands": commands, "options": command_options},
    "models.md": {"models": models, "equations": model_sections},
    "formats.md": {"formats": formats},
    "api.md": {"names": api},
    "scaling.md": {"million": lambda: table(million.HEADER, million.rows())},
}
"""Page -> mark -> what stands there."""


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    cells = [header, ("---",) * len(header), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |\n" for row in cells)


def first_paragraph(text: str | None) -> str:
    """On one line."""
    return " ".join((text or "").strip().split("\n\n")[0].split())


def with_tables(name: str, page: str) -> str:
    """The text of a page with the tables of today."""
    for mark, made in TABLES[name].items():
        begin, end = f"<!-- begin {mark} -->\n", f"<!-- end {mark} -->"
        page = f"{page[: page.index(begin)]}{begin}\n{made()}\n{page[page.index(end) :]}"
    return page


if __name__ == "__main__":
    for name in TABLES:
        path = PAGES / name
        path.write_text(with_tables(name, path.read_text(encoding="utf-8")), encoding="utf-8")
