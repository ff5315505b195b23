"""`omnilines render targets` and `omnilines validate`: what they write, that the whole path holds, and that errors are seen."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import camera_models
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.checkerboard import Checkerboard
from camera_models import InputError
from camera_models.pose import Pose
from omnilines import cli
from omnilines.calibration.options import CalibrationOptions
from omnilines.calibration.record import calibration_record
from omnilines.calibration.single import calibrate_camera
from omnilines.commands.calibrate import calibrate_corners, calibrate_photos
from omnilines.files import read_corners, read_poses, write_corners
from omnilines.pipelines.render import RenderOptions, render, render_targets
from omnilines.pipelines.rendered import RenderedTargets
from omnilines.records import ImagePoses
from omnilines.studies.validate import validate
from omnilines.studies.validation import Validation, compare
from omnilines.synthetic.targets import board_angle_rad, example_camera, simulate_corners

SIZE = (640, 480)
SPEC = "checkerboard:8x6:30mm"
SMALL = ("--size", "640x480", "--views", "8")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """(exit status, standard output) of one command."""
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return int(ended.value.code or 0), capsys.readouterr().out


@pytest.mark.slow
def test_render_targets_writes_photos_and_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = []
    rendered = render_targets(SPEC, "scaramuzza", RenderOptions(fov_deg=200.0, views=3, size_px=SIZE, seed=4))
    files = rendered.save(tmp_path, lambda *step: told.append(step))
    assert all(path.is_file() for path in files) and len(files) == 6
    assert told[-1] == ("rendering photos", 3, 3)
    truth = camera_models.load(tmp_path / "calibration.yaml")
    assert truth["cam0"].NAME == "scaramuzza" and truth["cam0"].image_size == SIZE
    assert truth.provenance["seed"] == 4
    poses, corners = read_poses(tmp_path / "poses.csv"), read_corners(tmp_path / "true_corners.csv")
    assert len(corners) == 3 * 48
    for k, view in enumerate(truth.views):
        photo = cv2.imread(str(tmp_path / view.image), cv2.IMREAD_UNCHANGED)
        assert photo.shape == (480, 640) and photo.dtype == np.uint8
        np.testing.assert_array_equal(photo, rendered.photos[view.image])
        assert view.cam_from_board is not None
        torch.testing.assert_close(view.cam_from_board.translation, poses.cam_from_world.translation[k])
        own = corners.view == k
        pixels, _ = truth["cam0"].project(view.cam_from_board.transform(torch.as_tensor(corners.board_m[own])))
        np.testing.assert_allclose(pixels.numpy(), corners.pixels[own], atol=1e-9)
        # A corner lies between two dark and two bright squares: what is just round it spans the print's contrast.
        u, v = np.rint(corners.pixels[own][0]).astype(int)
        assert np.ptp(photo[v - 4 : v + 5, u - 4 : u + 5].astype(int)) > 100
    status, out = run(capsys, "render", "targets", "--out", tmp_path / "again", "--seed", 4, "--model", "scaramuzza",
                      "--fov-deg", 200, "--views", 3, "--size", "640x480", "--json")  # fmt: skip
    assert status == 0 and json.loads(out)["photos"] == ["view00.png", "view01.png", "view02.png"]
    for name in ("view02.png", "true_corners.csv"):
        assert (tmp_path / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_what_render_refuses() -> None:
    with pytest.raises(InputError, match="found 190"):
        render_targets(SPEC, "pinhole", RenderOptions(fov_deg=190.0))
    with pytest.raises(InputError, match="half the field of view"):
        render_targets(SPEC, options=RenderOptions(fov_deg=190.0), max_angle_deg=100.0)
    with pytest.raises(InputError, match="At least 1 view"):
        RenderOptions(views=0)
    with pytest.raises(InputError, match="vignetting of 0 to 1"):
        RenderOptions(vignetting=2.0)
    with pytest.raises(InputError, match="with a scene only"):
        render_targets(SPEC, "scaramuzza", RenderOptions(mirror=True))


def test_a_given_camera_and_given_poses_are_those_of_the_photos() -> None:
    drawn = render_targets(SPEC, "opencv-fisheye", RenderOptions(fov_deg=170.0, views=2, size_px=SIZE, seed=3))
    again = render_targets(pattern(SPEC), drawn.camera, RenderOptions(fov_deg=170.0, seed=3), poses=drawn.cam_from_board)
    assert list(again.photos) == ["view00.png", "view01.png"]
    np.testing.assert_array_equal(again.photos["view01.png"], drawn.photos["view01.png"])
    whole = render_targets(SPEC, drawn.camera, RenderOptions(views=1))
    assert 170.0 < whole.fov_deg <= 360.0


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[RenderedTargets, camera_models.Calibration, Path]:
    """The truth of 8 photos, and a calibration from its corners with 0.1 px of white noise: no detector takes part."""
    folder = tmp_path_factory.mktemp("noisy")
    truth = render_targets(SPEC, options=RenderOptions(fov_deg=190.0, views=8, size_px=SIZE, seed=2))
    corners = simulate_corners(truth.camera, pattern(SPEC), truth.cam_from_board, 0.1, 0)
    write_corners(folder / "corners.csv", corners)
    calibrate_corners(folder / "corners.csv", SIZE, folder / "out", CalibrationOptions("opencv-fisheye", loss="none"))
    return truth, camera_models.load(folder / "out/calibration.yaml"), folder / "corners.csv"


Noisy = tuple[RenderedTargets, camera_models.Calibration, Path]


def test_white_noise_passes_the_checks_of_parameters_and_lines(noisy: Noisy) -> None:
    truth, calibration, path = noisy
    validation = compare(truth, calibration, read_corners(path))
    checks = {check.name: check for check in validation.checks}
    assert len(checks) == 8 and all(check.holds == (check.value <= check.limit) for check in checks.values())
    assert validation.photos_lost == 0
    assert validation.bearing_limit_deg == pytest.approx(0.1 * 190.0 / 480.0)
    assert checks["parameters, squared Mahalanobis distance"].holds
    assert checks["worst parameter, standard deviations off"].holds
    assert checks["lines, squared Mahalanobis distance"].holds
    assert validation.corners_aside <= 2
    # 8 photos of 14 lines with two ends each, 0.1 px at some 0.3 m and 150 px focal length.
    assert 1e-5 < validation.lines.aligned.rms_m < 1e-3
    assert validation.lines.predicted_rms_m == pytest.approx(validation.lines.aligned.rms_m, rel=0.6)


def test_a_wrong_camera_and_lost_photos_are_seen(noisy: Noisy) -> None:
    truth, calibration, path = noisy
    parameters = truth.camera.parameters.clone()
    parameters[:2] *= 1.01
    images, poses = (*truth.poses.images, "lost1.png", "lost2.png"), truth.cam_from_board[[*range(8), 0, 0]]
    off = replace(truth, camera=truth.camera.with_parameters(parameters), poses=ImagePoses(images, poses))
    failed = {check.name for check in compare(off, calibration, read_corners(path)).checks if not check.holds}
    assert failed == {
        "photos without a usable target",
        "bearing error, RMS over the pixels",
        "parameters, squared Mahalanobis distance",
        "worst parameter, standard deviations off",
    }


LINES_CHECK = "lines, squared Mahalanobis distance"
RMS_CHECK, SCALE_CHECK = "distance of the lines' ends, RMS", "scale of the lines, over the board"


@dataclass(frozen=True)
class MovedBoard(Checkerboard):
    """A print that is not what its specification says: column 3 is `shift_m` further right, then all x times `stretch`."""

    shift_m: float = 0.0
    stretch: float = 1.0

    @property
    def points_m(self) -> np.ndarray:
        points = super().points_m
        points[:, 0] = self._columns()[1][np.arange(len(points)) % self.nx]
        return points

    def reflectance(self, points_m: np.ndarray, footprint_m: np.ndarray) -> np.ndarray:
        said, printed = self._columns()
        # Straight pieces between the columns; beyond the outermost ones the stretch alone.
        x = np.interp(points_m[..., 0], printed, said)
        outside = (points_m[..., 0] < printed[0]) | (points_m[..., 0] > printed[-1])
        x = np.where(outside, points_m[..., 0] / self.stretch, x)
        return super().reflectance(np.stack([x, points_m[..., 1]], -1), footprint_m)

    def _columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the columns are said to be, and where they are."""
        said = self.square_m * np.arange(self.nx)
        return said, self.stretch * (said + np.where(np.arange(self.nx) == 3, self.shift_m, 0.0))


WRONG_BOARDS = {
    "a column 2 mm off": MovedBoard(8, 6, 0.03, shift_m=2e-3),
    "a column 0.2 mm off": MovedBoard(8, 6, 0.03, shift_m=2e-4),
    "squares too wide by 1 percent": MovedBoard(8, 6, 0.03, stretch=1.01),
}


@pytest.mark.parametrize("board", WRONG_BOARDS.values(), ids=WRONG_BOARDS)
def test_lines_of_a_wrong_board_do_not_hold(noisy: Noisy, board: MovedBoard, tmp_path: Path) -> None:
    """Photographed was another board than the truth and the calibration take it for, whose robust loss sets corners aside."""
    truth, _, _ = noisy
    corners = simulate_corners(truth.camera, board, truth.cam_from_board, 0.02, 0)
    write_corners(tmp_path / "corners.csv", replace(corners, board_m=truth.pattern.points_m[corners.ids]))
    calibrate_corners(tmp_path / "corners.csv", SIZE, tmp_path / "out", CalibrationOptions("opencv-fisheye"))
    calibration = camera_models.load(tmp_path / "out/calibration.yaml")
    checks = {check.name: check for check in compare(truth, calibration, read_corners(tmp_path / "out/corners.csv")).checks}
    assert not checks[LINES_CHECK].holds and checks[LINES_CHECK].value > 3 * checks[LINES_CHECK].limit


@pytest.mark.parametrize("board", WRONG_BOARDS.values(), ids=WRONG_BOARDS)
def test_a_truth_that_was_not_photographed_is_seen(noisy: Noisy, board: MovedBoard) -> None:
    """Photos and calibration are right, the truth is another board. At 0.1 px, 0.2 mm are within the noise."""
    truth, calibration, path = noisy
    checks = compare(replace(truth, pattern=board), calibration, read_corners(path)).checks
    failed = {check.name for check in checks if not check.holds}
    assert failed - {RMS_CHECK, SCALE_CHECK} == (set() if board.shift_m == 2e-4 else {LINES_CHECK})


def test_lines_that_are_stated_to_be_bad_or_too_long_do_not_hold(noisy: Noisy) -> None:
    """The similarity takes a common scale out, and corners that state their errors excuse any line: neither is good."""
    truth, calibration, path = noisy
    corners = read_corners(path)
    longer = replace(
        calibration,
        views=tuple(
            replace(view, cam_from_board=Pose(view.cam_from_board.rotation, 1.01 * view.cam_from_board.translation))
            for view in calibration.views
        ),
    )
    failed = {check.name for check in compare(truth, longer, corners).checks if not check.holds}
    assert failed == {SCALE_CHECK}
    noise = np.random.default_rng(1).normal(size=corners.pixels.shape)
    bad = replace(corners, pixels=corners.pixels + noise, sigma_px=np.full(len(corners), 1.0))
    checks = {check.name: check for check in compare(truth, calibration, bad).checks}
    assert checks[LINES_CHECK].holds and not checks[RMS_CHECK].holds


def test_wrong_corners_are_set_aside_for_what_the_other_photos_say(noisy: Noisy) -> None:
    truth, calibration, path = noisy
    corners = read_corners(path)
    pixels = corners.pixels.copy()
    # Corner 0 of three photos, which is an end of a row and of a column.
    wrong = np.flatnonzero(corners.ids == 0)[:3]
    pixels[wrong] += [3.0, -2.0]
    validation = compare(truth, calibration, replace(corners, pixels=pixels))
    assert 3 <= validation.corners_aside <= 5
    assert all(check.holds for check in validation.checks if check.name in (LINES_CHECK, "corners that fit no line"))
    # Half of all corners: the lines no longer rest on what was seen.
    rng = np.random.default_rng(0)
    half = rng.random(len(corners)) < 0.25
    pixels = corners.pixels + half[:, None] * rng.uniform(-5, 5, corners.pixels.shape)
    checks = {check.name: check for check in compare(truth, calibration, replace(corners, pixels=pixels)).checks}
    assert not checks["corners that fit no line"].holds


@pytest.mark.slow
@pytest.mark.parametrize(("model", "fov"), [("opencv-fisheye", 190.0), pytest.param("pinhole", 90.0, marks=pytest.mark.full)])
def test_lines_hold_over_seeds_and_lenses(model: str, fov: float) -> None:
    """With corners as good as stated the statistic is chi-square, less what camera and poses take out of the noise."""
    shares = []
    for seed in range(8):
        truth = example_camera(model, fov, SIZE, seed)
        reach = board_angle_rad(fov)
        poses = random_board_poses(pattern(SPEC), truth, 8, reach, seed=seed)
        corners = simulate_corners(truth, pattern(SPEC), poses, 0.05, seed)
        found = calibrate_camera(corners, SIZE, model)
        rendered = render_targets(SPEC, truth, RenderOptions(fov_deg=fov), poses=poses)
        lines = compare(rendered, calibration_record(found, False, {}), corners).lines
        assert lines.statistic < lines.limit
        shares.append(lines.statistic / (4 * 14 - 7))
    assert 0.6 < np.mean(shares) < 1.1


@pytest.mark.slow
def test_photos_of_a_misprinted_board_do_not_hold(tmp_path: Path) -> None:
    """The same from pixels on: rendered photos, the detector, the calibration."""
    options = RenderOptions(fov_deg=190.0, views=8, size_px=SIZE, seed=3)
    misprinted = render_targets(WRONG_BOARDS["a column 2 mm off"], options=options)
    misprinted.save(tmp_path)
    calibrate_photos(
        [tmp_path / name for name in misprinted.photos], SPEC, tmp_path / "out", CalibrationOptions("opencv-fisheye")
    )
    truth = replace(misprinted, pattern=pattern(SPEC))
    calibration = camera_models.load(tmp_path / "out/calibration.yaml")
    checks = compare(truth, calibration, read_corners(tmp_path / "out/corners.csv")).checks
    assert LINES_CHECK in [check.name for check in checks if not check.holds]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "fov"),
    [("opencv-fisheye", 190), pytest.param("scaramuzza", 190, marks=pytest.mark.full), ("scaramuzza", 220), ("pinhole", 90)],
)
def test_the_whole_path_holds(model: str, fov: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out = run(capsys, "validate", "--model", model, "--fov-deg", fov, *SMALL, "--seed", 5, "--out", tmp_path, "--json")
    data = json.loads(out)
    assert [check["name"] for check in data["checks"] if not check["holds"]] == []
    assert status == 0 and data["holds"] and data["photos_used"] >= 7
    assert data["bearing_rms_deg"] < 0.1 * fov / 480
    names = ["calibration.yaml", "corners.csv", "poses.csv", "segments.csv", "lines.csv", "lines.ply", "report.html"]
    assert all((tmp_path / name).is_file() for name in names)
    page = (tmp_path / "report.html").read_text()
    assert "view00.png" in page and "Bearing error" in page and len(page) < 15e6


@pytest.mark.slow
def test_objects_in_objects_out(tmp_path: Path) -> None:
    told = []
    checked = validate(
        render(SPEC, "pinhole", fov_deg=90.0, views=6, size_px=(480, 360), seed=5), progress=lambda *s: told.append(s)
    )
    assert isinstance(checked, Validation) and {stage for stage, _, _ in told} >= {"detecting corners", "rebuilding lines"}
    assert len(checked.checks) == 8 and checked.holds == all(check.holds for check in checked.checks)
    assert checked.bearings.rms_deg < 0.05 and checked.model.NAME == "pinhole"
    assert not list(tmp_path.iterdir())
    names = ["calibration.yaml", "corners.csv", "covariance.npz", "lines.csv", "lines.ply", "poses.csv", "segments.csv"]
    assert sorted(path.name for path in checked.save(tmp_path / "out")) == names
    assert "Bearing error" in checked.report(tmp_path / "report.html").read_text()


@pytest.mark.slow
def test_noise_beyond_the_limit_exits_with_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With little light and few photos the bearings are worse than 0.02 degrees, and the command says so."""
    status, out = run(
        capsys, "validate", "--model", "pinhole", "--fov-deg", 60, "--size", "480x360", "--views", 3, "--noise", 25,
        "--blur", 1.5, "--seed", 1, "--out", tmp_path, "--json",
    )  # fmt: skip
    data = json.loads(out)
    assert status == 1 and not data["holds"]
    assert "bearing error, RMS over the pixels" in [check["name"] for check in data["checks"] if not check["holds"]]
