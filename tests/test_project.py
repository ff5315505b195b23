"""The project holds together: README, docs and changelog say what the code does, modules stay small, imports keep direction."""

import contextlib
import json
import os
import pathlib
import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, metadata, requires, version

import pytest
import tables
import typer
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import omnilines.files.corners
import omnilines.files.lines
import omnilines.files.poses
import omnilines.files.segments
from calib_patterns import pattern
from camera_models.formats.calibration_data import SIGN_SOURCES
from omnilines.cli import app
from omnilines.records import LINE_STATUSES

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGES = ("camera_models", "calib_patterns", "omnilines")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
FORMATS = (ROOT / "docs" / "formats.md").read_text()


def section(text: str, title: str) -> str:
    """What stands under a heading of the second level."""
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    assert found, f"no section '{title}'"
    return found[1]


def table(text: str) -> list[list[str]]:
    """Cells of the rows of the first table in a text, without its header."""
    found = re.search(r"^\|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.M)
    assert found, "no table"
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in found[1].splitlines()]


COMMANDS = dict(tables.leaf_commands(typer.main.get_command(app)))


def test_every_command_takes_json_and_has_it_documented() -> None:
    documented = set(re.findall(r"`([a-z ]+)`", "".join(re.findall(r"^(`.*):$", section(FORMATS, "JSON"), re.M))))
    assert documented == COMMANDS.keys()
    for name, command in COMMANDS.items():
        assert "--json" in {option for parameter in command.params for option in parameter.opts}, name


def test_commands_written_in_the_documents_exist() -> None:
    written = "\n".join(path.read_text() for path in DOCUMENTS).replace("\\\n", " ")
    code = (
        re.findall(r"^ {4,}(.+)$", written, re.M)
        + "".join(re.findall(r"^```bash\n(.*?)^```$", written, re.M | re.S)).splitlines()
    )
    calls = [
        call
        for line in code
        for call in re.findall(r"(?:^(?:\$ )?|\|\| )omnilines (?!--threads|--install-completion)([^|]+)", line)
    ]
    assert len(calls) > 100
    for call in calls:
        names = [name for name in COMMANDS if f"{call} ".startswith(f"{name} ")]
        assert len(names) == 1, call
        known = {option for parameter in COMMANDS[names[0]].params for option in parameter.opts}
        given = set(re.findall(r"(?<=\s)--[a-z-]+", call))
        assert given <= known, f"{call}: {given - known}"


def test_the_readme_begins_with_the_main_job_and_the_tests() -> None:
    """On a machine with nothing but Python and make; `.ci/run` calls the second."""
    commands = re.findall(r"^    make (\w+)", (ROOT / "README.md").read_text(), re.M)
    assert commands[:2] == ["demo", "test"]
    rules = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))
    assert set(commands) <= rules
    assert "make test" in (ROOT / ".ci" / "run").read_text()


def test_targets_written_in_the_documents_can_be_given() -> None:
    """Whole specifications in code, such as `checkerboard:8x6:30mm`; forms as `aprilgrid:NXxNY:...` are no specifications."""
    written = {
        found.rstrip(".:,")
        for path in DOCUMENTS
        for found in re.findall(r"(?<![\w-])(?:checkerboard|charuco|aprilgrid):\d[\w.:=]*", path.read_text())
    }
    assert len(written) > 5
    for specification in sorted(written):
        pattern(specification)


def test_tests_leave_no_folders_behind() -> None:
    """Pytest removes those of `tmp_path`, a TemporaryDirectory goes by itself; a folder of `mkdtemp` stays."""
    own = pathlib.Path(__file__)
    leaving = [path.name for path in sorted(own.parent.rglob("*.py")) if path != own and "mkdtemp" in path.read_text()]
    assert leaving == []


def test_every_link_in_the_documents_leads_somewhere() -> None:
    links = 0
    for path in DOCUMENTS:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)", path.read_text()):
            assert (path.parent / target).exists(), f"{path.name}: {target}"
            links += 1
    assert links > 3


def test_documented_columns_are_those_of_the_readers() -> None:
    rows = {row[0].strip("`"): [re.findall(r"[\w,]+", cell) for cell in row[1:]] for row in table(section(FORMATS, "Tables"))}
    modules = {
        "corners.csv": omnilines.files.corners,
        "poses.csv": omnilines.files.poses,
        "segments.csv": omnilines.files.segments,
        "lines.csv": omnilines.files.lines,
    }
    assert rows.keys() == modules.keys()
    for name, module in modules.items():
        required, optional = rows[name]
        assert required == [",".join(module.COLUMNS)]
        documented = {column for cell in optional if cell != "or" for column in cell.split(",")}
        assert set(getattr(module, "OPTIONAL", ())) == documented


def test_documented_statuses_are_those_of_the_records() -> None:
    listed = [cells[0] for cells in (line.strip("|").split("|") for line in section(FORMATS, "Tables").splitlines()) if cells]
    statuses = [cell.strip(" `") for cell in listed if re.fullmatch(r" `[a-z_]+` ", cell)]
    assert statuses == list(LINE_STATUSES)
    for source in SIGN_SOURCES:
        assert re.search(rf"sign_source: .*\b{source}\b", FORMATS)


def test_changelog_has_the_version() -> None:
    assert version("omnilines") == PYPROJECT["project"]["version"]
    assert re.search(rf"^## {re.escape(PYPROJECT['project']['version'])}\b", (ROOT / "CHANGELOG.md").read_text(), re.M)


def test_modules_are_short() -> None:
    modules = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    assert len(modules) > 20
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in modules}
    assert {name: length for name, length in lengths.items() if length > 400} == {}


def test_imports_keep_their_direction() -> None:
    lint_imports = pathlib.Path(sys.executable).with_name("lint-imports")
    if not lint_imports.exists():
        if os.environ.get("CI"):
            pytest.fail("CI must have import-linter (make lint installs it); it is absent.")
        pytest.skip("import-linter is absent; make lint installs it")
    done = subprocess.run([lint_imports, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_constraints_hold_every_direct_dependency() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    pins = [Requirement(line) for line in lines]
    assert all(re.fullmatch(r"==[\w.]+", str(pin.specifier)) for pin in pins)
    pinned = {canonicalize_name(pin.name): pin for pin in pins}
    assert len(pinned) == len(pins)
    project = PYPROJECT["project"]
    wanted = [*project["dependencies"], *PYPROJECT["build-system"]["requires"]]
    for extra in project["optional-dependencies"].values():
        wanted += extra
    for requirement in map(Requirement, wanted):
        pin = pinned[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(str(pin.specifier).removeprefix("==")), requirement
        assert f"{requirement.name}".lower() in (ROOT / "THIRD_PARTY.md").read_text().lower()


def closure(requirements: list[str]) -> dict[str, str]:
    """Versions of the installed distributions that the requirements and their own requirements ask for, on this machine."""
    found: dict[str, str] = {}
    waiting = [(Requirement(text), ("",)) for text in requirements]
    while waiting:
        requirement, extras = waiting.pop()
        name = canonicalize_name(requirement.name)
        wanted = requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in extras)
        if not wanted or name in found:
            continue
        found[name] = version(name)
        waiting += [(Requirement(text), ("", *requirement.extras)) for text in requires(name) or ()]
    return found


def test_constraints_are_complete() -> None:
    # Of what is installed: lint's packages are absent where only the tests were asked for.
    project = PYPROJECT["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["test"]]
    with contextlib.suppress(PackageNotFoundError):
        wanted = [*wanted, *closure(project["optional-dependencies"]["lint"])]
    installed = {name: found.partition("+")[0] for name, found in closure(wanted).items()}
    assert len(installed) > 30
    pins = dict(re.findall(r"^([\w.-]+)==([\w.]+)$", (ROOT / "constraints.txt").read_text(), re.M))
    assert installed.items() <= pins.items(), dict(installed.items() - pins.items())


PERMISSIVE = (
    "mit", "mit-cmu", "bsd", "0bsd", "bsd license", "bsd-2-clause", "bsd-3-clause", "bsd 3-clause", "apache-2.0",
    "apache software license", "apache-2.0 with llvm-exception", "isc license (iscl)", "mit license", "bsl-1.0", "zlib",
    "cc0-1.0", "psf-2.0", "python software foundation license",
)  # fmt: skip
"""Licences as packages state them: an expression, a classifier, or a word."""


def test_all_that_is_run_has_a_permissive_licence() -> None:
    extras = PYPROJECT["project"]["optional-dependencies"]
    installed = closure([*PYPROJECT["project"]["dependencies"], *extras["parquet"], *extras["cluster"]])
    assert len(installed) > 25
    for name in installed:
        about = metadata(name)
        classifiers = [text.rpartition("::")[2] for text in about.get_all("Classifier") or [] if text.startswith("License")]
        expression = about.get("License-Expression")
        stated = [expression] if expression else classifiers or [str(about.get("License"))]
        parts = [part.strip().lower() for text in stated for part in re.split(r" AND | OR ", text)]
        assert parts and all(part in PERMISSIVE for part in parts), (name, stated)


HEAVY = (
    "torch",
    "cv2",
    "scipy",
    "kornia",
    "plotly",
    "trimesh",
    "jinja2",
    "matplotlib",
    "numba",
    "pycolmap",
    "pyarrow",
    "rerun",
    "dask",
)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["calibrate", "--help"], ["validate", "--help"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    script = (
        "import json, sys\n"
        "from omnilines.cli import main\n"
        "try:\n"
        f"    main({arguments!r})\n"
        "except SystemExit as end:\n"
        "    assert not end.code, end.code\n"
        "print()\n"
        "print(json.dumps(sorted(name.partition('.')[0] for name in sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    loaded = set(json.loads(done.stdout.splitlines()[-1]))
    assert "typer" in loaded
    assert not loaded & set(HEAVY)
