"""Folders that results are written to, and what may be written there."""

import contextlib
import json
import os
import tempfile
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from camera_models import InputError
from camera_models.formats.disk import MANIFEST, MOVING, TEMPORARY, locked, read_text, write_atomically
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
    """Refuse, before any work, a folder that could not be made or written to; nothing stays there. Raises InputError."""
    folder = Path(out).absolute()
    try:
        there = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    except OSError as error:
        raise InputError(
            f"A folder to write to was expected at {out}, found that it cannot be looked at ({error.strerror})."
        ) from None
    if not there.is_dir() or not os.access(there, os.W_OK):
        why = "cannot be written to" if there.is_dir() else "is no folder"
        raise InputError(f"A folder to write to was expected at {out}, found that {there} {why}; name another.")
    try:  # to root every folder seems writable: /proc, what is mounted from elsewhere
        made = Path(tempfile.mkdtemp(prefix=".omnilines.", suffix=".part", dir=there))
        with contextlib.suppress(FileNotFoundError):  # another run removes what it takes for left behind
            made.rmdir()
    except OSError as error:
        raise InputError(
            f"A folder to write to was expected at {out}, found that none can be made in {there} ({error.strerror}); name "
            "another."
        ) from None


WORK = "work"
"""In the results of a command: the folder of what it keeps, so that it goes on where it was stopped."""
OF_PAGE, OF_RENDER, OF_CONVERT = "page ", "render", "convert "
"""What the names of sets begin with: a page by itself, photos with their truth, files for other tools."""


class Written(NamedTuple):
    """A file in the list of a folder."""

    by: str
    """The set that it is of: the next of that name removes what it does not write again."""
    sha256: str
    """Of its content as it was written."""


def written(folder: str | Path) -> dict[str, Written]:
    """The list of a folder, by name; nothing where there is no list, or it is not one."""
    try:
        rows = json.loads(read_text(Path(folder) / MANIFEST))["written"]
        return {str(name): Written(str(row["by"]), str(row["sha256"])) for name, row in rows.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):  # InputError is a ValueError
        return {}


def write_list(folder: Path, rows: dict[str, Written]) -> None:
    """Replace the list of a folder."""
    entries = {name: row._asdict() for name, row in sorted(rows.items())}
    write_atomically(folder / MANIFEST, json.dumps({"written": entries}, indent=1) + "\n")


def check_results(out: str | Path, names: Iterable[str], inputs: Iterable[str | Path] = (), *, by: str = "") -> None:
    """Refuse, before any work, results that may not be written; nothing is made.

    Names are POSIX paths relative to the folder; `inputs` are the files and folders that the command reads; `by` is the set that
    the results are of, where one is written. Raises InputError where a result would go over an input, over a file that is not in
    the list of the folder, over the truth of rendered photos, over a file that was converted (or that one over others), or
    through a link out of it; and where pictures would be written among the photos that the same command reads.
    """
    check_output_folder(out)
    folder, given = Path(out), [Path(os.path.realpath(path)) for path in inputs]
    # While a set is moved into place its own list may lie beside it.
    own = {name: row.by for name, row in {**written(folder), **written(folder / MOVING)}.items()}
    for name in sorted(set(names)):
        _check_result(folder, name, own, given)
        its = own.get(name, by)
        lasts = its.startswith((OF_RENDER, OF_CONVERT)) or by.startswith(OF_CONVERT)
        if its != by and lasts and not by.startswith(OF_PAGE) and os.path.lexists(folder / name):
            raise InputError(f"A place for results was expected, found {folder / name}, which `{its}` wrote; give another `out`.")


def way_out(folder: Path, name: str) -> str | None:
    """Why a name does not stand for a file in a folder and its own sub-folders; None where it does."""
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts:
        return f"the name '{name}', which leads out of it; rename its input"
    step = folder
    for part in parts.parts[:-1]:
        step = step / part
        if step.is_symlink() or step.is_mount():
            return f"that {step} is a link out of it; give another `out`"
        # Asked in this order, since another run may remove a folder of its own that is empty.
        if not (step.is_dir() and os.access(step, os.W_OK)) and os.path.lexists(step):
            return f"that {step} is no folder that can be written to; give another `out`"
    return None


def _check_result(folder: Path, name: str, own: Collection[str], inputs: Sequence[Path]) -> None:
    if (why := way_out(folder, name)) is not None:
        raise InputError(f"Results were expected inside {folder}, found {why}.")
    target = folder / name
    real = Path(os.path.realpath(target))
    if real in inputs:
        raise InputError(f"A folder without the inputs was expected to write to, found that {target} is one; give another `out`.")
    if os.path.lexists(target) and (name not in own or (target.is_dir() and not target.is_symlink())):
        raise InputError(
            f"Results go over nothing but earlier results, found {target}, which is not in {MANIFEST} there (nor is what "
            "versions without that list wrote); give another `out`, or remove it."
        )
    among = [path for path in inputs if path.is_dir() and real.is_relative_to(path)]
    if among and target.suffix.lower() in PHOTO_SUFFIXES:
        raise InputError(
            f"Pictures were expected outside of the photos, found {target} in {among[0]}, where they would be taken for "
            "photos the next time; give another `out`."
        )


def check_work_folder(work: Path, inputs: Iterable[str | Path] = ()) -> None:
    """Refuse a folder for what a run keeps that is not one, or that the run reads from. Raises InputError; nothing is made."""
    check_output_folder(work)
    # Another run may be making it, or was killed while it did.
    holds = work.exists() and any(not TEMPORARY.fullmatch(entry.name) for entry in work.iterdir())
    if work.is_symlink() or (holds and not (work / MANIFEST).is_file()):
        raise InputError(
            f"What is found is kept in {work}, found a folder there that is not of an earlier run (it holds no {MANIFEST}); give "
            "another `out`, or rename it."
        )
    for path in inputs:
        if Path(os.path.realpath(path)).is_relative_to(os.path.realpath(work)):
            raise InputError(f"Inputs were expected outside of {work}, where a run keeps what it finds, found {path}; copy it.")


def work_folder(work: str | Path) -> Path:
    """The folder for what a run keeps, made and marked as such. Raises InputError as `check_work_folder` does."""
    folder = Path(work)
    check_work_folder(folder)
    output_folder(folder)
    if not (folder / MANIFEST).is_file():
        write_list(folder, {})
    return folder


@contextlib.contextmanager
def alone_in(work: str | Path) -> Iterator[None]:
    """Within it no other run that asks for that is at work in the folder for what runs keep, which is made. Raises InputError
    where one is, and as `work_folder` does."""
    folder = work_folder(work)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(folder))
        except BlockingIOError:
            raise InputError(
                f"{folder.parent} was expected to be written to by one run at a time, found another one that is taking frames "
                "there; wait for its end, or give another `out`."
            ) from None
        except OSError:  # file systems without locks
            pass
        yield
