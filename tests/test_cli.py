"""The command line, in process: the fixed spellings, the files they write, and one sentence for every mistake."""

import csv
import json
import re
import subprocess
import sys
from importlib.metadata import version

import cv2
import numpy as np
import pytest
import torch
import yaml

import camera_models
from calib_patterns import Detection, pattern
from calib_patterns.rendering import render_target
from camera_models.pose import Pose, rotation_from_vector
from omnilines import cli
from omnilines.cli._shared import LENS_MODELS
from omnilines.pipelines.photo_corners import corner_table, counts_remark
from omnilines.records import Corners

LENS = camera_models.OpenCVFisheye([170.0, 170.5, 325.0, 236.0, -0.01, 0.003, -0.001, 0.0001], (640, 480))
SPEC = "checkerboard:7x5:30mm"
POSES = [
    ((0.5, 0.1, 0.1), (-0.14, -0.10, 0.22)),
    ((-0.4, 0.3, 0.0), (-0.02, -0.06, 0.20)),
    ((0.1, -0.6, 0.3), (-0.12, 0.02, 0.24)),
    ((0.2, 0.5, -0.2), (-0.20, -0.06, 0.20)),
    ((-0.5, -0.2, 0.1), (0.02, 0.02, 0.22)),
]


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for index, (turn, shift) in enumerate(POSES):
        pose = Pose(rotation_from_vector(torch.tensor(turn, dtype=torch.float64)), torch.tensor(shift, dtype=torch.float64))
        image = render_target(pattern(SPEC), LENS, pose, noise_grey=1.0, blur_px=0.5, seed=index)
        assert cv2.imwrite(str(folder / f"view{index}.png"), image)
    return folder


def run(capsys, *arguments):
    """(exit status, standard output, standard error) of one command."""
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    out = capsys.readouterr()
    return ended.value.code or 0, out.out, out.err


def refused(capsys, *arguments):
    """The one sentence that a refused command prints."""
    status, out, err = run(capsys, *arguments)
    assert status == 2
    assert out == ""
    sentences = [line for line in err.splitlines() if line.startswith("omnilines: ")]
    assert len(sentences) == 1
    assert "Traceback" not in err
    return sentences[0]


def read_csv(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def write_csv(path, header, rows):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])
    return path


def corner_rows(poses=POSES):
    board = pattern(SPEC).points_m
    rows = []
    for index, (turn, shift) in enumerate(poses):
        pose = Pose(rotation_from_vector(torch.tensor(turn, dtype=torch.float64)), torch.tensor(shift, dtype=torch.float64))
        pixels, valid = LENS.project(pose.transform(torch.as_tensor(board)).numpy())
        assert valid.all()
        rows += [[index, f"view{index}.png", *b[:2], *p] for b, p in zip(board, pixels, strict=True)]
    return rows


CORNERS = "view,image,board_x_m,board_y_m,u_px,v_px"


@pytest.mark.parametrize("command", ["reconstruct", "extract", "directions"])
def test_who_has_no_calibration_reads_how_to_get_one(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "photos", "--out", "out"])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and "Missing option '--calibration': omnilines calibrate makes such a file" in said
    assert said.count("\n") == 1


def test_calibrate_from_photos(photos, tmp_path, capsys):
    status, out, _ = run(capsys, "calibrate", photos, "--pattern", SPEC, "--model", "opencv-fisheye", "--out", tmp_path, "--json")
    assert status == 0
    data = json.loads(out)
    assert data["holds"] and data["rms_px_per_axis"] < 0.1
    made = {"calibration.yaml", "corners.csv", "report.html", "work", ".omnilines.json"}
    assert made == {path.name for path in tmp_path.iterdir()}
    model = camera_models.load(tmp_path / "calibration.yaml")["cam0"]
    assert abs(float(model.parameters[0]) - 170.0) < 1.0
    stored = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    assert [view["used"] for view in stored["views"]] == [True] * 5
    assert stored["cameras"]["cam0"]["max_angle_deg"] > 30
    page = (tmp_path / "report.html").read_text()
    assert "view0.png" in page and len(page) < 15e6


def test_detect_writes_the_corners_that_calibrate_reads(photos, tmp_path, capsys):
    status, out, _ = run(capsys, "detect", photos, "--pattern", SPEC, "--out", tmp_path)
    assert status == 0 and "35 corners" in out
    assert out.endswith(f"Next: omnilines calibrate {tmp_path / 'corners.csv'} --image-size 640x480 --out result\n")
    table = read_csv(tmp_path / "corners.csv")
    assert len(table) == 5 * 35
    status, out, _ = run(
        capsys, "calibrate", tmp_path / "corners.csv", "--image-size", "640x480", "--model", "opencv-fisheye", "--out",
        tmp_path / "again", "--json",
    )  # fmt: skip
    assert status == 0 and json.loads(out)["rms_px_per_axis"] < 0.1


def test_corners_csv_to_calibration(tmp_path, capsys):
    path = write_csv(tmp_path / "corners.csv", CORNERS, corner_rows())
    status, out, _ = run(
        capsys, "calibrate", path, "--image-size", "640x480", "--model", "opencv-fisheye", "--loss", "none", "--out",
        tmp_path / "out",
    )  # fmt: skip
    assert status == 0 and "rms_px_per_axis" in out
    assert f"Next: omnilines reconstruct PHOTOS --calibration {tmp_path / 'out/calibration.yaml'} " in out
    model = camera_models.load(tmp_path / "out/calibration.yaml")["cam0"]
    np.testing.assert_allclose(model.parameters.numpy()[:4], LENS.parameters.numpy()[:4], atol=1e-3)


@pytest.mark.slow
def test_a_bad_photo_is_skipped_and_the_run_goes_on(photos, tmp_path, capsys):
    folder = tmp_path / "mixed"
    folder.mkdir()
    for path in photos.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "broken.jpg").write_bytes(b"not an image")
    cv2.imwrite(str(folder / "empty.png"), np.full((480, 640), 120, np.uint8))
    small = cv2.imread(str(photos / "view0.png"))
    cv2.imwrite(str(folder / "other_size.png"), cv2.resize(small, (800, 600)))
    status, _, err = run(capsys, "calibrate", folder, "--pattern", SPEC, "--model", "opencv-fisheye", "--out", tmp_path / "o")
    assert status == 0
    notes = {line.split(":")[1].strip(): line for line in err.splitlines() if line.startswith("note: ")}
    assert {"broken.jpg", "empty.png", "other_size.png"} <= set(notes)
    assert "cannot be decoded" in notes["broken.jpg"]
    assert "800x600 px where most photos have 640x480 px" in notes["other_size.png"]
    views = yaml.safe_load((tmp_path / "o/calibration.yaml").read_text())["views"]
    assert sum(view["used"] for view in views) == 5 and len(views) == 8
    assert all(view["reason"] for view in views if not view["used"])


@pytest.mark.slow
def test_what_photos_can_get_wrong(photos, tmp_path, capsys):
    out = ("--out", tmp_path / "o")
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "No image found" in refused(capsys, "calibrate", empty, "--pattern", SPEC, *out)
    (empty / "corners.csv").write_text("view,board_x_m,board_y_m,u_px,v_px\n")
    size = ("--image-size", "640x480")
    assert f"found a table of corners and no photo; give {empty / 'corners.csv'} itself" in refused(
        capsys, "calibrate", empty, *size, *out
    )
    assert "into one table with a column camera, or calibrate each camera alone" in refused(
        capsys, "calibrate", empty / "corners.csv", tmp_path / "b.csv", *size, *out
    )
    assert "--image-size beside corners.csv was expected" in refused(capsys, "calibrate", empty / "corners.csv", *out)
    assert "found photos, which have a size" in refused(capsys, "calibrate", photos, "--pattern", SPEC, *size, *out)
    assert "does not exist" in refused(capsys, "calibrate", tmp_path / "nowhere", "--pattern", SPEC, *out)
    assert "--pattern was expected" in refused(capsys, "calibrate", photos, *out)
    assert "checkerboard:4x4:30mm was expected" in refused(
        capsys, "calibrate", photos, "--pattern", "checkerboard:4x4:30mm", *out
    )
    assert "checkerboard" in refused(capsys, "calibrate", photos, "--pattern", "chess:7x5:30mm", *out)
    two = [photos / "view0.png", photos / "view1.png"]
    assert "at least 3, found 2" in refused(capsys, "calibrate", *two, "--pattern", SPEC, *out)
    assert (
        "pinhole, opencv-fisheye, fisheye624, scaramuzza, unified, extended-unified, double-sphere, equirectangular"
        in refused(capsys, "calibrate", photos, "--pattern", SPEC, "--model", "fish", *out)
    )
    # What was found is kept for the same photos with other options.
    assert [path.name for path in (tmp_path / "o").iterdir()] == ["work"]


def test_detect_tells_of_a_wrong_count_of_corners(photos, tmp_path, capsys):
    status, _, err = run(capsys, "detect", photos, "--pattern", "checkerboard:9x8:30mm", "--out", tmp_path / "d")
    assert status == 0 and "All 5 photos show 7x5 inner corners of a board of 9x8" in err.replace("5x7", "7x5")
    status, _, err = run(capsys, "detect", photos, "--pattern", SPEC, "--out", tmp_path / "d")
    assert status == 0 and "inner corners of a board" not in err


def test_a_corner_beside_the_board_hides_no_wrong_count():
    """Of nine photos eight show 4x3 corners, one a corner more; where as many show more, the board is larger."""
    board = pattern("checkerboard:8x6:30mm")
    part = [8 * row + column for row in (1, 2, 3) for column in (2, 3, 4, 5)]

    def table(more: int) -> Corners:
        ids = [np.array([4] * (k < more) + part) for k in range(9)]
        seen = [(f"{k}.png", Detection(own, np.zeros((len(own), 2)), np.ones(len(own)))) for k, own in enumerate(ids)]
        return corner_table(seen, board)

    assert "8 of 9 photos show 4x3 inner corners of a board of 8x6" in str(counts_remark(board, table(1)))
    assert counts_remark(board, table(4)) is None


@pytest.mark.slow
def test_what_a_table_of_corners_can_get_wrong(tmp_path, capsys):
    rows = corner_rows()
    good = ("--image-size", "640x480", "--model", "opencv-fisheye", "--out", tmp_path / "o")

    def message(header, content, options=good):
        return refused(capsys, "calibrate", write_csv(tmp_path / "corners.csv", header, content), *options)

    assert "v_px" in message(CORNERS.replace(",v_px", ""), [row[:-1] for row in rows])
    broken = [list(row) for row in rows]
    broken[7][4] = "12,5"
    text = message(CORNERS, broken)
    assert "corners.csv" in text and "line 9" in text and "u_px" in text
    broken[7][4] = "nan"
    assert "u_px" in message(CORNERS, broken)
    broken[7][4] = 5000.0
    assert "check --image-size" in message(CORNERS, broken)
    assert "--image-size" in message(CORNERS, rows, good[2:])
    assert "WIDTHxHEIGHT" in message(CORNERS, rows, ("--image-size", "640", *good[2:]))
    assert "at least 3, found 2" in message(CORNERS, corner_rows(POSES[:2]))
    flat = [((0.0, 0.0, 0.0), (-0.1 + 0.02 * k, -0.06, 0.2 + 0.02 * k)) for k in range(5)]
    assert "all boards parallel" in message(CORNERS, corner_rows(flat))
    assert "none, huber, cauchy" in message(CORNERS, rows, (*good, "--loss", "tukey"))
    assert not (tmp_path / "o").exists()


def scene_files(folder, noise_px=0.0):
    """Ten lines seen by six fisheye cameras, as a user's own tables; the true ends of each line."""
    rng = np.random.default_rng(0)
    camera_models.save(folder / "calibration.yaml", {"cam0": LENS})
    ends = rng.uniform([-1, -1, 1.5], [1, 1, 3], (10, 2, 3))
    poses, segments = [], []
    for k in range(6):
        pose = Pose(rotation_from_vector(torch.as_tensor(rng.uniform(-0.3, 0.3, 3))), torch.as_tensor(rng.uniform(-0.8, 0.8, 3)))
        poses.append([f"{k}.png", "", *pose.quaternion.tolist(), *pose.translation.tolist()])
        pixels, valid = LENS.project(pose.transform(torch.as_tensor(ends.reshape(-1, 3))).numpy())
        assert valid.all()
        pixels = (pixels + noise_px * rng.standard_normal(pixels.shape)).reshape(-1, 4)
        segments += [[f"{k}.png", f"line{j}", *p] for j, p in enumerate(pixels)]
    segments.append(["0.png", "", 10, 10, 60, 60])
    segments.append(["0.png", "lonely", 10, 10, 60, 60])
    write_csv(folder / "poses.csv", "image,camera,qw,qx,qy,qz,tx,ty,tz", poses)
    write_csv(folder / "segments.csv", "image,track,u1_px,v1_px,u2_px,v2_px", segments)
    return ends


def scene_options(folder):
    names = ("calibration.yaml", "poses.csv", "segments.csv")
    return [part for name in names for part in (f"--{name.split('.')[0]}", folder / name)]


def test_unmatched_segments_ask_for_their_photos(tmp_path, capsys):
    scene_files(tmp_path)
    table = tmp_path / "segments.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()]
    table.write_text("\n".join(",".join([row[0], "" if k else row[1], *row[2:]]) for k, row in enumerate(rows[:-1])) + "\n")
    status, _, err = run(capsys, "reconstruct", *scene_options(tmp_path), "--out", tmp_path / "out")
    assert status == 2 and f"found none in {len(rows) - 2}; unmatched segments are matched beside their photos: give these" in err


@pytest.mark.parametrize("verb", ["reconstruct", "adjust"])
@pytest.mark.parametrize("method", ["dual", "averaging", "svd"])
def test_reconstruct_from_tables(tmp_path, capsys, verb, method):
    ends = scene_files(tmp_path)
    out = tmp_path / "out"
    status, text, err = run(capsys, verb, *scene_options(tmp_path), "--triangulation", method, "--out", out, "--json")
    assert status == 0
    assert json.loads(text)["status"] == {"ok": 10, "too_few_views": 1}
    assert "1 segments belong to no track" in err
    rows = {row["track"]: row for row in read_csv(out / "lines.csv")}
    assert rows["lonely"]["status"] == "too_few_views" and rows["lonely"]["x1_m"] == ""
    for j, (a, b) in enumerate(ends):
        row = rows[f"line{j}"]
        found = np.array([[float(row[c + e]) for c in "xyz"] for e in ("1_m", "2_m")])
        found = found if np.linalg.norm(found[0] - a) < np.linalg.norm(found[0] - b) else found[::-1]
        np.testing.assert_allclose(found, [a, b], atol=1e-6)
        assert float(row["rms_px"]) < 1e-6 and int(row["views"]) == 6
    names = {path.name for path in out.iterdir()}
    assert names >= {"calibration.yaml", "poses.csv", "segments.csv", "lines.csv", "lines.ply", "covariance.npz", "report.html"}
    again = {row["image"]: row for row in read_csv(out / "poses.csv")}
    assert len(again) == 6


def test_what_a_scene_can_get_wrong(tmp_path, capsys):
    scene_files(tmp_path)
    options = [*scene_options(tmp_path), "--out", tmp_path / "o"]
    assert "dual, averaging, svd" in refused(capsys, "adjust", *options, "--triangulation", "magic")
    assert "sector, whitened" in refused(capsys, "adjust", *options, "--cost", "magic")
    assert "--refine" in refused(capsys, "adjust", *options, "--refine", "everything")
    assert "--subset was expected with --triangulation averaging" in refused(capsys, "adjust", *options, "--subset", "4")
    assert "--weights was expected with" in refused(capsys, "adjust", *options, "--triangulation", "svd", "--weights", "unit")
    assert "unit, published, most-likely" in refused(capsys, "adjust", *options, "--triangulation", "dual", "--weights", "heavy")
    text = (tmp_path / "calibration.yaml").read_text()
    (tmp_path / "calibration.yaml").write_text(text.replace("fx:", "fz:"))
    assert "calibration.yaml" in refused(capsys, "adjust", *options)
    (tmp_path / "calibration.yaml").write_text("cameras: [\n  broken")
    assert "calibration.yaml" in refused(capsys, "adjust", *options)
    (tmp_path / "calibration.yaml").write_text(text)
    poses = (tmp_path / "poses.csv").read_text()
    (tmp_path / "poses.csv").write_text(poses.replace(".png", ".jpg"))
    assert "No segment can be used" in refused(capsys, "adjust", *options)
    (tmp_path / "poses.csv").unlink()
    assert "poses.csv" in refused(capsys, "adjust", *options)


def test_a_tilde_is_the_home_where_shells_leave_it(photos, tmp_path, capsys, monkeypatch):
    home, here = tmp_path / "home", tmp_path / "here"
    here.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(here)
    assert run(capsys, "detect", photos / "view0.png", "--pattern", SPEC, "--out=~/corners")[0] == 0
    assert (home / "corners/corners.csv").is_file() and not list(here.iterdir())
    assert f"found {home}/corners, which" in refused(capsys, "view", "~/corners")


def test_help_names_every_command_and_loads_nothing_heavy():
    code = (
        "import sys\n"
        "from omnilines import cli\n"
        "try:\n    cli.main(['--help'])\nexcept SystemExit as e:\n    assert not e.code\n"
        "heavy = {'torch', 'cv2', 'numpy', 'scipy', 'kornia', 'plotly'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in ("detect", "calibrate", "reconstruct", "adjust", "render", "validate", "experiment"):
        assert name in done.stdout


def test_the_models_that_the_help_names_are_those_with_parameters():
    calibrated = [name for name, _ in camera_models.MODELS if camera_models.model_class(name).CALIBRATED]
    assert re.split(", | or ", LENS_MODELS) == calibrated


def test_version(capsys):
    status, out, _ = run(capsys, "--version")
    assert status == 0 and out.strip() == f"omnilines {version('omnilines')}"
