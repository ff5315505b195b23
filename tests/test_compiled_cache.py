"""A package that cannot be written to and a user without a home: compiled functions are kept in a temporary folder."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from omnilines import compiled_cache

ROOT = Path(compiled_cache.__file__).parents[1]
NOWHERE = "/proc/nowhere"
KERNEL = "import numba\n\n\n@numba.njit(cache=True)\ndef twice(x):\n    return 2.0 * x\n"
CALL = "from omnilines.a_kernel import twice\nassert twice(3.0) == 6.0\nprint('done')\n"
PROVIDE = (
    "from omnilines.compiled_cache import provide_cache\nfolder = provide_cache()\nassert folder is not None\nprint(folder)\n"
)


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """An installation in which no folder for bytecode can be made, since a file has its name: that holds for root too."""
    package = tmp_path / "site" / "omnilines"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    shutil.copyfile(compiled_cache.__file__, package / "compiled_cache.py")
    (package / "a_kernel.py").write_text(KERNEL)
    (package / "__pycache__").write_text("")
    return tmp_path / "site"


def run(installed: Path, script: str, temporary: Path, **more: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment = {**kept, "PYTHONPATH": str(installed), "HOME": NOWHERE, "TMPDIR": str(temporary), **more}
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=environment, cwd=installed, check=False
    )


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="takes a folder in which even root can make nothing")
def test_a_temporary_cache_serves_where_there_is_no_other(installed: Path, tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    alone = run(installed, CALL, temporary)
    assert alone.returncode != 0 and "cannot cache function" in alone.stderr
    done = run(installed, PROVIDE + CALL, temporary)
    assert done.returncode == 0, done.stderr
    folder = Path(done.stdout.splitlines()[0])
    assert folder.parent == temporary and folder.stat().st_mode & 0o777 == 0o700
    kept = {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb*")}
    assert kept
    # The next process finds what the first compiled.
    assert run(installed, PROVIDE + CALL, temporary).stdout == done.stdout
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb*")} == kept


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="takes a folder in which even root can make nothing")
def test_a_folder_that_others_prepared_is_not_taken(installed: Path, tmp_path: Path) -> None:
    first = Path(run(installed, PROVIDE, tmp_path).stdout.strip())
    first.chmod(0o777)
    other = Path(run(installed, PROVIDE, tmp_path).stdout.strip())
    assert other != first and other.stat().st_mode & 0o777 == 0o700
    first.rmdir()
    first.symlink_to(tmp_path)
    assert Path(run(installed, PROVIDE, tmp_path).stdout.strip()) not in (first, tmp_path)


def test_nothing_changes_where_there_is_a_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(compiled_cache.VARIABLE, raising=False)
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.setattr(compiled_cache, "__file__", str(tmp_path / "compiled_cache.py"))
    assert compiled_cache.provide_cache() is None and compiled_cache.VARIABLE not in os.environ
    monkeypatch.setenv(compiled_cache.VARIABLE, str(tmp_path))
    assert compiled_cache.provide_cache() is None and os.environ[compiled_cache.VARIABLE] == str(tmp_path)


def test_a_temporary_cache_is_said_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = tmp_path / "omnilines-someone-0123"
    folder.mkdir()
    monkeypatch.setenv(compiled_cache.VARIABLE, str(folder))
    note = compiled_cache.note_on_cache()
    assert note is not None and str(folder) in note and compiled_cache.VARIABLE in note
    (folder / "compiled.nbi").write_text("")
    assert compiled_cache.note_on_cache() is None
    monkeypatch.setenv(compiled_cache.VARIABLE, str(tmp_path / "of the user"))
    assert compiled_cache.note_on_cache() is None
    monkeypatch.delenv(compiled_cache.VARIABLE)
    assert compiled_cache.note_on_cache() is None
