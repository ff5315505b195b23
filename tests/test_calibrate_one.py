"""`ol.calibrate`: what the command line calibrates from a pattern, Python does in the same words, to the last bit."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import omnilines as ol
from calib_patterns import pattern
from omnilines.calibration.lines.options import LineOptions
from omnilines.cli import main
from omnilines.options import with_settings
from omnilines.pipelines.calibrate import CalibrationResult
from omnilines.pipelines.calibrate_lines import LineResult, calibrate_lines

BOARD = "checkerboard:5x4:60mm"
LENS = "opencv-fisheye"


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room, and a board beside it, by one small fisheye."""
    folder = tmp_path_factory.mktemp("photos")
    room = ol.render("plain-room", LENS, fov_deg=170.0, views=3, size_px=(320, 240), seed=1)
    room.save(folder / "room")
    ol.render(BOARD, room.camera, views=4, seed=3).save(folder / "board")
    (folder / "both").mkdir()
    for kind in ("room", "board"):
        for path in (folder / kind).glob("*.png"):
            (folder / "both" / f"{kind}_{path.name}").write_bytes(path.read_bytes())
    return folder


def same(one: CalibrationResult | LineResult, other: CalibrationResult | LineResult) -> bool:
    """To the last bit."""
    equal = bool((one.camera.parameters == other.camera.parameters).all()) and np.array_equal(one.covariance, other.covariance)
    return equal and one.calibration.provenance["inputs"] == other.calibration.provenance["inputs"]


def commanded(photos: Path, text: str, out: Path) -> Any:
    """What the command line writes."""
    with pytest.raises(SystemExit):
        main(["calibrate", str(photos), "--pattern", text, "--model", LENS, "--out", str(out)])
    return ol.load(out / "calibration.yaml")["cam0"].parameters


@pytest.mark.slow
def test_a_target_is_that_of_its_corners(photos: Path, tmp_path: Path) -> None:
    result = ol.calibrate(photos / "both", BOARD, model=LENS)
    assert isinstance(result, CalibrationResult)
    found = ol.detect(photos / "both", BOARD)
    assert same(result, ol.calibrate(found, model=LENS))
    assert same(result, ol.calibrate(photos / "both", pattern(BOARD), ol.CalibrationOptions(LENS)))
    assert bool((commanded(photos / "both", BOARD, tmp_path / "out") == result.camera.parameters).all())
    size = found.image_size
    assert same(ol.calibrate(found.corners, size, model=LENS), ol.calibrate(found.corners, image_size=size, model=LENS))


@pytest.mark.slow
def test_lines_are_those_of_their_pipeline(photos: Path) -> None:
    quick = ol.LinesOptions(adjustment=LineOptions(most_starts=1, rounds=1))
    result = ol.calibrate(str(photos / "room"), "lines", model=LENS, lines=quick)
    assert isinstance(result, LineResult) and result.boards is None
    straight = sum(photo.straight for photo in result.fit.photos)
    assert repr(result) == f"LineResult({result.camera}, photos={len(result.fit.photos)}, straight_lines={straight})"
    assert same(result, calibrate_lines(photos / "room", model=LENS, lines=quick))
    lens, half = ol.load(photos / "room" / "calibration.yaml")["cam0"], math.radians(85.0)
    rim, _ = lens.project([[math.sin(half), 0.0, math.cos(half)]])
    assert result.rim_px == pytest.approx(float(np.linalg.norm(rim - lens.centre_px.detach().numpy())), abs=2.0)


@pytest.mark.full
def test_a_target_and_lines_are_one_adjustment(photos: Path, tmp_path: Path) -> None:
    result = ol.calibrate(photos / "both", f"{BOARD}, lines", model=LENS)
    assert isinstance(result, LineResult) and result.boards is not None
    assert bool((commanded(photos / "both", f"lines,{BOARD}", tmp_path / "out") == result.camera.parameters).all())
    known = ol.calibrate(ol.detect(photos / "both", BOARD), model=LENS)
    assert same(result, ol.calibrate(photos / "both", "lines", model=LENS, boards=known))


CORNERS = {"a": (np.zeros((4, 3)), np.zeros((4, 2)))}
PICTURES = {"a": np.zeros((240, 320), np.uint8)}
SOFT = with_settings(ol.DetectionOptions(), ["detection.fit.max_sigma_px=0.3"], "detection.")
FEW = ol.LinesOptions(adjustment=LineOptions(searches=3))
CALIBRATE: Any = ol.calibrate
"""With what its types refuse."""


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: CALIBRATE("photos/"), "`pattern` was expected with photos, found none"),
        (lambda: CALIBRATE(PICTURES), "`pattern` was expected with photos, found none"),
        (lambda: CALIBRATE(["a.png"], (320, 240)), "`pattern` was expected with photos, found none"),
        (lambda: CALIBRATE(None), "or photos and a pattern, were expected, found NoneType"),
        (lambda: CALIBRATE(np.zeros((240, 320)), BOARD), "with a pattern, found ndarray"),
        (lambda: CALIBRATE(CORNERS, "lines"), "with a pattern, found several arrays for one name"),
        (lambda: CALIBRATE({}, "lines"), "an empty one"),
        (lambda: CALIBRATE("photos/", f"{BOARD},charuco:5x4:60mm:45mm:DICT_4X4_50"), "One target was expected, found check"),
        (lambda: CALIBRATE(PICTURES, ""), "pattern"),
        (lambda: CALIBRATE(PICTURES, BOARD, image_size=(320, 240)), "`image_size` was expected with a table of corners alone"),
        (lambda: CALIBRATE(PICTURES, "lines", loss="huber"), "`loss` does not count with lines alone"),
        (lambda: CALIBRATE(PICTURES, "lines", detection=SOFT), "`detection` does not count with lines alone"),
        (lambda: CALIBRATE(PICTURES, f"{BOARD},lines", mirror=True), "`mirror` does not count with lines beside a target"),
        (lambda: CALIBRATE(PICTURES, f"{BOARD},lines", rolling_shutter=True), "`rolling_shutter` does not count with lines"),
        (lambda: CALIBRATE(PICTURES, BOARD, lines=FEW), "`lines` does not count with a target alone"),
        (lambda: CALIBRATE(CORNERS, (320, 240), detection=SOFT), "`detection` does not count with corners"),
        (lambda: CALIBRATE("no_such_folder/", "lines"), "no_such_folder"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_said(call: Callable[[], object], words: str) -> None:
    with pytest.raises(ol.InputError, match=words):
        call()


def test_corners_with_a_pattern_and_folders_of_a_rig_are_refused(photos: Path, tmp_path: Path) -> None:
    found = ol.detect(photos / "board", BOARD)
    with pytest.raises(ol.InputError, match="with a pattern, found PhotoCorners"):
        CALIBRATE(found, "lines")
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        for path in (photos / "room").glob("*.png"):
            (tmp_path / name / path.name).write_bytes(path.read_bytes())
    for what in ("lines", BOARD, f"{BOARD},lines"):
        for given in (tmp_path, [tmp_path / "left", tmp_path / "right"]):
            with pytest.raises(ol.InputError, match="photos of the same names in left and right; calibrate a rig"):
                CALIBRATE(given, what)
    with pytest.raises(ol.InputError, match="found RigCorners; of a rig `calibrate_rig`"):
        CALIBRATE(ol.detect_rig({"left": photos / "board"}, BOARD))
