"""Which compiled functions a job calls, with which types of arguments, and which of them numba keeps already.

`entries.yaml` lists them, as `docs/scripts/compiled.py` saw them in runs of commands. What is called beside (another type of
argument, a rare path) is compiled when it is needed, as without the list.
"""

import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from omnilines.compiled_cache import cache_folders

PACKAGES = Path(__file__).parents[2]
TABLE = Path(__file__).with_name("entries.yaml")
EVERYTHING = "everything"
"""The job that needs all of them: a new machine, or an image of one, is prepared by it."""


@dataclass(frozen=True)
class Entry:
    """A compiled function that Python calls."""

    function: str
    """Module and name."""
    jobs: tuple[str, ...]
    """Those that call it."""
    seconds: float
    """How long it took to compile, of one core: to share the work, and to say how long it will take."""
    arguments: tuple[tuple[object, ...], ...]
    """The types of its arguments, as `argument_types.written` writes them; for each way in which it is called."""

    @property
    def source(self) -> Path:
        """The file of its module."""
        return PACKAGES.joinpath(*self.function.split(".")[:-1]).with_suffix(".py")

    @property
    def module(self) -> str:
        """Name of its module."""
        return self.function.rpartition(".")[0]


@cache
def entries() -> tuple[Entry, ...]:
    """All of them."""
    import yaml  # not with the command line, which imports this

    rows = yaml.load(TABLE.read_text(), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return tuple(
        Entry(row["function"], tuple(row["jobs"].split()), row["seconds"], tuple(map(tuple, row["arguments"]))) for row in rows
    )


def not_compiled(*jobs: str) -> tuple[Entry, ...]:
    """Entries of some jobs of which numba keeps nothing, or nothing newer than the source."""
    its = [entry for entry in entries() if not {*entry.jobs, EVERYTHING}.isdisjoint(jobs)]
    return tuple(entry for entry in its if not _is_kept(entry))


def _is_kept(entry: Entry) -> bool:
    """As numba names its indices: `module.function-line.pyVERSION.nbi`."""
    name = f"{entry.source.stem}.{entry.function.rpartition('.')[2]}-*.py{sys.version_info[0]}{sys.version_info[1]}*.nbi"
    changed = entry.source.stat().st_mtime if entry.source.exists() else 0.0
    found = (path for folder in cache_folders(entry.source) for path in folder.glob(name))
    return any(path.stat().st_mtime >= changed for path in found)
