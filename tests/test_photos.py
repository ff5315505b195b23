"""Photos are found in natural order under the names that tables use, and read upright; bad ones are named, quietly."""

import json
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import calib_patterns
import omnilines as ol
from camera_models import Calibration, OpenCVFisheye
from camera_models.errors import InputError
from omnilines import cli
from omnilines.files import PHOTO_SUFFIXES, find_photos, of_one_range, photos_of, read_photo
from omnilines.files.orientation import turned_otherwise
from omnilines.files.passed_over import passed_over


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def found(*paths: str | Path) -> list[str]:
    return [photo.name for photo in find_photos(list(paths))]


def test_a_folder_in_natural_order(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "img10.JPG",
        "img2.jpg",
        "IMG1.jpg",
        "notes.txt",
        ".hidden.jpg",
        ".thumbs/img3.jpg",
        "b/2.png",
        "b/10.Png",
        "jpg",
    )
    assert found(tmp_path) == ["b/2.png", "b/10.Png", "IMG1.jpg", "img2.jpg", "img10.JPG"]
    assert found(str(tmp_path)) == found(tmp_path)
    assert all(photo.path == tmp_path / photo.name for photo in find_photos([tmp_path]))


def test_links_out_of_the_folder_are_followed_once(tmp_path: Path) -> None:
    """A data set elsewhere is linked to; links back do not run in circles, and what lies in the folder has its own name."""
    touch(tmp_path, "elsewhere/1.png", "photos/cam3/2.png")
    for link, target in (("cam1", "elsewhere"), ("cam2", "elsewhere"), ("cam0", "photos/cam3")):
        (tmp_path / "photos" / link).symlink_to(tmp_path / target)
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "photos")
    (tmp_path / "elsewhere" / "self").symlink_to(tmp_path / "elsewhere")
    assert found(tmp_path / "photos") == ["cam1/1.png", "cam3/2.png"]


def test_every_suffix_is_found_and_readable(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (8, 9), dtype=np.uint8)
    assert len(PHOTO_SUFFIXES) == 8
    for suffix in PHOTO_SUFFIXES:
        assert cv2.imwrite(str(tmp_path / f"a{suffix}"), pixels)
    photos = find_photos([tmp_path])
    assert sorted(photo.path.suffix for photo in photos) == sorted(PHOTO_SUFFIXES)
    assert all(read_photo(photo.path).shape[:2] == (8, 9) for photo in photos)


def test_files_and_several_folders_share_the_deepest_folder(tmp_path: Path) -> None:
    touch(tmp_path, "cam0/1.jpg", "cam0/2.jpg", "cam1/1.jpg")
    assert found(tmp_path / "cam0" / "2.jpg", tmp_path / "cam0" / "1.jpg") == ["1.jpg", "2.jpg"]
    assert found(tmp_path / "cam0", tmp_path / "cam1") == ["cam0/1.jpg", "cam0/2.jpg", "cam1/1.jpg"]
    assert found(tmp_path / "cam0", tmp_path / "cam1" / "1.jpg") == ["cam0/1.jpg", "cam0/2.jpg", "cam1/1.jpg"]
    assert found(tmp_path / "cam0", tmp_path / "cam0" / ".." / "cam0" / "1.jpg") == ["1.jpg", "2.jpg"]


def test_relative_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, "p/1.jpg")
    monkeypatch.chdir(tmp_path)
    assert found("p") == found("p/1.jpg") == ["1.jpg"] and found(".") == ["p/1.jpg"]


def test_real_photos_are_named_as_in_the_tables(shared_data: Path) -> None:
    names = found(shared_data / "calibration" / "fisheye1" / "images")
    assert names == [f"Fisheye1_{k}.jpg" for k in range(1, 16)]


def test_what_is_no_photo_is_named(tmp_path: Path) -> None:
    touch(tmp_path, "notes.txt")
    with pytest.raises(InputError, match=r"No image found in .*; expected files ending in \.jpg \.jpeg"):
        find_photos([tmp_path])
    with pytest.raises(InputError, match="No image found in an empty list"):
        find_photos([])
    with pytest.raises(InputError, match=r"none\.jpg does not exist"):
        find_photos([tmp_path / "none.jpg"])
    with pytest.raises(InputError, match=r"notes\.txt is not a photo; expected a file ending in"):
        find_photos([tmp_path / "notes.txt"])
    with open(os.fsencode(tmp_path) + b"/\xff.jpg", "wb"):
        pass
    with pytest.raises(InputError, match=r"holds characters that are not text; rename it"):
        find_photos([tmp_path])


@pytest.mark.parametrize(
    ("shape", "dtype", "expected"),
    [
        ((6, 7), np.uint8, (6, 7)),
        ((6, 7), np.uint16, (6, 7)),
        ((6, 7, 3), np.uint8, (6, 7, 3)),
        ((6, 7, 3), np.uint16, (6, 7, 3)),
        ((6, 7, 4), np.uint8, (6, 7, 3)),
    ],
)
def test_pixels_come_as_they_were_written(shape: tuple[int, ...], dtype: type, expected: tuple[int, ...], tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape, dtype=dtype)
    path = tmp_path / "ünïcode 写真 1.png"
    path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    read = read_photo(path)
    assert read.dtype == dtype and read.shape == expected
    assert np.array_equal(read, pixels if len(shape) == 2 else pixels[..., :3])


def test_arrays_need_no_names() -> None:
    """In their order; a list of arrays and paths is neither."""
    camera = OpenCVFisheye([200.0, 200.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0], (640, 480))
    named = dict(ol.render("checkerboard:5x4:60mm", camera, ol.RenderOptions(views=2, seed=3)).photos)
    pixels = list(named.values())
    board = calib_patterns.pattern("checkerboard:5x4:60mm")
    by_name, listed = (ol.detect(given, board).corners for given in (named, [pixels[0], torch.as_tensor(pixels[1])]))
    assert listed.images == ("photo0", "photo1")
    np.testing.assert_array_equal(listed.pixels, by_name.pixels)
    with pytest.raises(InputError, match="The photo photo1 was expected as an array"):
        photos_of([pixels[0], pixels[1].astype(float)])
    with pytest.raises(InputError, match=r"`photos` of detect was expected as .*Sequence of Tensor or ndarray or Mapping"):
        ol.detect([pixels[0], "a.png"], board)  # type: ignore[list-item]


def test_photos_of_12_bits_in_16_fill_them_and_stay_as_bright_as_each_other(tmp_path: Path) -> None:
    scene = np.random.default_rng(2).integers(0, 4096, (40, 50), dtype=np.uint16)
    scene[0, :2] = 0, 4095
    dim = scene // 4
    for name, pixels in (("a.png", scene), ("b.tif", dim), ("c.png", (scene >> 4).astype(np.uint8))):
        (tmp_path / name).write_bytes(cv2.imencode(Path(name).suffix, pixels)[1].tobytes())
    (tmp_path / "d.png").write_bytes(b"\x89PNG cut short")
    from_files = of_one_range(find_photos([tmp_path]))[:3]
    in_memory = of_one_range(photos_of({"a": scene, "b": dim, "c": (scene >> 4).astype(np.uint8)}))
    for photos in (from_files, in_memory):
        full, darker, eight = (photo.read() for photo in photos)
        assert np.abs(full - scene * (65535.0 / 4095.0)).max() <= 0.5
        assert np.abs(darker - dim * (65535.0 / 4095.0)).max() <= 0.5
        assert np.array_equal(eight, scene >> 4)
    assert np.array_equal(
        of_one_range(photos_of({"all": np.arange(65536, dtype=np.uint16)[None]}))[0].read()[0], np.arange(65536)
    )


def exif(orientation: int) -> bytes:
    """A JPEG APP1 segment with nothing but the orientation tag (Exif 2.3, tag 0x0112)."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    return b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff


@pytest.mark.parametrize(
    ("orientation", "turned"), [(1, lambda a: a), (3, lambda a: a[::-1, ::-1]), (6, lambda a: np.rot90(a, -1))]
)
def test_exif_orientation_turns_the_photo_upright(
    orientation: int, turned: Callable[[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    ramp = np.add.outer(np.arange(40) * 4, np.arange(64)).astype(np.uint8)
    jpeg = cv2.imencode(".jpg", ramp)[1].tobytes()
    (tmp_path / "plain.jpg").write_bytes(jpeg)
    (tmp_path / "turned.jpg").write_bytes(jpeg[:2] + exif(orientation) + jpeg[2:])
    assert np.array_equal(read_photo(tmp_path / "turned.jpg"), turned(read_photo(tmp_path / "plain.jpg")))


def test_a_photo_turned_otherwise_by_its_exif_is_named(tmp_path: Path) -> None:
    ramp = np.add.outer(np.arange(40) * 4, np.arange(64)).astype(np.uint8)
    jpeg, png, tiff = (cv2.imencode(suffix, ramp)[1].tobytes() for suffix in (".jpg", ".png", ".tif"))
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg)
    (tmp_path / "half.jpg").write_bytes(jpeg[:2] + exif(3) + jpeg[2:])
    (tmp_path / "cut.jpg").write_bytes((jpeg[:2] + exif(3))[:20])
    chunk = b"eXIf" + exif(6)[10:]
    png = png[:33] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + png[33:]
    (tmp_path / "side.png").write_bytes(png)
    (tmp_path / "plain.tif").write_bytes(tiff)
    assert read_photo(tmp_path / "side.png").shape == (64, 40)
    named = turned_otherwise(find_photos([tmp_path]))
    assert sorted(named) == ["half.jpg", "side.png"] and "turns it by 180 degrees" in named["half.jpg"]
    assert turned_otherwise(find_photos([tmp_path / "half.jpg"])) == {}


def behind_pixels(ending: str, pixels: np.ndarray, orientation: int) -> bytes:
    """A photo whose orientation stands behind its pixels, as many programs write it."""
    data, tags = cv2.imencode(ending, pixels, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes(), exif(orientation)[10:]
    if ending == ".png":
        return (
            data[:-12]
            + struct.pack(">I", len(tags))
            + b"eXIf"
            + tags
            + struct.pack(">I", zlib.crc32(b"eXIf" + tags))
            + data[-12:]
        )
    if ending == ".webp":
        sides = b"".join((side - 1).to_bytes(3, "little") for side in pixels.shape[1::-1])
        parts = b"WEBPVP8X" + struct.pack("<II", 10, 8) + sides + data[12:] + b"EXIF" + struct.pack("<I", len(tags)) + tags
        return b"RIFF" + struct.pack("<I", len(parts)) + parts
    (place,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, place)
    entries = sorted(
        [data[at : at + 12] for at in range(place + 2, place + 2 + 12 * count, 12)] + [tags[10:22]], key=lambda e: e[1::-1]
    )
    padded = data + bytes(len(data) % 2)
    return padded[:4] + struct.pack("<I", len(padded)) + padded[8:] + struct.pack("<H", count + 1) + b"".join(entries) + bytes(4)


@pytest.mark.parametrize("ending", [".png", ".webp", ".tif"])
def test_an_orientation_behind_the_pixels_is_found(tmp_path: Path, ending: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (400, 420, 3), dtype=np.uint8)
    for name, orientation in (("a", 1), ("b", 1), ("c", 3)):
        data = behind_pixels(ending, pixels, orientation)
        assert len(data) > 1 << 18
        (tmp_path / f"{name}{ending}").write_bytes(data)
    photos = find_photos([tmp_path])
    upright, _, turned = (photo.read() for photo in photos)
    assert np.array_equal(upright, pixels) and np.array_equal(turned, pixels[::-1, ::-1])
    assert list(turned_otherwise(photos)) == [f"c{ending}"]


def test_deep_colours_in_planes_are_refused(tmp_path: Path) -> None:
    """OpenCV 5.0 reads the first plane as all three colours; those of 8 bits it reads."""
    for kind in (np.uint8, np.uint16):
        pixels = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (6, 8, 3), dtype=kind)
        size, depth = pixels.nbytes, 8 * pixels.itemsize
        tags = [(256, 1, 8), (257, 1, 6), (258, 3, 170), (259, 1, 1), (262, 1, 2), (273, 3, 176), (277, 1, 3), (278, 1, 6)]
        tags += [(279, 3, 188), (284, 1, 2)]
        entries = b"".join(struct.pack("<HHII", tag, 3 if tag == 258 else 4, count, value) for tag, count, value in tags)
        beside = struct.pack("<3H3I3I", *[depth] * 3, *(200 + k * size // 3 for k in range(3)), *[size // 3] * 3)
        header = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)
        data = header.ljust(170, b"\0") + beside + pixels.transpose(2, 0, 1).tobytes()
        (tmp_path / f"{depth}.tif").write_bytes(data)
        if kind is np.uint8:
            assert np.array_equal(read_photo(tmp_path / "8.tif"), pixels[..., ::-1])
    with pytest.raises(InputError, match=r"16\.tif .* colours pixel by pixel, found them in planes of 16 bits"):
        read_photo(tmp_path / "16.tif")


def damaged(kind: str) -> bytes:
    pixels = np.random.default_rng(2).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    jpeg, png, tiff = (cv2.imencode(suffix, pixels)[1].tobytes() for suffix in (".jpg", ".png", ".tif"))
    middle = len(png) // 2
    return {
        "text": b"not a photo at all",
        "jpeg cut short": jpeg[: len(jpeg) // 2],
        "jpeg header": jpeg[:50],
        "png cut short": png[:middle],
        "png changed": png[:middle] + bytes([png[middle] ^ 255]) + png[middle + 1 :],
        "tiff cut short": tiff[: len(tiff) // 2],
    }[kind]


DAMAGED = ["text", "jpeg cut short", "jpeg header", "png cut short", "png changed", "tiff cut short"]


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_image_is_named_quietly(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.jpg").write_bytes(damaged(kind))
    with pytest.raises(
        InputError, match=r"The image .*bad\.jpg cannot be decoded: it is damaged, cut short or of another format"
    ):
        read_photo(tmp_path / "bad.jpg")
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "afterwards\n"


def test_empty_absent_and_float_images_are_named(tmp_path: Path) -> None:
    touch(tmp_path, "empty.jpg")
    with pytest.raises(InputError, match=r"empty\.jpg is empty \(0 bytes\)"):
        read_photo(tmp_path / "empty.jpg")
    with pytest.raises(InputError, match=r"none\.jpg does not exist"):
        read_photo(tmp_path / "none.jpg")
    (tmp_path / "f.tif").write_bytes(cv2.imencode(".tif", np.ones((4, 4), np.float32))[1].tobytes())
    with pytest.raises(InputError, match=r"f\.tif must have 8 or 16 bits per channel, found float32"):
        read_photo(tmp_path / "f.tif")


def test_photos_are_read_with_standard_error_closed(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.png"), np.zeros((3, 5), np.uint8))
    script = "import os, sys; os.close(2); from omnilines.files import read_photo; print(read_photo(sys.argv[1]).shape)"
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path / "a.png")], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "(3, 5)"


def test_photos_of_phones_are_named_as_what_they_are(tmp_path: Path) -> None:
    """A folder of them was said to hold no image, and one called .jpg to be damaged: "copy it again"."""
    heic = b"\0\0\0\x18ftypheic" + bytes(100)
    (tmp_path / "IMG_1.HEIC").write_bytes(heic)
    with pytest.raises(InputError, match=r"IMG_1\.HEIC is of a format that is not read: convert it to JPEG"):
        find_photos([tmp_path])
    (tmp_path / "IMG_2.jpg").write_bytes(heic)
    (photo,) = find_photos([tmp_path])
    with pytest.raises(InputError, match=r"IMG_2\.jpg is HEIC or AVIF, whatever its name says, which is not read; convert it"):
        photo.read()


def test_what_is_passed_over_beside_photos_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Photos of phones and raw files beside others, but for those with a JPEG of the same picture; pages behind the first."""
    touch(tmp_path, "in/IMG_1.HEIC", "in/more/IMG_2.heic", "in/3.CR2")
    picture = Image.fromarray(np.full((48, 64), 90, dtype=np.uint8))
    picture.save(tmp_path / "in/3.jpg")
    for name in ("in/4.tif", "in/5.png", "in/6.webp"):
        picture.save(tmp_path / name, save_all=True, append_images=[picture.rotate(180), picture.point(lambda grey: 255 - grey)])
    with passed_over() as beside:
        assert found(tmp_path / "in") == ["3.jpg", "4.tif", "5.png", "6.webp"]
    heic, pages = beside.notes
    assert heic == (
        "2 files, such as IMG_1.HEIC, are of a format that is not read, and passed over: convert to JPEG what should count."
    )
    assert pages.startswith("3 files, such as 4.tif, are of several pages, of which the first alone is looked at")
    calibration, out = tmp_path / "c.yaml", tmp_path / "views"
    ol.save(calibration, Calibration({"cam0": OpenCVFisheye([30.0, 30.0, 31.5, 23.5, 0.0, 0.0, 0.0, 0.0], (64, 48))}))
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        cli.main(["rectify", str(tmp_path / "in"), "--calibration", str(calibration), "--out", str(out), "--json"])
    assert not ended.value.code and {heic, pages} <= set(json.loads(capsys.readouterr().out)["notes"])


def test_one_page_is_said_to_be_one(tmp_path: Path) -> None:
    """Also where a TIFF holds a small version of its picture too, as cameras write it."""
    picture = Image.fromarray(np.full((48, 64), 90, dtype=np.uint8))
    for name in ("1.tif", "2.png", "3.webp"):
        picture.save(tmp_path / name)
    small = picture.resize((16, 12))
    small.encoderinfo = {"tiffinfo": {254: 1}}
    picture.save(tmp_path / "4.tif", save_all=True, append_images=[small])
    (tmp_path / "5.tif").write_bytes(b"II*\0\xff\xff\xff\xff")
    with Image.open(tmp_path / "4.tif") as pages, passed_over() as beside:
        assert pages.n_frames == 2
        assert len(found(tmp_path)) == 5 and beside.notes == ()


@pytest.mark.parametrize("kind", [1, 2])
def test_transparency_of_a_tiff_leaves_its_colours(kind: int, tmp_path: Path) -> None:
    """libtiff multiplies colours by their opacity (ExtraSamples 2), or they are stored so (1): a fading rim was an edge."""
    colours = np.random.default_rng(0).integers(0, 256, (32, 64, 3), dtype=np.uint8)
    opacity = np.broadcast_to(np.arange(1, 65, dtype=np.uint8) * 4 - 1, (32, 64))
    stored = colours if kind == 2 else np.rint(colours * (opacity[..., None] / 255)).astype(np.uint8)
    picture = Image.fromarray(np.dstack([stored, opacity]), "RGBA")
    picture.save(tmp_path / "a.tif")
    stated = struct.pack("<HHIH", 338, 3, 1, 2)
    content = (tmp_path / "a.tif").read_bytes()
    assert content.count(stated) == 1
    (tmp_path / "a.tif").write_bytes(content.replace(stated, struct.pack("<HHIH", 338, 3, 1, kind)))
    with Image.open(tmp_path / "a.tif") as file:
        assert file.tag_v2[338] == (kind,)
    off = np.abs(read_photo(tmp_path / "a.tif")[..., ::-1].astype(float) - colours)
    # One level of what is stored, and its rounding.
    assert (off <= 255 / opacity[..., None] + 0.5).all() and off[:, -1].max() <= 1
