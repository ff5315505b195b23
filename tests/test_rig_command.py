"""The command line on rigs: folders of photos by camera, tables with a camera column, what is written and what is refused."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import pytest
import scipy.stats
import torch
from rig_views import BOARD, RigScene, boards_at, looking_along, mixed_rig, outward_rig
from table_checks import read_npz

import omnilines as ol
from calib_patterns import pattern
from calib_patterns.rendering import graded_background, render_target
from camera_models import InputError, OpenCVFisheye, load, save
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.cli.values import parse_each
from omnilines.files import is_rig_table, read_corners, read_rig_corners, write_corners
from omnilines.pages.rig_figures import rig_summaries
from omnilines.pipelines.detect_rig import is_rig
from omnilines.pipelines.rig_corners import RigCorners
from omnilines.posing.instant_names import frame_of

SIZES = "cam0=1280x960,cam1=1020x1000,cam2=640x480"
MODELS = "cam0=pinhole,cam1=opencv-fisheye,cam2=scaramuzza"


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> tuple[RigScene, Path]:
    """A mixed rig's table and its calibration by the command line."""
    folder = tmp_path_factory.mktemp("mixed")
    rig = mixed_rig(24)
    write_corners(folder / "corners.csv", rig.noisy(0.2, 1))
    arguments = ["calibrate", folder / "corners.csv", "--image-size", SIZES, "--model", MODELS, "--degree", 4]
    assert run(*arguments, "--out", folder / "out") == 0
    return rig, folder


@pytest.mark.slow
def test_table_to_calibration_with_rig_and_covariance(mixed):
    rig, folder = mixed
    found = load(folder / "out/calibration.yaml")
    assert list(found) == list(rig.names) == list(found.rig)
    assert [model.NAME for model in found.values()] == ["pinhole", "opencv-fisheye", "scaramuzza"]
    assert found.estimates["cam2"].sign_source == "rig"
    joint = read_npz(folder / "out/covariance.npz")
    names = joint["name"].tolist()
    assert len(names) == sum(len(model.parameters) for model in found.values()) + 12 and len(set(names)) == len(names)
    off = [found[name].parameters - truth.parameters for name, truth in zip(rig.names, rig.models, strict=True)]
    off += [(found.rig[name].cam_from_rig @ rig.cam_from_rig[c].inverse()).log() for c, name in enumerate(rig.names) if c]
    error, covariance = torch.cat(off).numpy(), joint["covariance"]
    free = np.diag(covariance) > 0
    inverse = np.linalg.pinv(covariance[np.ix_(free, free)], hermitian=True, rcond=1e-14)
    # d and e of the polynomial move together.
    assert error[free] @ inverse @ error[free] < scipy.stats.chi2.ppf(0.999, free.sum() - 1)
    assert (np.abs(error[free]) < 4.5 * np.sqrt(np.diag(covariance)[free])).all()
    for c, name in enumerate(rig.names[1:]):
        own = [names.index(f"{name}.{twist}") for twist in ("rotation_x_rad", "y_m")]
        block = found.rig[name].covariance
        assert block is not None and found.rig[name].sigma is not None
        np.testing.assert_allclose(block[[0, 4], [0, 4]], covariance[own, own], rtol=1e-9)
        np.testing.assert_allclose(found.rig[name].sigma, np.sqrt(np.diag(block)), rtol=1e-12)
        assert c < 2 and not found.rig["cam0"].covariance.any()
    page = (folder / "out/report.html").read_text()
    assert all(f"{name}: what to shoot next" in page for name in rig.names) and page.count("would fall from") >= 3
    view = found.views[30]
    assert view.used and view.frame == rig.corners.frames[30] and view.camera == rig.corners.cameras[30]
    assert view.cam_from_board is not None
    truth = rig.cam_from_rig[int(view.camera[3:])] @ rig.rig_from_board[int(view.frame)]
    assert float((view.cam_from_board @ truth.inverse()).log().norm()) < 0.01


def test_report_draws_the_rig(mixed):
    rig, folder = mixed
    page = (folder / "out/report.html").read_text()
    for text in ("The rig", "weakest link", "common corners", "cam2: field of view", "Pairs that see the target at once"):
        assert text in page
    for name in rig.names:
        assert f"{name}: residuals" in page and f"{name}: projection uncertainty" in page
    assert len(page) < 15_000_000


@pytest.mark.slow
def test_json_of_a_rig(mixed, capsys):
    _, folder = mixed
    arguments = ["calibrate", folder / "out/corners.csv", "--image-size", SIZES]
    assert run(*arguments, "--model", "scaramuzza", "--calibration", folder / "out/calibration.yaml", "--out", folder / "x") == 2
    assert "begins from --calibration, with the model" in capsys.readouterr().err
    assert run(*arguments, "--calibration", folder / "out/calibration.yaml", "--hold", "--out", folder / "held", "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["left_out"] == {} and data["holds"] and data["frames"] == 24
    assert [camera["held"] for camera in data["cameras"].values()] == [True] * 3
    assert sum(link["weakest"] for link in data["links"]) == 1 and len(data["links"]) == 3
    assert set(data["views"][0]) == {"image", "camera", "frame", "used", "reason", "rms_px_per_point", "remarks"}
    pixel = data["cameras"]["cam1"]["parameters"]
    assert pixel == load(folder / "out/calibration.yaml")["cam1"].named_parameters()


@pytest.mark.full
def test_left_out_camera_has_a_file_of_its_own(tmp_path, capsys):
    rig = outward_rig(24)
    corners = rig.noisy(0.1, 1)
    frames = tuple(f"late {f}" if c == "cam2" else f for c, f in zip(corners.cameras, corners.frames, strict=True))
    write_corners(tmp_path / "corners.csv", type(corners)(**{**vars(corners), "frames": frames}))
    out = tmp_path / "out"
    assert run("calibrate", tmp_path / "corners.csv", "--image-size", "1020x1000", "--model", "opencv-fisheye", "--out", out) == 0
    assert "Camera cam2 is not of the rig" in capsys.readouterr().err
    assert list(load(out / "calibration.yaml").rig) == ["cam0", "cam1", "cam3"]
    alone = load(out / "calibration-cam2.yaml")
    assert not alone.rig and abs(float(next(iter(alone.values())).parameters[0] - rig.models[2].parameters[0])) < 1


@pytest.mark.slow
def test_a_camera_that_never_sees_the_board_is_left_out_by_name(tmp_path):
    """Noise in the photos of one camera; the corners of the others are as if found beside them."""
    board, lens = pattern("checkerboard:7x5:30mm"), OpenCVFisheye([200.0, 200.0, 199.5, 149.5, 0.0, 0.0, 0.0, 0.0], (400, 300))
    middle = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 0.35]) - torch.as_tensor(board.points_m.mean(0)))
    for name in ("blind", "left"):
        (tmp_path / name).mkdir()
        noise = np.random.default_rng(0).integers(0, 255, (300, 400), dtype=np.uint8)
        photo = noise if name == "blind" else render_target(board, lens, middle, supersample=2)
        cv2.imwrite(str(tmp_path / name / "0.png"), photo)
    seen = ol.detect_rig(tmp_path, board.specification)
    assert list(seen.image_sizes) == ["left"] and list(seen.blind) == ["blind"]
    rig = outward_rig(24)
    sizes = {f"cam{c}": model.image_size for c, model in enumerate(rig.models)}
    found = replace(RigCorners.of_table(rig.noisy(0.1, 1), sizes), blind=seen.blind)
    result = ol.calibrate_rig(found, model="opencv-fisheye")
    assert result.fit.left_out == dict(seen.blind)
    summary = rig_summaries(result)[0]
    assert ("left out", "blind") in summary.rows
    assert any(advice.limit.startswith("Camera blind is not of the rig: ") for advice in summary.advice)


def rendered(
    folder: Path, models: dict[str, OpenCVFisheye], cam_from_middle: Pose, boards: Pose, specification: str, half_angle_deg: float
) -> RigScene:
    """Photos of a target by all cameras that see half of it or more; each is named after its camera's folder. `boards` are poses
    of the middle of the target."""
    board = pattern(specification)
    middle = torch.as_tensor(board.points_m.mean(0) - BOARD.mean(0))
    poses = Pose(boards.rotation, boards.translation - boards.rotation @ middle)
    for c, (name, model) in enumerate(models.items()):
        (folder / name).mkdir(parents=True)
        background = graded_background(model, np.random.default_rng(c))
        for f in range(len(poses)):
            pose = cam_from_middle[c] @ poses[f]
            place = pose.transform(torch.as_tensor(board.points_m))
            angle = torch.atan2(place[:, :2].norm(dim=-1), place[:, 2])
            if float(angle.median()) > math.radians(half_angle_deg):
                continue
            look = {"supersample": 3, "blur_px": 0.5, "noise_grey": 2.0, "background": background, "seed": 99 * c + f}
            cv2.imwrite(str(folder / name / f"{name}_{f:02d}.png"), render_target(board, model, pose, **look))
    rig = cam_from_middle[0]
    return RigScene(tuple(models.values()), cam_from_middle @ rig.inverse(), rig @ poses, mixed_rig(1).corners)


def off_truth(out: Path, rig: RigScene) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all parameters and poses, and their joint covariance."""
    found = load(out / "calibration.yaml")
    off = [found[name].parameters - truth.parameters for name, truth in zip(found, rig.models, strict=True)]
    off += [(found.rig[name].cam_from_rig @ rig.cam_from_rig[c].inverse()).log() for c, name in enumerate(found) if c]
    return torch.cat(off).numpy(), read_npz(out / "covariance.npz")["covariance"]


def check_truth(out: Path, rig: RigScene, label: str) -> None:
    error, covariance = off_truth(out, rig)
    distance, limit = float(error @ np.linalg.solve(covariance, error)), scipy.stats.chi2.ppf(0.999, len(error))
    print(f"{label}: chi-square {distance:.1f} of {len(error)}")
    assert distance < limit and (np.abs(error) < 4.5 * np.sqrt(np.diag(covariance))).all()


def fisheyes(names: tuple[str, ...], focal_px: float, side_px: int) -> dict[str, OpenCVFisheye]:
    centre = 0.5 * (side_px - 1)
    lens = OpenCVFisheye([focal_px, focal_px + 0.5, centre, centre + 2, 0.01, -0.004, 0.001, -0.0001], (side_px, side_px))
    steps = torch.tensor([1.0, -1.0, 3.0, -2.0, 0.002, 0, 0, 0], dtype=torch.float64)
    return {name: lens.with_parameters(lens.parameters + c * steps) for c, name in enumerate(names)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "specification", [pytest.param("aprilgrid:4x4:40mm:0.3:36h11", marks=pytest.mark.full), "checkerboard:7x5:30mm"]
)
def test_folders_of_photos(tmp_path, capsys, specification):
    """Two fisheyes of 220 degrees that look 100 degrees apart, the board mostly at the rims of both: everything within the stated
    uncertainty; a photo without a partner is named and used."""
    rng = np.random.default_rng(3)
    axes = np.array([[math.sin(a), 0.05, math.cos(a)] for a in (-math.radians(50), math.radians(50))])
    directions = np.array([0.0, 0.0, 1.0]) + 0.6 * rng.standard_normal((16, 3))
    directions[::3] = axes[rng.integers(0, 2, 6)] + 0.4 * rng.standard_normal((6, 3))
    boards = boards_at(directions, rng.uniform(0.22, 0.4, 16), rng, 35)
    models = fisheyes(("left", "right"), 118.0, 480)
    rig = rendered(tmp_path / "photos", models, looking_along(axes, 0.06 * axes), boards, specification, 105.0)
    stray = next((tmp_path / "photos/left").iterdir())
    stray.rename(stray.with_name("left_stray.png"))
    out = tmp_path / "out"
    arguments = ["calibrate", tmp_path / "photos", "--pattern", specification, "--model", "opencv-fisheye", "--out", out]
    assert run(*arguments) == 0
    messages = capsys.readouterr().err
    assert re.search(r"note: \d+ of \d+ photos of camera left have no photo of the same name", messages)
    found = load(out / "calibration.yaml")
    assert list(found.rig) == ["left", "right"] and sum(view.used for view in found.views) > 20
    assert any(view.image == "left/left_stray.png" and view.used and view.frame == "stray" for view in found.views)
    assert (out / "report.html").is_file()
    check_truth(out, rig, specification)


@pytest.mark.full
def test_photos_of_cameras_that_look_outwards(tmp_path):
    """Four cameras of 220 degrees on a tetrahedron, 24 frames."""
    axes = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((24, 3))
    for f in range(0, 24, 2):
        a, b = rng.choice(4, 2, replace=False)
        directions[f] = axes[a] + axes[b] + 0.3 * rng.standard_normal(3)
    boards, specification = boards_at(directions, rng.uniform(0.3, 0.5, 24), rng), "aprilgrid:5x5:70mm:0.3:36h11"
    models = fisheyes(("cam0", "cam1", "cam2", "cam3"), 150.0, 640)
    rig = rendered(tmp_path / "photos", models, looking_along(axes, 0.08 * axes), boards, specification, 105.0)
    out = tmp_path / "out"
    arguments = [
        "calibrate",
        *sorted((tmp_path / "photos").iterdir()),
        "--pattern",
        specification,
        "--model",
        "opencv-fisheye",
        "--out",
        out,
    ]
    assert run(*arguments) == 0
    assert len(load(out / "calibration.yaml").rig) == 4
    check_truth(out, rig, "outward rig")


def test_what_is_a_rig(tmp_path):
    photo = np.zeros((8, 8), np.uint8)
    for name in ("a/1.png", "a/2.png", "b/1.png", "c/inner/3.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / name), photo)
    assert is_rig([tmp_path]) and is_rig([tmp_path / "a", tmp_path / "b"])
    assert not is_rig([tmp_path / "a"]) and not is_rig([tmp_path / "a", tmp_path / "c"]) and not is_rig([tmp_path / "c"])
    assert not is_rig([tmp_path / "a/1.png", tmp_path / "b/1.png"])
    cv2.imwrite(str(tmp_path / "beside.png"), photo)
    assert not is_rig([tmp_path])
    (tmp_path / "beside.png").unlink()
    (tmp_path / "b/1.png").rename(tmp_path / "b/7.png")
    assert not is_rig([tmp_path])


@pytest.mark.parametrize(
    ("name", "frame"),
    [
        ("cam0/000123.png", "000123"),
        ("cam0/cam0_000123.png", "000123"),
        ("left/left01.jpg", "01"),
        ("right/01-Right.jpg", "01"),
        ("cam1/data/17.png", "data/17"),
        ("1/101.png", "101"),
        ("left/left.png", "left"),
    ],
)
def test_the_instant_of_a_photo(name, frame):
    assert frame_of(PurePosixPath(name)) == frame


def test_rig_tables(tmp_path):
    """Rows of one view, camera and board are a view; the instant is the frame, else a shared view, else the photo's name."""
    path = tmp_path / "corners.csv"
    header = "view,image,board_x_m,board_y_m,u_px,v_px,camera"
    rows = [
        f"{view},{camera}/{view}.png,{x},0,{10 + 5 * x},20,{camera}" for view in "pq" for camera in ("a", "b") for x in range(3)
    ]
    path.write_text("\n".join([header, *rows]) + "\n")
    assert is_rig_table(path)
    corners = read_rig_corners(path)
    assert corners.view_names == ("p", "p", "q", "q") and corners.cameras == ("a", "b", "a", "b") and corners.frames is None
    assert np.bincount(corners.view).tolist() == [3, 3, 3, 3]
    with pytest.raises(InputError, match="expected the corners of one camera"):
        read_corners(path)
    path.write_text("\n".join([header + ",frame,board", *(f"{row},f{row[0]},{row[-1]}1" for row in rows)]) + "\n")
    framed = read_rig_corners(path)
    assert framed.frames == ("fp", "fp", "fq", "fq") and framed.boards == ("a1", "b1", "a1", "b1")
    write_corners(tmp_path / "again.csv", framed)
    again = read_rig_corners(tmp_path / "again.csv")
    assert (again.view_names, again.cameras, again.frames, again.boards) == (
        framed.view_names,
        framed.cameras,
        framed.frames,
        framed.boards,
    )
    np.testing.assert_array_equal(again.pixels, framed.pixels)
    path.write_text("\n".join([header + ",frame", *(f"{row},{k}" for k, row in enumerate(rows))]) + "\n")
    with pytest.raises(InputError, match="line 3, column frame: expected '0' as in line 2 of the same view 'p'"):
        read_rig_corners(path)


def test_places_of_boards_are_not_in_photos(tmp_path, capsys):
    for name in ("a/1.png", "b/1.png"):
        (tmp_path / name).parent.mkdir()
        cv2.imwrite(str(tmp_path / name), np.zeros((96, 96), np.uint8))
    arguments = ["calibrate", tmp_path, "--pattern", "checkerboard:7x5:30mm", "--out", tmp_path / "out"]
    assert run(*arguments, "--boards", "known") == 2
    assert "--boards known was expected with a corners.csv" in capsys.readouterr().err
    assert run(*arguments) == 2
    assert "A pattern was expected in the photos of some camera" in capsys.readouterr().err


def test_values_by_camera():
    assert parse_each("pinhole", "--model") == {"": "pinhole"}
    assert parse_each("scaramuzza,cam1 = pinhole", "--model") == {"": "scaramuzza", "cam1": "pinhole"}
    for wrong in ("a=1,a=2", "x,y", "cam0=", "=pinhole"):
        with pytest.raises(InputError, match="--model was expected as a value, or as CAMERA=VALUE"):
            parse_each(wrong, "--model")


@pytest.mark.slow
def test_users_are_told_what_is_wrong(mixed, tmp_path, capsys):
    rig, folder = mixed
    table = folder / "corners.csv"
    cases = [
        (["--image-size", "cam0=1280x960"], "--image-size was expected for every camera"),
        (["--image-size", "640x480"], "every corner was expected inside the image of 640x480 px of cam0"),
        (
            ["--image-size", SIZES, "--model", "cam7=pinhole"],
            "--model: cameras among cam0, cam1, cam2 were expected, found 'cam7'",
        ),
        (["--image-size", SIZES, "--model", "cam0=pinhol"], "pinhol"),
        (["--image-size", SIZES, "--boards", "glued"], "--boards is one of fixed, known, moving, found 'glued'"),
        (["--image-size", SIZES, "--hold"], "found no --calibration"),
        (["--image-size", SIZES, "--refine-board", "tilt"], "aspect and flatness, found 'tilt'"),
    ]
    for arguments, message in cases:
        assert run("calibrate", table, *arguments, "--out", tmp_path / "out") == 2
        assert message in capsys.readouterr().err, message
    other = tmp_path / "other.yaml"
    save(other, {"front": rig.models[0]})
    assert run("calibrate", table, "--image-size", SIZES, "--calibration", other, "--out", tmp_path / "out") == 2
    assert "cameras among cam0, cam1, cam2 were expected, found 'front'" in capsys.readouterr().err
    save(other, {"cam1": rig.models[0]})
    assert run("calibrate", table, "--image-size", SIZES, "--calibration", other, "--out", tmp_path / "out") == 2
    assert "camera cam1 was expected with images of 1020x1000 px, found 1280x960 px" in capsys.readouterr().err
    lone = tmp_path / "lone.csv"
    text = table.read_text().splitlines()
    lone.write_text("\n".join([text[0], *(line for line in text[1:] if ",cam0," in line)]) + "\n")
    assert run("calibrate", lone, "--image-size", "1280x960", "--boards", "moving", "--out", tmp_path / "out") == 2
    assert "with a rig: a folder with" in capsys.readouterr().err
