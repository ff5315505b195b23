"""The cameras and rigs files of COLMAP as records, text and binary (little endian):

cameras.bin   uint64 count; each: uint32 id, int32 model, uint64 width, uint64 height, float64 parameters
rigs.bin      uint64 count; each: uint32 id, uint32 sensors; the reference: int32 type, uint32 id; the others: the same, and
              uint8 whether a pose follows, float64 qw qx qy qz tx ty tz
"""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes, read_text
from camera_models.formats.values import of_text

MODELS: dict[str, int] = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12,
    "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6, "EQUIRECTANGULAR": 2,
}  # fmt: skip
"""Number of parameters of COLMAP's models, in the order of their ids from 0."""
CAMERA = "CAMERA"
_SENSORS = (CAMERA, "IMU")


@dataclass(frozen=True)
class CameraRecord:
    """One camera, in COLMAP's own terms."""

    id: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class SensorRecord:
    """One sensor of a rig."""

    type: str
    id: int
    pose: tuple[float, ...] | None
    """sensor_from_rig: qw qx qy qz tx ty tz; None for the reference, and where it is not known."""


@dataclass(frozen=True)
class RigRecord:
    """One rig; the first sensor is its frame."""

    id: int
    sensors: tuple[SensorRecord, ...]


def read_cameras(path: Path) -> list[CameraRecord]:
    """The cameras of cameras.txt or cameras.bin; raises InputError with what was expected."""
    records = list(_cameras_of_bytes(_bytes(path)) if path.suffix.lower() == ".bin" else map(_camera_of_row, _rows(path)))
    if not records:
        raise InputError(f"{path} must hold at least one camera, found none; name another file.")
    if len({record.id for record in records}) < len(records):
        raise InputError(f"{path}: every camera must have its own id, found one twice; correct the file.")
    for record in records:
        if record.width < 1 or record.height < 1 or not all(map(math.isfinite, record.parameters)):
            raise InputError(
                f"{path}: camera {record.id} must have a size and finite parameters, found others; correct the file."
            )
    return records


def read_rigs(path: Path) -> list[RigRecord]:
    """The rigs of rigs.txt or rigs.bin; raises InputError with what was expected."""
    records = list(_rigs_of_bytes(_bytes(path)) if path.suffix.lower() == ".bin" else map(_rig_of_row, _rows(path)))
    sensors = [(sensor.type, sensor.id) for record in records for sensor in record.sensors]
    if len(set(sensors)) < len(sensors):
        raise InputError(f"{path}: every sensor must be in one rig once, found one twice; correct the file.")
    return records


def write_cameras(records: Sequence[CameraRecord], binary: bool) -> str | bytes:
    """cameras.bin or cameras.txt."""
    if binary:
        known = list(MODELS)
        parts = [struct.pack("<Q", len(records))]
        for record in records:
            parts.append(struct.pack("<IiQQ", record.id, known.index(record.model), record.width, record.height))
            parts.append(struct.pack(f"<{len(record.parameters)}d", *record.parameters))
        return b"".join(parts)
    lines = ["# Cameras: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines += [_row(r.id, r.model, r.width, r.height, *map(repr, r.parameters)) for r in records]
    return "\n".join(lines) + "\n"


def write_rigs(records: Sequence[RigRecord], binary: bool) -> str | bytes:
    """rigs.bin or rigs.txt."""
    if binary:
        parts = [struct.pack("<Q", len(records))]
        for record in records:
            parts.append(struct.pack("<II", record.id, len(record.sensors)))
            for index, sensor in enumerate(record.sensors):
                parts.append(struct.pack("<iI", _SENSORS.index(sensor.type), sensor.id))
                if index:
                    parts.append(struct.pack("<B", sensor.pose is not None))
                    parts.append(struct.pack(f"<{len(sensor.pose or ())}d", *(sensor.pose or ())))
        return b"".join(parts)
    lines = ["# Rigs: RIG_ID, NUM_SENSORS, REF_TYPE, REF_ID, SENSORS[] (TYPE, ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])"]
    for record in records:
        cells: list[Any] = [record.id, len(record.sensors)]
        for index, sensor in enumerate(record.sensors):
            cells += [sensor.type, sensor.id]
            if index:
                cells += [int(sensor.pose is not None), *map(repr, sensor.pose or ())]
        lines.append(_row(*cells))
    return "\n".join(lines) + "\n"


def _row(*cells: Any) -> str:
    return " ".join(map(str, cells))


def _rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    for at, line in enumerate(read_text(path).splitlines()):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{path}, line {at + 1}", line.split()


def _converted(where: str, what: str, convert: Callable[[str], Any], cells: Sequence[str]) -> list[Any]:
    try:
        return [convert(cell) for cell in cells]
    except ValueError:
        raise InputError(f"{where} must hold {what}, found '{' '.join(cells)[:60]}'; correct it.") from None


def _camera_of_row(row: tuple[str, list[str]]) -> CameraRecord:
    where, cells = row
    if len(cells) < 4:
        raise InputError(f"{where} must hold CAMERA_ID MODEL WIDTH HEIGHT PARAMS..., found {len(cells)} cells; correct it.")
    number, width, height = _converted(where, "whole numbers", partial(of_text, kind=int), [cells[0], *cells[2:4]])
    count = _count(cells[1], where)
    if len(cells) != 4 + count:
        raise InputError(f"{where} must hold {count} parameters for {cells[1]}, found {len(cells) - 4}; correct it.")
    return CameraRecord(number, cells[1], width, height, tuple(_converted(where, "numbers", of_text, cells[4:])))


def _count(model: str, where: str) -> int:
    if model not in MODELS:
        raise InputError(f"{where} must name a camera model of COLMAP ({', '.join(MODELS)}), found {model}; correct it.")
    return MODELS[model]


def _rig_of_row(row: tuple[str, list[str]]) -> RigRecord:
    where, cells = row
    at, sensors = 2, []
    try:
        number, count = int(cells[0]), int(cells[1])
        for index in range(count):
            kind, own = cells[at], int(cells[at + 1])
            known = index > 0 and cells[at + 2] == "1"
            at += 3 if index else 2
            pose = tuple(map(of_text, cells[at : at + 7])) if known else None
            if known and len(pose or ()) < 7:
                raise IndexError
            at += 7 if known else 0
            sensors.append(SensorRecord(kind, own, pose))
    except (IndexError, ValueError):
        at = -1
    if at != len(cells):
        raise InputError(f"{where} must hold RIG_ID NUM_SENSORS and the sensors with their poses, found another row; correct it.")
    return RigRecord(number, tuple(sensors))


def _bytes(path: Path) -> "_Reader":
    return _Reader(path, read_bytes(path))


class _Reader:
    """Little-endian values one after the other."""

    def __init__(self, path: Path, content: bytes) -> None:
        self.path, self.content, self.at = path, content, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(f"<{layout}")
        if self.at + size > len(self.content):
            raise InputError(f"{self.path} ends in the middle of a record, after {len(self.content)} bytes; restore the file.")
        values = struct.unpack_from(f"<{layout}", self.content, self.at)
        self.at += size
        return values

    def end(self) -> None:
        if self.at != len(self.content):
            raise InputError(
                f"{self.path} must end after its records, found {len(self.content) - self.at} more bytes; restore the file."
            )


def _cameras_of_bytes(reader: _Reader) -> Iterator[CameraRecord]:
    known = list(MODELS)
    for _ in range(reader.take("Q")[0]):
        number, kind, width, height = reader.take("IiQQ")
        if not 0 <= kind < len(known):
            raise InputError(
                f"{reader.path}: camera {number} must be of a model from 0 to {len(known) - 1}, found {kind}; restore the file."
            )
        yield CameraRecord(number, known[kind], width, height, reader.take(f"{MODELS[known[kind]]}d"))
    reader.end()


def _rigs_of_bytes(reader: _Reader) -> Iterator[RigRecord]:
    for _ in range(reader.take("Q")[0]):
        number, count = reader.take("II")
        sensors: list[SensorRecord] = []
        for index in range(count):
            kind, own = reader.take("iI")
            if not 0 <= kind < len(_SENSORS):
                raise InputError(f"{reader.path}: a sensor must be a camera or an IMU, found type {kind}; restore the file.")
            pose = reader.take("7d") if index and reader.take("B")[0] else None
            sensors.append(SensorRecord(_SENSORS[kind], own, pose))
        yield RigRecord(number, tuple(sensors))
    reader.end()
