"""Results that belong together: in their folder all are new or all are as they were, whatever interrupts.

    with claimed(out, ["calibration.yaml", "report.html"], inputs, by="calibrate") as folder:
        save(folder / "calibration.yaml", ...)          # whatever writes these files, by `write_atomically`

Until the block ends they are written to a hidden folder in `out`, so that a full disk, an error or a kill leaves what was there.
Then that folder is renamed to MOVING: from here on the new set counts. Files of the earlier set that are not written any more are
removed, the list of results and the new files are moved to their places. Where that is interrupted, the next run that writes
there goes on with it (`settle`); until then who reads a file that still waits there is told so (`camera_models.formats.disk`).
"""

import contextlib
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from pathlib import Path

from camera_models import InputError
from camera_models.errors import OmnilinesError
from camera_models.formats import disk
from camera_models.formats.disk import MANIFEST, MOVING, locked, own_folder
from omnilines.files.fingerprint import content_hash
from omnilines.files.folders import OF_PAGE, Written, check_results, way_out, write_list, written

_removed: ContextVar[list[Path] | None] = ContextVar("_removed", default=None)


@contextmanager
def claimed(
    out: str | Path, names: Iterable[str], inputs: Iterable[str | Path] = (), *, by: str, kept: Iterable[str] = ()
) -> Iterator[Path]:
    """The folder, made if absent, for as long as a set of results is written to it; they are there when the block has ended.

    `by` names the set: what an earlier one of that name wrote, and this one does not, is removed, but for `kept`, and for what
    was changed since. A set within a larger one that is being written is a part of it. Raises InputError as `check_results` does,
    and where the folder cannot be written to; nothing is changed then.
    """
    folder, wanted, given = Path(out), set(names), list(inputs)
    places = {os.path.abspath(folder / name): name for name in wanted}
    if places.keys() <= disk.staged.keys():
        yield folder
        return
    check_results(folder, wanted, given, by=by)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        with _told(folder):
            folder.mkdir(parents=True, exist_ok=True)
            settle(folder)
        with _stage(folder) as stage:
            disk.staged.update({path: stage / name for path, name in places.items()})
            try:
                yield folder
            finally:
                for place in places:
                    disk.staged.pop(place, None)
            with _told(folder), _alone(folder):
                _settle(folder)
                check_results(folder, wanted, given, by=by)
                _publish(folder, stage, wanted, by, set(kept))
    except BaseException:
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def claimed_page(path: str | Path) -> AbstractContextManager[Path]:
    """A page by itself: `claimed` for one file, the folder of which may hold others."""
    return claimed(Path(path).parent, [Path(path).name], by=f"{OF_PAGE}{Path(path).name}")


@contextmanager
def withdrawn_where_refused(out: str | Path) -> Iterator[None]:
    """Where a command is refused after it wrote a set of its inputs, the folder is gone again, if it was not there before."""
    folder = Path(out)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        yield
    except OmnilinesError:
        if made and folder.is_dir():
            for name, row in written(folder).items():
                _remove(folder, name, row.sha256)
            (folder / MANIFEST).unlink(missing_ok=True)
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def settle(folder: Path) -> None:
    """Move what an interrupted run left to be moved, if there is any. Raises InputError where that cannot be done."""
    if (folder / MOVING).exists():
        with _told(folder), _alone(folder):
            _settle(folder)


def _publish(folder: Path, stage: Path, names: set[str], by: str, kept: set[str]) -> None:
    new = {name: Written(by, content_hash(stage / name)) for name in names if (stage / name).is_file()}
    old = {name: row for name, row in written(folder).items() if (folder / name).exists()}
    stays = {name: row for name, row in old.items() if row.by != by or name in kept}
    write_list(stage, {**stays, **new})
    for parent in {(folder / name).parent for name in new}:
        parent.mkdir(parents=True, exist_ok=True)  # which takes room, unlike what follows
    disk.tell("whole", folder / MOVING)
    os.replace(stage, folder / MOVING)
    try:
        _settle(folder)
    except BaseException:  # a signal: what is left to do takes no time
        _settle(folder)
        raise


def _settle(folder: Path) -> None:
    moving = folder / MOVING
    if moving.is_symlink() or not moving.is_dir():
        return
    paths = [path for path in sorted(moving.rglob("*")) if path.is_symlink() or not path.is_dir()]
    for path in paths:
        if path.is_symlink() or not path.is_file():
            raise InputError(f"Results in {moving} were expected to be files, found {path.name}, which is none; remove {moving}.")
    if (moving / MANIFEST).exists():
        for name in sorted(written(folder).keys() - written(moving).keys()):
            gone = _remove(folder, name, written(folder)[name].sha256)
            if gone and (told := _removed.get()) is not None:
                told.append(folder / name)
        _move(moving, folder, MANIFEST)
    for path in paths:
        if path.name != MANIFEST or path.parent != moving:
            _move(moving, folder, path.relative_to(moving).as_posix())
    shutil.rmtree(moving)


def _move(moving: Path, folder: Path, name: str) -> None:
    if (why := way_out(folder, name)) is not None:
        raise InputError(f"Results in {moving} were expected to be of {folder}, found {why}; remove {moving}.")
    target = folder / name
    disk.tell("moving", target)
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(moving / name, target)


@contextmanager
def removals() -> Iterator[list[Path]]:
    """The files of earlier runs that are removed as long as this lasts."""
    found = list[Path]()
    before = _removed.set(found)
    try:
        yield found
    finally:
        _removed.reset(before)


def _remove(folder: Path, name: str, sha256: str) -> bool:
    """Remove a file that is as it was written, and the folders that it leaves empty; whether it was there and so."""
    path = folder / name
    if way_out(folder, name) is not None or path.is_symlink() or not path.is_file() or content_hash(path) != sha256:
        return False
    disk.tell("removing", path)
    path.unlink()
    for parent in path.relative_to(folder).parents:
        if parent.parts:
            with contextlib.suppress(OSError):
                (folder / parent).rmdir()
    return True


@contextmanager
def _stage(folder: Path) -> Iterator[Path]:
    """A hidden folder."""
    with contextlib.ExitStack() as held:
        with _told(folder):
            stage = held.enter_context(own_folder(folder, ".omnilines.", ".part"))
        yield stage


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Other processes that move results into a folder are waited for."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            held.enter_context(locked(folder, wait=True))
        yield


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """What the system refuses, in one sentence."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"Results were expected to find their place in {folder}, found {error.strerror or error}; make room, or give another "
            "`out`."
        ) from error
