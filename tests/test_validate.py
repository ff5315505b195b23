"""`omnilines render targets` and `omnilines validate`: what they write, that the whole path holds, and that errors are seen."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import camera_models
from calib_patterns import pattern
from camera_models import InputError
from omnilines import cli
from omnilines.commands._validation import compare
from omnilines.commands.calibrate import calibrate_corners
from omnilines.commands.render import RenderedTargets, render_targets, write_targets
from omnilines.files import read_corners, read_poses, write_corners
from omnilines.simulate import simulate_corners

SIZE = (640, 480)
SPEC = "checkerboard:8x6:30mm"
SMALL = ("--size", "640x480", "--views", "8")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """(exit status, standard output) of one command."""
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return int(ended.value.code or 0), capsys.readouterr().out


def test_render_targets_writes_photos_and_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = []
    result = render_targets(
        tmp_path, model="scaramuzza", fov_deg=200.0, views=3, size=SIZE, seed=4, progress=lambda *step: told.append(step)
    )
    assert all(path.is_file() for path in result.files) and len(result.files) == 6
    assert told[-1] == ("rendering photos", 3, 3)
    truth = camera_models.load(tmp_path / "calibration.yaml")
    assert truth["cam0"].NAME == "scaramuzza" and truth["cam0"].image_size == SIZE
    assert truth.provenance["seed"] == 4
    poses, corners = read_poses(tmp_path / "poses.csv"), read_corners(tmp_path / "true_corners.csv")
    assert len(corners) == 3 * 48
    for k, view in enumerate(truth.views):
        photo = cv2.imread(str(tmp_path / view.image), cv2.IMREAD_UNCHANGED)
        assert photo.shape == (480, 640) and photo.dtype == np.uint8
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


def test_what_render_refuses(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found 190"):
        render_targets(tmp_path, model="pinhole", fov_deg=190.0)
    with pytest.raises(InputError, match="half the field of view"):
        render_targets(tmp_path, fov_deg=190.0, max_angle_deg=100.0)
    with pytest.raises(InputError, match="At least 1 view"):
        render_targets(tmp_path, views=0)
    assert not list(tmp_path.glob("*.yaml"))


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[RenderedTargets, camera_models.Calibration, Path]:
    """The truth of 8 photos, and a calibration from its corners with 0.1 px of white noise: no detector takes part."""
    folder = tmp_path_factory.mktemp("noisy")
    options = {"model": "opencv-fisheye", "fov_deg": 190.0, "size": SIZE, "noise": 0.0, "blur": 0.5, "seed": 2}
    truth = write_targets(folder, pattern_spec=SPEC, views=8, **options)  # type: ignore[arg-type]
    corners = simulate_corners(truth.model, pattern(SPEC), truth.cam_from_board, 0.1, 0)
    write_corners(folder / "corners.csv", corners)
    calibrate_corners(folder / "corners.csv", SIZE, folder / "out", model="opencv-fisheye", loss="none")
    return truth, camera_models.load(folder / "out/calibration.yaml"), folder / "corners.csv"


Noisy = tuple[RenderedTargets, camera_models.Calibration, Path]


def test_white_noise_passes_the_checks_of_parameters_and_lines(noisy: Noisy) -> None:
    truth, calibration, path = noisy
    validation = compare(truth, 190.0, calibration, read_corners(path))
    checks = {check.name: check for check in validation.checks}
    assert len(checks) == 5 and all(check.holds == (check.value <= check.limit) for check in checks.values())
    assert validation.photos_lost == 0
    assert validation.bearing_limit_deg == pytest.approx(0.1 * 190.0 / 480.0)
    assert checks["parameters, squared Mahalanobis distance"].holds
    assert checks["worst parameter, standard deviations off"].holds
    assert checks["lines, squared Mahalanobis distance"].holds
    # 8 photos of 14 lines with two ends each, 0.1 px at some 0.3 m and 150 px focal length.
    assert 1e-5 < validation.lines.aligned.rms_m < 1e-3
    assert validation.lines.predicted_rms_m == pytest.approx(validation.lines.aligned.rms_m, rel=0.6)


def test_a_wrong_camera_and_lost_photos_are_seen(noisy: Noisy) -> None:
    truth, calibration, path = noisy
    parameters = truth.model.parameters.clone()
    parameters[:2] *= 1.01
    off = replace(truth, model=truth.model.with_parameters(parameters), images=(*truth.images, "lost1.png", "lost2.png"))
    failed = {check.name for check in compare(off, 190.0, calibration, read_corners(path)).checks if not check.holds}
    assert failed == {
        "photos without a usable target",
        "bearing error, RMS over the pixels",
        "parameters, squared Mahalanobis distance",
        "worst parameter, standard deviations off",
    }


@pytest.mark.slow
@pytest.mark.parametrize(("model", "fov"), [("opencv-fisheye", 190), ("scaramuzza", 190), ("scaramuzza", 220), ("pinhole", 90)])
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
def test_noise_beyond_the_limit_exits_with_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With little light and few photos the bearings are worse than 0.02 degrees, and the command says so."""
    status, out = run(
        capsys, "validate", "--model", "pinhole", "--fov-deg", 60, "--size", "480x360", "--views", 3, "--noise", 25,
        "--blur", 1.5, "--seed", 1, "--out", tmp_path, "--json",
    )  # fmt: skip
    data = json.loads(out)
    assert status == 1 and not data["holds"]
    assert "bearing error, RMS over the pixels" in [check["name"] for check in data["checks"] if not check["holds"]]
