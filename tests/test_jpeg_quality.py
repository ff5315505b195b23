"""The quality of a JPEG is known from its tables, and low ones are named."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import omnilines as ol
from camera_models import Pinhole
from omnilines.photo_size import jpeg_quality

SIZE = (320, 240)
CAMERA = Pinhole([300.0, 300.0, 159.5, 119.5, *[0.0] * 9], SIZE)


def photo() -> np.ndarray:
    image = np.full(SIZE[::-1], 60, dtype=np.uint8)
    cv2.fillConvexPoly(image, np.array([[60, 50], [250, 62], [244, 190], [76, 176]]), 190)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def encoded(quality: int) -> bytes:
    return bytes(cv2.imencode(".jpg", photo(), [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())


@pytest.mark.parametrize("quality", [20, 50, 60, 75, 90, 95])
def test_the_quality_that_a_jpeg_was_saved_with_is_found(quality: int) -> None:
    assert jpeg_quality(encoded(quality)) == pytest.approx(quality, abs=1)


def test_what_is_no_jpeg_or_cut_short_has_no_quality() -> None:
    assert jpeg_quality(cv2.imencode(".png", photo())[1].tobytes()) is None
    whole = encoded(60)
    assert [jpeg_quality(whole[:length]) for length in (2, 5, 21, 40)] == [None] * 4


def test_photos_of_low_quality_are_named(tmp_path: Path) -> None:
    """Lines of ten such photos were found half as often, and nothing said why."""
    for name, quality in (("a.jpg", 60), ("b.jpg", 95), ("c.jpg", 70)):
        (tmp_path / name).write_bytes(encoded(quality))
    (note,) = ol.extract(tmp_path, CAMERA).notes
    assert note.startswith("2 of 3 photos are JPEG of low quality (a.jpg: 60 of 100)")
    assert not ol.extract(tmp_path, CAMERA, options=ol.ExtractionOptions(coarse_jpeg_quality=50)).notes
