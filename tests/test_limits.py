"""What limits a result, as it was measured, and what to do about it."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import omnilines as ol
from camera_models import Calibration, OpenCVFisheye
from camera_models.wording import rounded
from omnilines.calibration.lines.camera import LineCamera, LinePhoto
from omnilines.calibration.lines.check import LineCheck, RegionDrift
from omnilines.files import Photo, photos_of
from omnilines.pages.arcs import arcs_summary
from omnilines.pages.limits import line_advice, unused_advice
from omnilines.pages.limits_of_lines import arcs_advice, check_advice
from omnilines.pipelines.check import CheckResult
from omnilines.pipelines.check_options import CheckOptions
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs
from omnilines.pipelines.same_place import is_same_place
from omnilines.records import ViewResult
from omnilines.report.numbers import figure, with_sigma

LENS = OpenCVFisheye([200.0, 200.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0], (640, 480))


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (543.78789, 0.1, "543.79 ± 0.10"),
        (-0.00042441, 0.00035, "-0.00042 ± 0.00035"),
        (0.0, 7e-5, "(0.0 ± 7.0)e-05"),
        (-1e-9, 0.0996, "0.00 ± 0.10"),
        (1234567.0, 2500.0, "1234600 ± 2500"),
        (0.5, 0.0, "0.5 (held)"),
        (1.0, math.inf, "1 ± not known"),
        (math.nan, 1.0, "not known"),
    ],
)
def test_a_number_ends_where_its_sigma_says(value: float, sigma: float, text: str) -> None:
    assert with_sigma(value, sigma) == text


def test_photos_without_use_are_named_where_they_are_many() -> None:
    lost = [ViewResult(f"view {k}", f"{k}.png", False, "no board was found.") for k in range(4)]
    assert unused_advice(lost, 16) == ()
    (one,) = unused_advice(lost, 12)
    assert one.limit == "4 of 12 photos are not used; of 4 it is said: no board was found."
    assert one.do == "Shoot again: 0.png, 1.png, 2.png and 1 more."


@pytest.mark.slow
def test_what_to_do_about_photos_without_use_follows_from_their_reasons(tmp_path: Path) -> None:
    """Damaged files are copied again, not shot again; and the count is that of the views that are not used."""
    photos = ol.render("checkerboard:5x4:60mm", LENS, ol.RenderOptions(views=5, seed=3)).photos
    for name, pixels in photos.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), pixels)
    first, second, *_ = sorted(tmp_path.iterdir())
    (tmp_path / "a_page.png").write_text("<html>Not found</html>")
    (tmp_path / "cut.png").write_bytes(first.read_bytes()[:2000])
    (tmp_path / "empty.png").touch()
    (tmp_path / "second.png").write_bytes(second.read_bytes())
    cv2.imwrite(str(tmp_path / "half.png"), cv2.imread(str(first))[::2, ::2])
    cv2.imwrite(str(tmp_path / "white.png"), np.full(LENS.image_size[::-1], 255, np.uint8))
    result = ol.calibrate(tmp_path, "checkerboard:5x4:60mm", model="opencv-fisheye")
    (one,) = unused_advice([view for view in result.views if not view.used], len(result.views))
    assert sum(view.used for view in result.views) == 5
    assert one.limit.startswith("6 of 11 photos are not used, 1 of them as a copy; of 3 it is said, the first: The image ")
    assert "a_page.png cannot be decoded" in one.limit and "again" not in one.limit
    assert one.do.startswith("Copy it again: a_page.png, cut.png, empty.png. ")
    assert "Give it as the camera took it: half.png." in one.do and "Shoot again: white.png." in one.do


def line_camera(sigma_px: float, frames: int, reach_deg: float) -> LineCamera:
    photos = tuple(LinePhoto(f"{k}.png", 50, 40, 30, 3, k < frames, 0.1, 0.2) for k in range(4))
    covariance = np.diag([sigma_px**2] * 2 + [0.01] * 6)
    none = np.zeros((0, 2))
    return LineCamera(LENS, covariance, 0.1, photos, none, none, np.zeros(0, np.int64), 0.0, reach_deg, (), ())


def test_lines_say_what_tells_the_focal_length_and_how_far_they_reach() -> None:
    edge_deg = math.degrees(math.hypot(319.5, 239.5) / 200.0)
    assert line_advice(line_camera(0.5, 4, edge_deg)) == ()
    focal, reach = line_advice(line_camera(4.0, 2, 60.0))
    assert focal.limit.startswith("The focal length is known to 2 percent only: 2 of 4 photos")
    assert focal.do.endswith(f"10 more like these would bring it to about {2 * math.sqrt(2 / 12):.2g} percent.")
    assert reach.limit.startswith("No edge lies beyond 60 degrees off axis, where the image reaches to 11")
    assert line_advice(line_camera(0.5, 4, 60.0), rim_px=220.0) == (), "what lies beyond the rim of the lens is dark"
    (to_the_rim,) = line_advice(line_camera(0.5, 4, 40.0), rim_px=220.0)
    assert to_the_rim.limit == "No edge lies beyond 40 degrees off axis, where the image reaches to 63."
    assert line_advice(line_camera(4.0, 0, 120.0))[0].do.endswith("or of a board.")
    (left_open,) = line_advice(replace(line_camera(40.0, 0, 120.0), open_terms=("fx fy",)))
    assert left_open.limit == "Lines leave open fx fy."


def checked(holds: bool, sigma_px: float, frames: int) -> CheckResult:
    regions = [RegionDrift(f"region {k}", 0 if k == 3 else 9, 0.1, 0.1 * k, 0.05, 0.08 * k) for k in range(9)]
    change, spread = np.array([0.1, 0.1, 3.0, 0, 0, 0, 0, 0]), np.full(8, 0.5)
    found = LineCheck(
        LENS, 40.0, 8, 60.0, 1e-6, 0.4, 0.0 if holds else 0.3, sigma_px, change, spread, tuple(regions), 300, 200, frames
    )
    return CheckResult(found, holds, CheckOptions(), ("a.png", "b.png"), (), {})


def test_a_check_says_where_it_drifted_or_what_photos_could_not_tell() -> None:
    (drift,) = check_advice(checked(False, 0.05, 2))
    assert "region 8 of the image, by at least 0.64 px; the parameter cx is off most clearly, by 6 sigma" in drift.limit
    assert drift.do.endswith(f" by: omnilines calibrate PHOTOS --pattern lines --model {LENS.NAME} --out calibrated_again")
    (asked,) = check_advice(checked(False, 0.05, 2), ["my photos", "--mask", "sky.png"])
    assert "omnilines calibrate 'my photos' --mask sky.png --pattern lines --model" in asked.do
    unseen = check_advice(checked(True, 0.05, 2))
    assert [one.limit for one in unseen] == ["No edges lie at the region 3 of the image: nothing tells of it."]
    angles, more, _ = check_advice(checked(True, 0.3, 0))
    assert (
        angles.limit.startswith("No photo shows lines at right angles") and more.do == "About 18 photos like these would tell it."
    )


def test_a_check_asks_for_other_photos_where_no_number_of_the_same_would_do() -> None:
    more = check_advice(checked(True, 6.3, 2))[0]
    assert more.do.startswith("More photos like these hardly help: least is known at the region 0 of the image (0.05 px).")


def arcs_of(counts: list[int], tmp_path: Path) -> PhotoArcs:
    found = []
    for k, count in enumerate(counts):
        (photo,) = photos_of({f"{k}.png": np.zeros((480, 640), np.uint8)})
        # Through the centre, where a straight line has a straight image.
        ends = np.tile([[269.5, 239.5], [369.5, 239.5]], (count, 1, 1))
        covariance = np.tile(np.diag([9.0, 0.04]), (count, 2, 1, 1))
        assert isinstance(photo, Photo)
        found.append(FoundArcs(photo, "cam0", ends, covariance, np.full(count, 100.0), np.zeros((count, 2, 3))))
    return PhotoArcs(tuple(found), Calibration({"cam0": LENS}))


def test_arcs_say_how_well_they_are_known_and_which_photos_have_few(tmp_path: Path) -> None:
    arcs = arcs_of([40, 40, 40, 3], tmp_path)
    (few,) = arcs_advice(arcs)
    assert few.limit == "3.png (3) has few arcs, where half of the photos have 40 or more."
    verdict = arcs_summary(arcs, tmp_path / "segments.csv").verdict
    assert verdict.startswith("123 arcs of straight lines in 4 of 4 photos") and "known to 0.2 px across" in verdict
    assert arcs_advice(arcs_of([40, 40], tmp_path)) == ()
    skipped = replace(arcs, photos=(*arcs.photos, replace(arcs.photos[0], reason="it is black.")))
    assert arcs_advice(skipped)[0].limit.startswith("1 of 5 photos is skipped; of ")
    same = "It shows what 0.png shows from the same place, which tells no distances."
    assert is_same_place(same)
    for reason in (same, "It is a copy of 0.png, and would count twice."):
        missed = replace(arcs, photos=(*arcs.photos, replace(arcs.photos[0], reason=reason)))
        assert arcs_advice(missed) == (few,)


def test_numbers_of_ordinary_size_have_no_exponent() -> None:
    assert [rounded(value) for value in (123.4, 0.0123, 99.6, 2.0, -1234.0)] == ["120", "0.012", "100", "2", "-1200"]
    assert (rounded(12.2, 1), rounded(3.2e-7), rounded(2.5e7)) == ("10", "3.2e-07", "2.5e+07")
    assert (figure(1234.5), figure(123.4, ".2g", "px"), figure(1234.5, ".2f"), figure(math.nan)) == (
        "1230",
        "120 px",
        "1234.50",
        "not known",
    )
