"""A command that is stopped after some of its photos: the same command goes on from what they were found to show."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from test_kept import board

import omnilines as ol
from calib_patterns import DetectionOptions
from calib_patterns.checkerboard import Checkerboard
from omnilines.commands import calibrate_lines, check, detect, directions, extract, frames, rectify
from omnilines.extraction import ExtractionOptions
from omnilines.extraction.options import SmoothChainOptions
from omnilines.files.folders import WORK
from omnilines.geometry.chains import Chains
from omnilines.pipelines import arc_chains, arcs, chains, kept_results
from omnilines.pipelines.check_options import CheckOptions
from omnilines.pipelines.line_options import LinesOptions
from omnilines.progress import ProgressCallback, silent

TARGET = "checkerboard:5x4:30mm"
OTHER_ARCS = ExtractionOptions(min_length_px=12.0)
OTHER_LINES = LinesOptions(extraction=OTHER_ARCS)
STOPPED_AFTER = 2


@dataclass(frozen=True)
class Case:
    """A command that looks at photos."""

    run: Callable[[Path, Path, ProgressCallback, bool], object]
    """Of the folder of inputs, that of results, what is told of the progress, and whether other options are asked for."""
    stage: str
    """In which it is stopped."""
    looks: tuple[Any, str]
    """What looks at one photo: where it stands, and its name."""


def lines_of(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    return calibrate_lines.calibrate_line_photos([given / "room"], "lines", out, FISHEYE, progress=tell)


def smooth_chains_of(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    options = SmoothChainOptions(strong_grey=30.0 if other else SmoothChainOptions().strong_grey)
    found = chains.chains_of(given / "room", options=options, work=out / WORK, progress=tell)
    return np.savez(out / "chains.npz", **table_of(found.chains), circle=np.array(found.circle))


def arc_chains_of(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    model = ol.load(given / "calibration.yaml")["cam0"]
    arcs = OTHER_ARCS if other else ExtractionOptions()
    found, _ = arc_chains.arc_chains_of(given / "room", model, arcs, work=out / WORK, progress=tell)
    return np.savez(out / "chains.npz", **table_of(found))


def table_of(chains: Chains) -> dict[str, Any]:
    return {**vars(chains)}


def detected(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    return detect.detect([given / "boards"], TARGET, out, options=DetectionOptions(min_corners=7 if other else 6), progress=tell)


def frames_of(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    return frames.frames(
        [given / "board.avi"], out, TARGET, detection=DetectionOptions(min_corners=7 if other else 6), progress=tell
    )


def arcs_of(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    options = OTHER_ARCS if other else ExtractionOptions()
    return extract.extract([given / "room"], given / "calibration.yaml", out, options=options, progress=tell)


def directions_of(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    arcs = OTHER_ARCS if other else ExtractionOptions()
    return directions.directions([given / "room"], given / "calibration.yaml", out, extraction=arcs, progress=tell)


def upright(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    arcs = OTHER_ARCS if other else ExtractionOptions()
    return rectify.rectify([given / "room"], given / "calibration.yaml", out, upright=True, extraction=arcs, progress=tell)


def checked(given: Path, out: Path, tell: ProgressCallback, other: bool) -> object:
    options = CheckOptions(lines=OTHER_LINES) if other else CheckOptions()
    return check.check([given / "room"], given / "calibration.yaml", out, options=options, progress=tell)


FISHEYE = ol.CalibrationOptions(model="opencv-fisheye")
CASES = {
    "detect": Case(detected, "detecting corners", (Checkerboard, "detect")),
    "frames": Case(frames_of, "looking at frames", (Checkerboard, "detect")),
    "extract": Case(arcs_of, "extracting arcs", (arcs, "extract_arcs")),
    "directions": Case(directions_of, "extracting arcs", (arcs, "extract_arcs")),
    "rectify": Case(upright, "extracting arcs", (arcs, "extract_arcs")),
    "check": Case(checked, "extracting arcs", (arc_chains, "arc_chains")),
    "edges without a camera": Case(smooth_chains_of, "following edges", (chains, "smooth_chains")),
    "edges of arcs": Case(arc_chains_of, "extracting arcs", (arc_chains, "arc_chains")),
}
SLOW = {"frames", "directions", "rectify", "check"}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos of a board, a video of it, and photos of a room with its camera."""
    folder = tmp_path_factory.mktemp("given")
    (folder / "boards").mkdir()
    video = cv2.VideoWriter(str(folder / "board.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (320, 240))
    for k in range(5):
        cv2.imwrite(str(folder / "boards" / f"{k}.png"), board(5 * k))
        for _ in range(4):
            video.write(cv2.cvtColor(board(5 * k), cv2.COLOR_GRAY2BGR))
    video.release()
    room = folder / "room"
    ol.render("plain-room", "opencv-fisheye", fov_deg=190.0, views=5, size_px=(400, 300), seed=1).save(room)
    (room / "calibration.yaml").rename(folder / "calibration.yaml")
    return folder


def counted(monkeypatch: pytest.MonkeyPatch, where: Any, what: str) -> list[int]:
    """A list that grows with every call of a function."""
    calls, real = list[int](), getattr(where, what)

    def count(*given: Any, **named: Any) -> Any:
        calls.append(1)
        return real(*given, **named)

    monkeypatch.setattr(where, what, count)
    return calls


def stop(stage: str) -> ProgressCallback:
    """Stops a run in a stage."""

    def tell(now: str, done: int, total: int) -> None:
        if now == stage and done >= STOPPED_AFTER:
            raise ol.Cancelled

    return tell


def results(out: Path) -> dict[str, bytes]:
    paths = (path for path in out.rglob("*") if path.is_file())
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in paths if path.relative_to(out).parts[0] != WORK}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in CASES])
def test_the_same_command_goes_on_to_the_same_bytes(
    name: str, given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, looked = CASES[name], counted(monkeypatch, *CASES[name].looks)
    monkeypatch.setattr("omnilines.progress.cores", lambda: 1)

    def looks(out: Path, tell: ProgressCallback = silent, other: bool = False) -> int:
        looked.clear()
        case.run(given, tmp_path / out, tell, other)
        return len(looked)

    every = looks(Path("whole"))
    with pytest.raises(ol.Cancelled):
        looks(Path("stopped"), stop(case.stage))
    assert set(path.name for path in (tmp_path / "stopped").iterdir()) == {WORK}
    kept = len(list((tmp_path / "stopped" / WORK).rglob("*.npz")))
    assert STOPPED_AFTER <= kept
    rest = looks(Path("stopped"))
    assert 0 < rest <= every - STOPPED_AFTER
    assert results(tmp_path / "stopped") == results(tmp_path / "whole") and looks(Path("stopped")) == 0
    # Other options, and other code.
    assert looks(Path("stopped"), other=True) == every
    monkeypatch.setattr(kept_results, "revision", lambda *made_by: "other")
    assert looks(Path("stopped")) == every


def test_another_photo_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos, looked = {f"{k}.png": board(5 * k) for k in range(3)}, counted(monkeypatch, Checkerboard, "detect")
    for changed, count in ((None, 3), (None, 0), ("1.png", 1)):
        looked.clear()
        if changed:
            photos[changed] = np.ascontiguousarray(photos[changed][:, ::-1])
        # Of photos in memory their pixels count, as those of files do.
        ol.detect(photos, TARGET, work=tmp_path / "work")
        assert len(looked) == count


@pytest.mark.slow
def test_a_calibration_by_lines_goes_on_to_the_same_bytes(given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera that leads to arcs is the same to the last bit where it is made of edges that were kept."""
    smooth, along = counted(monkeypatch, chains, "smooth_chains"), counted(monkeypatch, arc_chains, "arc_chains")
    monkeypatch.setattr("omnilines.progress.cores", lambda: 1)
    lines_of(given, tmp_path / "whole", silent, False)
    every = len(smooth)
    assert every == len(along)
    with pytest.raises(ol.Cancelled):
        lines_of(given, tmp_path / "stopped", stop("extracting arcs"), False)
    smooth.clear()
    along.clear()
    lines_of(given, tmp_path / "stopped", silent, False)
    assert not smooth and 0 < len(along) <= every - STOPPED_AFTER
    assert results(tmp_path / "stopped") == results(tmp_path / "whole")
