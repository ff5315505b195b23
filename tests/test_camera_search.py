"""Photos searched with a camera: straightened views, and the loop of detection and calibration in the commands."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from calib_patterns import Detection, DetectionOptions, Pattern, pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import graded_background, render_target
from calib_patterns.tangent_views import detect_in_views, places_of_interest, tangent_view
from camera_models import Calibration, CameraModel, InputError, save
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pose import Pose
from camera_models.scaramuzza import Scaramuzza
from omnilines.calibration.options import CalibrationOptions
from omnilines.calibration.select import Candidate
from omnilines.cli import main
from omnilines.commands.calibrate import calibrate_photos
from omnilines.commands.detect import detect as detect_command
from omnilines.files import photos as photos_module
from omnilines.files import read_corners
from omnilines.pipelines import calibrate as calibrate_pipeline
from omnilines.pipelines.camera_search import completed, resected, searched
from omnilines.pipelines.detect import detect, search_again
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.records import ViewResult

OPTIONS = DetectionOptions()
SIZE = (1280, 960)
LENS_220 = OpenCVFisheye([246.0, 246.0, 639.5, 479.5, -0.01, 0.003, -0.001, 0.0001], SIZE)
SMALL = OpenCVFisheye([143.0, 143.0, 319.5, 239.5, -0.01, 0.003, -0.001, 0.0001], (640, 480))
BOARD = pattern("checkerboard:7x6:30mm")
SPEC = BOARD.specification


def rim_photo(board: Pattern, model: CameraModel, reach_deg: float, seed: int) -> tuple[np.ndarray, np.ndarray, Pose]:
    """A photo of a board as far out as it is seen, its true corners, and its pose."""
    pose = random_board_poses(board, model, 1, math.radians(reach_deg), min_spacing_px=8.0, seed=seed)[0]
    image = render_target(board, model, pose, blur_px=0.5, noise_grey=2.0, vignetting=0.2, seed=seed)
    return image, model.project(pose.transform(torch.as_tensor(board.points_m)))[0].numpy(), pose


def error_px(found: Detection, truth: np.ndarray, board: Pattern) -> np.ndarray:
    """Of a plain board in either of the numberings that look alike."""
    own = np.abs(found.pixels - truth[found.ids]).max()
    turned = np.abs(found.pixels - truth[::-1][found.ids]).max()
    return np.asarray(min(own, turned) if board.NAME == "checkerboard" else own)


@pytest.mark.parametrize("model", [LENS_220, SMALL, Scaramuzza.examples()[0]], ids=["220", "190", "scaramuzza"])
def test_a_view_is_the_stereographic_one(model: CameraModel) -> None:
    """Its middle is the axis, directions around it are at 2 atan(r / f), and it is turned like the photo."""
    rng = np.random.default_rng(1)
    checked = 0
    for _ in range(6):
        pixel = rng.uniform(0.2, 0.8, 2) * model.image_size
        axis, valid = model.unproject(pixel[None])
        if not valid[0]:
            continue
        view = tangent_view(model, axis[0], OPTIONS.views)
        assert view is not None
        side = view.camera.image_size[0]
        middle = np.full((1, 2), 0.5 * (side - 1))
        np.testing.assert_allclose(view.in_photo(middle, model), pixel[None], atol=1e-6)
        np.testing.assert_allclose(view.camera_from_view.T @ view.camera_from_view, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.camera_from_view) > 0 and not view.reversed
        focal = 0.5 * side / math.tan(0.5 * math.radians(OPTIONS.views.half_angle_deg))
        offset = rng.uniform(-0.4, 0.4, (20, 2)) * side
        radius = np.linalg.norm(offset, axis=1)
        theta = 2 * np.arctan(radius / focal)
        direction = np.concatenate([offset / radius[:, None] * np.sin(theta)[:, None], np.cos(theta)[:, None]], 1)
        expected, seen = model.project(direction @ view.camera_from_view.T)
        found = view.in_photo(middle + offset, model)
        np.testing.assert_allclose(found[seen], expected[seen], atol=1e-6)
        assert (found[~seen] < -1000).all()
        right = view.in_photo(middle + np.array([0.5, 0.0]), model) - pixel
        assert right[0, 0] > 0 and abs(right[0, 1]) < 1e-2 * right[0, 0]
        checked += 1
    assert checked >= 4


@pytest.mark.parametrize("spec", ["checkerboard:8x6:30mm", "charuco:9x7:30mm:22mm:DICT_5X5_100", "aprilgrid:4x4:35mm:0.3:36h11"])
@pytest.mark.slow
def test_boards_past_ninety_degrees_are_found_in_views(spec: str) -> None:
    board = pattern(spec)
    image, truth, pose = rim_photo(board, LENS_220, 107.0, 1)
    seen = pose.transform(torch.as_tensor(board.points_m)).numpy()
    assert np.degrees(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])).max() > 100.0
    found = detect_in_views(image, board, LENS_220)
    assert len(found) > 0.9 * len(truth) and error_px(found, truth, board) < 0.3
    # With what these lead to nothing is missing.
    whole = completed(image, board, LENS_220, found)
    assert whole is not None and len(whole) == len(truth) and error_px(whole, truth, board) < 0.3


def test_a_mirror_shows_the_right_way_round_in_views() -> None:
    """A mirror's photo is reversed, what its camera model makes of it is not: so numbers the handedness of the board."""
    mirror = next(model for model in Scaramuzza.examples() if float(model.parameters[5]) < 0)
    pose = random_board_poses(BOARD, mirror, 3, math.radians(75.0), min_spacing_px=9.0, seed=4)[2]
    image = render_target(BOARD, mirror, pose, blur_px=0.4, noise_grey=1.0, seed=1)
    truth = mirror.project(pose.transform(torch.as_tensor(BOARD.points_m)))[0].numpy()
    view = tangent_view(mirror, places_of_interest(image, mirror, OPTIONS)[0], OPTIONS.views)
    assert view is not None and view.reversed
    found = detect_in_views(image, BOARD, mirror, mirrored=True)
    assert len(found) > 0.8 * len(truth) and error_px(found, truth, BOARD) < 0.3
    # Taken for a lens's photo, its corners are numbered the other way round, which no pose makes good.
    other = detect_in_views(image, BOARD, mirror, mirrored=False)
    assert len(other) > 0.8 * len(truth) and error_px(other, truth, BOARD) > 5.0


def test_no_board_no_corners() -> None:
    rng = np.random.default_rng(3)
    scene = graded_background(SMALL, rng)
    clutter = np.clip(scene + rng.normal(0.0, 8.0, scene.shape), 0, 255).astype(np.uint8)
    for image in (clutter, np.full((480, 640), 90, dtype=np.uint8)):
        assert len(searched(image, BOARD, SMALL, Detection.empty())) == 0
    assert places_of_interest(np.full((480, 640), 90, dtype=np.uint8), SMALL, OPTIONS) == []


def test_resection_of_a_known_camera() -> None:
    _, truth, pose = rim_photo(BOARD, LENS_220, 105.0, 5)
    ids = np.array([0, 5, 20, 41])
    found = resected(BOARD, LENS_220, Detection(ids, truth[ids], np.full(4, 0.1)))
    assert found is not None
    np.testing.assert_allclose(found.rotation.numpy(), pose.rotation.numpy(), atol=1e-6)
    np.testing.assert_allclose(found.translation.numpy(), pose.translation.numpy(), atol=1e-7)
    assert resected(BOARD, LENS_220, Detection(ids[:3], truth[ids[:3]], np.full(3, 0.1))) is None


@dataclass(frozen=True)
class Set:
    """Photos in a folder, with their poses and true corners."""

    folder: Path
    poses: Pose
    truth: np.ndarray


@pytest.fixture(scope="module")
def photo_set(tmp_path_factory: pytest.TempPathFactory) -> Set:
    """Seven small photos of whole boards."""
    folder = tmp_path_factory.mktemp("photos")
    poses = random_board_poses(BOARD, SMALL, 7, math.radians(80.0), min_spacing_px=9.0, seed=8)
    for k in range(7):
        image = render_target(BOARD, SMALL, poses[k], blur_px=0.5, noise_grey=2.0, seed=k)
        assert cv2.imwrite(str(folder / f"{k}.png"), image)
    truth = SMALL.project(poses.transform(torch.as_tensor(BOARD.points_m).expand(7, -1, -1)))[0].numpy()
    return Set(folder, poses, truth)


def reduced(whole: PhotoCorners, photos: Set) -> PhotoCorners:
    """As if a detection had lost photo 3, and of photos 1 and 5 all but a few corners."""
    better = {"1.png": whole.detection("1.png"), "5.png": whole.detection("5.png")}
    for name, kept in (("1.png", slice(0, 12)), ("5.png", slice(20, 28))):
        d = better[name]
        blur = None if d.blur_px is None else d.blur_px[kept]
        better[name] = Detection(d.ids[kept], d.pixels[kept], d.sigma_px[kept], blur)
    better["3.png"] = Detection.empty()
    less = whole.updated(better)
    lost = ViewResult("3.png", "3.png", False, "No board was found.")
    assert less.corners.images == tuple(f"{k}.png" for k in (0, 1, 2, 4, 5, 6))
    return replace(less, skipped=(lost,))


def test_search_again_completes_photos_and_finds_lost_ones(photo_set: Set) -> None:
    whole = detect(photo_set.folder, BOARD)
    assert len(whole.corners) == 7 * 42
    less = reduced(whole, photo_set)
    poses = {name: pose for name in less.corners.images if (pose := resected(BOARD, SMALL, less.detection(name))) is not None}
    told: list[tuple[str, int, int]] = []
    again = search_again(less, SMALL, poses, first=True, progress=lambda *step: told.append(step))
    assert told == [("searching with the camera", k, 7) for k in range(1, 8)]
    assert again.corners.images == whole.corners.images and again.skipped == () and len(again.corners) == 7 * 42
    assert again.corners.ids is not None and again.corners.sigma_px is not None and again.blur_px is not None
    for k, name in enumerate(again.corners.images):
        found = again.detection(name)
        assert found.ids.tolist() == list(range(42)) and error_px(found, photo_set.truth[k], BOARD) < 0.2
        np.testing.assert_array_equal(again.corners.board_m[again.corners.view == k], BOARD.points_m)
    # Those that were complete are fitted again, along the edges that the camera sees.
    moved = np.abs(again.detection("0.png").pixels - whole.detection("0.png").pixels).max()
    assert 0.0 < moved < 0.05
    told.clear()
    kept = search_again(less, SMALL, poses, first=False, progress=lambda *step: told.append(step))
    assert told[-1][2] == 2
    assert kept.skipped == less.skipped and "3.png" not in kept.corners.images and len(kept.corners) == 6 * 42


def test_complete_photos_are_read_the_first_time_only(photo_set: Set, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = detect(photo_set.folder, BOARD)
    poses = {name: pose for name in whole.corners.images if (pose := resected(BOARD, SMALL, whole.detection(name))) is not None}
    assert len(poses) == 7

    def unread(path: Path) -> np.ndarray:
        raise AssertionError(f"{path} was read")

    monkeypatch.setattr(photos_module, "read_photo", unread)
    again = search_again(whole, SMALL, poses, first=False)
    np.testing.assert_array_equal(again.corners.pixels, whole.corners.pixels)
    with pytest.raises(AssertionError, match="was read"):
        search_again(whole, SMALL, poses, first=True)


@pytest.mark.parametrize("model", ["opencv-fisheye", pytest.param("auto", marks=pytest.mark.full)])
@pytest.mark.slow
def test_calibrate_gains_what_detection_lost(photo_set: Set, model: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    whole = detect(photo_set.folder, BOARD)
    monkeypatch.setattr("omnilines.commands.calibrate.detect", lambda *_, **__: reduced(whole, photo_set))
    if model == "auto":
        # The models are compared once, by the final corners.
        original = calibrate_pipeline.select_model
        sizes = []
        two = (Candidate("opencv-fisheye", {}), Candidate("scaramuzza", {"degree": 4}))

        def selecting(corners: object, *args: object, **options: object) -> object:
            sizes.append(len(corners))  # type: ignore[arg-type]
            return original(corners, *args, candidates=two, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(calibrate_pipeline, "select_model", selecting)
    result = calibrate_photos([photo_set.folder], SPEC, tmp_path, CalibrationOptions(model))
    assert model != "auto" or sizes == [7 * 42]
    table = read_corners(tmp_path / "corners.csv")
    assert len(table) == 7 * 42 and len(table.images) == 7
    used = [view for view in yaml.safe_load((tmp_path / "calibration.yaml").read_text())["views"] if view["used"]]
    assert len(used) == 7
    note = "The camera led to 106 corners that had been missed, those of 1 photo in which no board had been found among them."
    assert note in result.warnings and note in result.data["notes"]


@pytest.mark.slow
def test_calibrate_says_nothing_where_nothing_was_missing(photo_set: Set, tmp_path: Path) -> None:
    result = calibrate_photos([photo_set.folder], SPEC, tmp_path, CalibrationOptions("opencv-fisheye"))
    assert not any("The camera led to" in text for text in result.warnings)


def test_detect_takes_a_calibration(photo_set: Set, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save(path, {"cam0": SMALL})
    original = type(BOARD).detect
    calls = []

    def few(self: Pattern, image: np.ndarray, **given: object) -> tuple[Detection, str | None]:
        found, reason = original(self, image, **given)  # type: ignore[arg-type]
        calls.append(image.shape)
        return Detection(found.ids[:9], found.pixels[:9], found.sigma_px[:9]), reason

    monkeypatch.setattr(type(BOARD), "detect", few)
    counts = {}
    for name, calibration in (("without", None), ("with", path)):
        detect_command([photo_set.folder], SPEC, tmp_path / name, calibration=calibration)
        counts[name] = len(read_corners(tmp_path / name / "corners.csv"))
    assert counts == {"without": 7 * 9, "with": 7 * 42} and len(calls) == 14


def test_detect_refuses_what_is_not_the_camera(photo_set: Set, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    two, other = tmp_path / "two.yaml", tmp_path / "other.yaml"
    save(two, Calibration({"left": SMALL, "right": SMALL}))
    save(other, {"cam0": LENS_220})
    cases = ((two, "found 2 cameras (left, right)"), (other, "of 640x480 px, was expected, found one of 1280x960 px"))
    for path, words in cases:
        with pytest.raises(InputError) as caught:
            detect_command([photo_set.folder], SPEC, tmp_path / "out", calibration=path)
        assert words in str(caught.value)
    arguments = ["detect", str(photo_set.folder), "--pattern", SPEC, "--calibration", str(two), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "found 2 cameras" in capsys.readouterr().err


@pytest.mark.slow
def test_every_photo_of_a_mirror_is_used(shared_data: Path, tmp_path: Path) -> None:
    """The board of the eighth photo is in full view, and bent by more than a right angle."""
    result = calibrate_photos([shared_data / "calibration" / "kaidan" / "images"], "checkerboard:11x7:30mm", tmp_path)
    views = result.data["views"]
    assert len(views) == 17 and all(view["used"] for view in views)
    assert result.data["rms_px_per_axis"] < 0.25
    eighth = next(view for view in views if view["image"] == "KaidanOmni8.jpg")
    assert eighth["rms_px_per_point"] < 0.4
    assert (
        result.warnings[0].startswith("A lens is assumed, though no corner lies near the axis")
        and "`mirror`" in result.warnings[0]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "spec", "photos", "rms_px"),
    [("fisheye1", "checkerboard:8x6:32.5mm", 15, 0.275), ("fisheye190", "checkerboard:7x6:30mm", 8, 0.18)],
)
def test_the_guided_corners_are_as_good_as_the_others(
    name: str, spec: str, photos: int, rms_px: float, shared_data: Path, tmp_path: Path
) -> None:
    result = calibrate_photos([shared_data / "calibration" / name / "images"], spec, tmp_path)
    assert sum(view["used"] for view in result.data["views"]) == photos and result.data["rms_px_per_axis"] < rms_px
    assert len(read_corners(tmp_path / "corners.csv")) == photos * len(pattern(spec).points_m)
