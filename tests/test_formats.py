"""The law suite: every registered file format, every camera model, every example; adding a format adds no test here."""

import codecs
import fnmatch
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hostile.good import FILES, store

import camera_models
from camera_models import MODELS, Calibration, CameraModel, InputError, model_class
from camera_models.formats import FORMATS, format_for_writing, format_named, format_of_file, read, write
from camera_models.formats.calibration_data import RigCamera
from camera_models.formats.contract import CalibrationFormat
from camera_models.formats.transfer import transfer
from camera_models.pose import Pose

ROOT = Path(__file__).resolve().parents[1]
FORMAT_NAMES = [entry.name for entry in FORMATS]
EXAMPLES = [(name, index, model) for name, _ in MODELS for index, model in enumerate(model_class(name).examples())]
PAIRS = [(entry.name, model, f"{entry.name}-{name}-{index}") for entry in FORMATS for name, index, model in EXAMPLES]
EACH_PAIR = pytest.mark.parametrize(("name", "model"), [pair[:2] for pair in PAIRS], ids=[pair[2] for pair in PAIRS])
EACH = pytest.mark.parametrize("name", FORMAT_NAMES)
LONG_TO_FIT = (
    "kalibr",
    "basalt",
    "mrcal",
    "ros",
    "anipose",
    "caliscope",
    "mc-calib",
    "camodocal",
    "metashape",
    "lensfun",
    "nerfstudio",
    "openmvg",
    "aria",
    "usd",
)


def suffixes(name: str) -> tuple[str, ...]:
    return format_named(name).SUFFIXES


def held(target: CalibrationFormat) -> list[CameraModel]:
    """Examples that a format holds exactly."""
    return [model for _, _, model in EXAMPLES if target.why_not(model) is None]


def pose(seed: int) -> Pose:
    return Pose.exp(torch.randn(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


def rig_of(models: list[CameraModel]) -> Calibration:
    """Cameras of a rig with unlike poses, the first of which is its frame."""
    names = [f"cam{index}" for index in range(len(models))]
    poses = [Pose.identity(), *(pose(index) for index in range(1, len(models)))]
    rig = {name: RigCamera(pose) for name, pose in zip(names, poses, strict=True)}
    return Calibration(dict(zip(names, models, strict=True)), rig=rig)


def assert_same_camera(read_back: CameraModel, model: CameraModel) -> None:
    assert type(read_back) is type(model) and read_back.image_size == model.image_size
    a, b = read_back.named_parameters(), model.named_parameters()
    extra = {value for key, value in [*a.items(), *b.items()] if key not in a.keys() & b.keys()}
    assert extra <= {0.0}
    for key in a.keys() & b.keys():
        assert abs(a[key] - b[key]) <= 1e-12 * max(1.0, abs(b[key])), (key, a[key], b[key])


def test_registry() -> None:
    assert len(set(FORMAT_NAMES)) == len(FORMATS) >= 8
    for entry in FORMATS:
        target = format_named(entry.name)
        assert target.NAME == entry.name and target.FORMS and target.SUFFIXES and target.TITLE
        assert {form.model for form in target.FORMS} <= dict(MODELS).keys()
        assert all(pattern == pattern.lower() for pattern in entry.files)
        for form in target.FORMS:
            names = {name for model in model_class(form.model).examples() for name in model.PARAMETER_NAMES}
            assert set(form.written or ()) | form.held.keys() | set(form.positive) <= names, form.name
    with pytest.raises(InputError, match=r"A format is one of colmap, .*found 'bundler'"):
        format_named("bundler")


def test_listing_formats_imports_nothing_heavy() -> None:
    script = "import sys, camera_models.formats as f; f.FORMATS; print(sorted({'torch', 'cv2', 'yaml'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@EACH
def test_names_of_files_decide_what_is_written(name: str) -> None:
    (entry,) = (entry for entry in FORMATS if entry.name == name)
    assert entry.files
    for pattern in entry.files:
        plain = pattern.replace("*", "x")
        earlier = FORMATS[: FORMATS.index(entry)]
        assert not any(fnmatch.fnmatchcase(plain, other) for before in earlier for other in before.files), pattern
        assert format_for_writing(Path("folder") / plain.upper()).NAME == name
        assert Path(plain).suffix in suffixes(name)


def test_a_name_without_a_format_is_refused() -> None:
    with pytest.raises(InputError, match=r"found 'camera\.dat'; name the format with `to_format`"):
        format_for_writing("camera.dat")


@EACH_PAIR
def test_what_is_held_comes_back(name: str, model: CameraModel, tmp_path: Path) -> None:
    target = format_named(name)
    if target.why_not(model) is not None:
        with pytest.raises(InputError, match="was expected to hold camera cam0, found that"):
            target.write(tmp_path / f"camera{target.SUFFIXES[0]}", Calibration({"cam0": model}))
        assert not list(tmp_path.iterdir())
        return
    for suffix in target.SUFFIXES:
        path = tmp_path / f"cameras{suffix}"
        assert path in target.write(path, Calibration({"cam0": model}))
        assert format_of_file(path).NAME == name
        content = target.read(path)
        assert content.notes == ()
        assert len(content.calibration) == 1 and not content.calibration.rig
        assert_same_camera(next(iter(content.calibration.values())), model)
        first = path.read_bytes()
        target.write(path, content.calibration)
        assert path.read_bytes() == first, "writing what was read changes the file"
        path.unlink()


@EACH
def test_every_model_listed_is_held(name: str) -> None:
    target = format_named(name)
    found = {model.NAME for model in held(target)}
    assert {form.model for form in target.FORMS} == found


@EACH
@pytest.mark.parametrize("count", [2, 3])
def test_a_rig_comes_back(name: str, count: int, tmp_path: Path) -> None:
    target = format_named(name)
    # OpenCV has no files of more than two omnidirectional cameras.
    models = [model for model in held(target) if not (name == "opencv" and model.NAME == "unified")]
    assert models
    calibration = rig_of([models[index * (len(models) - 1) // (count - 1)] for index in range(count)])
    paths = [tmp_path / "folder"]
    if target.TOGETHER:
        paths += [tmp_path / suffix[1:] / f"cameras{suffix}" for suffix in target.SUFFIXES]
    rigs = 0
    for path in paths:
        keeps = "rig" in target.keeps(path, calibration)
        try:
            target.write(path, calibration)
        except InputError as error:
            assert "a folder, which gets a file for each camera" in str(error) and not keeps
            continue
        content = target.read(path)
        again = content.calibration
        assert format_of_file(path).NAME == name
        for one, two in zip(again.values(), calibration.values(), strict=True):
            assert_same_camera(one, two)
        assert bool(again.rig) == keeps
        rigs += keeps
        for one, two in zip(again.rig.values(), calibration.rig.values(), strict=keeps):
            assert (one.cam_from_rig.rotation - two.cam_from_rig.rotation).abs().max() < 1e-12
            assert (one.cam_from_rig.translation - two.cam_from_rig.translation).abs().max() < 1e-12
    assert bool(rigs) == target.RIGS


@EACH
def test_poses_are_not_invented(name: str, tmp_path: Path) -> None:
    """Cameras whose places are not known go to a file that can leave them open, or to files of their own."""
    target = format_named(name)
    models = held(target)[:1] * 2
    calibration = Calibration(dict(zip(("a", "b"), models, strict=True)))
    path = tmp_path / f"cameras{target.SUFFIXES[0]}"
    try:
        target.write(path, calibration)
        assert target.TOGETHER and not target.NEEDS_RIG
        assert not target.read(path).calibration.rig
    except InputError as error:
        assert "a folder, which gets a file for each camera" in str(error)
        assert not list(tmp_path.iterdir())
    target.write(tmp_path / "folder", calibration)
    again = target.read(tmp_path / "folder").calibration
    assert len(again) == 2 and not again.rig


@EACH
def test_a_rig_with_a_frame_of_its_own(name: str, tmp_path: Path) -> None:
    """Relative poses stay; where the frame is lost, it is said."""
    target = format_named(name)
    calibration = rig_of(held(target)[:1] * 2)
    frame = pose(9)
    moved = {key: RigCamera(item.cam_from_rig @ frame) for key, item in calibration.rig.items()}
    calibration = Calibration(calibration.cameras, rig=moved)
    path = tmp_path / ("folder" if not target.TOGETHER else f"cameras{target.SUFFIXES[-1]}")
    if "rig" not in target.keeps(path, calibration):
        assert any("stand in the rig" in note for note in transfer(calibration, target, path).dropped)
        return
    target.write(path, calibration)
    content = target.read(path)
    first, second = (item.cam_from_rig for item in content.calibration.rig.values())
    wanted = moved["cam1"].cam_from_rig @ moved["cam0"].cam_from_rig.inverse()
    got = second @ first.inverse()
    assert (got.rotation - wanted.rotation).abs().max() < 1e-12 and (got.translation - wanted.translation).abs().max() < 1e-12
    if target.REFERRED:
        assert (first.rotation - torch.eye(3)).abs().max() == 0 and first.translation.abs().max() == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full) if name in LONG_TO_FIT else name for name in FORMAT_NAMES]
)
def test_what_is_not_held_is_fitted_or_refused(name: str, tmp_path: Path) -> None:
    """The error stated is the one measured here on every fifth pixel; what cannot be fitted says why."""
    target = format_named(name)
    asked = {model.NAME: model for _, _, model in reversed(EXAMPLES) if target.why_not(model) is not None}
    fitted = 0
    for source in asked.values():
        path = tmp_path / f"camera{target.SUFFIXES[0]}"
        try:
            result = transfer(Calibration({"cam0": source}), target, path, fov_deg=120)
        except InputError as error:
            assert f"was expected to hold camera cam0 ({source.NAME})" in str(error) and "another format" in str(error)
            continue
        fitted += 1
        conversion = result.conversions["cam0"]
        target.write(path, result.calibration)
        (camera,) = target.read(path).calibration.values()
        w, h = source.image_size
        pixels = np.stack(np.meshgrid(np.arange(0.0, w, 5), np.arange(0.0, h, 5)), -1).reshape(-1, 2)
        bearings, valid = source.unproject(pixels)
        axis = source.unproject(source.centre_px.numpy())[0]
        use = valid & (np.degrees(np.arccos(np.clip(bearings @ axis, -1, 1))) <= 60)
        off = np.linalg.norm(camera.project(bearings[use])[0] - pixels[use], axis=-1)
        assert abs(np.sqrt((off**2).mean()) - conversion.rms_px) < 0.03 * conversion.rms_px + 1e-9
        assert abs(off.max() - conversion.max_px) < 0.1 * conversion.max_px + 1e-9
        assert sum(ring.pixels for ring in conversion.rings) > 500 and conversion.rings[-1].to_deg <= 65
    assert fitted or not asked


@EACH
def test_nothing_is_lost_without_a_word(name: str, tmp_path: Path) -> None:
    """Whatever a full calibration holds is either read back or named."""
    target = format_named(name)
    model = held(target)[0]
    size = len(model.parameters)
    estimate = camera_models.CameraEstimate(
        sigma=dict.fromkeys(model.PARAMETER_NAMES, 0.5),
        covariance=0.25 * np.eye(size),
        max_angle_deg=40.0,
        min_angle_deg=5.0,
        rms_px_per_axis=0.3,
        rms_px_per_point=0.4,
        sign_source="tags",
    )
    known = {"sigma": np.full(6, 0.1), "covariance": 0.01 * np.eye(6)}
    rig = {"left": RigCamera(Pose.identity(), **known), "right": RigCamera(pose(3), **known)}
    views = (camera_models.formats.calibration_data.ViewRecord("1.jpg", "left", True),)
    given = Calibration({"left": model, "right": model}, {"left": estimate}, rig, views, {"software": "omnilines"})
    path = tmp_path / ("folder" if not target.TOGETHER else f"cameras{target.SUFFIXES[0]}")
    if target.TOGETHER and "rig" not in target.keeps(path, given):
        path = tmp_path / f"cameras{target.SUFFIXES[-1]}"
    result = transfer(given, target, path)
    target.write(path, result.calibration)
    again = target.read(path).calibration
    told = " | ".join(result.dropped)
    # The first camera, whatever a format calls it.
    found = again.estimates.get(next(iter(again)), camera_models.CameraEstimate())
    for field in ("sigma", "covariance", "max_angle_deg", "min_angle_deg", "rms_px_per_axis", "rms_px_per_point", "sign_source"):
        kept = getattr(found, field) not in (None, 0.0) if field != "covariance" else found.covariance is not None
        assert kept or f"{field} of left" in told, field
    assert again.views or "1 views" in told
    assert again.provenance or "provenance" in told
    assert again.rig or "stand in the rig" in told
    assert (
        all(item.sigma is not None for item in again.rig.values()) or not again.rig or "sigma of left, right in the rig" in told
    )
    assert list(again) == ["left", "right"] or "the names left, right" in told
    assert len(again) == 2
    if name == "omnilines":
        assert not result.dropped


SUFFIXES = [(name, suffix) for name in FORMAT_NAMES for suffix in format_named(name).SUFFIXES]


@pytest.mark.parametrize(("name", "suffix"), SUFFIXES, ids=["".join(pair) for pair in SUFFIXES])
def test_damaged_files_are_refused_in_one_sentence(name: str, suffix: str, tmp_path: Path) -> None:
    """Cut anywhere, or with a character changed, a file reads or raises InputError, and nothing else."""
    target = format_named(name)
    path = tmp_path / f"cameras{suffix}"
    (content,) = target.documents(path, Calibration({"cam0": held(target)[0]})).values()
    whole = content.encode() if isinstance(content, str) else content
    rng = np.random.default_rng(0)
    damaged = [b"", b"\x00\xff\xfe", b"{}", b"[]", b"a: 1\n", b"1 2 3\n", *(whole[: len(whole) * k // 12] for k in range(1, 12))]
    for _ in range(60):
        changed = bytearray(whole)
        changed[rng.integers(len(whole))] = rng.choice(list(b"x-9 :,.{['\n<"))
        damaged.append(bytes(changed))
    refused = 0
    for data in damaged:
        path.write_bytes(data)
        try:
            target.read(path)
        except InputError as error:
            refused += 1
            assert path.name in str(error) and str(error).endswith("."), error
    assert refused > 10
    with pytest.raises(InputError, match=r"does not exist|cannot be read"):
        target.read(tmp_path / f"absent{suffix}")


@EACH
def test_a_failure_leaves_the_file_that_was_there(name: str, tmp_path: Path) -> None:
    target = format_named(name)
    path = tmp_path / f"cameras{target.SUFFIXES[0]}"
    path.write_text("precious")
    lost = [model for _, _, model in EXAMPLES if target.why_not(model) is not None]
    if lost:
        with pytest.raises(InputError):
            target.write(path, Calibration({"cam0": lost[0]}))
    bad = held(target)[0]
    if len(bad.parameters):
        with pytest.raises(InputError, match=r"must be finite|cannot hold|was expected to hold"):
            target.write(path, Calibration({"cam0": bad.with_parameters(bad.parameters * float("nan"))}))
    assert path.read_text() == "precious" and [part.name for part in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("kind", [kind for kind, (name, _, _) in FILES.items() if not name.endswith(".bin")])
def test_a_byte_order_mark_changes_nothing(kind: str, tmp_path: Path) -> None:
    """Editors of Windows write one."""
    name, own, models = FILES[kind]
    (tmp_path / name).write_bytes(codecs.BOM_UTF8 + (store() / kind / name).read_bytes())
    assert type(format_of_file(tmp_path / name)) is type(format_named(own))
    assert len(read(tmp_path / name).calibration) == len(models)


@pytest.mark.parametrize("kind", ["omnilines", "kalibr", "ros", "basalt", "anipose"])
def test_a_number_of_thousands_of_digits_is_called_that(kind: str, tmp_path: Path) -> None:
    name = FILES[kind][0]
    text = (store() / kind / name).read_text()
    (tmp_path / name).write_text(re.sub(r"(?<![\d.])646(?=\D)", "9" * 5000, text, count=1))
    with pytest.raises(InputError, match="numbers within reason, found one of thousands of digits; restore it"):
        read(tmp_path / name)


def test_short_cuts(tmp_path: Path) -> None:
    model = camera_models.OpenCVFisheye.examples()[0]
    assert write(tmp_path / "cameras.txt", Calibration({"cam0": model})) == [tmp_path / "cameras.txt"]
    assert_same_camera(read(tmp_path / "cameras.txt").calibration["1"], model)
    assert_same_camera(read(tmp_path / "cameras.txt", "colmap").calibration["1"], model)
    (tmp_path / "notes.txt").write_text("nothing of a camera")
    with pytest.raises(
        InputError, match=r"notes.txt was expected to be a calibration of colmap, .*name its format with `from_format`"
    ):
        read(tmp_path / "notes.txt")
    with pytest.raises(InputError, match="does not exist"):
        read(tmp_path / "absent.yaml")
