"""COLMAP's cameras.txt or cameras.bin, and rigs.txt or rigs.bin beside (from COLMAP 3.12 on).

    cameras    CAMERA_ID MODEL WIDTH HEIGHT PARAMS...
    rigs       RIG_ID NUM_SENSORS REF_TYPE REF_ID (TYPE ID HAS_POSE [QW QX QY QZ TX TY TZ])...       sensor_from_rig

The upper left corner of the image is (0, 0) there, so centres are ours plus 0.5. A camera is called by its id. The division model
is the polynomial one of degree 2: k = a0 a2; THIN_PRISM_FISHEYE is read as what is nearest to it. COLMAP's code sees nothing at
z <= 0 through any model but EQUIRECTANGULAR.
COLMAP documentation, "output format" and "camera models"; `colmap_files` has the layout of the binary files.
"""

from pathlib import Path
from typing import ClassVar

from camera_models._model import CameraModel
from camera_models.equirectangular import Equirectangular
from camera_models.errors import InputError
from camera_models.fisheye624 import Fisheye624
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.colmap_files import (
    CAMERA,
    MODELS,
    CameraRecord,
    RigRecord,
    SensorRecord,
    read_cameras,
    read_rigs,
    write_cameras,
    write_rigs,
)
from camera_models.formats.colmap_lens import nearest_thin_prism_fisheye
from camera_models.formats.contract import CalibrationFormat, Content, Documents, is_folder
from camera_models.formats.forms import Form
from camera_models.formats.nearest import Nearest, told
from camera_models.formats.rig_poses import pose_of_quaternion, quaternion_of_pose, rig_of
from camera_models.pose import Pose
from camera_models.scaramuzza import Scaramuzza
from camera_models.wording import listed

_K = ("fx", "fy", "cx", "cy")
_F = ("f", "cx", "cy")
_RAD_TAN = "RAD_TAN_THIN_PRISM_FISHEYE"
_BROWN = ("k1", "k2", "p1", "p2")
_CENTRE = 0.5
"""Of the first pixel, in COLMAP."""


class Colmap(CalibrationFormat):
    """A folder with cameras.txt or cameras.bin, or one of these files."""

    NAME = "colmap"
    TITLE = "COLMAP"
    SUFFIXES = (".txt", ".bin")
    RIGS = True
    FOLDERS = True
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("SIMPLE_PINHOLE", "pinhole", _F, ends_deg=90.0),
        Form("PINHOLE", "pinhole", _K, ends_deg=90.0),
        Form("SIMPLE_RADIAL", "pinhole", (*_F, "k1"), ends_deg=90.0),
        Form("RADIAL", "pinhole", (*_F, "k1", "k2"), ends_deg=90.0),
        Form("OPENCV", "pinhole", (*_K, *_BROWN), ends_deg=90.0),
        Form("FULL_OPENCV", "pinhole", (*_K, *_BROWN, "k3", "k4", "k5", "k6"), options={"coefficients": 8}, ends_deg=90.0),
        Form("SIMPLE_FISHEYE", "opencv-fisheye", _F, ends_deg=90.0),
        Form("FISHEYE", "opencv-fisheye", _K, ends_deg=90.0),
        Form("SIMPLE_RADIAL_FISHEYE", "opencv-fisheye", (*_F, "k1"), ends_deg=90.0),
        Form("RADIAL_FISHEYE", "opencv-fisheye", (*_F, "k1", "k2"), ends_deg=90.0),
        Form("OPENCV_FISHEYE", "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4"), ends_deg=90.0),
        Form(_RAD_TAN, "fisheye624", Fisheye624.PARAMETER_NAMES, ends_deg=90.0, on_request=True),
        Form(
            "DIVISION",
            "scaramuzza",
            ("cx", "cy", "c", "a0", "a2"),
            fixed={"d": 0.0, "e": 0.0},
            positive=("a0", "c"),
            options={"degree": 2},
            ends_deg=90.0,
        ),
        Form("EUCM", "extended-unified", (*_K, "alpha", "beta"), ends_deg=90.0),
        Form("EQUIRECTANGULAR", "equirectangular", ()),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """By the name of the file, or that a folder holds it."""
        if path.is_dir():
            return any((path / name).is_file() for name in ("cameras.bin", "cameras.txt"))
        if path.suffix.lower() == ".bin":
            return path.name.lower().startswith("cameras")
        rows = [line.split() for line in head.splitlines() if line.strip() and not line.startswith("#")]
        return bool(rows) and len(rows[0]) > 4 and rows[0][1] in MODELS

    def names(self, calibration: Calibration) -> list[str]:
        """The ids."""
        return [str(number) for number in _ids(calibration)]

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        file = _in_folder(path) if path.is_dir() else path
        records = read_cameras(file)
        cameras, estimates, notes = told({str(record.id): self._camera(record) for record in records})
        beside = file.with_name(file.name.replace("cameras", "rigs"))
        if beside == file or not beside.is_file():
            return Content(Calibration(cameras, estimates), notes)
        rigs = [rig for rig in read_rigs(beside) if len(rig.sensors) > 1]
        poses, note = _poses(rigs, list(cameras))
        return Content(Calibration(cameras, estimates, rig_of(poses)), (*notes, note) if note else notes)

    def _camera(self, record: CameraRecord) -> CameraModel | Nearest:
        where = f"camera {record.id}"
        size = (record.width, record.height)
        values = list(record.parameters)
        if record.model == "EQUIRECTANGULAR":
            if tuple(values) != size:
                raise InputError(
                    f"The panorama of {where} must fill its image of {size[0]} x {size[1]} px, found {listed(values)}; crop it."
                )
            return Equirectangular([], size)
        if record.model in ("DIVISION", "SIMPLE_DIVISION"):
            return _of_division(record)
        if record.model == "THIN_PRISM_FISHEYE":
            return nearest_thin_prism_fisheye(values, (values[2] - _CENTRE, values[3] - _CENTRE), size)
        model = self.form_named(record.model, where).camera(values, size, where)
        named = model.named_parameters()
        return type(model).from_mapping(named | {key: named[key] - _CENTRE for key in ("cx", "cy")}, size)

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        file = path / "cameras.txt" if is_folder(path) else path
        ids = _ids(calibration)
        binary = file.suffix.lower() == ".bin"
        records = [self._record(number, model) for number, model in zip(ids, calibration.values(), strict=True)]
        whole: Documents = {file: write_cameras(records, binary)}
        if calibration.rig:
            beside = file.with_name(file.name.replace("cameras", "rigs") if "cameras" in file.name else f"rigs{file.suffix}")
            whole[beside] = write_rigs([_rig_record(ids, calibration)], binary)
        stale = [
            other
            for name in ("cameras.bin", "rigs.bin", "cameras.txt", "rigs.txt")
            if (other := file.with_name(name)) not in whole and other.exists() and file.stem == "cameras"
        ]
        if stale:
            raise InputError(
                f"A folder without files of another calibration was expected, found {listed(stale)}, which COLMAP would read "
                "with the new ones; remove them or give another path."
            )
        return whole

    def _record(self, number: int, model: CameraModel) -> CameraRecord:
        form = self.exact_form(model)
        width, height = model.image_size
        if isinstance(model, Equirectangular):
            values = [float(width), float(height)]
        elif isinstance(model, Scaramuzza):
            cx, cy, c, a0, a2 = form.values(model)
            values = [a0, a0 * c, cx + _CENTRE, cy + _CENTRE, a0 * a2]
        else:
            order = form.order or ()
            values = [
                value + (_CENTRE if name in ("cx", "cy") else 0.0) for name, value in zip(order, form.values(model), strict=True)
            ]
        return CameraRecord(number, form.name, width, height, tuple(values))


def _in_folder(folder: Path) -> Path:
    # The order in which COLMAP itself looks.
    for name in ("cameras.bin", "cameras.txt"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{folder}: cameras.bin or cameras.txt was expected, found neither; name a COLMAP model.")


def _of_division(record: CameraRecord) -> Scaramuzza:
    values = list(record.parameters)
    if record.model == "SIMPLE_DIVISION":
        values.insert(0, values[0])
    fx, fy, cx, cy, k = values
    return Scaramuzza([cx - _CENTRE, cy - _CENTRE, fy / fx, 0.0, 0.0, fx, k / fx], (record.width, record.height))


def _ids(calibration: Calibration) -> list[int]:
    """The names where they are ids, as in a calibration that was read from COLMAP, else 1, 2, ..."""
    names = list(calibration)
    if all(name.isdecimal() and str(int(name)) == name and 0 < int(name) < 2**32 - 1 for name in names):
        return [int(name) for name in names]
    return list(range(1, len(names) + 1))


def _rig_record(ids: list[int], calibration: Calibration) -> RigRecord:
    poses = [calibration.rig[name].cam_from_rig for name in calibration]
    first = poses[0].inverse()
    sensors = [SensorRecord(CAMERA, ids[0], None)]
    for number, pose in zip(ids[1:], poses[1:], strict=True):
        relative = pose @ first
        sensors.append(SensorRecord(CAMERA, number, (*quaternion_of_pose(relative), *relative.translation.tolist())))
    return RigRecord(1, tuple(sensors))


def _poses(rigs: list[RigRecord], names: list[str]) -> tuple[dict[str, Pose], str | None]:
    """cam_from_rig of all cameras; none, and why, where the rigs of the file are not one rig of all cameras."""
    if not rigs:
        return {}, None
    (rig, *others) = rigs
    cameras = {str(sensor.id): sensor for sensor in rig.sensors if sensor.type == CAMERA}
    if others or set(cameras) != set(names):
        return {}, "Not kept: the rigs, which are not one rig of all cameras; here a rig has every camera of the file."
    reference = rig.sensors[0]
    if any(sensor.pose is None for sensor in rig.sensors[1:]):
        return {}, "Not kept: the rig, in which the pose of a camera is not known."
    poses = {str(reference.id): Pose.identity()} if reference.type == CAMERA else {}
    for sensor in cameras.values():
        if sensor.pose is not None:
            poses[str(sensor.id)] = pose_of_quaternion(list(sensor.pose[:4]), list(sensor.pose[4:]), f"camera {sensor.id}")
    return {name: poses[name] for name in names}, None
