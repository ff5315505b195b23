"""Calibration and check by lines from the command line, in rendered rooms."""

import json
import math
from pathlib import Path

import pytest
from drawn_chains import FISHEYE, disturbed

import omnilines as ol
from omnilines.cli import main
from omnilines.evaluation.cameras import bearing_error_deg


def status_of(*arguments: str) -> int:
    """That a command ends with."""
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    return int(end.value.code or 0)


@pytest.mark.full
def test_a_room_calibrates_and_checks_a_fisheye_without_a_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room, out = tmp_path / "room", tmp_path / "out"
    ol.render("plain-room", "opencv-fisheye", fov_deg=190.0, views=6, size_px=(800, 600), seed=1).save(room)
    (room / "torn.png").write_bytes(b"no photo")
    lines = ("--pattern", "lines", "--model", "opencv-fisheye")
    assert status_of("calibrate", str(room), *lines, "--out", str(out), "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["open"] == [] and list(data["skipped"]) == ["torn.png"]
    assert "Photos that were not used" in (out / "report.html").read_text()
    (room / "torn.png").unlink()
    truth, found = ol.load(room / "calibration.yaml")["cam0"], ol.load(out / "calibration.yaml")
    assert bearing_error_deg(found["cam0"], truth, math.radians(found.estimates["cam0"].max_angle_deg or 0.0))[0] < 0.1
    true = ("--calibration", str(room / "calibration.yaml"))
    assert status_of("check", str(room), *true, "--out", str(tmp_path / "check")) == 0
    assert len((tmp_path / "check" / "check.csv").read_text().splitlines()) == 10
    wrong = tmp_path / "wrong.yaml"
    ol.save(wrong, ol.Calibration({"cam0": disturbed(truth, cx=4.0)}))
    assert status_of("check", str(room), "--calibration", str(wrong)) == 1


@pytest.mark.full
def test_a_room_calibrates_a_mirror_without_a_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room, out = tmp_path / "room", tmp_path / "out"
    ol.render("plain-room", "scaramuzza", fov_deg=200.0, views=6, size_px=(640, 480), seed=7, mirror=True).save(room)
    options = ("--pattern", "lines", "--model", "scaramuzza", "--mirror")
    assert status_of("calibrate", str(room), *options, "--out", str(out), "--json") == 0
    assert json.loads(capsys.readouterr().out)["parameters"]["a0"] < 0
    truth, found = ol.load(room / "calibration.yaml")["cam0"], ol.load(out / "calibration.yaml")
    assert bearing_error_deg(found["cam0"], truth, math.radians(95.0))[0] < 0.1
    assert found.estimates["cam0"].sign_source == "mirror"


@pytest.mark.full
def test_a_board_and_a_room_calibrate_a_fisheye_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Few photos of a board, far from the rim, and photos of a room: together as good as either at least."""
    truth, photos = FISHEYE, tmp_path / "photos"
    ol.render("checkerboard:8x6:30mm", truth, views=5, seed=3).save(tmp_path / "board")
    ol.render("plain-room", truth, views=5, seed=3).save(tmp_path / "room")
    photos.mkdir()
    for kind in ("board", "room"):
        for path in sorted((tmp_path / kind).glob("*.png")):
            path.rename(photos / f"{kind}_{path.name}")
    found = {}
    for pattern in ("checkerboard:8x6:30mm", "lines", "checkerboard:8x6:30mm,lines"):
        arguments = ("--pattern", pattern, "--model", "opencv-fisheye", "--out", str(tmp_path / "out" / pattern[-5:]), "--json")
        assert status_of("calibrate", str(photos), *arguments) == 0
        found[pattern] = json.loads(capsys.readouterr().out)
    board, lines, joint = found.values()
    assert joint["corners"] > 150 and lines["corners"] == 0
    for name, sigma in joint["sigma"].items():
        assert sigma < 1.05 * min(board["sigma"][name], lines["sigma"][name])
        assert abs(joint["parameters"][name] - truth.named_parameters()[name]) < 4.5 * sigma
    assert not any("contradict" in note for note in joint["notes"])
    # Such as that a term of the distortion is held at 0, which it is not once lines are there.
    assert board["notes"] and all(f"From corners alone: {note}" in joint["notes"] for note in board["notes"])


@pytest.mark.parametrize(
    "options",
    [["--rolling-shutter"], ["--refine-board", "aspect"], ["--set", "calibration.searches=1"], ["--loss", "huber"]],
)
def test_what_does_not_count_with_lines_is_refused(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["calibrate", str(tmp_path), "--pattern", "lines", "--out", str(tmp_path / "out"), *options]
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert "counts only with a target" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--mirror", "--rolling-shutter"])
def test_what_lines_do_not_know_is_refused_with_a_board_beside(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert status_of("calibrate", str(tmp_path), "--pattern", "checkerboard:8x6:30mm,lines", "--out", str(out), option) == 2
    assert "counts only with a target alone" in capsys.readouterr().err
    assert not out.exists()
