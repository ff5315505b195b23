"""The report's sections of a line scene: counts and figures as given, curves against OpenCV and closed forms."""

import html
import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_models import CameraModel, Equirectangular, InputError, OpenCVFisheye, Pinhole
from camera_models.pose import Pose
from omnilines import report
from omnilines.records import ImagePoses, Lines, Segments, StageCount
from omnilines.report import line_scene
from omnilines.report.line_scene import (
    families_section,
    line_curves,
    line_photos_section,
    line_table_section,
    stage_section,
)
from omnilines.structure.families import Families, line_families

FISHEYE = OpenCVFisheye([320.0, 322.0, 400.0, 301.0, 0.02, -0.003, 0.001, 0.0], (800, 600))
PINHOLE = Pinhole([500.0, 510.0, 400.0, 300.0] + [0.0] * 9, (800, 600))


def markup(section: report.Section) -> str:
    return str(section.html(5_000_000) if callable(section.html) else section.html)


def cells(section: report.Section) -> list[list[list[str]]]:
    """The texts of every cell of every table, heads included."""
    tables = re.findall(r"<table>(.*?)</table>", markup(section), re.S)
    rows = [re.findall(r"<tr>(.*?)</tr>", table, re.S) for table in tables]
    return [[[html.unescape(c) for c in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)] for row in table] for table in rows]


def some_lines(n: int, sigma: float = 1e-3) -> Lines:
    """Lines before a camera at the origin, with known uncertainty; the second has none in space."""
    rng = np.random.default_rng(n)
    ends = rng.uniform([-2, -1.5, 3], [2, 1.5, 6], (n, 2, 3))
    status = tuple("epipolar" if k == 1 else "ok" for k in range(n))
    ends[1] = np.nan
    covariance = np.tile(np.diag([9.0, 1.0, 4.0, 9.0]) * sigma**2, (n, 1, 1))
    sigma_m = np.where(np.isfinite(ends[:, 0, 0]), 1e-3 * (1 + np.arange(n)), np.nan)
    names = tuple(f"<{k}>" for k in range(n))
    return Lines(names, ends, np.full(n, 4), np.full(n, 0.3), sigma_m, status, covariance, np.zeros((n, 3)), np.ones(n))


def observed(lines: Lines, model: CameraModel, images: tuple[str, ...]) -> Segments:
    """Every known line in every photo of a camera at the origin, and one arc that is matched to nothing."""
    known = np.flatnonzero(lines.known)
    pixels = np.stack([model.project(lines.ends_m[known, end])[0] for end in range(2)], 1)
    n, k = len(known), len(images)
    image, track = np.repeat(np.arange(k), n), np.tile(known, k)
    ends = np.tile(pixels, (k, 1, 1))
    return Segments(
        np.append(image, 0), images, np.append(track, -1), lines.tracks, np.concatenate([ends, [[[5.0, 5.0], [9.0, 9.0]]]])
    )


def at_origin(images: tuple[str, ...], cameras: tuple[str, ...] | None = None) -> ImagePoses:
    return ImagePoses(images, Pose.identity(len(images)), cameras)


def test_stages_with_their_reasons() -> None:
    stages = [
        StageCount("detected", 1200, ()),
        StageCount("matched", 300, (("no candidate", 700), ("<ambiguous>", 200), ("too short", 0))),
    ]
    (table,) = cells(stage_section(stages))
    assert table == [
        ["Stage", "Kept", "Dropped", "Why"],
        ["detected", "1,200", "0", "–"],
        ["matched", "300", "900", "700 no candidate; 200 <ambiguous>"],
    ]
    assert "Nothing is left" not in markup(stage_section(stages)) and "<ambiguous>" not in markup(stage_section(stages))
    lost = [
        *stages,
        StageCount("verified", 0, (("behind a camera", 40), ("off the epipolar sweep", 260))),
        StageCount("built", 0, ()),
    ]
    assert "after the stage <strong>verified</strong>: off the epipolar sweep." in markup(stage_section(lost))
    assert "<strong>detected</strong>: nothing came to it." in markup(stage_section([StageCount("detected", 0, ())]))


def test_families_with_their_figures() -> None:
    tilt = math.radians(89.9)
    families = Families(
        family=np.array([0] * 8 + [1] * 5 + [-1] * 3),
        direction=np.array([[1.0, 0, 0], [math.cos(tilt), math.sin(tilt), 0]]),
        covariance=np.zeros((2, 3, 3)),
        sigma_rad=np.radians([0.05, 0.08]),
        members=np.array([8, 5]),
        spread_rad=np.radians([0.2, 0.31]),
        chi_square=np.array([12.34, 80.0]),
        probability=np.array([0.58, 4.6e-14]),
        right_angles=np.array([[0, 1]]),
        angle_rad=np.array([tilt]),
        angle_sigma_rad=np.radians([0.0943]),
        tolerance_rad=math.radians(0.3),
        considered=15,
    )
    section = families_section(families)
    table, right = cells(section)
    assert table[1] == ["1", "8", "1.0000 0.0000 0.0000", "0.05", "0.2", "12.3 of 14", "0.58"]
    assert table[2] == ["2", "5", "0.0017 1.0000 0.0000", "0.08", "0.31", "80.0 of 8", "4.6e-14"]
    assert right[1] == ["1 and 2", "89.900", "0.094"]
    assert "13 of 15 lines" in markup(section) and "tolerance of 0.3 degrees" in markup(section)
    alone = replace(families, right_angles=np.empty((0, 2), dtype=np.int64), angle_rad=np.empty(0), angle_sigma_rad=np.empty(0))
    assert len(cells(families_section(alone))) == 1 and "No two families are at a right angle" in markup(families_section(alone))
    none = line_families(some_lines(2))
    assert cells(families_section(none)) == [] and "0 of 1 lines" in markup(families_section(none))


def test_table_of_lines_has_the_least_certain_first() -> None:
    lines = some_lines(400, sigma=2e-3)
    section = line_table_section(lines)
    (table,) = cells(section)
    assert len(table) == 1 + line_scene.SHOWN_LINES
    assert [row[0] for row in table[1:4]] == ["<399>", "<398>", "<397>"]
    length = np.linalg.norm(lines.ends_m[399, 1] - lines.ends_m[399, 0])
    # The direction moves by the second and third coordinate of the chart: the larger of 1 and 2 times 2 mrad.
    assert table[1][1:] == ["ok", "4", f"{length:.3f}", "400", f"{math.degrees(4e-3):.3g}", "0.3"]
    assert "399 of 400 tracks have a line" in markup(section) and "300 are shown" in markup(section)
    assert '<a href="covariance.npz">' in markup(section)
    bare = replace(lines, covariance=None, sigma_m=np.full(400, np.nan))
    (table,) = cells(line_table_section(bare))
    assert table[1][4:6] == ["not known", "not known"] and "href" not in markup(line_table_section(bare))


def test_curves_are_what_opencv_images() -> None:
    lines = some_lines(12)
    cameras = {"fish": FISHEYE, "flat": PINHOLE}
    poses = at_origin(("a.jpg", "b.jpg"), ("fish", "flat"))
    for k, model in enumerate(cameras.values()):
        curves = line_curves(lines, observed(lines, model, (poses.images[k],)), poses, cameras)
        model_curves, arcs = ([c for c in curves if c.kind == kind] for kind in ("model", "observed"))
        assert len(model_curves) == len(arcs) == 11 and {c.image for c in curves} == {poses.images[k]}
        assert [c.label for c in model_curves] == [lines.tracks[i] for i in np.flatnonzero(lines.known)]
        for curve, arc in zip(model_curves, arcs, strict=True):
            ends = lines.ends_m[lines.tracks.index(curve.label)]
            dense = ends[0] + np.linspace(0, 1, 4001)[:, None] * (ends[1] - ends[0])
            fx, fy, cx, cy, *d = model.parameters.tolist()
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            zero = np.zeros(3)
            if model is FISHEYE:
                truth = cv2.fisheye.projectPoints(dense[:, None], zero, zero, matrix, np.array(d))[0][:, 0]
            else:
                truth = cv2.projectPoints(dense, zero, zero, matrix, np.zeros(5))[0][:, 0]
            for drawn in (curve.pixels, arc.pixels):
                away = np.linalg.norm(drawn[:, None] - truth, axis=-1).min(1)
                assert away.max() < 0.3, "every point lies on the image of the line, whose samples are up to 0.5 px apart"
                np.testing.assert_allclose(drawn[[0, -1]], truth[[0, -1]], atol=1e-6)
            # Evenly along the arc: no long stretch without a point.
            assert np.linalg.norm(np.diff(curve.pixels, axis=0), axis=1).max() < 3 * np.linalg.norm(truth[-1] - truth[0]) / 24


def test_curves_break_behind_a_pinhole_and_at_the_seam_of_a_panorama() -> None:
    ends = np.array([[[-1.0, 0.2, 4.0], [3.0, 0.2, -1.0]], [[-2.0, 0.5, -3.0], [2.0, 0.5, -3.0]]])
    n = np.ones(2)
    lines = Lines(("a", "b"), ends, np.full(2, 3), n, n, ("ok", "ok"))
    segments = Segments(np.zeros(2, dtype=np.int64), ("p.png",), np.arange(2), ("a", "b"), np.full((2, 2, 2), 20.0))
    flat = [c for c in line_curves(lines, segments, at_origin(("p.png",)), {"flat": PINHOLE}) if c.kind == "model"]
    assert np.isfinite(flat[0].pixels[0]).all() and np.isnan(flat[0].pixels[-1]).all() and np.isnan(flat[1].pixels).all()
    panorama = Equirectangular([], (1000, 500))
    around = [c for c in line_curves(lines, segments, at_origin(("p.png",)), {"pano": panorama}) if c.kind == "model"]
    assert np.isfinite(around[0].pixels).all()
    gap = np.isnan(around[1].pixels).any(1)
    assert gap.sum() == 1 and not gap[[0, -1]].any()
    left, right = np.split(around[1].pixels, np.flatnonzero(gap))
    longitude = np.arctan2(ends[1, :, 0], ends[1, :, 2])
    expected = (longitude / (2 * math.pi) + 0.5) * 1000 - 0.5
    np.testing.assert_allclose([left[0, 0], right[-1, 0]], expected, atol=1e-9)
    assert np.abs(np.diff(left[:, 0])).max() < 30 and np.abs(np.diff(right[1:, 0])).max() < 30


def test_photos_and_a_whole_page(tmp_path: Path) -> None:
    lines, cameras = some_lines(6), {"fish": FISHEYE}
    images = ("a.jpg", "b.jpg", "no pose.jpg")
    for name in images:
        cv2.imwrite(str(tmp_path / name), np.full((600, 800, 3), 90, np.uint8))
    segments, poses = observed(lines, FISHEYE, images), at_origin(images[:2])
    section = line_photos_section(tmp_path, lines, segments, poses, cameras)
    text = markup(section)
    assert text.count("<img") == 2 and text.count("5 curves") == 2 and text.count("45 observed points") == 2
    assert "&lt;0&gt;" in text and "<0>" not in text
    page = report.write_report(
        tmp_path / "report.html",
        "Scene",
        [stage_section([StageCount("lines", 5, ())]), line_table_section(lines), families_section(line_families(lines)), section],
    )
    assert page.stat().st_size < report.PAGE_LIMIT_BYTES
    with pytest.raises(InputError, match=r"camera of a\.jpg was expected to be one of other, found 'fish'"):
        line_photos_section(tmp_path, lines, segments, replace(poses, cameras=("fish", "fish")), {"other": FISHEYE})
