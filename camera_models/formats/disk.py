"""Bytes and text in, files out that are never half written: a reader sees the old content or the new, whatever interrupts.

write_atomically(path, text_or_bytes)      # everything that is written goes through here, pictures and archives too
read_text(path)                            # no pipe, no device, no end of memory
"""

import contextlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from camera_models.errors import InputError

fcntl: Any = None
with contextlib.suppress(ImportError):  # on Windows, where a file that is open cannot be removed by another process
    import fcntl

MOST_BYTES = 1 << 34
"""Of a file that is read as a whole."""
TEMPORARY = re.compile(r"\..+\.[a-z0-9_]{8}\.part")
"""Names of what is being written, or was when a process was killed."""

moment: Callable[[str, Path], None] | None = None
"""For tests, which end the process there: called with `before`, `inside`, `written` and `after`, and the file being written."""
_swept: set[str] = set()
staged: dict[str, Path] = {}
"""Files of sets that are being written, by their absolute path: where each lies until the set is whole (files/sets.py)."""
MANIFEST = ".omnilines.json"
"""In a folder of results: the names of what was written there, which may be written again."""
MOVING = ".omnilines.moving"
"""In a folder of results: a set that is whole, of which these files are still to be moved to their places."""


def write_atomically(path: str | Path, data: str | bytes) -> None:
    """Replace the file at `path` by `data` (text as UTF-8, line ends as given), through a temporary file beside it.

    The file gets the permissions a plain `open` would give, or keeps those it had. What an earlier run, that was killed, left
    half written in the folder is removed. A file of a set is written to where it lies for now (`staged`). Raises InputError where
    the folder is absent or cannot be written to, or the path is a folder or a device; what was on disk is then untouched.
    """
    target = Path(path)
    try:
        content = data.encode("utf-8") if isinstance(data, str) else data
    except UnicodeEncodeError as error:
        raise InputError(
            f"{target} cannot hold the name {data[error.start - 20 : error.end + 20]!r}; rename what it stands for."
        ) from None
    try:
        place = staged.get(os.path.abspath(target), target)
        if place is not target:
            place.parent.mkdir(parents=True, exist_ok=True)
        _sweep(place.parent)
        tell("before", target)
        if target.exists() and not target.is_file():
            raise InputError(f"{target} cannot be written (it is {_kind(target.stat().st_mode)}); give another path.")
        handle, temporary = _temporary(place)
        try:
            with os.fdopen(handle, "wb") as file:
                if moment is not None:
                    file.write(content[: len(content) // 2])
                    file.flush()
                    tell("inside", target)
                    file.seek(0)
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
                os.chmod(temporary, _permissions(target))
                tell("written", target)
                os.replace(temporary, place)
        except BaseException:  # an interrupt too must leave no partial file; it is raised again
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
            raise
        tell("after", target)
    except (OSError, ValueError) as error:  # a name with a NUL is a ValueError
        if isinstance(error, InputError):
            raise
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise InputError(f"{target} cannot be written ({why}); give a path in a folder that can be.") from error


def tell(when: str, target: Path) -> None:
    """For tests: what is about to happen to a file, or has."""
    if moment is not None:
        moment(when, target)


def _temporary(target: Path) -> tuple[int, str]:
    """A temporary file beside the target, locked as long as it is open: one that is not was left by a process that is gone."""
    while True:
        # Of a long name the beginning, since a name holds 255 bytes.
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name[:50]}.", suffix=".part")
        if fcntl is None:
            return handle, temporary
        with contextlib.suppress(OSError):  # file systems without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        # Another process may have taken it for a left one before it was locked.
        if os.fstat(handle).st_nlink:
            return handle, temporary
        os.close(handle)


def _sweep(folder: Path) -> None:
    """Remove the temporary files of processes that are gone; once for each folder in each process."""
    where = os.path.abspath(folder)
    if where in _swept or fcntl is None:
        return
    _swept.add(where)
    with os.scandir(where) as entries:
        left = [entry.path for entry in entries if TEMPORARY.fullmatch(entry.name) and entry.is_file(follow_symlinks=False)]
    for path in left:
        with contextlib.suppress(OSError), open(path, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.unlink(path)


def _permissions(path: Path) -> int:
    # mkstemp makes files for their owner alone; the mask can only be read by setting it.
    if path.exists():
        return path.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask


def _kind(mode: int) -> str:
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def read_bytes(path: str | Path, most: int | None = None, start: int = 0) -> bytes:
    """The content of a file, or `most` bytes of it, from the byte `start` on.

    Raises InputError where it is not there, is a folder, a pipe or a device, cannot be read, or is larger than memory.
    """
    file = Path(path)
    require_in_place(file)
    try:
        # Opening a pipe would wait for its other end.
        handle = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as stream:
            about = os.fstat(handle)
            if stat.S_ISDIR(about.st_mode):
                raise InputError(f"{file} is a folder where a file was expected; name the file in it.")
            if not stat.S_ISREG(about.st_mode):
                raise InputError(f"{file} was expected to be a file, found {_kind(about.st_mode)}; save it as a file first.")
            if most is None and about.st_size > MOST_BYTES:
                raise InputError(
                    f"{file} was expected to hold at most {MOST_BYTES / 1e9:.0f} GB, found {about.st_size / 1e9:.0f}."
                )
            if start:
                stream.seek(min(start, MOST_BYTES))
            content = stream.read() if most is None else stream.read(most)
            if content is None:  # a file of the kernel that would have to be waited for
                raise InputError(
                    f"{file} was expected to be a file, found that it has nothing to read now; save it as a file first."
                )
            return content
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{file} does not exist; check the path.") from None
    except MemoryError:
        raise InputError(f"{file} was expected to fit into memory, found that it does not; give a smaller file.") from None
    except OSError as error:
        if file.is_dir():  # Windows does not open folders
            raise InputError(f"{file} is a folder where a file was expected; name the file in it.") from None
        raise InputError(f"{file} cannot be read ({error.strerror}); check the path and its permissions.") from error
    except ValueError:
        raise InputError(f"{str(file)!r} was expected to be a path, found that no file has such a name; check it.") from None


def require_in_place(file: Path) -> None:
    """Raises InputError where the newer content of a file still waits to be moved here, and others may have been."""
    own = Path(os.path.abspath(file))
    for folder in own.parents:
        if own.name != MANIFEST and os.path.lexists(folder / MOVING / own.relative_to(folder)):
            raise InputError(
                f"{file} was expected to be whole with the files beside it, found that the run that wrote them was ended while "
                f"it moved them from {folder / MOVING}; run its command again, or remove that folder."
            )


def read_text(path: str | Path) -> str:
    """The text of a UTF-8 file, without a byte order mark, line ends as they are; raises InputError where it is not one."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text (byte {error.start}); save it as UTF-8.") from None


@contextlib.contextmanager
def locked(folder: Path, wait: bool = False) -> Iterator[None]:
    """Raises OSError where another process has the folder, or none can have it."""
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def own_folder(parent: Path, prefix: str, suffix: str = "") -> Iterator[Path]:
    """A new folder of this process, gone at the end; those of such names that processes which are gone have left are removed.

    Raises OSError where none can be made.
    """
    for left in [path for path in parent.glob(f"{prefix}????????{suffix}") if path.is_dir() and not path.is_symlink()]:
        with contextlib.suppress(OSError), locked(left):
            shutil.rmtree(left)
    with contextlib.ExitStack() as held:
        while True:
            folder = Path(tempfile.mkdtemp(prefix=prefix, suffix=suffix, dir=parent))
            try:
                held.enter_context(locked(folder))
            except (BlockingIOError, FileNotFoundError):  # another process takes it for a left one
                continue
            except OSError:  # file systems without locks
                break
            # Another process may have removed it before it was locked.
            if folder.is_dir():
                break
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
