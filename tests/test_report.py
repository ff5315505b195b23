"""The report: figures against closed forms and plotly's own validation, size and privacy of the page."""

import base64
import html
import json
import os
import pathlib
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import plotly.graph_objects
import pytest
import torch
from report_page import (
    SIZE,
    camera_ring,
    curves_on_photos,
    every_section,
    residual_case,
    some_lines,
    some_segments,
    write_every_section,
    write_photos,
)

from camera_models.errors import InputError
from camera_models.pose import Pose
from omnilines import report
from omnilines.records import Check, ImagePoses, Lines, Polyline, ViewResult
from omnilines.report import page as report_page
from omnilines.report import plots, tables
from omnilines.spelling import spelled_as


def markup(section: report.Section, allowed_bytes: int = 8_000_000) -> str:
    return str(section.html(allowed_bytes) if callable(section.html) else section.html)


def specs(section: report.Section) -> list[dict]:
    """The plotly figures of a section."""
    return [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', markup(section), re.S)]


def text_of(fragment: str) -> str:
    return " ".join(html.unescape(re.sub(r"<script.*?</script>|<[^>]+>", " ", fragment, flags=re.S)).split())


def test_a_page_names_parameters_as_whoever_asked_for_it() -> None:
    """In Python as there, of a command by its options; what is no parameter stays as it is."""
    text = "give `scale_from` and `a_name`"
    assert "<code>scale_from</code>" in report_page.fragment("notes", notes=[text])
    with spelled_as(lambda name: {"scale_from": "--scale-from"}.get(name, name)):
        page = report_page.fragment("notes", notes=[text])
    assert "<code>--scale-from</code>" in page and "<code>a_name</code>" in page
    assert "<code>scale_from</code>" in report_page.fragment("notes", notes=[text])


@pytest.fixture(scope="module")
def photo_folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    return write_photos(tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def report_file(tmp_path_factory: pytest.TempPathFactory, photo_folder: pathlib.Path) -> pathlib.Path:
    return write_every_section(tmp_path_factory.mktemp("out") / "deep" / "report.html", photo_folder)


class _Addresses(HTMLParser):
    """Every address that a tag of the page refers to, and the headings."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "action", "srcset", "data"):
                self.addresses.append(value or "")
            if name == "id":
                self.anchors.add(value or "")


def test_page_is_one_file_that_refers_to_nothing_outside(report_file: pathlib.Path) -> None:
    assert os.listdir(report_file.parent) == ["report.html"], "a temporary file was left behind"
    assert report_file.stat().st_size < report.PAGE_LIMIT_BYTES
    page = report_file.read_text("utf-8")
    assert page.count("plotly.js v") == 1
    parser = _Addresses()
    parser.feed(page)
    inside = [a for a in parser.addresses if a.startswith("#")]
    assert len(inside) == 13  # twelve sections and the skip link
    assert {a[1:] for a in inside} <= parser.anchors
    assert all(a.startswith(("#", "data:")) for a in parser.addresses)
    assert "&lt;test&gt;" in page and "<test>" not in page
    assert "&lt;row &amp; column&gt;" in page


def test_same_input_gives_same_page(report_file: pathlib.Path, tmp_path: pathlib.Path, photo_folder: pathlib.Path) -> None:
    again = tmp_path / "again.html"
    again.write_text("an older report")
    write_every_section(again, photo_folder)
    assert again.read_bytes() == report_file.read_bytes()


def test_failed_write_keeps_the_old_report(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    monkeypatch.setattr(report_page, "PAGE_LIMIT_BYTES", 1_000_000)
    with pytest.raises(InputError, match="holds at most 1 MB"):
        report.write_report(path, "t", [])
    monkeypatch.undo()

    def refuse(source: object, target: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(InputError, match="no space"):
        report.write_report(path, "t", [])
    assert os.listdir(tmp_path) == ["report.html"] and path.read_text() == "old"


def test_figures_are_valid_plotly_with_titled_axes(photo_folder: pathlib.Path) -> None:
    figures = [spec for section in every_section(photo_folder, curves_on_photos()) for spec in specs(section)]
    assert len(figures) == 11
    for spec in figures:
        plotly.graph_objects.Figure(spec)  # raises on an attribute that plotly does not know
        axes = spec["layout"].get("scene", spec["layout"])
        titled = [a for name, a in axes.items() if re.fullmatch(r"[xyz]axis\d?", name) and a.get("showticklabels", True)]
        assert len(titled) >= 2 and all(a["title"]["text"] for a in titled)


def test_residual_figures() -> None:
    pixels, residuals, view, names = residual_case()
    residuals[7] = np.nan
    section = report.residual_section(pixels, residuals, SIZE, view, names)
    cloud, histogram, arrows, magnitude = specs(section)
    kept = np.delete(residuals, 7, axis=0)
    text = text_of(markup(section))
    rms = np.sqrt((kept**2).sum(1).mean())
    assert f"rms_px_per_point = {rms:.4f} px" in text and f"rms_px_per_axis = {rms / np.sqrt(2):.4f} px" in text
    assert "899 residuals" in text and " 1 more are not known" in text
    assert len(cloud["data"][0]["x"]) == 899
    circle = np.hypot(cloud["data"][1]["x"], cloud["data"][1]["y"])
    np.testing.assert_allclose(circle, rms / np.sqrt(2), rtol=1e-4)

    bars = [t for t in histogram["data"] if t["type"] == "bar"]
    inside = np.abs(kept).max(1) <= histogram["layout"]["xaxis"]["range"][1]
    assert [sum(b["y"]) for b in bars] == [
        int((np.abs(kept[:, k]) <= histogram["layout"]["xaxis"]["range"][1]).sum()) for k in (0, 1)
    ]
    assert inside.sum() > 890
    normals = [t for t in histogram["data"] if t["type"] == "scatter"]
    area = np.trapezoid(normals[0]["y"], normals[0]["x"]) / bars[0]["width"]
    assert area == pytest.approx(899, rel=1e-3)

    magnification = float(re.search(r"magnified ([\d.]+) times", text)[1])  # type: ignore[index]
    path = np.array([[np.nan if c is None else c for c in arrows["data"][0][k]] for k in "xy"]).T.reshape(899, 6, 2)
    np.testing.assert_allclose(path[:, 1] - path[:, 0], magnification * kept, atol=0.11)
    assert np.isnan(path[:, 5]).all() and arrows["layout"]["yaxis"]["range"][0] > arrows["layout"]["yaxis"]["range"][1]

    groups = magnitude["data"][1]
    assert np.sqrt(np.mean(np.square(groups["y"]))) == pytest.approx(rms, rel=0.01)
    assert groups["x"] == sorted(groups["x"])


def test_large_and_degenerate_residuals() -> None:
    pixels, residuals, view, names = residual_case(30_000)
    section = report.residual_section(pixels, residuals, SIZE, view, names, theta_deg=np.linspace(0, 90, 30_000))
    sizes = [max(len(t["x"]) for t in spec["data"]) for spec in specs(section)]
    assert max(sizes) <= 6 * 1500 and sizes[0] == plots.SHOWN_POINTS
    assert text_of(markup(section)).count("of 30,000 points are drawn") == 3
    assert len(markup(section)) < 1_500_000
    none = report.residual_section(pixels[:0], residuals[:0], SIZE, view[:0], names)
    assert "no residual" in markup(none) and not specs(none)
    exact = report.residual_section(pixels[:3], np.zeros((3, 2)), SIZE, view[:3], names)
    assert len(specs(exact)) == 4


@pytest.mark.parametrize(("part", "share"), [((1.0, 1.0), 100), ((0.5, 1.0), 50), ((0.5, 1 / 3), 17)])
def test_coverage_is_the_share_of_cells(part: tuple[float, float], share: int) -> None:
    u, v = np.meshgrid(np.linspace(-0.5, part[0] * 1200 - 0.51, 200), np.linspace(-0.5, part[1] * 900 - 0.51, 200))
    pixels = np.stack([u, v], -1).reshape(-1, 2)
    assert f" {share} % of the cells" in markup(report.coverage_section(pixels, (1200, 900)))


def test_resolution_is_the_slope_of_the_projection_curve() -> None:
    theta = np.linspace(0, 100, 201)
    curve, slope = specs(report.radial_section(theta, 2 * 300 * np.sin(np.deg2rad(theta) / 2)))
    np.testing.assert_allclose(curve["data"][0]["y"][100], 600 * np.sin(np.deg2rad(25)), rtol=1e-4)
    np.testing.assert_allclose(slope["data"][0]["y"][1:-1], 300 * np.cos(np.deg2rad(theta[1:-1]) / 2) * np.pi / 180, rtol=1e-4)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_histogram_counts_every_finite_value(logarithmic: bool) -> None:
    rng = np.random.default_rng(0)
    values = {"before": np.exp(rng.normal(size=(40, 10))), "after": np.append(np.exp(rng.normal(size=300) - 2), np.nan)}
    (figure,) = specs(report.histogram_section("Residual", values, "residual (px)", logarithmic=logarithmic))
    totals = [sum(t["y"]) // 2 for t in figure["data"]]
    assert totals == [400, 300]
    assert f"median {np.nanmedian(values['after']):.3g}" in figure["data"][1]["name"]
    assert "no value" in markup(report.histogram_section("Residual", {"none": np.array([np.nan])}, "px"))


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.827, 0.119, "0.83 ± 0.12"),
        (342.7123, 0.118, "342.71 ± 0.12"),
        (1234.5, 25.0, "1234 ± 25"),
        (-1.2104e-9, 8.1e-12, "(-1.2104 ± 0.0081) × 10<sup>-9</sup>"),
        (0.0, 3e-5, "(0.0 ± 3.0) × 10<sup>-5</sup>"),
        (1.0, 0.0, "1"),
        (2.5e-7, float("nan"), "2.5 × 10<sup>-7</sup>"),
    ],
)
def test_value_is_cut_where_its_sigma_says(value: float, sigma: float, text: str) -> None:
    assert tables._with_sigma(value, sigma) == text


def test_tables_say_what_holds_and_escape() -> None:
    checks = report.checks_section((Check("bearing <error>", 0.01234567, 0.02, "degrees", False),))
    assert "Checks that do not hold: 1 of 1. " in text_of(markup(checks))
    assert "bearing <error> 0.01235 0.02 degrees ✗ no" in text_of(markup(checks)) and "<error>" not in markup(checks)
    assert "All checks hold (0)." in markup(report.checks_section(()))
    views = report.views_section(
        [
            ViewResult("view 0", "a.jpg", True, None, 48, 0, 0.25),
            ViewResult("view 1", "b.jpg", True, None, 40, 8, 0.5, camera="cam1"),
            ViewResult("view 2", "c.jpg", False, "too few corners."),
        ]
    )
    text = text_of(markup(views))
    assert "2 of 3 views were used." in text and "✗ no : too few corners. 0 0 –" in text and "cam1" in text
    assert re.findall(r"background-size:([\d.]+)% ", markup(views)) == ["50.0", "100.0"]
    assert "Leverage" not in text
    remarks = ("It shows the same as b.jpg.", "it is <blurred>")
    views = report.views_section(
        [
            ViewResult("view 0", "a.jpg", True, None, 48, 0, 0.25, leverage=0.7128, remarks=remarks),
            ViewResult("view 1", "b.jpg", True, None, 40, 8, 0.5, leverage=0.2872),
            ViewResult("view 2", "c.jpg", False, "too few corners.", remarks=remarks[:1]),
        ]
    )
    text = text_of(markup(views))
    assert "✓ yes : It shows the same as b.jpg; it is <blurred> 48 0 71.3 % 0.250" in text
    assert "✓ yes 40 8 28.7 % 0.500" in text and "✗ no : too few corners. 0 0 – –" in text
    parameters = report.parameters_section("pinhole", ["fx"], np.array([500.0]), None)
    assert "Standard deviations are not known" in markup(parameters)
    bounds = np.array([[480.0, 531.0], [-np.inf, 2.0]])
    text = text_of(
        markup(report.parameters_section("unified", ["fx", "xi"], np.array([500.0, 1.0]), np.ones(2), intervals=bounds))
    )
    assert "curved valley" in text and "480 to 531" in text and "-inf to 2" in text


def test_photos_name_what_is_left_out(photo_folder: pathlib.Path) -> None:
    fragment = markup(report.photos_section(photo_folder, curves_on_photos()))
    assert "2 of 4 photos are not shown." in fragment
    assert "broken.jpg: it cannot be read" in fragment and "absent.jpg: it cannot be read" in fragment
    assert "M10.0 10.0L60.0 12.0M100.0 14.0L150.0 20.0" in fragment, "a curve must be lifted over its gap"
    jpegs = [base64.b64decode(data) for data in re.findall(r"data:image/jpeg;base64,([^\"]+)", fragment)]
    shapes = [cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape for jpeg in jpegs]
    assert shapes == [(1000, 1600, 3), (300, 400, 3)]
    chosen = markup(report.photos_section(photo_folder, curves_on_photos(), images=["small.png"]))
    assert chosen.count("<img") == 1 and 'alt="Photo small.png"' in chosen


@pytest.mark.slow
def test_photos_stay_within_what_they_are_allowed(tmp_path: pathlib.Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (900, 1300, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "0.jpg"), noise)
    names = [f"{k}.jpg" for k in range(16)]
    for name in names[1:]:
        os.link(tmp_path / "0.jpg", tmp_path / name)
    dense = [Polyline(name, np.tile([[100.0, 200.0]], (500, 1)), name, kind) for name in names for kind in ("model", "observed")]
    section = report.photos_section(tmp_path, dense)
    shown = []
    for allowed in (200_000, 2_000_000):
        fragment = markup(section, allowed)
        assert len(fragment.encode()) <= allowed
        shown.append(fragment.count("<img"))
        assert f"{16 - shown[-1]} of 16 photos are not shown" in fragment or shown[-1] == 16
    assert 0 < shown[0] < shown[1] == 16
    path = report.write_report(tmp_path / "r.html", "noise", [section, report.photos_section(tmp_path, dense, title="again")])
    assert 8_000_000 < path.stat().st_size < report.PAGE_LIMIT_BYTES


def test_scene_holds_lines_boards_cameras_and_truth() -> None:
    lines, cameras = some_lines(), camera_ring(6)
    section = report.scene_section(lines=lines, cameras=cameras, truth_m=lines.ends_m[:4], groups=["a", "a", "b", "b", "b"])
    (spec,) = specs(section)
    by_name = {t["name"]: t for t in spec["data"]}
    assert list(by_name) == ["truth", "a", "b", "cameras"]
    assert len(by_name["a"]["x"]) == 2 * 4 and by_name["a"]["x"][3] is None
    assert by_name["a"]["text"][4] == "track 1: ok, 7 views<br>largest sigma across 1.2 mm, residual 0.25 px"
    assert "4 of 5 tracks have a line" in markup(section)
    assert "meta" not in spec["layout"]
    (spec,) = specs(report.scene_section(lines=lines, segments=some_segments()))
    seen = {"track 0": [1], "track 1": [], "track 2": [0, 2], "track 3": []}
    assert spec["layout"]["meta"] == {"photos": ["wide.jpg", "small.png", "broken.jpg"], "lines": seen}
    # Each pyramid opens along its optical axis: here towards the origin, from its centre.
    pyramids = np.array([by_name["cameras"][k] for k in "xyz"], dtype=float).T.reshape(6, -1, 3)
    centres = cameras.cam_from_world.centre.numpy()
    np.testing.assert_allclose(pyramids[:, 0], centres, atol=1e-4)
    bases = pyramids[:, 1:5].mean(1) - centres
    towards = torch.nn.functional.cosine_similarity(torch.tensor(bases), torch.tensor(-centres)).numpy()
    np.testing.assert_allclose(towards, 1, atol=1e-6)
    scene = spec["layout"]["scene"]
    sides = np.array([np.ptp(scene[f"{k}axis"]["range"]) for k in "xyz"])
    ratio = np.array([scene["aspectratio"][k] for k in "xyz"])
    np.testing.assert_allclose(ratio, sides / sides.max(), atol=1e-3)
    assert scene["aspectmode"] == "manual"


def test_lines_of_no_family_have_no_colour_of_one() -> None:
    groups = ["no family", "family 10", "family 2", "family 1", "family 1"]
    (spec,) = specs(report.scene_section(lines=some_lines(), groups=groups))
    colours = {trace["name"]: trace["line"]["color"] for trace in spec["data"]}
    assert list(colours) == ["family 1", "family 2", "family 10", "no family"]
    assert colours["no family"] == plots.QUIET and len(set(colours.values())) == 4
    (spec,) = specs(report.scene_section(lines=some_lines()))
    assert plots.QUIET not in {trace["line"]["color"] for trace in spec["data"]}


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
@pytest.mark.parametrize("sides", [(5.0, 4.0, 3.0), (40.0, 3.0, 8.0), (1.0, 1.0, 0.0)])
def test_first_view_of_a_scene_shows_all_of_it_upright(up: tuple[float, float, float], sides: tuple[float, float, float]) -> None:
    """Plotly looks from eye to center with a field of 45 degrees; the box of the scene fills it. Far things do not shrink it."""
    rng = np.random.default_rng(1)
    ends = rng.uniform(-0.5, 0.5, (200, 2, 3)) * sides
    ends[7] *= 300.0
    n = len(ends)
    lines = Lines(tuple(map(str, range(n))), ends, np.full(n, 3), np.full(n, 0.3), np.full(n, 0.01), ("ok",) * n)
    centres = torch.tensor(rng.uniform(-0.3, 0.3, (9, 3)) * sides)
    centres[4] = 500.0
    cameras = ImagePoses(tuple(map(str, range(9))), Pose(torch.eye(3).double().expand(9, 3, 3), -centres))
    (spec,) = specs(report.scene_section(lines=lines, cameras=cameras, up=up))
    scene = spec["layout"]["scene"]
    low, high = np.array([scene[f"{k}axis"]["range"] for k in "xyz"]).T
    assert (low <= -0.45 * np.array(sides)).all() and (high >= 0.45 * np.array(sides)).all()
    assert (high - low).max() < 1.6 * max(sides)
    eye, centre, upward, ratio = (
        np.array([part[k] for k in "xyz"])
        for part in (*(scene["camera"][name] for name in ("eye", "center", "up")), scene["aspectratio"])
    )
    ahead = (centre - eye) / np.linalg.norm(centre - eye)
    right = np.cross(ahead, upward) / np.linalg.norm(np.cross(ahead, upward))
    assert upward @ np.array(up) == pytest.approx(1, abs=1e-3) and ahead @ upward < 0
    corners = 0.5 * ratio * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) - eye
    aspect = 1.6 * np.ptp(scene["domain"]["x"])
    tangent = np.stack([corners @ right / aspect, corners @ np.cross(right, ahead)], -1) / (corners @ ahead)[:, None]
    share = np.abs(tangent) / np.tan(np.radians(22.5))
    assert (corners @ ahead > 0).all() and share.max() < 0.95 and share.max() > 0.85


def test_scene_limits_far_lines_and_many_lines() -> None:
    rng = np.random.default_rng(0)
    ends = rng.uniform(-1, 1, (30_000, 2, 3))
    ends[0] *= 1e6
    n = len(ends)
    lines = Lines(tuple(map(str, range(n))), ends, np.full(n, 3), np.full(n, 0.3), np.full(n, 0.01), ("ok",) * n)
    section = report.scene_section(lines=lines)
    (spec,) = specs(section)
    assert len(spec["data"][0]["x"]) == 10_000 * 4 and "A random 10,000 of 30,000 lines are drawn" in markup(section)
    assert max(abs(limit) for k in "xyz" for limit in spec["layout"]["scene"][f"{k}axis"]["range"]) < 1.2
    assert "2 far points lie outside the view" in markup(section)
    ends[0, 1] = 0.0
    assert "1 far point lies outside the view" in markup(report.scene_section(lines=lines))
    assert len(markup(section)) < 3_500_000
    assert "nothing to show" in markup(report.scene_section())


def test_rounding_and_sampling() -> None:
    assert [plots.round_number(v) for v in (1.0, 1.99, 2.0, 4.9, 50.0, 0.07)] == pytest.approx([1, 1, 2, 2, 50, 0.05])
    rows = plots.sample(20_000)
    assert len(set(rows.tolist())) == plots.SHOWN_POINTS and (np.diff(rows) > 0).all()
    assert plots.numbers(np.array([np.pi * 1e-7, np.inf])) == [3.1416e-07, None]


# In the browser.
