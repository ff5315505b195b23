"""`omnilines view` and what shells are told of commands."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from camera_models import InputError
from omnilines.cli import main
from omnilines.commands import view as module


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "report.html").write_text("<title>of it</title>")
    (tmp_path / "scene.rrd").write_bytes(b"RRF2")
    return tmp_path


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["view", *arguments])
    assert not ended.value.code
    return capsys.readouterr().out


def test_a_report_is_opened(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    opened: list[str] = []
    monkeypatch.setattr(module.webbrowser, "open", lambda address: opened.append(address) or True)
    monkeypatch.setenv("DISPLAY", ":0")
    assert json.loads(run([str(folder), "--json"], capsys))["opened"] is True
    assert "opened in  the browser" in run([str(folder / "report.html")], capsys)
    assert opened == [(folder / "report.html").as_uri()] * 2


def test_without_a_browser_the_path_is_told(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module.sys, "platform", "linux")
    for name in module.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(module.webbrowser, "open", lambda address: pytest.fail("a browser was started"))
    told = run([str(folder)], capsys)
    assert str(folder / "report.html") in told and "open it on another machine" in told


def test_a_recording_goes_to_rerun(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    started: list[Any] = []
    monkeypatch.setattr(module.subprocess, "Popen", lambda command, **_: started.append(command))
    monkeypatch.setenv("DISPLAY", ":0")
    assert "the viewer of rerun" in run([str(folder), "--rerun"], capsys)
    assert started == [[sys.executable, "-m", "rerun", str(folder / "scene.rrd")]]


def test_what_there_is_not_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"A folder with report\.html was expected, found .*; run calibrate"):
        module.view(tmp_path)
    with pytest.raises(InputError, match=r"with scene\.rrd was expected, .* reconstruct with --recording"):
        module.view(tmp_path / "nowhere", rerun=True)
    (tmp_path / "notes.txt").write_text("no report")
    with pytest.raises(InputError, match=r"holds none"):
        module.view(tmp_path / "notes.txt")


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (["cali"], ["calibrate"]),
        (["calibrate", "photos", "--refine"], ["--refine-board"]),
        (["calibrate", "photos", "--model", "s"], ["scaramuzza"]),
        (["convert", "a.yaml", "b.json", "--to", "open"], ["opensfm", "openmvg", "opencv"]),
    ],
)
def test_a_shell_completes(typed: list[str], offered: list[str]) -> None:
    asked = {"_OMNILINES_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(["omnilines", *typed]), "COMP_CWORD": str(len(typed))}
    script = "import sys; sys.argv = ['omnilines']; from omnilines.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", script], env=os.environ | asked, capture_output=True, text=True, check=True)
    assert sorted(done.stdout.split()) == sorted(offered) and not done.stderr
