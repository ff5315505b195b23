"""Images in bags: every encoding gives the grey levels or colours that went in."""

import cv2
import numpy as np
import pytest
from bag_messages import ROS, packed, raw

from omnilines.files.bag_images import image_of

COLOURS = np.random.default_rng(1).integers(0, 255, (24, 32, 3), dtype=np.uint8)


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "bgra8", "rgba8", "8UC3", "mono8", "8UC1", "bgr16", "rgb16"])
@pytest.mark.parametrize("big", [False, True])
def test_encodings(encoding: str, big: bool) -> None:
    bgr = COLOURS if "bgr" in encoding or encoding == "8UC3" else COLOURS[..., ::-1]
    stored = bgr if "8" in encoding else bgr.astype(np.uint16) * 257
    if encoding.endswith("a8"):
        stored = np.concatenate([stored, np.full((24, 32, 1), 9, np.uint8)], 2)
    single = encoding in ("mono8", "8UC1")
    store = ROS["cdr"]
    message = raw(store, 5, stored[..., 0] if single else stored, encoding, padding=6, big=big)
    found = image_of(message.__msgtype__, "cdr", bytes(store.serialize_cdr(message, message.__msgtype__)))
    wanted = np.repeat(stored[..., :1], 3, 2) if single else COLOURS
    full = "16" in encoding and (COLOURS.min() > 0 or COLOURS.max() < 255)
    assert found.stamp_ns == 5 and np.abs(found.pixels.astype(int) - wanted).max() <= (3 if full else 0)


def test_sixteen_bits_are_stretched() -> None:
    thermal = np.linspace(7000, 8000, 24 * 32).reshape(24, 32).astype(np.uint16)
    store = ROS["ros1"]
    for message in (raw(store, 0, thermal, "mono16"), packed(store, 0, thermal, ".png", "16UC1; png compressed")):
        found = image_of(message.__msgtype__, "ros1", bytes(store.serialize_ros1(message, message.__msgtype__)))
        assert found.pixels.min() == 0 and found.pixels.max() == 255
        assert np.abs(found.pixels[..., 1] - 255 * (thermal - 7000.0) / 1000.0).max() <= 1.0


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("how", ["8", "16", "png"])
def test_mosaics(order: str, how: str) -> None:
    """Of a plain colour, each place of the mosaic holds the value of its letter."""
    value = {"r": 200, "g": 120, "b": 40}
    mosaic = np.tile(np.array([value[letter] for letter in order], np.uint8).reshape(2, 2), (12, 16))
    store = ROS["cdr"]
    if how == "png":
        message = packed(store, 0, mosaic, ".png", f"bayer_{order}8; png compressed ")
    else:
        message = raw(store, 0, mosaic if how == "8" else mosaic.astype(np.uint16) * 257, f"bayer_{order}{how}")
    found = image_of(message.__msgtype__, "cdr", bytes(store.serialize_cdr(message, message.__msgtype__)))
    colour = found.pixels[8, 8].astype(float)
    wanted = np.array([40, 120, 200.0])
    assert np.allclose(colour, wanted if how != "16" else (wanted - 40) * 255 / 160, atol=1.0)


def test_packed_yuv_and_jpeg() -> None:
    store = ROS["cdr"]
    smooth = cv2.resize(COLOURS[:3, :4], (32, 24), interpolation=cv2.INTER_CUBIC)
    jpeg = packed(store, 0, smooth, ".jpg", "rgb8; jpeg compressed bgr8")
    found = image_of(jpeg.__msgtype__, "cdr", bytes(store.serialize_cdr(jpeg, jpeg.__msgtype__)))
    assert np.abs(found.pixels.astype(int) - smooth).mean() < 4
    for encoding, conversion in (("yuv422", cv2.COLOR_BGR2YUV_UYVY), ("yuv422_yuy2", cv2.COLOR_BGR2YUV_YUY2)):
        message = raw(store, 0, cv2.cvtColor(smooth, conversion), encoding)
        found = image_of(message.__msgtype__, "cdr", bytes(store.serialize_cdr(message, message.__msgtype__)))
        assert np.abs(found.pixels.astype(int) - smooth).mean() < 4
