"""`calibration.yaml`: what is written reads back to the bit, by us and by a stranger's YAML reader; errors name the place."""

import math
import os
import stat
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import camera_models
from camera_models.errors import InputError
from camera_models.formats.calibration_data import SIGN_SOURCES
from camera_models.formats.native import Calibration, CameraEstimate, RigCamera, ViewRecord, load, save
from camera_models.formats.quaternions import file_quaternion, quaternion_for_file, rotation_from_file
from camera_models.formats.yaml_text import read_yaml, yaml_text
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose, quaternion_from_rotation, rotation_from_quaternion

MINIMAL = """
format: omnilines-calibration
version: 1
cameras:
  cam0:
    parameters: {cy: 239.5, cx: 320, fy: 300, fx: 301}
    image_size: [640, 480]
    model: pinhole
"""

FORMATS = Path(__file__).resolve().parents[1] / "docs" / "formats.md"

finite = st.floats(allow_nan=False, allow_infinity=False)


def random_pose(seed: int) -> Pose:
    generator = torch.Generator().manual_seed(seed)
    return Pose.exp(torch.randn(6, generator=generator, dtype=torch.float64))


def full_calibration() -> Calibration:
    left = OpenCVFisheye([300.1, 1 / 3, 320 - 1e-13, 0.1 + 0.2, -1e-06, 5e-324, 1e17, -0.0], (640, 480))
    right = Pinhole.from_mapping({"fx": 700.0, "fy": 701.5, "cx": 319.5, "cy": 239.5, "k1": -0.25}, (640, 480))
    factor = np.random.default_rng(3).normal(size=(8, 8))
    estimate = CameraEstimate(
        sigma=dict(zip(left.PARAMETER_NAMES, np.sqrt(np.diag(factor @ factor.T)).tolist(), strict=True)),
        covariance=factor @ factor.T,
        max_angle_deg=92.7,
        min_angle_deg=11.1,
        rms_px_per_axis=0.2838,
        rms_px_per_point=0.2838 * math.sqrt(2),
        sign_source="mirror",
    )
    views = (
        ViewRecord("a/1.jpg", "left", True, None, 48, 2, 0.31, random_pose(1), frame="0", view="7"),
        ViewRecord("b/001", "right", False, "No pattern found.", frame="0"),
    )
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(random_pose(2), np.arange(6) / 7)}
    provenance = {"software": "omnilines 0.1.0", "inputs": ["corners.csv"], "seed": 0, "tolerance": 1e-9, "date": "2024-01-01"}
    return Calibration({"left": left, "right": right}, {"left": estimate}, rig, views, provenance)


def bits(values: object) -> bytes:
    return np.asarray(values, dtype=np.float64).tobytes()


def assert_same(a: Calibration, b: Calibration) -> None:
    assert list(a) == list(b)
    for name in a:
        assert type(a[name]) is type(b[name]) and a[name].image_size == b[name].image_size
        assert a[name].PARAMETER_NAMES == b[name].PARAMETER_NAMES
        assert bits(a[name].parameters) == bits(b[name].parameters)
        x, y = a.estimates.get(name, CameraEstimate()), b.estimates.get(name, CameraEstimate())
        assert (x.covariance is None) == (y.covariance is None)
        assert x.covariance is None or bits(x.covariance) == bits(y.covariance)
        plain = ("sigma", "max_angle_deg", "min_angle_deg", "rms_px_per_axis", "rms_px_per_point", "sign_source")
        assert [getattr(x, key) for key in plain] == [getattr(y, key) for key in plain]
    assert list(a.rig) == list(b.rig) and len(a.views) == len(b.views)
    assert a.provenance == b.provenance


def test_a_full_calibration_comes_back(tmp_path: Path) -> None:
    written = full_calibration()
    save(tmp_path / "c.yaml", written)
    read = load(tmp_path / "c.yaml")
    assert_same(written, read)
    for one, two in zip(written.views, read.views, strict=True):
        same = ("image", "camera", "used", "reason", "corners_used", "corners_rejected", "rms_px_per_point", "frame", "view")
        assert [getattr(one, key) for key in same] == [getattr(two, key) for key in same]
    pose, pose_read = written.views[0].cam_from_board, read.views[0].cam_from_board
    assert pose is not None and pose_read is not None and read.views[1].cam_from_board is None
    assert (pose.rotation - pose_read.rotation).abs().max() < 3e-14
    assert bits(pose.translation) == bits(pose_read.translation)
    sigma = read.rig["right"].sigma
    assert sigma is not None and bits(sigma) == bits(np.arange(6) / 7)
    assert read.rig["left"].sigma is None and bits(read.rig["left"].cam_from_rig.rotation) == bits(np.eye(3))


def test_saving_what_was_loaded_changes_no_byte(tmp_path: Path) -> None:
    save(tmp_path / "1.yaml", full_calibration())
    save(tmp_path / "2.yaml", load(tmp_path / "1.yaml"))
    assert (tmp_path / "1.yaml").read_bytes() == (tmp_path / "2.yaml").read_bytes()


def test_a_plain_yaml_reader_sees_the_documented_keys(tmp_path: Path) -> None:
    save(tmp_path / "c.yaml", full_calibration())
    data = yaml.safe_load((tmp_path / "c.yaml").read_text())
    assert list(data) == ["format", "version", "cameras", "rig", "views", "provenance"]
    assert (data["format"], data["version"]) == ("omnilines-calibration", 1)
    left = data["cameras"]["left"]
    assert left["parameters"] == full_calibration()["left"].named_parameters()
    assert list(left["parameters"]) == "fx fy cx cy k1 k2 k3 k4".split()
    assert all(isinstance(value, float) for value in left["parameters"].values())
    assert np.shape(left["covariance"]) == (8, 8) and left["image_size"] == [640, 480]
    assert set(data["rig"]["right"]["cam_from_rig"]) == {"rotation_wxyz", "translation_m", "sigma"}
    assert data["views"][1]["reason"] == "No pattern found." and data["views"][1]["used"] is False
    assert "image_size: [640, 480]\n" in (tmp_path / "c.yaml").read_text()


@pytest.mark.parametrize("name", [name for name, _ in camera_models.MODELS])
def test_every_model_comes_back_to_the_bit(name: str, tmp_path: Path) -> None:
    examples = {f"cam{i}": model for i, model in enumerate(camera_models.model_class(name).examples())}
    assert examples
    save(tmp_path / "c.yaml", examples)
    assert_same(Calibration(examples), camera_models.load(tmp_path / "c.yaml"))


@given(values=st.lists(finite, min_size=4, max_size=4))
@settings(max_examples=200, deadline=None)
def test_any_double_comes_back_through_either_yaml(values: list[float], tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("y") / "c.yaml"
    path.write_text(yaml_text({"values": values}))
    assert bits(read_yaml(path)["values"]) == bits(values) == bits(yaml.safe_load(path.read_text())["values"])


@given(text=st.text(st.characters(exclude_categories=["Cs"])))
@settings(max_examples=300, deadline=None)
def test_any_text_comes_back_as_text(text: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("y") / "c.yaml"
    path.write_bytes(yaml_text({"text": text, text: [text]}).encode())
    assert read_yaml(path) == {"text": text, text: [text]} or text == "text"


@pytest.mark.parametrize(
    "text", ["1e3", "007", "0x1F", "12:30", "1_000", "no", "~", "2024-01-01", ".5", "1.e+3", "-1", "", " a", "a: b"]
)
def test_text_that_looks_like_something_else_is_quoted(text: str) -> None:
    assert yaml.safe_load(yaml_text({"image": text})) == {"image": text}


def test_a_file_written_by_hand(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(MINIMAL)
    read = load(str(tmp_path / "c.yaml"))
    assert list(read) == ["cam0"] and len(read) == 1 and isinstance(read["cam0"], Pinhole)
    assert read["cam0"].named_parameters() | {"k1": 0.0} == read["cam0"].named_parameters()
    assert (read["cam0"].named_parameters()["cx"], read["cam0"].image_size) == (320.0, (640, 480))
    assert not read.rig and not read.views and not read.provenance
    assert read.estimates["cam0"].sigma is None and read.estimates["cam0"].min_angle_deg == 0.0


def test_exponents_that_yaml_1_1_takes_for_text_are_numbers(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(MINIMAL.replace("fx: 301", "fx: 3e2, k1: -1e-6, k2: 1E+2, p1: 2.5e-3, p2: .5e0"))
    values = load(tmp_path / "c.yaml")["cam0"].named_parameters()
    assert [values[key] for key in ("fx", "k1", "k2", "p1", "p2")] == [300.0, -1e-6, 100.0, 0.0025, 0.5]


def test_a_covariance_follows_the_order_of_the_parameters_in_the_file(tmp_path: Path) -> None:
    rows = np.diag([4.0, 3.0, 2.0, 1.0])  # cy cx fy fx
    (tmp_path / "c.yaml").write_text(MINIMAL + f"    covariance: {rows.tolist()}\n")
    read = load(tmp_path / "c.yaml")
    covariance = read.estimates["cam0"].covariance
    assert covariance is not None
    assert np.diag(covariance)[:4].tolist() == [1.0, 2.0, 3.0, 4.0] and covariance.sum() == 10.0
    save(tmp_path / "d.yaml", read)
    again = load(tmp_path / "d.yaml").estimates["cam0"].covariance
    assert again is not None and bits(again) == bits(covariance)


def test_a_plain_mapping_and_a_parameter_with_gradient_can_be_saved(tmp_path: Path) -> None:
    parameters = torch.tensor([300.0, 300.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    save(tmp_path / "c.yaml", {"only": OpenCVFisheye(parameters, (640, 480))})
    assert bits(load(tmp_path / "c.yaml")["only"].parameters) == bits(parameters.detach())


def test_saving_is_all_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    save(path, full_calibration())
    before = path.read_bytes()
    bad = Calibration({"a": full_calibration()["left"]}, {"a": CameraEstimate(rms_px_per_axis=math.nan)})
    with pytest.raises(InputError, match=r"cameras\.a\.rms_px_per_axis is nan"):
        save(path, bad)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["c.yaml"]
    with pytest.raises(InputError, match=r"cannot be written \(No such file or directory\)"):
        save(tmp_path / "absent" / "c.yaml", full_calibration())


def test_a_failed_replacement_leaves_no_part_behind(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        save(tmp_path / "c.yaml", full_calibration())
    assert os.listdir(tmp_path) == ["c.yaml"]


def test_a_saved_file_has_the_permissions_of_any_other(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    save(tmp_path / "c.yaml", full_calibration())
    assert (tmp_path / "c.yaml").stat().st_mode == (tmp_path / "plain").stat().st_mode
    (tmp_path / "c.yaml").chmod(0o640)
    save(tmp_path / "c.yaml", full_calibration())
    assert stat.S_IMODE((tmp_path / "c.yaml").stat().st_mode) == 0o640


def test_quaternions_survive_the_way_through_a_matrix() -> None:
    generator = torch.Generator().manual_seed(0)
    random = torch.randn(100_000, 4, generator=generator, dtype=torch.float64)
    special = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)] * 4)
    special = special[special.norm(dim=-1) > 0]
    near = special + 1e-16 * torch.randn(special.shape, generator=generator, dtype=torch.float64)
    for q in (random, special, near, random * torch.tensor([1e-15, 1.0, 1.0, 1e-8], dtype=torch.float64)):
        rotation = rotation_from_file(q)
        assert torch.equal(quaternion_for_file(rotation), file_quaternion(q))
        assert torch.equal(rotation_from_file(quaternion_for_file(rotation)), rotation)
        assert (rotation - rotation_from_quaternion(q)).abs().max() < 3e-14
        assert (file_quaternion(q).norm(dim=-1) - 1).abs().max() < 1e-15
    # What this is for: without it, the way through a matrix does not come back.
    unit = random / random.norm(dim=-1, keepdim=True)
    assert not torch.equal(quaternion_from_rotation(rotation_from_quaternion(unit)).abs(), unit.abs())


FULL = MINIMAL.lstrip() + "    sigma: {fx: 1.0}\n    max_angle_deg: 60.0\n"
RIG = "rig:\n  cam0: {cam_from_rig: {rotation_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 0]}}\n"
VIEW = """views:
  - {image: 1.jpg, camera: cam0, used: true, cam_from_board: {rotation_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 1]}}
"""
ERRORS = [
    ("version: 1", "version: 2", "The file is of version 2 and this omnilines reads up to 1; install a newer omnilines"),
    ("version: 1", "version: 0", "The version must be 1 to 1, found 0"),
    ("version: 1", "version: one", "version must be a whole number, not negative, found 'one'"),
    ("version: 1\n", "", "The key version is missing in the file; add it"),
    ("omnilines-calibration", "kalibr", "The key format must be omnilines-calibration, found 'kalibr'"),
    ("format: omnilines-calibration\n", "", "found none; give a calibration.yaml .* omnilines convert FILE calibration.yaml"),
    ("    model: pinhole\n", "", "The key model is missing in camera cam0"),
    ("    image_size: [640, 480]\n", "", "The key image_size is missing in camera cam0"),
    ("model: pinhole", "model: pinhol", "camera cam0: A camera model is one of pinhole, .*, found 'pinhol'"),
    ("model: pinhole", "model: 3", "model of camera cam0 must be text, found 3"),
    ("[640, 480]", "[640]", r"image_size of camera cam0 must be \[width, height\], found 1 numbers"),
    ("[640, 480]", "[640, 480.5]", "image_size of camera cam0 must be a whole number, not negative, found 480.5"),
    ("[640, 480]", "[0, 480]", "image_size of camera cam0 must be at least 1 x 1 pixels, found 0 x 480"),
    ("[640, 480]", "640x480", "image_size of camera cam0 must be a list, found '640x480'"),
    ("fx: 301", "fx: .nan", "parameter fx of camera cam0 must be a finite number, found nan"),
    ("fx: 301", "fx: -.inf", "parameter fx of camera cam0 must be a finite number, found -inf"),
    ("fx: 301", "fx: wide", "parameter fx of camera cam0 must be a finite number, found 'wide'"),
    ("fx: 301", "fx: true", "parameter fx of camera cam0 must be a finite number, found True"),
    (
        "fx: 301",
        "fx: 1" + "0" * 400,
        "parameter fx of camera cam0 must be a finite number, found a whole number of about 400 digits",
    ),
    ("fx: 301", "fx: [3]", "parameter fx of camera cam0 must be a finite number, found a list"),
    (", fx: 301", "", "camera cam0: .*fx"),
    ("fx: 301", "fx: 301, kx: 1", "camera cam0: .*kx"),
    ("parameters: {cy: 239.5, cx: 320, fy: 300, fx: 301}", "parameters: 3", "parameters of camera cam0 must be a mapping"),
    ("  cam0:", "  0:", "Names in cameras must be text, found 0; put it in quotes"),
    ("{fx: 1.0}", "{fz: 1.0}", "The sigma of camera cam0 may name fx fy .*, found 'fz'"),
    ("{fx: 1.0}", "{fx: -1.0}", "The sigma of fx of camera cam0 must not be negative, found -1"),
    ("{fx: 1.0}", "{fx: .nan}", "sigma fx of camera cam0 must be a finite number, found nan"),
    ("max_angle_deg: 60.0", "max_angle_deg: 200", "camera cam0: .*0 <= min_angle_deg <= max_angle_deg <= 180, found 0 and 200"),
    ("max_angle_deg: 60.0", "max_angle_deg: wide", "max_angle_deg of camera cam0 must be a finite number, found 'wide'"),
    ("max_angle_deg: 60.0", "sign_source: guess", f"sign_source must be one of {', '.join(SIGN_SOURCES)}, found 'guess'"),
    ("max_angle_deg: 60.0", "covariance: [[1]]", "covariance of camera cam0 must hold 4 x 4 numbers, found a list of 1"),
    ("max_angle_deg: 60.0", "covariance: [[1], [1], [1], [1]]", "row 1 of the covariance of camera cam0 must hold 4 numbers"),
    (
        "max_angle_deg: 60.0",
        "covariance: [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
        "covariance of camera cam0 must be symmetric",
    ),
    (
        "rotation_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 1]",
        "rotation_wxyz: [0, 0, 0, 0], translation_m: [0, 0, 1]",
        "length zero",
    ),
    (
        "rotation_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 1]",
        "translation_m: [0, 0, 1]",
        r"rotation_wxyz is missing in view 1 \(1.jpg",
    ),
    (
        "rotation_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 1]",
        "rotation_wxyz: [1, 0, 0], translation_m: 1",
        "must hold 4 numbers",
    ),
    ("camera: cam0", "camera: cam1", "Every camera named under views must be one of cam0, found 'cam1'"),
    ("used: true", "used: false", "View 1.jpg must be used or have a reason why not, found used: false and reason: null"),
    ("used: true", "reason: blurred", "View 1.jpg must be used or have a reason why not, found used: true and reason: blurred"),
    ("used: true", "used: 1", r"used of view 1 \(1.jpg\) must be true or false, found 1"),
    ("image: 1.jpg", "image: 001", "image of view 1 must be text, found 1; put it in quotes"),
    ("image: 1.jpg, ", "", "The key image is missing in view 1"),
    ("  cam0: {cam_from_rig", "  cam1: {cam_from_rig", "Every camera named under rig must be one of cam0, found 'cam1'"),
    ("cam_from_rig: {rotation_wxyz: [1, 0, 0, 0], ", "other: {", "The key cam_from_rig is missing in rig camera cam0"),
    ("translation_m: [0, 0, 0]", "translation_m: [0, 0, 0], sigma: 1", "sigma of rig camera cam0 must be a list, found 1"),
    ("fx: 301}", "fx: 301", "line 6 is not valid YAML: .*; correct it"),
    ("version: 1", "version: 1\nversion: 1", "line 3 is not valid YAML: the key 'version' is given twice"),
    ("fx: 301", "fx: 301, fx: 302", "line 5 is not valid YAML: the key 'fx' is given twice"),
    ("version: 1", "version: 1\n\x01", "line 3 holds a character that YAML forbids"),
    ("model: pinhole", "model: !!python/name:os.system x", "line 7 is not valid YAML: could not determine a constructor"),
]


def test_the_file_that_the_errors_are_made_of_is_good(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(FULL + RIG + VIEW)
    read = load(tmp_path / "c.yaml")
    assert read.estimates["cam0"].max_angle_deg == 60.0 and list(read.rig) == ["cam0"] and len(read.views) == 1


@pytest.mark.parametrize(("old", "new", "message"), ERRORS)
def test_an_error_is_one_sentence_that_names_the_place(old: str, new: str, message: str, tmp_path: Path) -> None:
    good = FULL + RIG + VIEW
    assert old in good
    path = tmp_path / "c.yaml"
    path.write_text(good.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        load(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text and text.endswith(".") and text.count(str(path)) == 1


@pytest.mark.parametrize("content", ["", "- 1\n", "just text", "[1, 2"])
def test_other_files_are_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(content)
    with pytest.raises(InputError, match=r"must be a mapping|not valid YAML"):
        load(tmp_path / "c.yaml")


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml does not exist"):
        load(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a folder where a file was expected"):
        load(tmp_path)
    (tmp_path / "latin.yaml").write_bytes("é".encode("latin-1"))
    with pytest.raises(InputError, match=r"is not UTF-8 text \(byte 0\)"):
        load(tmp_path / "latin.yaml")


def test_a_rig_lists_every_camera_and_a_calibration_has_one() -> None:
    whole = full_calibration()
    with pytest.raises(InputError, match=r"must list every camera \(left, right\), found none named 'left'"):
        Calibration(whole.cameras, rig={"right": whole.rig["right"]})
    with pytest.raises(InputError, match="at least one camera"):
        Calibration({})


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c + np.where(np.eye(len(c)), np.nan, 0.0), "of finite numbers"),
        (lambda c: c + np.where(np.eye(len(c)), np.inf, 0.0), "of finite numbers"),
        (lambda c: -c, "no negative variance"),
        (lambda c: c + np.eye(len(c), k=1), "symmetric"),
        (lambda c: c + 5.0 * (np.ones_like(c) - np.eye(len(c))), "no combination"),
        (lambda c: np.diag(np.arange(len(c)) > 0) + np.eye(len(c))[::-1], "no combination"),
    ],
)
def test_a_covariance_of_nothing_is_refused(change: Any, told: str) -> None:
    cameras, rig = full_calibration().cameras, full_calibration().rig
    with pytest.raises(InputError, match="covariance of camera left must.* " + told):
        Calibration(cameras, {"left": CameraEstimate(covariance=change(np.eye(8)))})
    with pytest.raises(InputError, match="covariance of rig camera right must.* " + told):
        Calibration(cameras, rig={**rig, "right": replace(rig["right"], covariance=change(np.eye(6)))})


def test_what_is_known_of_cameras_and_rigs_has_their_size_and_sign() -> None:
    whole = full_calibration()
    with pytest.raises(InputError, match="must be an array of 8 x 8 numbers, found 2 x 2"):
        Calibration(whole.cameras, {"left": CameraEstimate(covariance=np.eye(2))})
    with pytest.raises(InputError, match="sigma of rig camera right was expected as six numbers of 0 or more"):
        Calibration(whole.cameras, rig={**whole.rig, "right": replace(whole.rig["right"], sigma=np.full(6, -1.0))})


def test_what_a_file_cannot_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"provenance\.when is a complex"):
        save(tmp_path / "c.yaml", Calibration(full_calibration().cameras, provenance={"when": 1j}))
    endless = torch.tensor([math.inf, 1, 1, 1, 0, 0, 0, 0])
    with pytest.raises(InputError, match=r"parameter fx of camera a must be a finite number, .* found inf"):
        save(tmp_path / "c.yaml", {"a": full_calibration()["left"].with_parameters(endless)})
    assert not list(tmp_path.iterdir())


def without_dots(value: Any) -> Any:
    """A part of the example of the documents; None where it stands for more than it says."""
    if isinstance(value, list):
        whole = [without_dots(item) for item in value]
        return None if None in whole or "..." in value else whole
    if isinstance(value, dict):
        parts = {key: without_dots(item) for key, item in value.items() if key != "..."}
        return {key: item for key, item in parts.items() if item is not None or value[key] is None}
    return value


def test_the_example_of_the_documents_is_read(tmp_path: Path) -> None:
    example = FORMATS.read_text().partition("## calibration.yaml")[2].partition("```yaml")[2].partition("```")[0]
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump(without_dots(yaml.safe_load(example)), sort_keys=False))
    read = load(tmp_path / "calibration.yaml")
    assert list(read) == list(read.rig) == ["cam0", "cam1"] and len(read.views) == 1
