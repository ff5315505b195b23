"""What the installation is, and that it is told what is wrong with it."""

import importlib.metadata
import json
import sys

import pytest

from omnilines.cli import main
from omnilines.commands import doctor as module
from omnilines.commands.doctor import ABSENT, OPENCV, doctor


def run(*arguments: str, capsys: pytest.CaptureFixture[str]) -> dict:
    with pytest.raises(SystemExit) as stopped:
        main(["doctor", *arguments, "--json"])
    assert not stopped.value.code
    return json.loads(capsys.readouterr().out)


def test_versions_cores_and_extras_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    told = run("--no-check", capsys=capsys)
    assert told["packages"]["torch"] == importlib.metadata.version("torch") and ABSENT not in told["packages"].values()
    assert told["packages"]["Python"] == ".".join(map(str, sys.version_info[:3])) and told["machine"]["cores"] >= 1
    assert set(told["extras"]) >= {"parquet", "viewer"}


def test_what_is_absent_or_lies_over_another_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    known = importlib.metadata.version

    def version(name: str) -> str:
        if name in ("trimesh", "pyarrow"):
            raise importlib.metadata.PackageNotFoundError(name)
        return "5.0" if name == "opencv-python" else known(name)

    monkeypatch.setattr(module.importlib.metadata, "version", version)
    result = doctor(check=False)
    assert result.data["extras"]["parquet"] == "pip install 'omnilines[parquet]'"
    absent, over = result.warnings
    assert absent.startswith("not installed: trimesh") and over.startswith(f"opencv-python lies over {OPENCV}")


@pytest.mark.full
def test_the_self_check_holds(capsys: pytest.CaptureFixture[str]) -> None:
    told = run(capsys=capsys)
    assert len(told["checks"]) == 14 and all(check["holds"] for check in told["checks"])
