"""Figures of reports as files for papers: every figure of a page, with its curves where the page has them, black on white."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from report_page import every_section
from test_cli import CORNERS, corner_rows, refused, run, write_csv

import omnilines as ol
from camera_models import InputError
from omnilines import report
from omnilines.records import Polyline
from omnilines.report.paper import paper_figures


def of_corners(folder: Path) -> list[object]:
    """A calibration from a table."""
    table = write_csv(folder / "corners.csv", CORNERS, corner_rows())
    return ["calibrate", table, "--image-size", "640x480", "--model", "opencv-fisheye", "--out", folder / "out"]


def test_a_folder_that_is_none_is_refused_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert "is no folder" in refused(capsys, *of_corners(tmp_path), "--plots", tmp_path / "file")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "command",
    [
        ["calibrate", "--pattern", "checkerboard:8x6:30mm", "--model", "opencv-fisheye"],
        ["directions", "--calibration", "c.yaml"],
        ["reconstruct", "--calibration", "c.yaml", "--poses", "sfm"],
    ],
)
def test_figures_are_not_written_among_the_photos(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The next run took them for photos."""
    photos = tmp_path / "photos"
    photos.mkdir()
    said = refused(capsys, command[0], photos, *command[1:], "--out", tmp_path / "out", "--plots", photos / "figures")
    assert "Figures were expected outside of the photos" in said and "give another --plots" in said
    assert not list(photos.iterdir()) and not (tmp_path / "out").exists()


@pytest.mark.full
def test_every_figure_of_a_report_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = of_corners(tmp_path)
    status, said, _ = run(capsys, *given, "--plots", tmp_path / "figures", "--json")
    labels = re.findall(r'<div class="plot" role="group" aria-label="([^"]*)"', (tmp_path / "out/report.html").read_text())
    names = [f"{n:02d}-{'-'.join(re.findall('[a-z0-9]+', label.lower()))}" for n, label in enumerate(labels, 1)]
    files = [Path(file) for file in json.loads(said)["files"] if "figures" in file]
    assert status == 0 and [file.name for file in files] == [f"{name}.{kind}" for name in names for kind in ("png", "svg")]
    assert len(labels) >= 9
    for png, svg in zip(files[::2], files[1::2], strict=True):
        shown = cv2.imread(str(png))
        assert shown.shape[1] == 1920 and (shown[[0, -1]] > 250).all(), "white to the border"
        assert (shown < 128).any(2).mean() > 1e-3
        assert "<svg" in svg.read_text()


@pytest.mark.full
def test_the_library_writes_the_figures_of_its_page(tmp_path: Path) -> None:
    table = write_csv(tmp_path / "corners.csv", CORNERS, corner_rows())
    result = ol.calibrate(ol.read_corners(table), (640, 480), model="opencv-fisheye")
    page = result.report(tmp_path / "page" / "report.html", plots=tmp_path / "figures")
    labels = re.findall(r'<div class="plot" role="group" aria-label="([^"]*)"', page.read_text())
    kinds = sorted(path.suffix for path in (tmp_path / "figures").glob("[!.]*"))
    assert len(labels) >= 9 and kinds == [".png"] * len(labels) + [".svg"] * len(labels)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is no folder"):
        result.report(tmp_path / "other.html", plots=tmp_path / "file")
    assert not (tmp_path / "other.html").exists()


@pytest.mark.slow
def test_curves_lie_where_the_page_has_them(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((20, 30, 3), np.uint8))
    sections = every_section(tmp_path, [Polyline("a.png", np.array([[1.0, 1.0], [20.0, 10.0]]), "line", "model")])
    figures = {one.name[3:]: one for one in paper_figures(report.write_report(tmp_path / "report.html", "Result", sections))}
    axes = figures["projection-curve"].drawing.axes[0]
    (line, dashed) = axes.get_lines()
    np.testing.assert_allclose(line.get_xydata(), np.stack([np.arange(96), 300 * np.deg2rad(np.arange(96))], 1), rtol=1e-4)
    assert dashed.get_linestyle() == "--" and np.asarray(dashed.get_xdata())[0] == 82.4
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("angle off axis (degrees)", "distance from the centre (px)")
    low, high = figures["points-in-the-image"].drawing.axes[0].get_ylim()
    assert low > high, "v points down"
    both = figures["histogram-of-the-residuals-per-axis"].drawing.axes
    assert [one.get_xlabel() for one in both] == ["residual in u (px)", "residual in v (px)"]
    assert figures["cost"].drawing.axes[0].get_yscale() == "log"
    assert figures["cost"].file("svg") == figures["cost"].file("svg")
    scene = figures["3d-view"].drawing
    assert [text.get_text() for text in scene.legends[0].get_texts()] == ["boards", "truth", "rows", "columns", "cameras"]
