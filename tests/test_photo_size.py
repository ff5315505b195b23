"""The size of a photo is known from its header, so that few bytes that stand for gigabytes are refused."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_models import InputError
from camera_models.formats.disk import read_bytes
from omnilines import photo_file
from omnilines.files import PHOTO_SUFFIXES, read_photo
from omnilines.photo_size import may_be_transparent, may_have_16_bits, size_of_photo

IMAGE = np.random.default_rng(0).integers(0, 255, (37, 53, 3), dtype=np.uint8)


def png(width: int, height: int, depth: int, kind: int) -> bytes:
    """A PNG of zeros, of few bytes: kind 0 is grey, 2 colour, 3 a palette."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    packer, rows = zlib.compressobj(9), []
    for _ in range(height):
        rows.append(packer.compress(bytes(1 + (width * depth * (3 if kind == 2 else 1) + 7) // 8)))
    palette = chunk(b"PLTE", bytes(6)) if kind == 3 else b""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0))
    data = chunk(b"IDAT", b"".join([*rows, packer.flush()]))
    return b"\x89PNG\r\n\x1a\n" + header + palette + data + chunk(b"IEND", b"")


def encoded(suffix: str, *options: int) -> bytes:
    image = IMAGE[..., 0] if suffix == ".pgm" else IMAGE
    return bytes(cv2.imencode(suffix, image, options)[1].tobytes())


ENCODED = {
    **{suffix: encoded(suffix) for suffix in (*PHOTO_SUFFIXES, ".ppm")},
    "progressive": encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "lossless": encoded(".webp", cv2.IMWRITE_WEBP_QUALITY, 101),
    "remark": b"P5\n# a remark 7\n53 37\n255\n" + bytes(37 * 53),
    "big-endian": b"MM\0*\0\0\0\x08\0\x02" + struct.pack(">HHIHHHHII", 256, 3, 1, 53, 0, 257, 4, 1, 37),
    "big-tiff": b"II+\0\x08\0\0\0" + struct.pack("<QQ", 16, 2) + struct.pack("<HHQQHHQQ", 256, 4, 1, 53, 257, 16, 1, 37),
    "top-down": b"BM" + bytes(12) + struct.pack("<Iii", 40, 53, -37) + bytes(40),
    "extended": b"RIFF\0\0\0\0WEBPVP8X" + bytes(8) + (52).to_bytes(3, "little") + (36).to_bytes(3, "little"),
}


@pytest.mark.parametrize("kind", ENCODED)
def test_the_header_says_the_size(kind: str) -> None:
    assert size_of_photo(ENCODED[kind]) == (53, 37)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("order", "<>")
def test_the_tags_of_a_large_tiff_are_read_where_they_stand(
    order: str, big: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not with all the pixels before them."""
    place = 3_000_000
    tags = ((256, 4, 53), (257, 4, 37), (262, 3, 2), (274, 3, 6), (277, 3, 4), (338, 3, 2))
    mark = {"<": b"II", ">": b"MM"}[order] + struct.pack(f"{order}H", 43 if big else 42)
    entries = b"".join(
        struct.pack(f"{order}HH{'Q' if big else 'I'}", tag, kind, 1)
        + struct.pack(f"{order}{'H' if kind == 3 else 'I'}", value).ljust(8 if big else 4, b"\0")
        for tag, kind, value in tags
    )
    head = mark + (struct.pack(f"{order}HHQ", 8, 0, place) if big else struct.pack(f"{order}I", place))
    path = tmp_path / "large.tif"
    path.write_bytes(head.ljust(place, b"\0") + struct.pack(f"{order}{'Q' if big else 'H'}", len(tags)) + entries)
    read: list[int] = []

    def counted(path: Path, most: int | None = None, start: int = 0) -> bytes:
        read.append(place if most is None else most)
        return read_bytes(path, most, start)

    monkeypatch.setattr(photo_file, "read_bytes", counted)
    start = photo_file.start_of_photo(path)
    assert size_of_photo(start) == (53, 37) and may_be_transparent(start)
    assert photo_file.orientation_of_file(path) == 6 and sum(read) < place / 2


@pytest.mark.parametrize("suffix", PHOTO_SUFFIXES)
def test_the_first_bytes_say_that_a_photo_has_8_bits_or_leave_it_open(suffix: str) -> None:
    assert may_have_16_bits(ENCODED[suffix][:25]) == (suffix in (".tif", ".tiff", ".pgm"))
    if suffix in (".png", ".tif", ".tiff", ".pgm"):
        deep = cv2.imencode(suffix, IMAGE[..., 0].astype(np.uint16))[1].tobytes()
        assert may_have_16_bits(deep[:25]) and not may_have_16_bits(b"")


@pytest.mark.parametrize("kind", ENCODED)
def test_a_header_that_is_cut_short_says_nothing_else(kind: str) -> None:
    for length in range(min(len(ENCODED[kind]), 700)):
        assert size_of_photo(ENCODED[kind][:length]) in (None, (53, 37))


def test_what_is_no_photo_has_no_size() -> None:
    rng = np.random.default_rng(0)
    for start in (b"", b"\xff\xd8", b"II*\0", b"BM", b"RIFF\0\0\0\0WEBPVP8 ", b"P5 "):
        for _ in range(200):
            size_of_photo(start + rng.bytes(200))
    assert size_of_photo(b"not a photo") is None


@pytest.mark.parametrize("big", [b"II+\0\x08\0\0\0", b"MM\0+\0\x08\0\0"])
def test_a_directory_beyond_all_files_has_no_size(big: bytes) -> None:
    assert size_of_photo(big + b"\xff" * 8 + bytes(100)) is None


def test_filling_before_the_frame_is_passed_over_at_once() -> None:
    good = ENCODED[".jpg"]
    assert size_of_photo(good[:2] + b"\xff" * 3_000_000 + good[2:]) == (53, 37)
    assert size_of_photo(good[:2] + b"\xff\xe0\0\2" * 300_000) is None


def test_a_bomb_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png(30_000, 30_000, 1, 0))
    assert path.stat().st_size < 200_000
    with pytest.raises(InputError, match=r"bomb.png was expected to have at most 537 megapixels, found 30000 x 30000 px"):
        read_photo(path)


def test_a_photo_larger_than_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png(2000, 1000, 8, 2))
    assert read_photo(path).shape == (1000, 2000, 3)
    monkeypatch.setattr(photo_file, "available_bytes", lambda: 5_000_000)
    with pytest.raises(InputError, match=r"Memory for the image .*large.png of 2000 x 1000 px"):
        read_photo(path)


@pytest.mark.parametrize(("width", "height"), [(1, 100_000), (100_000, 1), (1, 1)])
def test_thin_photos_are_read(tmp_path: Path, width: int, height: int) -> None:
    path = tmp_path / "thin.png"
    path.write_bytes(png(width, height, 8, 0))
    assert read_photo(path).shape == (height, width)


def test_palettes_and_pages(tmp_path: Path) -> None:
    path = tmp_path / "palette.png"
    path.write_bytes(png(64, 48, 1, 3))
    assert read_photo(path).shape == (48, 64, 3)
    pages = tmp_path / "pages.tif"
    assert cv2.imwritemulti(str(pages), [IMAGE] * 100)
    np.testing.assert_array_equal(read_photo(pages), IMAGE)
