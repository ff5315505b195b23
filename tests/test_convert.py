"""omnilines convert, from the command line: formats by contents and name, errors written beside, nothing lost without a word."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import camera_models
from camera_models import Calibration, CameraEstimate, CameraModel, InputError
from camera_models.formats import FORMATS, format_named, read
from camera_models.formats.calibration_data import RigCamera, ViewRecord
from camera_models.formats.transfer import seen_deg, transfer
from camera_models.pose import Pose
from omnilines import cli
from omnilines.commands.convert import convert as command
from omnilines.pipelines.convert import COLUMNS

LENS = camera_models.OpenCVFisheye.examples()[0]
OCAM = camera_models.Scaramuzza([641.0, 478.0, 0.999, 3e-4, 3e-4, 338.4, -1.2e-3, 1.27e-6, -2.85e-9], (1280, 960))
SLANTED = camera_models.Scaramuzza([640.2, 480.7, 1.0004, -0.03, 0.031, 361.0, -1.55e-3, 5.0e-7, -1.9e-9], (1280, 960))
BROWN = camera_models.Pinhole.examples()[0]


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    """(exit status, standard output, standard error) of one command."""
    with pytest.raises(SystemExit) as ended:
        cli.main(["convert", *map(str, arguments)])
    out = capsys.readouterr()
    return ended.value.code or 0, out.out, out.err


def refused(capsys, *arguments: object) -> str:
    """The one sentence that a refused command prints."""
    status, out, err = run(capsys, *arguments)
    assert status == 2 and out == ""
    (sentence,) = [line for line in err.splitlines() if line.startswith("omnilines: ")]
    return sentence


def save(path: Path, model: CameraModel, **estimate: object) -> Path:
    camera_models.save(path, Calibration({"cam0": model}, {"cam0": CameraEstimate(**estimate)} if estimate else {}))
    return path


def rig(*models: CameraModel) -> Calibration:
    names = [f"cam{index}" for index in range(len(models))]
    poses = [Pose.exp(torch.full((6,), 0.1 * index, dtype=torch.float64)) for index in range(len(models))]
    cameras = {name: RigCamera(pose) for name, pose in zip(names, poses, strict=True)}
    return Calibration(dict(zip(names, models, strict=True)), rig=cameras)


def test_there_and_back_through_every_format(tmp_path: Path, capsys) -> None:
    """Formats by name when writing, by contents when reading: through each that holds the camera, to the bit of a calibration."""
    source = save(tmp_path / "calibration.yaml", LENS)
    steps = 0
    for entry in FORMATS:
        if format_named(entry.name).why_not(LENS) is not None:
            continue
        steps += 1
        out = tmp_path / entry.name / entry.files[0].replace("*", "x")
        status, text, _ = run(capsys, source, out)
        assert status == 0 and ", exactly" in text and str(out) in text
        back = tmp_path / entry.name / "back.yaml"
        # The file under another name: its contents tell.
        hidden = out if entry.name == "colmap" else out.rename(out.with_name(f"other{out.suffix}"))
        status, text, _ = run(capsys, hidden, back)
        assert status == 0 and ", exactly" in text
        (camera,) = camera_models.load(back).values()
        np.testing.assert_allclose(camera.parameters, LENS.parameters, rtol=1e-14, atol=0)
        made_of = camera_models.load(back).provenance
        assert made_of["inputs"] == {"file": str(hidden), "format": entry.name}
        assert not list(out.parent.glob("*_conversion.csv"))
    assert steps >= 6


def test_a_fit_says_its_error_and_writes_it_beside(tmp_path: Path, capsys) -> None:
    source = save(tmp_path / "calibration.yaml", OCAM, max_angle_deg=80.0, rms_px_per_point=0.4, sigma={"cx": 0.1})
    status, text, err = run(capsys, source, tmp_path / "cameras.txt", "--json")
    assert status == 0
    data = json.loads(text)
    camera = data["cameras"]["cam0"]
    assert camera["from_model"] == "scaramuzza" and not camera["exact"] and 0 < camera["rms_px"] < 1
    assert (data["from_format"], data["to_format"], data["rig"]) == ("omnilines", "colmap", False)
    assert set(data["dropped"]) == {"sigma of cam0", "max_angle_deg of cam0", "rms_px_per_point of cam0"}
    assert "note: " in err and "Not kept: sigma of cam0" in err
    # As far as the data of the calibration reach.
    assert 155 < camera["fov_deg"] <= 160
    rows = list(csv.DictReader((tmp_path / "cameras.txt_conversion.csv").read_text().splitlines()))
    assert list(rows[0]) == list(COLUMNS) and len(rows) == 16
    assert data["files"] == [str(tmp_path / "cameras.txt"), str(tmp_path / "cameras.txt_conversion.csv")]
    # The rings together are the whole, and every figure is that of the file that was written.
    weight = np.array([int(row["pixels"]) for row in rows])
    squared = np.array([float(row["rms_px"]) ** 2 for row in rows])
    assert np.sqrt((weight * squared).sum() / weight.sum()) == pytest.approx(camera["rms_px"], rel=1e-9)
    assert max(float(row["max_px"]) for row in rows) == camera["max_px"]
    (written,) = read(tmp_path / "cameras.txt").calibration.values()
    theta, phi = np.radians(np.full(60, 62.5)), np.linspace(0, 2 * np.pi, 60)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    off = np.linalg.norm(OCAM.project(rays)[0] - written.project(rays)[0], axis=-1)
    ring = next(row for row in rows if float(row["from_deg"]) == 60)
    assert np.sqrt((off**2).mean()) == pytest.approx(float(ring["rms_px"]), rel=0.3)


@pytest.mark.slow
def test_names_of_formats_and_files_that_differ_in_their_ending(tmp_path: Path, capsys) -> None:
    source = save(tmp_path / "calibration.yaml", OCAM)
    for name in ("ros.yaml", "opensfm.json", "openmvg.json", "opencv.json", "opencv.yaml"):
        status, text, _ = run(capsys, source, tmp_path / name, "--fov", 120, "--json")
        assert status == 0 and json.loads(text)["to_format"] == name.partition(".")[0]
        assert (tmp_path / f"{name}_conversion.csv").exists()
    sentence = refused(capsys, source, tmp_path / "ros.json")
    assert "ROS camera_info files end in .yaml or .yml, found 'ros.json'; give such a name, or the format with --to" in sentence


@pytest.mark.slow
def test_a_fit_worse_than_the_calibration_says_what_is_lost(tmp_path: Path, capsys) -> None:
    """A real camera, calibrated to 0.62 px: without its tangential coefficients it is 10 px off, and no converted file holds."""
    numbers = [398.76, 400.34, 629.9, 431.38, 0.0, 1.0049, -0.032815, 0.011644, 0.021093, -0.0034617]
    camera = camera_models.Unified(numbers, (1280, 960))
    source = save(tmp_path / "calibration.yaml", camera, max_angle_deg=102.0, rms_px_per_point=0.625)
    status, text, err = run(capsys, source, tmp_path / "camera_info.yaml")
    assert status == 1 and (tmp_path / "camera_info.yaml").exists()
    assert "RMS error of cam0, beside 0.2 % of the image" in text and "DOES NOT HOLD" in text
    assert "cam0 is 10.4 px RMS off in this file, 17 times the 0.62 px RMS of its calibration" in err
    assert "opencv-fisheye has no place for p1 = 0.0211, p2 = -0.00346" in err
    assert (
        "calibrate with --model opencv-fisheye, or write it exactly with one of --to kalibr, camodocal, opencv, omnilines" in err
    )
    status, _, err = run(capsys, source, tmp_path / "double.yaml", "--model", "double-sphere")
    assert status == 1 and "leave --model out, and it is held exactly" in err
    # What is not known to be worse than the calibration gets no such note.
    assert "RMS off in this file" not in run(capsys, save(tmp_path / "b.yaml", OCAM), tmp_path / "cameras.txt", "--fov", 90)[2]


@pytest.mark.slow
def test_the_field_of_view_decides_the_error(tmp_path: Path, capsys) -> None:
    """A narrower field of view is fitted more closely; what no model of the format holds is refused with the reason."""
    source = save(tmp_path / "calibration.yaml", OCAM)
    errors = []
    for fov in (90, 110, 130):
        status, text, _ = run(capsys, source, tmp_path / "camera_info.yaml", "--model", "pinhole", "--fov", fov, "--json")
        assert status == 0
        errors.append(json.loads(text)["cameras"]["cam0"]["max_px"])
    assert errors[0] < errors[1] < errors[2]
    before = (tmp_path / "camera_info.yaml").read_bytes()
    sentence = refused(capsys, source, tmp_path / "camera_info.yaml", "--model", "pinhole", "--fov", 200)
    assert (
        "ROS camera_info was expected to hold camera cam0 (scaramuzza)" in sentence and "pinhole: it ends below 180" in sentence
    )
    assert (tmp_path / "camera_info.yaml").read_bytes() == before
    assert "above 0 and up to 360 degrees was expected, found -5" in refused(capsys, source, tmp_path / "a.yml", "--fov", -5)


def test_a_model_between_files_of_the_same_format(tmp_path: Path, capsys) -> None:
    source = save(tmp_path / "calibration.yaml", LENS, max_angle_deg=90.0)
    status, text, err = run(capsys, source, tmp_path / "double.yaml", "--model", "double-sphere")
    assert status == 0 and "opencv-fisheye fitted by double-sphere: " in text
    result = camera_models.load(tmp_path / "double.yaml")
    assert isinstance(result["cam0"], camera_models.DoubleSphere)
    assert result.estimates["cam0"].max_angle_deg == 90
    figures = result.provenance["conversion"]["cam0"]
    assert 0 < figures["rms_px"] < 2 and figures["fov_deg"] <= 180
    assert "Not kept" not in err
    status, text, err = run(capsys, source, tmp_path / "same.yaml", "--model", "opencv-fisheye")
    assert status == 0 and "opencv-fisheye, exactly" in text
    assert "--fov is of a camera that is fitted" in refused(
        capsys, source, tmp_path / "exact.yaml", "--model", "opencv-fisheye", "--fov", 90
    )
    assert "A camera model is one of" in refused(capsys, source, tmp_path / "x.yaml", "--model", "fisheye")
    assert "OCamCalib was expected to hold --model pinhole" in refused(
        capsys, source, tmp_path / "calib_results.txt", "--model", "pinhole"
    )


def test_parameters_that_a_format_lacks_are_made_up_for(tmp_path: Path, capsys) -> None:
    """Kalibr's radtan has no k3: the other coefficients take its part, as far as they can."""
    source = save(tmp_path / "calibration.yaml", BROWN)
    status, text, err = run(capsys, source, tmp_path / "camchain.yaml", "--model", "pinhole", "--json")
    camera = json.loads(text)["cameras"]["cam0"]
    # 4.0 px of 1280.
    assert status == 1 and camera["form"] == "pinhole-radtan"
    assert "cam0 is 4.01 px RMS off in this file; write it exactly with one of --to colmap, " in err
    assert camera["parameters"]["k3"] == 0 == camera["parameters"]["skew"] and BROWN.named_parameters()["k3"] != 0
    cut = BROWN.named_parameters() | {"k3": 0.0}
    pixels = np.random.default_rng(0).uniform([0, 0], BROWN.image_size, (400, 2))
    bearings = BROWN.unproject(pixels)[0]
    dropped = np.abs(camera_models.Pinhole.from_mapping(cut, BROWN.image_size).project(bearings)[0] - pixels).max()
    assert camera["max_px"] < 0.5 * dropped


@pytest.mark.slow
def test_a_turn_about_the_axis_goes_to_the_poses(tmp_path: Path, capsys) -> None:
    """d and e of OCamCalib turn the image; with the poses turned too, every camera still sees every point where it did."""
    given = rig(OCAM, SLANTED)
    camera_models.save(tmp_path / "calibration.yaml", given)
    status, text, err = run(capsys, tmp_path / "calibration.yaml", tmp_path / "rig.json", "--fov", 150, "--json")
    assert status == 0 and "cam1 by -1.75 degrees" in err and "turned instead, in their poses" in err
    assert json.loads(text)["cameras"]["cam1"]["max_px"] < 1.0
    content = read(tmp_path / "rig.json")
    points = np.random.default_rng(0).normal(size=(300, 3)) * [1.5, 1.5, 0] + [0, 0, 2.0]
    first, second = content.calibration.values()
    seen, where = given["cam0"].project(points)[0], torch.as_tensor(points)
    # The first camera was not turned (e = d), so its frame is the one given.
    assert np.abs(first.project(points)[0] - seen).max() < 1.0
    pose, other = (calibration.rig["cam1"].cam_from_rig for calibration in (given, content.calibration))
    old = SLANTED.project(pose.transform(where))[0]
    new, valid = second.project(other.transform(where))
    assert valid.all() and (new - old).abs().max() < 1.5
    # Where there are no poses, the error has it.
    save(tmp_path / "alone.yaml", SLANTED)
    status, text, err = run(capsys, tmp_path / "alone.yaml", tmp_path / "alone.json", "--fov", 150, "--json")
    assert "the error of the fit includes that turn" in err and json.loads(text)["cameras"]["cam0"]["max_px"] > 8


@pytest.mark.slow
def test_cameras_of_one_model_stay_of_one_model() -> None:
    """The fit of each alone would take different models for two lenses of a rig."""
    target = format_named("kalibr")
    result = transfer(rig(OCAM, OCAM.with_parameters(OCAM.parameters * 1.001), BROWN), target, Path("camchain.yaml"), fov_deg=150)
    models = [model.NAME for model in result.calibration.values()]
    assert models[0] == models[1] and models[0] != "pinhole" and set(result.conversions) == {"cam0", "cam1", "cam2"}


def test_a_rig_for_tools_that_have_none(tmp_path: Path, capsys) -> None:
    camera_models.save(tmp_path / "calibration.yaml", rig(LENS, BROWN))
    sentence = refused(capsys, tmp_path / "calibration.yaml", tmp_path / "camera_info.yaml")
    assert "expects one camera for one file, found 2 (cam0, cam1)" in sentence and "give a folder" in sentence
    status, text, err = run(capsys, tmp_path / "calibration.yaml", tmp_path / "ros", "--to", "ros")
    assert status == 0 and "where cam0, cam1 stand in the rig" in err and "rig  " not in text
    assert sorted(path.name for path in (tmp_path / "ros").iterdir()) == ["cam0.yaml", "cam1.yaml"]
    status, text, _ = run(capsys, tmp_path / "ros", tmp_path / "back.yaml")
    assert status == 0 and list(camera_models.load(tmp_path / "back.yaml")) == ["cam0", "cam1"]
    status, text, _ = run(capsys, tmp_path / "calibration.yaml", tmp_path / "model" / "cameras.bin")
    assert status == 0 and "poses of 2 cameras" in text and (tmp_path / "model" / "rigs.bin").is_file()
    status, text, _ = run(capsys, tmp_path / "model", tmp_path / "again.yaml", "--from", "colmap")
    pose = camera_models.load(tmp_path / "again.yaml").rig["2"].cam_from_rig
    assert (pose.translation - rig(LENS, BROWN).rig["cam1"].cam_from_rig.translation).abs().max() < 1e-12


def test_views_and_their_poses_go_through_the_native_format(tmp_path: Path, capsys) -> None:
    view = ViewRecord("1.jpg", "cam0", True, cam_from_board=Pose.exp(torch.full((6,), 0.2, dtype=torch.float64)))
    camera_models.save(tmp_path / "calibration.yaml", Calibration({"cam0": LENS}, views=(view,)))
    assert run(capsys, tmp_path / "calibration.yaml", tmp_path / "copy.yaml")[0] == 0
    assert camera_models.load(tmp_path / "copy.yaml").views[0].image == "1.jpg"
    _, _, err = run(capsys, tmp_path / "calibration.yaml", tmp_path / "camera.yml")
    assert "Not kept: 1 views." in err


def test_where_a_tool_ends_is_said(tmp_path: Path, capsys) -> None:
    """The lens sees 95 degrees off axis; where the data end earlier, the note does."""
    wide = save(tmp_path / "calibration.yaml", camera_models.OpenCVFisheye.examples()[1])
    assert seen_deg(camera_models.OpenCVFisheye.examples()[1]) > 95
    _, _, err = run(capsys, wide, tmp_path / "cameras.txt")
    assert "COLMAP itself ends 90 degrees off axis with OPENCV_FISHEYE: what cam0 (up to" in err
    assert "itself ends" not in run(capsys, wide, tmp_path / "calib.json")[2]
    narrow = save(tmp_path / "narrow.yaml", camera_models.OpenCVFisheye.examples()[1], max_angle_deg=70.0)
    assert "itself ends" not in run(capsys, narrow, tmp_path / "camchain.yaml")[2]


@pytest.mark.slow
def test_a_model_that_ends_before_the_image_does(tmp_path: Path, capsys) -> None:
    """Without --fov all is fitted that the target holds, which is said; a wider --fov is refused with the widest that holds."""
    lens = camera_models.DoubleSphere([350.0, 352.0, 640.3, 470.2, -0.2, 0.6], (1280, 960))
    source = save(tmp_path / "calibration.yaml", lens)
    out = tmp_path / "camera_info.yaml"
    status, text, err = run(capsys, source, out, "--json")
    assert status == 0
    camera = json.loads(text)["cameras"]["cam0"]
    assert 244 < camera["fov_deg"] <= 245 and camera["rms_px"] < 0.01
    assert "opencv-fisheye fits cam0 within 245 of the 246 degrees that it sees" in " ".join(err.split())
    sentence = refused(capsys, source, out, "--fov", 246)
    assert "opencv-fisheye: the best fit holds 245 degrees at most" in sentence and "give a smaller --fov" in sentence
    assert run(capsys, source, out, "--fov", 245)[0] == 0
    # Of models that hold different parts the widest is taken; one that holds all goes before.
    assert transfer(rig(lens), format_named("opencv"), tmp_path / "a.yml").conversions["cam0"].model.NAME == "unified"
    assert transfer(rig(lens), format_named("colmap"), tmp_path / "cameras.txt").conversions["cam0"].holds_deg is None
    # Data that end within what the target holds leave nothing to say.
    save(source, lens, max_angle_deg=100.0)
    assert "that it sees" not in run(capsys, source, out)[2]


def test_mistakes_are_one_sentence(tmp_path: Path, capsys) -> None:
    source = save(tmp_path / "calibration.yaml", LENS)
    assert "found 'a.dat'; name the format with --to" in refused(capsys, source, tmp_path / "a.dat")
    assert "A format is one of" in refused(capsys, source, tmp_path / "a.yml", "--to", "bundler")
    assert "found" in refused(capsys, source, source) and source.read_text().startswith("format: omnilines")
    assert "does not exist" in refused(capsys, tmp_path / "absent.yaml", tmp_path / "a.yml")
    (tmp_path / "poem.yaml").write_text("roses: red\n")
    assert "was expected to be a calibration of" in refused(capsys, tmp_path / "poem.yaml", tmp_path / "a.yml")
    assert "--image-size was expected as WIDTHxHEIGHT" in refused(capsys, source, tmp_path / "a.yml", "--image-size", "big")
    assert not (tmp_path / "a.yml").exists() and not (tmp_path / "a.dat").exists()
    (tmp_path / "file").write_text("")
    assert "is no folder" in refused(capsys, source, tmp_path / "file" / "a.yml")


def test_a_folder_holds_several_formats(tmp_path: Path, capsys) -> None:
    camera_models.save(tmp_path / "rig.yaml", Calibration({"left": LENS, "right": LENS}))
    for name in ("kalibr", "nerfstudio", "mc-calib"):
        assert run(capsys, tmp_path / "rig.yaml", tmp_path / "many", "--to", name)[0] == 0
    names = {path.name for path in (tmp_path / "many").iterdir()}
    assert names == {f"{name}.{suffix}" for name in ("left", "right") for suffix in ("yaml", "json", "yml")}
    before = (tmp_path / "many" / "left.yaml").read_text()
    said = refused(capsys, tmp_path / "rig.yaml", tmp_path / "many", "--to", "ros")
    assert "left.yaml, which `convert many to kalibr` wrote; give another" in said
    assert (tmp_path / "many" / "left.yaml").read_text() == before


def test_the_size_of_the_image_may_be_given(tmp_path: Path, capsys) -> None:
    matrix = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: {}\n"
    k, d = matrix.format(3, 3, [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]), matrix.format(1, 5, [0.0] * 5)
    (tmp_path / "k.yml").write_text(f"%YAML:1.0\n---\nK: {k}D: {d}")
    assert "give --image-size WIDTHxHEIGHT" in refused(capsys, tmp_path / "k.yml", tmp_path / "out.yaml")
    assert run(capsys, tmp_path / "k.yml", tmp_path / "out.yaml", "--image-size", "640x480")[0] == 0
    assert yaml.safe_load((tmp_path / "out.yaml").read_text())["cameras"]["cam0"]["image_size"] == [640, 480]


@pytest.mark.slow
def test_the_python_function(tmp_path: Path) -> None:
    source = save(tmp_path / "calibration.yaml", OCAM)
    result = command(source, tmp_path / "camchain.yaml", fov_deg=120)
    assert result.files == (tmp_path / "camchain.yaml", tmp_path / "camchain.yaml_conversion.csv") and result.holds
    with pytest.raises(InputError, match="Another file than the input"):
        command(source, source)


def test_a_lens_that_folds_inside_its_image_is_spoken_of(tmp_path, capsys) -> None:
    folding = camera_models.OpenCVFisheye([300.0, 300.0, 320.0, 240.0, -0.9, 0.0, 0.0, 0.0], (640, 480))
    save(tmp_path / "in.yaml", folding)
    status, _, err = run(capsys, tmp_path / "in.yaml", tmp_path / "out.yaml")
    assert status == 0 and "percent of its image, beyond that its distortion folds" in " ".join(err.split())
    save(tmp_path / "good.yaml", LENS)
    assert "folds" not in run(capsys, tmp_path / "good.yaml", tmp_path / "again.yaml")[2]
