"""The wheel holds exactly the three packages, and works from an environment that holds nothing but what it asks for."""

import os
import pathlib
import subprocess
import sys
import zipfile
from importlib.metadata import version

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGES = ("camera_models", "calib_patterns", "omnilines")
CONSTRAINTS = "constraints.txt"

IMPORT_EVERYTHING = """
import importlib, pathlib, pkgutil
count = 0
for name in ("camera_models", "calib_patterns", "omnilines"):
    package = importlib.import_module(name)
    print(pathlib.Path(package.__file__).parent)
    for module in pkgutil.walk_packages(package.__path__, f"{name}."):
        importlib.import_module(module.name)
        count += 1
print(count)
"""


def run(*command: str | pathlib.Path, cwd: pathlib.Path) -> str:
    """Standard output of a command that must succeed, with the build and pip held to the constraints and no other setting."""
    # Relative, since pip splits the variable at blanks: a path may hold some. pip from 25.3 reads the second for builds.
    pinned = {"PIP_CONSTRAINT": CONSTRAINTS, "PIP_BUILD_CONSTRAINT": CONSTRAINTS} if cwd == ROOT else {}
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        command, cwd=cwd, env={**inherited, **pinned}, capture_output=True, text=True, check=False, timeout=1500
    )
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The wheel of the working tree."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--wheel", "--outdir", out, ".", cwd=ROOT)
    (path,) = out.glob("*.whl")
    return path


@pytest.mark.slow
def test_wheel_holds_exactly_the_three_packages(wheel: pathlib.Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    own = {name for name in names if not name.startswith(f"omnilines-{version('omnilines')}.dist-info/")}
    in_tree = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert own == in_tree
    assert {f"{package}/py.typed" for package in PACKAGES} <= own
    assert "omnilines/report/templates/page.html.j2" in own
    licences = {pathlib.PurePosixPath(name).name for name in names - own if "/licenses/" in name}
    assert licences == {"LICENSE", "THIRD_PARTY.md"}


@pytest.mark.full
def test_wheel_works_in_an_empty_environment(wheel: pathlib.Path, tmp_path: pathlib.Path) -> None:
    environment, elsewhere = tmp_path / "env", tmp_path / "elsewhere"
    elsewhere.mkdir()
    run(sys.executable, "-m", "venv", environment, cwd=elsewhere)
    binaries = environment / ("Scripts" if os.name == "nt" else "bin")
    run(binaries / "python", "-m", "pip", "install", "--quiet", "-c", CONSTRAINTS, wheel, cwd=ROOT)

    assert run(binaries / "omnilines", "--version", cwd=elsewhere).strip() == f"omnilines {version('omnilines')}"
    help_text = run(binaries / "omnilines", "--help", cwd=elsewhere)
    assert "calibrate" in help_text and "reconstruct" in help_text
    run(binaries / "python", "-m", "pip", "check", cwd=elsewhere)
    # Imported when it is needed, hence not by what follows; poses from photos alone are no extra.
    run(binaries / "python", "-c", "from omnilines.posing._pycolmap import pycolmap; pycolmap()", cwd=elsewhere)

    *folders, count = run(binaries / "python", "-c", IMPORT_EVERYTHING, cwd=elsewhere).splitlines()
    assert len(folders) == len(PACKAGES)
    assert all(environment in pathlib.Path(folder).parents for folder in folders)
    assert int(count) > 20
