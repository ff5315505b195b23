"""Where numba keeps compiled functions: decided before it is imported, since it fails where it can write nowhere.

numba writes beside the source, or else under the home of the user. A container often has neither: a package that belongs to
root, and a home that cannot be written to or does not exist. There it stops at the first compiled function of any command with
"cannot cache function". Then a folder of the user in the system's temporary folder serves: compiled anew after each restart.
"""

import getpass
import hashlib
import os
import sys
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def provide_cache() -> Path | None:
    """Set NUMBA_CACHE_DIR to a temporary folder where numba would find no place of its own; None where it has one.

    To be called before numba is imported: it reads the variable then. A variable that is set is left as it is.
    """
    if os.environ.get(VARIABLE) or "numba" in sys.modules:
        return None
    package = Path(__file__).parent
    if _is_writable(package / "__pycache__") or _is_writable(_cache_of_user()):
        return None
    folder = _private_folder()
    os.environ[VARIABLE] = str(folder)
    return folder


def note_on_cache() -> str | None:
    """One sentence where a temporary folder serves in which nothing lies yet; None elsewhere."""
    folder = os.environ.get(VARIABLE)
    if folder is None or not _is_ours(Path(folder)) or any(Path(folder).iterdir()):
        return None
    return (
        f"neither the package nor the home of the user can be written to: compiled functions are kept in {folder}, and the first "
        f"run takes some minutes longer; {VARIABLE} names another folder."
    )


def cache_folders(source: Path) -> tuple[Path, ...]:
    """Where numba may keep what it compiles of a source file (`numba.core.caching`)."""
    folder = os.path.abspath(source.parent)
    own = f"{source.parent.name}_{hashlib.sha1(folder.encode(), usedforsecurity=False).hexdigest()}"
    if named := os.environ.get(VARIABLE):
        return (Path(named, own),)
    return (source.parent / "__pycache__", _cache_of_user() / own)


def _is_ours(folder: Path) -> bool:
    return folder.parent == Path(tempfile.gettempdir()) and folder.name.startswith("omnilines-") and folder.is_dir()


def _cache_of_user() -> Path:
    """Where numba goes where it cannot write beside the source (`numba.core.caching._UserProvidedCacheLocator` and its like)."""
    home = os.path.expanduser("~")
    if sys.platform == "darwin":
        return Path(home, "Library", "Caches", "numba")
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA") or Path(home, "AppData", "Local"), "numba")
    return Path(os.environ.get("XDG_CACHE_HOME") or Path(home, ".cache"), "numba")


def _is_writable(folder: Path) -> bool:
    """Whether files can be written to a folder, which is made where it is absent, as numba does."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _private_folder() -> Path:
    """A folder of this user and this installation that nobody else can write to: what lies there is run."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as containers have
        user = str(os.getuid()) if hasattr(os, "getuid") else "user"
    own = hashlib.sha256(f"{Path(__file__).parent} {sys.version}".encode()).hexdigest()[:12]
    folder = Path(tempfile.gettempdir(), f"omnilines-{''.join(c for c in user if c.isalnum())}-{own}")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError:
        return Path(tempfile.mkdtemp(prefix="omnilines-"))
    mine = not hasattr(os, "getuid") or (about.st_uid == os.getuid() and about.st_mode & 0o777 == 0o700)
    if mine and folder.is_dir() and not folder.is_symlink() and _is_writable(folder):
        return folder
    return Path(tempfile.mkdtemp(prefix="omnilines-"))
