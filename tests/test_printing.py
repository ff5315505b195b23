"""Prints at true scale: what the files say, parsed by hand, against the geometry of the targets; every target."""

import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import calib_patterns
from calib_patterns import Pattern
from calib_patterns.printing import Page, print_pattern
from camera_models.errors import InputError
from omnilines.cli import app

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


def test_matplotlib_is_imported_for_printing_only() -> None:
    code = (
        "import sys, calib_patterns, calib_patterns.printing\n"
        "calib_patterns.pattern('charuco:9x7:30mm:22mm:DICT_5X5_100').points_m\n"
        "sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
