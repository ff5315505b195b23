"""What a message of a bag says: when its image was taken, and the image, 8 bits BGR as frames of videos are.

    sensor_msgs/Image, CompressedImage        ROS 1 and 2; foxglove's CompressedImage also as protobuf or JSON in MCAP

Fields are those of ROS's and Foxglove's public message definitions. Encodings are those of sensor_msgs/image_encodings.h; images
of 16 bits are stretched to 8 from the darkest of their pixels to the brightest.
"""

import base64
import functools
import json
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt, UInt8

from camera_models.errors import InputError
from omnilines.photo_file import decoded_photo, eight_bits

RAW, PACKED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
FOXGLOVE = ("foxglove.CompressedImage", "foxglove_msgs/msg/CompressedImage")
IMAGE_TYPES = (RAW, PACKED, *FOXGLOVE)
FOXGLOVE_FIELDS = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"

_ENCODINGS: dict[str, tuple[int, type, int | None]] = {
    # channels, type of a value, conversion to BGR (none: as it is)
    **dict.fromkeys(("mono8", "8UC1"), (1, np.uint8, cv2.COLOR_GRAY2BGR)),
    **dict.fromkeys(("mono16", "16UC1"), (1, np.uint16, cv2.COLOR_GRAY2BGR)),
    **dict.fromkeys(("bgr8", "8UC3"), (3, np.uint8, None)),
    **dict.fromkeys(("bgr16", "16UC3"), (3, np.uint16, None)),
    "rgb8": (3, np.uint8, cv2.COLOR_RGB2BGR),
    "rgb16": (3, np.uint16, cv2.COLOR_RGB2BGR),
    **dict.fromkeys(("bgra8", "8UC4"), (4, np.uint8, cv2.COLOR_BGRA2BGR)),
    "rgba8": (4, np.uint8, cv2.COLOR_RGBA2BGR),
    **dict.fromkeys(("yuv422", "uyvy"), (2, np.uint8, cv2.COLOR_YUV2BGR_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, np.uint8, cv2.COLOR_YUV2BGR_YUY2)),
    **{
        f"bayer_{order}{bits}": (1, kind, conversion)
        for order, conversion in (
            ("rggb", cv2.COLOR_BayerRGGB2BGR),
            ("bggr", cv2.COLOR_BayerBGGR2BGR),
            ("gbrg", cv2.COLOR_BayerGBRG2BGR),
            ("grbg", cv2.COLOR_BayerGRBG2BGR),
        )
        for bits, kind in ((8, np.uint8), (16, np.uint16))
    },
}


class BagImage(NamedTuple):
    """An image and when it was taken."""

    stamp_ns: int
    """Of its header; 0 where none was set."""
    pixels: UInt8[np.ndarray, "h w 3"]
    """BGR."""


def image_of(kind: str, encoding: str, data: bytes) -> BagImage:
    """The image in a message of a type (one of IMAGE_TYPES), as serialised. Raises InputError where there is none."""
    try:
        if kind in FOXGLOVE and encoding in ("protobuf", "json"):
            stamp_ns, packed = (_from_protobuf if encoding == "protobuf" else _from_json)(data)
            return BagImage(stamp_ns, _bgr8(decoded_photo(packed, "in the message"), None))
        message = _read(encoding)(data, FOXGLOVE[1] if kind in FOXGLOVE else kind)
        stamp = message.timestamp if kind in FOXGLOVE else message.header.stamp
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        return BagImage(stamp_ns, _raw(message) if kind == RAW else _packed(message))
    except InputError:
        raise
    except Exception as error:
        # Whatever rosbags raises over bytes that are no such message.
        raise InputError("A message of an image was expected, found one that is damaged or cut short; record again.") from error


def _raw(message: Any) -> UInt8[np.ndarray, "h w 3"]:
    width, height, step = int(message.width), int(message.height), int(message.step)
    if message.encoding not in _ENCODINGS:
        raise InputError(
            f"An image was expected as one of {', '.join(_ENCODINGS)}, found {str(message.encoding)[:40]!r}; choose another "
            "topic."
        )
    channels, kind, conversion = _ENCODINGS[message.encoding]
    row = width * channels * np.dtype(kind).itemsize
    if min(width, height) < 1 or step < row or len(message.data) < step * (height - 1) + row:
        raise InputError(
            f"An image of {width} x {height} px was expected in {message.encoding}, found {len(message.data)} bytes in rows of "
            f"{step}; record again."
        )
    # The last row need not be filled up to the step.
    values = np.zeros(step * height, np.uint8)
    values[: len(message.data)] = message.data[: step * height]
    rows = np.ascontiguousarray(values.reshape(height, step)[:, :row])
    stored = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    pixels: UInt[np.ndarray, "h w *channels"] = (
        rows.view(stored).astype(kind).reshape(height, width, *((channels,) if channels > 1 else ()))
    )
    return _bgr8(pixels, conversion)


def _packed(message: Any) -> UInt8[np.ndarray, "h w 3"]:
    pixels = decoded_photo(message.data.tobytes(), "in the message")
    # image_transport packs a mosaic as it is, and says so before the semicolon.
    channels, _, conversion = _ENCODINGS.get(message.format.partition(";")[0].strip(), (3, None, None))
    return _bgr8(pixels, conversion if channels == 1 and message.format.startswith("bayer_") and pixels.ndim == 2 else None)


def _bgr8(pixels: UInt[np.ndarray, "h w *channels"], conversion: int | None) -> UInt8[np.ndarray, "h w 3"]:
    pixels = eight_bits(pixels)
    if conversion is None and pixels.ndim == 2:
        conversion = cv2.COLOR_GRAY2BGR
    return np.asarray(pixels if conversion is None else cv2.cvtColor(pixels, conversion), dtype=np.uint8)


@functools.cache
def _read(encoding: str) -> Callable[[bytes, str], Any]:
    """What reads messages of ROS. The definitions are rosbags' own: those in a bag are not looked at."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if encoding == "ros1":
        return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
    if encoding != "cdr":
        raise InputError(f"Messages were expected in ros1, cdr, protobuf or json, found {encoding[:40]!r}; choose another topic.")
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(FOXGLOVE_FIELDS, FOXGLOVE[1]))
    return store.deserialize_cdr


def _from_json(data: bytes) -> tuple[int, bytes]:
    message = json.loads(data)
    stamp = message.get("timestamp") or {}
    return int(stamp.get("sec", 0)) * 1_000_000_000 + int(stamp.get("nsec", 0)), base64.b64decode(message["data"])


def _from_protobuf(data: bytes) -> tuple[int, bytes]:
    """Field 1 is the time (1: s, 2: ns), field 2 the image."""
    fields = dict(_protobuf_fields(data))
    stamp = dict(_protobuf_fields(fields.get(1, b"")))
    return int(stamp.get(1, 0)) * 1_000_000_000 + int(stamp.get(2, 0)), bytes(fields[2])


def _protobuf_fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """The fields of a message: numbers of varints, bytes of all that has a length. Raises ValueError or IndexError elsewhere."""
    place = 0

    def varint() -> int:
        """The number at `place`, which moves behind it."""
        nonlocal place
        value = shift = 0
        while True:
            byte = data[place]
            place += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80 or shift > 63:
                return value

    while place < len(data):
        number, wire = divmod(varint(), 8)
        if wire == 0:
            yield number, varint()
        elif wire in (1, 2, 5):
            size = varint() if wire == 2 else 8 if wire == 1 else 4
            if place + size > len(data):
                raise ValueError("cut short")
            yield number, data[place : place + size]
            place += size
        else:
            raise ValueError("no protobuf")
