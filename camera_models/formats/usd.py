"""Cameras of Isaac Sim and Omniverse as a USD text file (.usda): the lens of a Camera prim by OmniLensDistortion's schemas.

    opencvPinhole    pinhole           fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 (s1 to s4: 0)
    opencvFisheye    opencv-fisheye    fx fy cx cy k1 k2 k3 k4

The corner of the image is (0, 0): the schema's own principal point is half the image's size, and Newton's renderer, which reads
these attributes, looks through u = column + 1/2. A prim looks along -z with y up; its `xformOp:transform` is rig_from_camera by
rows that are multiplied from the left, so that the rig's axes are those of its first camera here (x right, y down, z forward), in
units of `metersPerUnit` (0.01 where a stage does not say). USD keeps these attributes in single precision. Only what this module
writes is read of the language: one attribute a line, in prims `def Camera`; where poses are made of other steps than one matrix
of the camera's own, none are read, and a note says so. "Lens Distortion Schemas" of the ovrtx documentation; `metrics.h` of
UsdGeom; `compute_camera_rays_fisheye_opencv` of newton-physics.
"""

import re
from pathlib import Path
from typing import ClassVar

import torch

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import CalibrationFormat, Content, Documents, left_out
from camera_models.formats.disk import read_text
from camera_models.formats.forms import Form
from camera_models.formats.rig_poses import rig_of, rotation_of_matrix
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import number, numbers, of_text
from camera_models.pose import Pose
from camera_models.wording import listed

_K = ("fx", "fy", "cx", "cy")
_CENTRE = 0.5
"""Of the first pixel, in USD."""
_LENS, _MODEL = "omni:lensdistortion:", "omni:lensdistortion:model"
_SCHEMAS = {"opencvPinhole": "OmniLensDistortionOpenCvPinholeAPI", "opencvFisheye": "OmniLensDistortionOpenCvFisheyeAPI"}
_THIN_PRISM = ("s1", "s2", "s3", "s4")
_TRANSFORM, _ORDER, _APPLIED = "xformOp:transform", "xformOpOrder", "apiSchemas"
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""Between our camera frame and that of a prim, either way."""
_HEAD = '#usda 1.0\n(\n    defaultPrim = "Rig"\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n'
_STEP = re.compile(r"\bxformOp:[\w:]+(?=\s*=)")
_METRES = re.compile(r"^\s*metersPerUnit\s*=\s*(.+?)\s*$", re.M)
_CENTIMETRES = "0.01"
"""Of a stage that does not say: UsdGeomGetStageMetersPerUnit."""
_NEXT = re.compile(r"^\s*(?:def|over|class)\b", re.M)
_PRIM = re.compile(r'^\s*def Camera "([^"\n]+)"', re.M)
_ATTRIBUTE = re.compile(r"^\s*(?:uniform\s+|custom\s+)*[a-z]\w*(?:\[\])?\s+([A-Za-z][\w:]*)\s*=\s*(.+?)\s*$", re.M)


class Usd(CalibrationFormat):
    """A stage with a Camera prim for each camera."""

    NAME = "usd"
    TITLE = "USD"
    SUFFIXES = (".usda",)
    RIGS = True
    NEEDS_RIG = True
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("opencvPinhole", "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), options={"coefficients": 8}),
        Form("opencvFisheye", "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4")),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """USD text."""
        return path.suffix.lower() in self.SUFFIXES and head.startswith("#usda")

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Every prim stands somewhere."""
        return frozenset({"rig"})

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        content = read_text(path)
        begins = list(_PRIM.finditer(content))
        if not content.startswith("#usda") or not begins:
            raise InputError("USD text with a prim `def Camera` was expected, found none; save the stage as .usda.")
        if content.count("{") != content.count("}"):
            raise InputError("USD text was expected with as many { as }, found others: it is cut short; copy it again.")
        cameras: dict[str, CameraModel] = {}
        poses: dict[str, Pose] = {}
        beside: dict[str, list[str]] = {}
        unit = _METRES.search(content[: begins[0].start()])
        unit_m = _number(_CENTIMETRES if unit is None else unit[1], "metersPerUnit")
        if not unit_m > 0:
            raise InputError(f"metersPerUnit must be above 0, found {unit_m:g}; correct it.")
        elsewhere = content
        for begin in begins:
            name = begin[1]
            after = _NEXT.search(content, begin.end())
            own = content[begin.start() : len(content) if after is None else after.start()]
            elsewhere = elsewhere.replace(own, "")
            if name in cameras:
                raise InputError(f"Each camera must be there once, found {name} twice; rename one.")
            attributes = dict(_ATTRIBUTE.findall(own))
            cameras[name], read = self._camera(attributes, name)
            poses[name] = _cam_from_rig(attributes.get(_TRANSFORM), unit_m, name)
            beside[name] = [key for key in attributes if key not in (*read, _MODEL, _TRANSFORM, _ORDER, _APPLIED)]
        steps = set(_STEP.findall(elsewhere)) | {key for keys in beside.values() for key in keys if key.startswith("xformOp:")}
        notes = left_out(beside)
        if steps:
            notes = (
                *notes,
                f"Not kept: the poses, which were expected as one {_TRANSFORM} of each camera, found {listed(sorted(steps))} of "
                "cameras or of prims around them; bake them into one matrix.",
            )
        return Content(Calibration(cameras, rig={} if steps else rig_of(poses)), notes)

    def _camera(self, attributes: dict[str, str], name: str) -> tuple[CameraModel, list[str]]:
        """The camera, and the attributes that it is made of."""
        form = self.form_named(attributes.get(_MODEL, "no lens of OmniLensDistortion").strip('"'), name)
        prefix = f"{_LENS}{form.name}:"
        given = {key.removeprefix(prefix): value for key, value in attributes.items() if key.startswith(prefix)}
        sides = _listed(given.get("imageSize", ""), 2, f"imageSize of {name}")
        size = size_of([int(side) if side == int(side) else side for side in sides], f"imageSize of {name}")
        lost = [key for key in _THIN_PRISM if _number(given.get(key, "0"), f"{key} of {name}") != 0]
        if lost:
            raise InputError(
                f"The lens of {name} was expected without {', '.join(lost)}, for which the camera model has no place."
            )
        # What is not there has the schema's own value, which is not 0.
        absent = [key for key in form.order or () if key not in given]
        if absent:
            raise InputError(f"{prefix}{absent[0]} is missing in {name}; add it.")
        values = {key: _number(given[key], f"{key} of {name}") for key in form.order or ()}
        shifted = [value - _CENTRE if key in ("cx", "cy") else value for key, value in values.items()]
        return form.camera(shifted, size, name), [f"{prefix}{key}" for key in (*values, "imageSize", *_THIN_PRISM)]

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        prims = []
        for index, (name, model) in enumerate(calibration.items()):
            form = self.exact_form(model)
            prefix = f"{_LENS}{form.name}"
            named = dict(zip(form.order or (), form.values(model), strict=True))
            width, height = model.image_size
            pose = calibration.rig[name].cam_from_rig if calibration.rig else Pose.identity()
            lines = [
                f'    def Camera "cam{index}" (',
                f'        prepend {_APPLIED} = ["{_SCHEMAS[form.name]}"]',
                "    )",
                "    {",
                f'        token {_MODEL} = "{form.name}"',
                f"        int2 {prefix}:imageSize = ({width}, {height})",
                *(f"        float {prefix}:{key} = {_moved(key, value)!r}" for key, value in named.items()),
                f"        matrix4d {_TRANSFORM} = {_matrix(pose)}",
                f'        uniform token[] {_ORDER} = ["{_TRANSFORM}"]',
                "    }",
            ]
            prims.append("\n".join(lines))
        inside = "\n\n".join(prims)
        return {path: f'{_HEAD}\ndef Xform "Rig"\n{{\n{inside}\n}}\n'}


def _moved(key: str, value: float) -> float:
    return value + _CENTRE if key in ("cx", "cy") else value


def _matrix(cam_from_rig: Pose) -> str:
    """rig_from_prim, for rows that are multiplied from the left."""
    pose = cam_from_rig.inverse()
    rows = torch.cat([(pose.rotation @ _FLIP).mT, pose.translation[None]]) + 0.0
    ends = (0, 0, 0, 1)
    return (
        f"( {', '.join(f'({row[0]!r}, {row[1]!r}, {row[2]!r}, {end})' for row, end in zip(rows.tolist(), ends, strict=True))} )"
    )


def _cam_from_rig(written: str | None, unit_m: float, name: str) -> Pose:
    if written is None:
        return Pose(_FLIP, torch.zeros(3, dtype=torch.float64)).inverse()
    matrix = numbers(
        [_listed(row, 4, _TRANSFORM) for row in re.findall(r"\([^()]*\)", written)], (4, 4), f"{_TRANSFORM} of {name}"
    )
    rotation = rotation_of_matrix(matrix[:3, :3].T, f"{_TRANSFORM} of {name}")
    return Pose.of(torch.as_tensor(rotation) @ _FLIP, torch.as_tensor(matrix[3, :3] * unit_m)).inverse()


def _listed(written: str, count: int, where: str) -> list[float]:
    """The numbers of (a, b, ...)."""
    parts = written.strip().removeprefix("(").removesuffix(")").split(",")
    if len(parts) != count:
        raise InputError(f"{where} must be {count} numbers, found {written[:60] or 'none'}; correct it.")
    return [_number(part, where) for part in parts]


def _number(cell: str, where: str) -> float:
    try:
        return number(of_text(cell.strip()), where)
    except ValueError:
        raise InputError(f"{where} must be a number, found {cell[:60]}; correct it.") from None
