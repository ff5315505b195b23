"""Where commands run: no home, a user without a name, one core, few files, nothing to print to, folders of others."""

import ctypes
import os
import resource
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hostile.good import SPEC, store

from omnilines.files import read_corners

ROOT = Path(__file__).parents[1]
START = "import sys\nfrom omnilines.cli import main\nmain(sys.argv[1:])\n"
NO_NAME = "import pwd\ndef none(*user):\n    raise KeyError('uid not found')\npwd.getpwuid = none\n"
DROP, OVERRIDE, READ_SEARCH = 24, 1, 2
"""PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH: with them root may write anywhere."""


def run(
    folder: Path,
    *arguments: str,
    before: Callable[[], object] | None = None,
    start: str = START,
    drop: tuple[str, ...] = (),
    **environment: str,
) -> subprocess.CompletedProcess[str]:
    """A command in a folder, with variables set and dropped; `before` is called in its process."""
    kept = {name: value for name, value in os.environ.items() if name not in drop}
    return subprocess.run(
        [sys.executable, "-c", start, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        check=False,
        preexec_fn=before,
        env={**kept, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **environment},
    )


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder beside the photos of a board."""
    (tmp_path / "photos").symlink_to(store() / "photos")
    return tmp_path


def detected(*more: str) -> tuple[str, ...]:
    return ("detect", "photos", "--pattern", SPEC, *more)


@pytest.mark.slow
def test_an_unfriendly_container(photos: Path) -> None:
    """All at once: none of it stops a calibration."""

    def poor() -> None:
        os.umask(0o077)
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
        os.close(0)

    name = f"results of Jürgen 写真 {'x' * 190}"
    done = run(
        photos,
        *("calibrate", "photos", "--pattern", SPEC, "--model", "opencv-fisheye", "--out", name),
        before=poor,
        start=NO_NAME + START,
        drop=("HOME", "USER", "LOGNAME", "LNAME", "USERNAME", "LC_ALL"),
        LANG="C",
        PYTHONHASHSEED="7",
        PYTHONUTF8="0",
        PYTHONCOERCECLOCALE="0",
        TMPDIR="/nonexistent",
        TERM="dumb",
        COLUMNS="1",
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert len(read_corners(photos / name / "corners.csv")) == 105
    assert stat.S_IMODE((photos / name / "report.html").stat().st_mode) == 0o600


@pytest.mark.slow
@pytest.mark.parametrize("closed", [pytest.param((2,), marks=pytest.mark.full), (0, 1, 2)], ids=str)
def test_closed_streams(photos: Path, closed: tuple[int, ...]) -> None:
    def close() -> None:
        for handle in closed:
            os.close(handle)

    done = run(photos, *detected("--out", "found"), before=close)
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == 0, (done.returncode, list(photos.glob("found/*")))
    assert len((photos / "found/corners.csv").read_text().splitlines()) > 50


# Every module is compiled anew for it: 12 s.
@pytest.mark.full
def test_photos_are_looked_at_without_docstrings(photos: Path) -> None:
    done = run(photos, *detected("--out", "found"), PYTHONOPTIMIZE="2")
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert len((photos / "found/corners.csv").read_text().splitlines()) > 50


def test_help_without_docstrings(tmp_path: Path) -> None:
    done = run(tmp_path, "calibrate", "--help", PYTHONOPTIMIZE="2", PYTHONIOENCODING="ascii", COLUMNS="100")
    assert done.returncode == 0 and "--pattern" in done.stdout, done.stderr


@pytest.fixture
def unprivileged() -> Callable[[], object]:
    """For root, whom permissions do not hold otherwise."""
    if os.geteuid() != 0:
        return lambda: None
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "prctl"):
        pytest.skip("takes a user whom permissions hold")
    return lambda: [library.prctl(DROP, capability, 0, 0, 0) for capability in (OVERRIDE, READ_SEARCH)]


@pytest.mark.slow
@pytest.mark.parametrize("where", [pytest.param(".", marks=pytest.mark.full), "results"])
def test_folders_that_cannot_be_written_to(photos: Path, unprivileged: Callable[[], object], where: str) -> None:
    folder = photos / "of_another"
    (folder / "results").mkdir(parents=True)
    (folder / where).chmod(0o555)
    try:
        done = run(photos, *detected("--out", "of_another/results/new"), before=unprivileged)
        if where == ".":
            assert done.returncode == 0, done.stderr
            return
        assert done.returncode == 2 and done.stdout == ""
        assert len(done.stderr.strip().splitlines()) == 1 and "of_another/results" in done.stderr and "written" in done.stderr
    finally:
        (folder / where).chmod(0o755)
