"""Messages of ROS 1 and 2 for tests, as rosbags writes them."""

from typing import Any

import cv2
import numpy as np
from rosbags.typesys import Stores, get_typestore

ROS = {"ros1": get_typestore(Stores.ROS1_NOETIC), "cdr": get_typestore(Stores.ROS2_HUMBLE)}


def header(store: Any, stamp_ns: int) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    more = {"seq": 0} if "seq" in store.types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id="cam", **more)


def raw(store: Any, stamp_ns: int, pixels: np.ndarray, encoding: str, padding: int = 0, big: bool = False) -> Any:
    """sensor_msgs/Image; `padding` bytes end each row."""
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(len(pixels), -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, padding)))
    h, w = pixels.shape[:2]
    kind = store.types["sensor_msgs/msg/Image"]
    return kind(header(store, stamp_ns), h, w, encoding, int(big), data.shape[1], data.ravel())


def packed(store: Any, stamp_ns: int, pixels: np.ndarray, suffix: str, encoding: str) -> Any:
    """sensor_msgs/CompressedImage."""
    data = cv2.imencode(suffix, pixels)[1].ravel()
    return store.types["sensor_msgs/msg/CompressedImage"](header(store, stamp_ns), encoding, data)
