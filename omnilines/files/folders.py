"""Folders that results are written to."""

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from camera_models import InputError
from camera_models.formats.disk import read_text, write_atomically
from omnilines.files.photos import PHOTO_SUFFIXES


def output_folder(out: str | Path) -> Path:
    """The folder, made if absent. Raises InputError when that cannot be done."""
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"A folder to write to was expected at {folder}, found that it cannot be made ({error.strerror})."
        ) from error
    return folder


def check_output_folder(out: str | Path) -> None:
    """Refuse, before any work, a folder that could not be made or written to; nothing is made yet. Raises InputError."""
    folder = Path(out).absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        why = "cannot be written to" if there.is_dir() else "is no folder"
        raise InputError(f"A folder to write to was expected at {out}, found that {there} {why}; name another.")


MANIFEST = ".omnilines.json"
"""In a folder of results: the names of what was written there, which may be written again."""


def claim(out: str | Path, names: Iterable[str], inputs: Iterable[str | Path] = ()) -> Path:
    """The folder, made if absent, with its list of results extended by `names`, before any of them is written.

    Raises InputError as `check_results` does, with nothing written.
    """
    folder, wanted = Path(out), set(names)
    check_results(folder, wanted, inputs)
    made, own = output_folder(folder), set(written_names(folder))
    if not own >= wanted:
        write_atomically(made / MANIFEST, json.dumps({"written": sorted(own | wanted)}, indent=1) + "\n")
    return made


@contextmanager
def claimed(out: str | Path, names: Iterable[str], inputs: Iterable[str | Path] = ()) -> Iterator[Path]:
    """`claim` for as long as results are written; where that fails, what was not written is not in the list of the folder."""
    wanted, fresh = set(names), not Path(out).exists()
    folder = claim(out, wanted, inputs)
    try:
        yield folder
    except BaseException:
        kept = [name for name in written_names(folder) if name not in wanted or (folder / name).exists()]
        if kept:
            write_atomically(folder / MANIFEST, json.dumps({"written": kept}, indent=1) + "\n")
        else:
            (folder / MANIFEST).unlink(missing_ok=True)
            if fresh and not any(folder.iterdir()):
                folder.rmdir()
        raise


def check_results(out: str | Path, names: Iterable[str], inputs: Iterable[str | Path] = ()) -> None:
    """Refuse, before any work, results that may not be written; nothing is made.

    Names are POSIX paths relative to the folder; `inputs` are the files and folders that the command reads. Raises InputError
    where a result would go over an input, over a file that is not in the list of the folder, or through a link out of it; and
    where pictures would be written among the photos that the same command reads.
    """
    check_output_folder(out)
    folder, given = Path(out), [Path(os.path.realpath(path)) for path in inputs]
    own = set(written_names(folder))
    for name in sorted(set(names)):
        _check_result(folder, name, own, given)


def written_names(folder: str | Path) -> list[str]:
    """What the list of a folder names; nothing where there is no list, or it is not one."""
    try:
        names = json.loads(read_text(Path(folder) / MANIFEST))["written"]
    except (ValueError, KeyError, TypeError, RecursionError):  # InputError is a ValueError
        return []
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def _check_result(folder: Path, name: str, own: set[str], inputs: Sequence[Path]) -> None:
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts:
        raise InputError(
            f"Results were expected inside {folder}, found the name '{name}', which leads out of it; rename its input."
        )
    target = folder / name
    real = Path(os.path.realpath(target))
    if real in inputs:
        raise InputError(f"A folder without the inputs was expected to write to, found that {target} is one; give another --out.")
    step = folder
    for part in parts.parts[:-1]:
        step = step / part
        if step.is_symlink():
            raise InputError(f"Results were expected inside {folder}, found that {step} is a link out of it; give another --out.")
    if os.path.lexists(target) and name not in own:
        raise InputError(
            f"Results go over nothing but earlier results, found {target}, which is not in {MANIFEST} there; give another --out, "
            "or remove it."
        )
    among = [path for path in inputs if path.is_dir() and real.is_relative_to(path)]
    if among and target.suffix.lower() in PHOTO_SUFFIXES:
        raise InputError(
            f"Pictures were expected outside of the photos, found {target} in {among[0]}, where they would be taken for "
            "photos the next time; give another --out."
        )
