"""Prints at true scale: what the files say, parsed by hand, against the geometry of the targets; every target."""

import json
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import calib_patterns
from calib_patterns import Pattern
from calib_patterns.printing import Page, print_pattern
from camera_models.errors import InputError
from omnilines.cli import app
from omnilines.cli.spelling import with_flags

MM_PER_POINT = 25.4 / 72
ALL = [
    pytest.param(p, id=p.specification)
    for name, _ in calib_patterns.PATTERNS
    for p in calib_patterns.pattern_class(name).examples()
]
ONE_EACH = [pytest.param(calib_patterns.pattern_class(name).examples()[0], id=name) for name, _ in calib_patterns.PATTERNS]
SVG = "{http://www.w3.org/2000/svg}"


def rectangles_of_path(numbers: list[float]) -> np.ndarray:
    """(x0, y0, x1, y1) of closed paths of four corners, millimetres, y as in the file."""
    corners = np.array(numbers).reshape(-1, 4, 2) * MM_PER_POINT
    return np.concatenate([corners.min(1), corners.max(1)], 1)


def read_svg(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray], str]:
    """Page size in mm from its physical unit, rectangles by name, all text."""
    root = ElementTree.parse(path).getroot()
    size = []
    for key in ("width", "height"):
        match = re.fullmatch(r"([\d.]+)pt", root.attrib[key])
        assert match, root.attrib[key]
        size.append(float(match[1]) * MM_PER_POINT)
    view = [float(v) for v in root.attrib["viewBox"].split()]
    # One user unit is one point.
    np.testing.assert_allclose(np.array(view[2:]) * MM_PER_POINT, size, rtol=1e-9)
    shapes = {}
    for group in root.iter(f"{SVG}g"):
        outlines = group.findall(f"{SVG}path")
        if group.attrib.get("id") in ("target", "ruler"):
            assert len(outlines) == 1 and "transform" not in group.attrib
            shapes[group.attrib["id"]] = rectangles_of_path([float(v) for v in re.findall(r"-?[\d.]+", outlines[0].attrib["d"])])
    return np.array(size), shapes, " ".join(root.itertext())


def read_pdf(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Page size in mm, and the rectangles of every filled path of the page, y up, millimetres."""
    data = path.read_bytes()
    box = re.search(rb"/MediaBox \[ ([\d. ]+)\]", data)
    assert box and b"/UserUnit" not in data
    size = np.array([float(v) for v in box[1].split()])
    assert (size[:2] == 0).all()
    fills = []
    for stream in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", data, re.S):
        try:
            text = zlib.decompress(stream[1]).decode("latin-1")
        except zlib.error:
            continue
        # Nothing but the identity between the page and these paths.
        for path_text in re.findall(r"((?:-?[\d.]+ -?[\d.]+ [ml]\s+|h\s+)+)f\b", text):
            assert " cm" not in text.split(path_text)[0].replace("1 0 0 1 0 0 cm", "")
            numbers = [float(v) for v in re.findall(r"-?[\d.]+", path_text)]
            fills.append(rectangles_of_path(numbers))
    return size[2:] * MM_PER_POINT, fills


@pytest.mark.parametrize("pattern", ALL)
def test_rectangles_are_the_reflectance(pattern: Pattern) -> None:
    """Covers of boxes by the rectangles against the pattern's own mean."""
    rng = np.random.default_rng(5)
    low, size = np.array(pattern.top_left_m), np.array(pattern.size_m)
    centres = low + size * rng.uniform(0.02, 0.98, (200, 2))
    widths = size * rng.uniform(0.001, 0.3, (200, 2))
    rectangles = pattern.black_rectangles_m
    assert (rectangles[:, 2:] > rectangles[:, :2]).all()
    top, bottom = centres - widths / 2, centres + widths / 2
    overlap = np.minimum(bottom[:, None], rectangles[:, 2:]) - np.maximum(top[:, None], rectangles[:, :2])
    black = np.clip(overlap, 0.0, None).prod(-1).sum(1) / widths.prod(-1)
    np.testing.assert_allclose(pattern.reflectance(centres, widths), 1.0 - black, atol=1e-9)


@pytest.mark.parametrize("pattern", ONE_EACH)
def test_svg_has_true_scale(pattern: Pattern, tmp_path: Path) -> None:
    page = print_pattern(pattern, (tmp_path / "target.svg",))
    size, shapes, text = read_svg(tmp_path / "target.svg")
    np.testing.assert_allclose(size, [page.width_mm, page.height_mm], atol=1e-3)
    assert (size > 1000 * np.array(pattern.size_m)).all()
    expected = np.array(page.board_origin_mm * 2) + 1000 * pattern.black_rectangles_m
    np.testing.assert_allclose(shapes["target"], expected, atol=1e-3)
    ticks = shapes["ruler"][1:]
    np.testing.assert_allclose(np.diff(ticks[:, [0, 2]].mean(1)), 1.0, atol=1e-4)
    assert len(ticks) == page.ruler_mm + 1
    assert pattern.specification in text and f"{page.ruler_mm} mm" in text
    # Nothing lies on anything else or off the page.
    everything = np.concatenate([shapes["target"], shapes["ruler"]])
    assert (everything[:, :2] >= 0).all() and (everything[:, 2:] <= size).all()
    assert shapes["ruler"][:, 1].min() > shapes["target"][:, 3].max()


@pytest.mark.parametrize("pattern", ONE_EACH)
def test_pdf_has_true_scale(pattern: Pattern, tmp_path: Path) -> None:
    page = print_pattern(pattern, (tmp_path / "target.pdf",))
    size, fills = read_pdf(tmp_path / "target.pdf")
    np.testing.assert_allclose(size, [page.width_mm, page.height_mm], atol=1e-3)
    expected = np.array(page.board_origin_mm * 2) + 1000 * pattern.black_rectangles_m
    target = [fill for fill in fills if len(fill) == len(expected)]
    assert len(target) == 1
    upright = np.stack([target[0][:, 0], size[1] - target[0][:, 3], target[0][:, 2], size[1] - target[0][:, 1]], 1)
    np.testing.assert_allclose(upright, expected, atol=1e-3)
    ruler = next(fill for fill in fills if len(fill) == page.ruler_mm + 2)
    assert np.ptp(ruler[1:, [0, 2]].mean(1)) == pytest.approx(page.ruler_mm, abs=1e-3)


@pytest.mark.slow
def test_same_target_same_bytes(tmp_path: Path) -> None:
    pattern = ONE_EACH[0].values[0]
    assert isinstance(pattern, Pattern)
    for name in ("a", "b"):
        print_pattern(pattern, (tmp_path / f"{name}.svg", tmp_path / f"{name}.pdf"))
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


def test_command_writes_a_file_or_both(tmp_path: Path) -> None:
    run = CliRunner()
    both = run.invoke(app, ["pattern", "charuco:5x4:30mm:22mm:DICT_4X4_50", "--out", str(tmp_path / "prints"), "--json"])
    assert both.exit_code == 0, both.output
    answer = json.loads(both.stdout)
    assert answer["size_mm"] == pytest.approx([180, 150]) and answer["corners"] == 12 and answer["holds"]
    assert {Path(name).suffix for name in answer["files"]} == {".pdf", ".svg"}
    assert all(Path(name).stat().st_size > 1000 for name in answer["files"]) and len(answer["files"]) == 2
    one = run.invoke(app, ["pattern", "checkerboard:8x6:32.5mm", "--out", str(tmp_path / "board.pdf")])
    assert one.exit_code == 0 and (tmp_path / "board.pdf").exists() and "357.5 x 292.5 mm" in one.stdout


def test_what_cannot_be_printed(tmp_path: Path) -> None:
    board = calib_patterns.pattern("checkerboard:8x6:32.5mm")
    with pytest.raises(InputError, match=r"ending in \.pdf or \.svg"):
        print_pattern(board, (tmp_path / "board.png",))
    for text in ("checkerboard:8x6:32.5m", "checkerboard:8x6:0.1mm"):
        with pytest.raises(InputError, match="check the unit"):
            Page.of(calib_patterns.pattern(text))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["board.png", "board.html", "board.dxf"])
def test_an_ending_that_no_target_has_is_refused(name: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["pattern", "checkerboard:8x6:30mm", "--out", str(tmp_path / name)])
    assert isinstance(
        done.exception, InputError
    ) and f"ending in .pdf or .svg, or a folder, was expected, found '{tmp_path}" in str(done.exception)
    assert ("goes with --screen" in with_flags(str(done.exception))) is (name == "board.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["board.v2", "board_32.5mm", "boards.png"])
def test_a_folder_may_have_a_dot_in_its_name(name: str, tmp_path: Path) -> None:
    if name == "boards.png":
        (tmp_path / name).mkdir()
    done = CliRunner().invoke(app, ["pattern", "checkerboard:8x6:30mm", "--out", str(tmp_path / name)])
    assert done.exit_code == 0 and {path.suffix for path in (tmp_path / name).iterdir()} >= {".pdf", ".svg"}


@pytest.mark.slow
def test_matplotlib_is_imported_for_printing_only() -> None:
    code = (
        "import sys, calib_patterns, calib_patterns.printing\n"
        "calib_patterns.pattern('charuco:9x7:30mm:22mm:DICT_5X5_100').points_m\n"
        "sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "specification", ["checkerboard:8x6:30mm", "charuco:9x7:30mm:22mm:DICT_5X5_100", "aprilgrid:4x3:60mm:0.3:36h11"]
)
def test_the_page_of_a_screen_shows_the_target_that_it_names(specification: str, tmp_path: Path) -> None:
    """In Chromium: what is detected in a screenshot has the size that the page states, for the size of a pixel it was told."""
    chromium = shutil.which("chromium") or "/usr/bin/chromium"
    if not Path(chromium).exists():
        if os.environ.get("CI"):
            pytest.fail("CI must have Debian's chromium (apt-get install chromium); it is absent.")
        pytest.skip("Debian's chromium is absent; install it to test the page in a browser")
    from playwright.sync_api import sync_playwright

    assert CliRunner().invoke(app, ["pattern", specification, "--screen", "--out", str(tmp_path)]).exit_code == 0
    (path,) = tmp_path.glob("*.html")
    pixel_mm = 0.27
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        asked, errors = [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(path.as_uri())
        page.fill("#measured", f"{pixel_mm * float(page.input_value('#width')):.4f}")
        shown = page.evaluate("document.body.dataset.pattern")
        assert shown in page.inner_text("#found")
        page.evaluate("document.getElementById('panel').hidden = true")
        image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        browser.close()
    assert not errors and asked == [path.as_uri()]
    target = calib_patterns.pattern(shown)
    found, why = target.detect(image)
    assert why is None
    assert len(found.pixels) == len(target.points_m)
    ideal = target.points_m[found.ids, :2]
    scale = 1e3 / pixel_mm
    off = found.pixels - scale * ideal
    # A corner of pixels lies half a pixel before their centres; edges of tags are rounded to pixels.
    assert np.abs(off - np.median(off, axis=0)).max() < 0.75
    nominal = calib_patterns.pattern(specification)
    assert 0.85 < target.size_m[0] / nominal.size_m[0] <= 1.0001


def test_a_page_of_a_screen_goes_to_a_page(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["pattern", "checkerboard:8x6:30mm", "--screen", "--out", str(tmp_path / "a.pdf")])
    assert isinstance(done.exception, InputError) and ".html" in str(done.exception) and not list(tmp_path.iterdir())
