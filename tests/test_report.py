"""The report: figures against closed forms and plotly's own validation, size and privacy of the page, and Chromium's verdict."""

import base64
import contextlib
import html
import json
import os
import pathlib
import re
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser

import cv2
import numpy as np
import plotly.graph_objects
import pytest
import torch
from playwright.sync_api import Locator, Page, sync_playwright

from camera_models.errors import InputError
from camera_models.pose import Pose
from omnilines import report
from omnilines.records import Check, ImagePoses, Lines, Polyline, Segments, Summary, ViewResult
from omnilines.report import page as report_page
from omnilines.report import plots, tables

SIZE = (1032, 778)
CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # WebGL without a GPU.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


def markup(section: report.Section, allowed_bytes: int = 8_000_000) -> str:
    return str(section.html(allowed_bytes) if callable(section.html) else section.html)


def specs(section: report.Section) -> list[dict]:
    """The plotly figures of a section."""
    return [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', markup(section), re.S)]


def text_of(fragment: str) -> str:
    return " ".join(html.unescape(re.sub(r"<script.*?</script>|<[^>]+>", " ", fragment, flags=re.S)).split())


def residual_case(n: int = 900, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, 1, (n, 2)) * (np.array(SIZE) - 1)
    return pixels, 0.3 * rng.normal(size=(n, 2)), rng.integers(0, 5, n), [f"view {k}" for k in range(5)]


def uncertainty_case() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A map that grows from 0.01 px in the middle by 1000 times, with unknown corners of the image, and its columns and rows."""
    u, v = np.linspace(0, SIZE[0] - 1, 44), np.linspace(0, SIZE[1] - 1, 33)
    radius = np.hypot(*np.meshgrid(u - 515.5, v - 388.5))
    return np.where(radius < 600, 0.01 * 1000 ** (radius / 600) ** 2, np.nan), u, v


def some_lines() -> Lines:
    ends = np.array([[[0.1 * k, 0.0, 0.0], [0.1 * k, 0.4, 0.0]] for k in range(5)])
    ends[4] = np.nan
    status = ("ok", "ok", "ok", "weak", "epipolar")
    names = tuple(f"track {k}" for k in range(5))
    return Lines(names, ends, np.full(5, 7), np.full(5, 0.25), np.full(5, 0.0012), status)


def some_segments() -> Segments:
    """Track 2 in the wide photo and in one that cannot be read, track 0 in the small one, and an arc of no track."""
    tracks = tuple(f"track {k}" for k in range(5))
    image, track = np.array([0, 2, 1, 1, 0]), np.array([2, 2, 0, -1, 2])
    return Segments(image, ("wide.jpg", "small.png", "broken.jpg"), track, tracks, np.zeros((5, 2, 2)))


def camera_ring(n: int) -> ImagePoses:
    """Cameras on a circle of radius 1 m at height 1 m that look at the origin."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, n, endpoint=False):
        centre = np.array([np.cos(angle), np.sin(angle), 1.0])
        z = -centre / np.linalg.norm(centre)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        poses.append(Pose.of(rotation, -rotation @ centre))
    return ImagePoses(tuple(f"photo {k}" for k in range(n)), Pose.stack(poses))


def every_section(photo_folder: pathlib.Path, curves: list[Polyline]) -> list[report.Section]:
    pixels, residuals, view, names = residual_case()
    theta = np.linspace(0, 95, 96)
    phase = np.linspace(0, 2 * np.pi, 73)
    circle = np.stack([515.5 + 380 * np.cos(phase), 388.5 + 380 * np.sin(phase)], 1)
    board = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.4, 0.5, 0], [0.0, 0.5, 0]])
    views = [ViewResult("view 0", "a.jpg", True, None, 48, 1, 0.31), ViewResult("view 1", "b.jpg", False, "no board was found.")]
    return [
        report.summary_section(Summary("Result", (("rms_px_per_axis", "0.30 px"),), ("A note.",))),
        report.checks_section((Check("bearing error", 0.0123, 0.02, "degrees", True), Check("photos lost", 2.0, 1.0, "", False))),
        report.parameters_section("pinhole", ["fx", "k1"], np.array([500.0, -1e-3]), np.array([0.2, 2e-5])),
        report.views_section(views),
        report.residual_section(pixels, residuals, SIZE, view, names),
        report.coverage_section(pixels, SIZE, circle, supported_angle_deg=82.4),
        report.uncertainty_section(*uncertainty_case(), SIZE, circle, corners_px=pixels, supported_angle_deg=82.4),
        report.radial_section(theta, 300 * np.deg2rad(theta), supported_angle_deg=82.4),
        report.histogram_section(
            "Before and after", {"before": np.abs(residuals[:, 0]) * 9, "after": np.abs(residuals[:, 0])}, "px"
        ),
        report.curve_section("Cost", {"sector": (np.arange(5.0), 10.0 ** -np.arange(5))}, "iteration", "cost", logarithmic=True),
        report.photos_section(photo_folder, curves),
        report.scene_section(
            boards=[("board", board)],
            lines=some_lines(),
            groups=["rows"] * 3 + ["columns"] * 2,
            cameras=camera_ring(8),
            truth_m=some_lines().ends_m[:4],
            segments=some_segments(),
        ),
    ]


@pytest.fixture(scope="module")
def photo_folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A wide photo with one bright disc, a small one, and a file that is no photo."""
    folder = tmp_path_factory.mktemp("photos")
    wide = np.full((2001, 3203, 3), 20, np.uint8)
    cv2.circle(wide, (2310, 405), 90, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.imwrite(str(folder / "wide.jpg"), wide)
    cv2.imwrite(str(folder / "small.png"), np.full((300, 400, 3), 128, np.uint8))
    (folder / "broken.jpg").write_bytes(b"not a photo")
    return folder


@pytest.fixture(scope="module")
def photo_curves() -> list[Polyline]:
    gap = np.array([[10.0, 10.0], [60.0, 12.0], [np.nan, np.nan], [100.0, 14.0], [150.0, 20.0]])
    return [
        Polyline("wide.jpg", np.array([[2310.0, 405.0]]), "disc", "observed"),
        Polyline("wide.jpg", np.array([[2200.0, 405.0], [2420.0, 405.0]]), "across the disc"),
        Polyline("small.png", gap, "<row & column>"),
        Polyline("broken.jpg", np.array([[1.0, 1.0]]), "", "observed"),
        Polyline("absent.jpg", np.array([[1.0, 1.0]]), "", "observed"),
    ]


@pytest.fixture(scope="module")
def report_file(
    tmp_path_factory: pytest.TempPathFactory, photo_folder: pathlib.Path, photo_curves: list[Polyline]
) -> pathlib.Path:
    path = tmp_path_factory.mktemp("out") / "deep" / "report.html"
    return report.write_report(path, 'Calibration of "cam0" <test>', every_section(photo_folder, photo_curves))


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


def test_same_input_gives_same_page(
    report_file: pathlib.Path, tmp_path: pathlib.Path, photo_folder: pathlib.Path, photo_curves: list[Polyline]
) -> None:
    again = tmp_path / "again.html"
    again.write_text("an older report")
    report.write_report(str(again), 'Calibration of "cam0" <test>', every_section(photo_folder, photo_curves))
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


def test_figures_are_valid_plotly_with_titled_axes(photo_folder: pathlib.Path, photo_curves: list[Polyline]) -> None:
    figures = [spec for section in every_section(photo_folder, photo_curves) for spec in specs(section)]
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
    assert re.findall(r"width:([\d.]+)%", markup(views)) == ["50.0", "100.0"]
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


def test_photos_name_what_is_left_out(photo_folder: pathlib.Path, photo_curves: list[Polyline]) -> None:
    fragment = markup(report.photos_section(photo_folder, photo_curves))
    assert "2 of 4 photos are not shown." in fragment
    assert "broken.jpg: it cannot be read" in fragment and "absent.jpg: it cannot be read" in fragment
    assert "M10.0 10.0L60.0 12.0M100.0 14.0L150.0 20.0" in fragment, "a curve must be lifted over its gap"
    jpegs = [base64.b64decode(data) for data in re.findall(r"data:image/jpeg;base64,([^\"]+)", fragment)]
    shapes = [cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape for jpeg in jpegs]
    assert shapes == [(1000, 1600, 3), (300, 400, 3)]
    chosen = markup(report.photos_section(photo_folder, photo_curves, images=["small.png"]))
    assert chosen.count("<img") == 1 and 'alt="Photo small.png"' in chosen


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
    tangent = np.stack([corners @ right / 1.6, corners @ np.cross(right, ahead)], -1) / (corners @ ahead)[:, None]
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
    assert len(markup(section)) < 3_500_000
    assert "nothing to show" in markup(report.scene_section())


def test_rounding_and_sampling() -> None:
    assert [plots.round_number(v) for v in (1.0, 1.99, 2.0, 4.9, 50.0, 0.07)] == pytest.approx([1, 1, 2, 2, 50, 0.05])
    rows = plots.sample(20_000)
    assert len(set(rows.tolist())) == plots.SHOWN_POINTS and (np.diff(rows) > 0).all()
    assert plots.numbers(np.array([np.pi * 1e-7, np.inf])) == [3.1416e-07, None]


# In the browser.


@pytest.fixture(scope="module")
def chromium() -> str:
    """Path of Debian's Chromium; where it is absent these tests skip, but never in CI."""
    path = shutil.which("chromium") or "/usr/bin/chromium"
    if not pathlib.Path(path).exists():
        if os.environ.get("CI"):
            pytest.fail("CI must have Debian's chromium (apt-get install chromium); it is absent.")
        pytest.skip("Debian's chromium is absent; install it to test the report in a browser")
    return path


@contextlib.contextmanager
def opened(chromium: str, path: pathlib.Path, scheme: str) -> Iterator[tuple[Page, list[str], list[str]]]:
    """The page with all plots drawn, its messages on the console and the addresses it asked for."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=CHROMIUM_FLAGS)
        context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme=scheme)
        page, messages, requests = context.new_page(), [], []
        page.on("console", lambda message: messages.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: messages.append(f"pageerror: {error}"))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-plots=drawn]", timeout=120_000)
        try:
            yield page, messages, requests
        finally:
            browser.close()


def picture(element: Locator) -> np.ndarray:
    """A screenshot, (h, w, 3)."""
    return cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR)


def settled(page: Page, element: Locator) -> np.ndarray:
    """The first of two equal screenshots in a row."""
    last = picture(element)
    for _ in range(40):
        page.wait_for_timeout(250)
        now = picture(element)
        if np.array_equal(now, last):
            return now
        last = now
    pytest.fail("the 3D view does not come to rest in 10 s")


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.full)])
def test_page_in_chromium(chromium: str, report_file: pathlib.Path, scheme: str) -> None:
    with opened(chromium, report_file, scheme) as (page, messages, requests):
        scene = page.locator(".plot", has=page.locator("canvas"))
        scene.scroll_into_view_if_needed()
        before = settled(page, scene)
        background = before[-3, -3]
        assert (background.mean() > 128) == (scheme == "light")
        drawn = np.abs(before.astype(int) - background).max(2) > 24
        assert drawn.mean() > 0.01 and len(np.unique(before.reshape(-1, 3), axis=0)) > 100
        box = scene.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 160, y + 40, steps=8)
        page.mouse.up()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] - 5)
        after = settled(page, scene)
        changed = np.abs(after.astype(int) - before.astype(int)).max(2) > 24
        assert changed.mean() > 0.01, "dragging must turn the scene"
        assert page.evaluate("[...document.querySelectorAll('.plot')].every(p => p.querySelector('svg.main-svg'))")
        widths = page.evaluate("Promise.all([...document.images].map(i => i.decode().then(() => i.naturalWidth)))")
        assert widths == [1600, 400]
        buttons = page.locator(".modebar-btn").evaluate_all("all => all.map(b => b.getAttribute('data-title'))")
        assert "Download plot as a PNG" in buttons and not [b for b in buttons if re.search("share|cloud|edit", b, re.I)]
        page.set_viewport_size({"width": 420, "height": 800})
        # Plots follow the window a moment later; then nothing may stick out of a narrow page.
        page.wait_for_function("document.documentElement.scrollWidth <= innerWidth", timeout=30_000)
    assert messages == []
    assert requests and all(address.startswith(("file:", "data:", "blob:")) for address in requests)
    assert [a for a in requests if a.startswith("file:")] == [report_file.as_uri()]


@pytest.mark.slow
def test_overlay_lies_on_its_photo(chromium: str, report_file: pathlib.Path) -> None:
    """The disc drawn by OpenCV in the photo and the observed point at its centre coincide on the screen, small and enlarged."""
    with opened(chromium, report_file, "light") as (page, messages, _):
        frame = page.locator(".frame").first
        checked = 0
        for _ in range(2):
            page.locator(".show-observed").uncheck()
            page.locator(".show-model").uncheck()
            frame.scroll_into_view_if_needed()
            bright = picture(frame)[:, :, 0] > 140
            bright[[0, -1]] = bright[:, [0, -1]] = False  # the page beside a frame that starts between two pixels
            rows, columns = np.nonzero(bright)
            disc = np.array([columns.mean(), rows.mean()]) + 0.5
            box = frame.bounding_box()
            point, left, top, width, height = frame.evaluate(
                """frame => {
                    const point = new DOMPoint(2310, 405).matrixTransform(frame.querySelector("svg").getScreenCTM());
                    const photo = frame.querySelector("img").getBoundingClientRect();
                    return [[point.x, point.y], photo.x, photo.y, photo.width, photo.height];
                }"""
            )
            assert box is not None
            # The centre of pixel (u, v) lies at (u + 0.5, v + 0.5) from the corner of the photo, which is 3203 x 2001.
            np.testing.assert_allclose(point, [left + 2310.5 / 3203 * width, top + 405.5 / 2001 * height], atol=1e-2)
            # Chromium paints an image on whole pixels and an overlay between them; screenshots start at a whole pixel.
            np.testing.assert_allclose(disc, [point[0] - np.floor(box["x"]), point[1] - np.floor(box["y"])], atol=0.75)
            page.locator(".show-observed").check()
            shown = picture(frame)
            yellow = (shown[:, :, 2] > 200) & (shown[:, :, 0] < 120)
            centre = np.argwhere(yellow).mean(0)[::-1] + 0.5
            np.testing.assert_allclose(centre, disc, atol=0.75)
            checked += 1
            frame.click()
        assert checked == 2 and frame.get_attribute("aria-expanded") == "false"
    assert messages == []
