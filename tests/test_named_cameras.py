"""A panorama's camera by its name in place of a file: the size it takes, and what is refused."""

import numpy as np
import pytest

from camera_models import Calibration, Equirectangular, InputError, save
from omnilines import cli
from omnilines.files import PhotoArray, find_photos, write_png
from omnilines.files.cameras import calibration_files, read_cameras


def photo(width: int, height: int, name: str = "a.png") -> PhotoArray:
    """A black one."""
    return PhotoArray(name, np.zeros((height, width, 3), np.uint8))


@pytest.mark.parametrize(
    ("given", "photos", "size"),
    [
        ("equirectangular:5376x2688", (), (5376, 2688)),
        ("equirectangular:640x200", [photo(100, 50)], (640, 200)),
        ("equirectangular", [photo(100, 50)], (100, 50)),
        ("equirectangular", [photo(1001, 500)], (1001, 500)),
        ("equirectangular", [photo(80, 60), photo(100, 50)], (100, 50)),
    ],
)
def test_camera_of_a_name(given, photos, size):
    """By its own size, or that of the photos."""
    cameras = read_cameras(given, photos)
    assert [(type(model), model.image_size) for model in cameras.values()] == [(Equirectangular, size)]
    assert calibration_files(given) == []


def test_a_photo_that_cannot_be_read_does_not_say_the_size(tmp_path):
    """The next one does; where none can be read, its own error stands."""
    (tmp_path / "a.png").write_bytes(b"no photo")
    with pytest.raises(InputError, match="cannot be decoded"):
        read_cameras("equirectangular", find_photos([tmp_path]))
    write_png(tmp_path / "b.png", np.zeros((50, 100), np.uint8))
    assert read_cameras("equirectangular", find_photos([tmp_path]))["cam0"].image_size == (100, 50)


@pytest.mark.parametrize(
    ("given", "photos", "sentence"),
    [
        ("equirectangular", [photo(100, 75)], "twice as wide as high, .* found a.png of 100x75 px; .* equirectangular:100x75"),
        ("equirectangular", (), "give equirectangular:WIDTHxHEIGHT"),
        ("equirectangular:100", (), "WIDTHxHEIGHT in pixels, found 'equirectangular:100'"),
        ("equirectangular:0x50", (), "WIDTHxHEIGHT in pixels"),
        ("cylindrical", [photo(100, 50)], r"has parameters \(fx, fy, cx, cy\); write them to a calibration.yaml"),
        ("opencv-fisheye", [photo(100, 50)], "which has 8 parameters; .* --model opencv-fisheye"),
        ("equirect", [photo(100, 50)], "equirect does not exist"),
    ],
)
def test_what_is_no_camera_by_name(given, photos, sentence):
    """Each is answered with what to give."""
    with pytest.raises(InputError, match=sentence):
        read_cameras(given, photos)


def test_a_file_of_that_name_is_read(tmp_path, monkeypatch):
    """What lies on disk comes first."""
    monkeypatch.chdir(tmp_path)
    save("equirectangular", Calibration({"left": Equirectangular([], (64, 32))}))
    assert list(read_cameras("equirectangular")) == ["left"]
    assert [path.name for path in calibration_files("equirectangular")] == ["equirectangular"]


def run(*arguments: str) -> None:
    """A command that ends well."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert not ended.value.code


@pytest.mark.slow
def test_arcs_of_panoramas_without_a_file(tmp_path, capsys):
    """`extract` gives what it gives with the file, and names the camera in what comes next."""
    photos, named, filed = (str(tmp_path / name) for name in ("room", "named", "filed"))
    run("render", "scene", "--model", "equirectangular", "--size", "640x320", "--views", "3", "--out", photos)
    capsys.readouterr()
    run("extract", photos, "--calibration", "equirectangular", "--out", named)
    assert "--calibration equirectangular" in capsys.readouterr().out
    run("extract", photos, "--calibration", f"{photos}/calibration.yaml", "--out", filed)
    assert (tmp_path / "named/segments.csv").read_text() == (tmp_path / "filed/segments.csv").read_text()
