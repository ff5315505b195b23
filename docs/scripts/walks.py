"""The walks of the documents: read from their pages, run as written, and written as notebooks.

    python docs/scripts/walks.py FOLDER [NAME]      # runs them in FOLDER/NAME; what they print now goes into the pages
    python docs/scripts/walks.py --notebooks        # writes the notebooks beside the pages

A page is Markdown. A block `bash` holds `omnilines` commands, a block `python` code that goes on from the one before; a
block `text` right below holds what was printed, of which lines may be left out (`...` alone) or end early (` ...`). An empty
one is filled.
"""

import contextlib
import io
import json
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

from omnilines.cli import main

PAGES = Path(__file__).resolve().parents[1] / "walks"
NAMES = ("fisheye", "rig", "room", "field", "camera360")
NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.M | re.S)


@dataclass(frozen=True)
class Block:
    """Something to be run, and what the page shows of what it prints."""

    language: str
    code: str
    shown: str | None


def parts_of(page: str) -> Iterator[str | Block]:
    """The text and the blocks of a page, in their order."""
    end = 0
    for found in BLOCK.finditer(page):
        yield page[end : found.start()]
        yield Block(found[1], found[2], found[3])
        end = found.end()
    yield page[end:]


def commands_of(code: str) -> list[list[str]]:
    """The arguments of each command of a block; a line that ends in a backslash goes on in the next."""
    calls = [shlex.split(line) for line in code.replace("\\\n", " ").splitlines() if line.strip()]
    if any(call[0] != "omnilines" for call in calls):
        raise ValueError(f"Commands that begin with 'omnilines' were expected, found {calls}.")
    return [call[1:] for call in calls]


def run(block: Block, names: dict[str, Any]) -> str:
    """What a block prints, run in the current folder; raises RuntimeError where a command ends with another status than 0."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        if block.language == "python":
            exec(compile(block.code, "a walk", "exec"), names)
        else:
            for call in commands_of(block.code):
                try:
                    main(call)
                except SystemExit as end:
                    if end.code:
                        raise RuntimeError(f"omnilines {shlex.join(call)} ended with status {end.code}.") from end
    return "".join(f"{line.rstrip()}\n" for line in printed.getvalue().splitlines())


def words(line: str) -> str:
    """A line without its numbers."""
    return " ".join(re.sub(NUMBER, "#", line).split())


def printed_anew(shown: str, printed: str) -> list[tuple[str, str]]:
    """(line as the page has it, that line of what is printed now, cut where the page cuts it).

    Raises ValueError for a line that is not printed.
    """
    if not shown:
        return [("", line) for line in printed.splitlines()]
    lines, pairs = iter(printed.splitlines()), []
    for line in shown.splitlines():
        if line.strip() == "...":
            pairs.append((line, line))
            continue
        cut = line.endswith(" ...")
        start = words(line.removesuffix(" ..."))
        for now in lines:
            if words(now) == start or (cut and words(now).startswith(start)):
                pairs.append((line, _first_words(now, line) if cut else now))
                break
        else:
            raise ValueError(f"'{line}' was expected among what is printed, found\n{printed}")
    return pairs


def _first_words(line: str, like: str) -> str:
    """As much of a line as another one shows of it."""
    count = len(like.removesuffix(" ...").split())
    found = re.match(rf"\s*(?:\S+\s+){{{count - 1}}}\S+", line)
    return f"{found[0] if found else line} ..."


def numbers_off(pairs: list[tuple[str, str]], share: float, least: float) -> list[tuple[str, str]]:
    """The pairs of lines of which a number differs by more than this share of it and by more than this."""
    return [
        pair for pair in pairs if any(_off(*two, share, least) for two in zip_longest(*(re.findall(NUMBER, s) for s in pair)))
    ]


def _off(a: str | None, b: str | None, share: float, least: float) -> bool:
    if a is None or b is None:
        return True
    return abs(float(a) - float(b)) > max(share * max(abs(float(a)), abs(float(b))), least)


def notebook_of(page: str) -> str:
    """A walk as a notebook (JSON, without outputs), which lies beside the page."""
    cells = []
    for part in parts_of(page):
        if isinstance(part, str) and part.strip():
            cells.append({"cell_type": "markdown", "metadata": {}, "source": part.strip()})
        elif isinstance(part, Block):
            source = ("%%bash\n" if part.language == "bash" else "") + part.code.rstrip("\n")
            cells.append({"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": [], "source": source})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    named = [{"id": f"cell{k}", **cell} for k, cell in enumerate(cells)]
    return json.dumps({"cells": named, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


def refreshed(page: str) -> str:
    """The page with what its blocks print today, run in the current folder."""
    names: dict[str, Any] = {}
    out = []
    for part in parts_of(page):
        if isinstance(part, str):
            out.append(part)
            continue
        printed = run(part, names)
        out.append(f"```{part.language}\n{part.code}```\n")
        if part.shown is not None:
            lines = [f"{now}\n" for _, now in printed_anew(part.shown, printed)]
            out.append("\n```text\n" + "".join(lines) + "```\n")
    return "".join(out)


if __name__ == "__main__":
    if sys.argv[1:] == ["--notebooks"]:
        for name in NAMES:
            (PAGES / f"{name}.ipynb").write_text(
                notebook_of((PAGES / f"{name}.md").read_text(encoding="utf-8")), encoding="utf-8"
            )
    else:
        for name in sys.argv[2:] or NAMES:
            place = Path(sys.argv[1], name).resolve()
            place.mkdir(parents=True)
            with contextlib.chdir(place):
                text = refreshed((PAGES / f"{name}.md").read_text(encoding="utf-8"))
            (PAGES / f"{name}.md").write_text(text, encoding="utf-8")
