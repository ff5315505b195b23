"""Text in, files out that are never half written: a reader sees the old content or the new, whatever interrupts the writing."""

import os
import tempfile
from pathlib import Path

from camera_models.errors import InputError


def write_atomically(path: str | Path, data: str | bytes) -> None:
    """Replace the file at `path` by `data` (text as UTF-8, line ends as given), through a temporary file beside it.

    The file gets the permissions a plain `open` would give, or keeps those it had. Raises InputError where the folder is
    absent or cannot be written to; what was on disk is then untouched.
    """
    target = Path(path)
    try:
        content = data.encode("utf-8") if isinstance(data, str) else data
    except UnicodeEncodeError as error:
        raise InputError(
            f"{target} cannot hold the name {data[error.start - 20 : error.end + 20]!r}; rename what it stands for."
        ) from None
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, _permissions(target))
            os.replace(temporary, target)
        except BaseException:  # an interrupt too must leave no partial file; it is raised again
            os.unlink(temporary)
            raise
    except OSError as error:
        raise InputError(f"{target} cannot be written ({error.strerror}); give a path in a folder that can be.") from error


def _permissions(path: Path) -> int:
    # mkstemp makes files for their owner alone; the mask can only be read by setting it.
    if path.exists():
        return path.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask


def read_text(path: str | Path) -> str:
    """The text of a UTF-8 file, without a byte order mark, line ends as they are; raises InputError where it is not one."""
    file = Path(path)
    try:
        return file.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{file} does not exist; check the path.") from None
    except IsADirectoryError:
        raise InputError(f"{file} is a folder where a file was expected; name the file in it.") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not UTF-8 text (byte {error.start}); save it as UTF-8.") from None
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror}); check the path and its permissions.") from error
