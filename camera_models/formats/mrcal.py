"""mrcal's .cameramodel: a Python dict literal, one camera a file.

    'lensmodel'    LENSMODEL_PINHOLE, LENSMODEL_STEREOGRAPHIC, LENSMODEL_OPENCV4, 5, 8 or 12
    'intrinsics'   fx fy cx cy and the distortion in OpenCV's order (12: with four thin-prism terms)
    'extrinsics'   rotation vector (rad) and translation (m) that take the reference frame to the camera
    'imagersize'   width height

mrcal documentation, "lens models", "camera model file formats" and "conventions"; pixels are OpenCV's. Its stereographic model,
2 tan(theta / 2) times the focal length, is the unified one with xi = 1 and twice the focal length.
"""

import ast
from pathlib import Path
from typing import Any, ClassVar

from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import DEFAULT_NAME, CalibrationFormat, Content, Documents
from camera_models.formats.disk import read_text
from camera_models.formats.forms import Form
from camera_models.formats.rig_poses import pose_of_vectors, rig_of, vectors_of_pose
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import items, mapping, number, numbers, required, text
from camera_models.pose import Pose
from camera_models.wording import listed

_K = ("fx", "fy", "cx", "cy")
_STEREOGRAPHIC = "LENSMODEL_STEREOGRAPHIC"
_LENS_KEYS = ("lensmodel", "lens_model", "distortion_model")
"""Newest first; the oldest writes DISTORTION_ for LENSMODEL_."""


class Mrcal(CalibrationFormat):
    """.cameramodel."""

    NAME = "mrcal"
    TITLE = "mrcal"
    SUFFIXES = (".cameramodel",)
    RIGS = True
    TOGETHER = False
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("LENSMODEL_PINHOLE", "pinhole", _K),
        Form("LENSMODEL_OPENCV4", "pinhole", (*_K, "k1", "k2", "p1", "p2")),
        Form("LENSMODEL_OPENCV5", "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3")),
        Form("LENSMODEL_OPENCV8", "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), options={"coefficients": 8}),
        Form(_STEREOGRAPHIC, "unified", _K, fixed={"xi": 1.0}),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """The suffix, or the keys of the dict."""
        return path.suffix.lower() in self.SUFFIXES or ("'imagersize'" in head and "'intrinsics'" in head)

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Every file says where its camera stands."""
        return frozenset({"rig"})

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = mapping(_literal(path), "the file")
        key = next((key for key in _LENS_KEYS if key in data), _LENS_KEYS[0])
        name = text(required(data, key, "the file"), key).replace("DISTORTION_", "LENSMODEL_")
        values = [number(item, "intrinsics") for item in _list(required(data, "intrinsics", "the file"), "intrinsics")]
        size = size_of(_list(required(data, "imagersize", "the file"), "imagersize"), "imagersize")
        if name == "LENSMODEL_OPENCV12":
            if any(values[12:]):
                raise InputError(
                    f"LENSMODEL_OPENCV12 was expected without thin-prism terms, found {listed(values[12:])}; convert it to "
                    "LENSMODEL_OPENCV8 with mrcal-convert-lensmodel."
                )
            name, values = "LENSMODEL_OPENCV8", values[:12]
        if name == _STEREOGRAPHIC and len(values) == 4:
            values = [2 * values[0], 2 * values[1], *values[2:]]
        camera = self.form_named(name, "the file").camera(values, size, "the file")
        rig: dict[str, Pose] = {}
        if data.get("extrinsics") is not None:
            vector = numbers(_list(data["extrinsics"], "extrinsics"), (6,), "extrinsics").tolist()
            rig = {DEFAULT_NAME: pose_of_vectors(vector[:3], vector[3:])}
        beside = [item for item in data if item not in (*_LENS_KEYS, "intrinsics", "extrinsics", "imagersize")]
        notes = (f"Not kept: {listed(beside)}.",) if beside else ()
        return Content(Calibration({DEFAULT_NAME: camera}, rig=rig_of(rig)), notes)

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        ((name, model),) = calibration.items()
        form = self.exact_form(model)
        values = form.values(model)
        if form.name == _STEREOGRAPHIC:
            values = [values[0] / 2, values[1] / 2, *values[2:]]
        pose = calibration.rig[name].cam_from_rig if calibration.rig else Pose.identity()
        rotation, translation = vectors_of_pose(pose)
        lines = (
            "{",
            f"    'lensmodel':  '{form.name}',",
            "",
            "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....",
            f"    'intrinsics': {values},",
            "",
            "    # extrinsics are rt_fromref",
            f"    'extrinsics': {[*rotation, *translation]},",
            "",
            f"    'imagersize': {list(model.image_size)},",
            "}",
            "",
        )
        return {path: "\n".join(lines)}


def _literal(path: Path) -> Any:
    text = read_text(path)
    try:
        # In parentheses, so that the dict may be indented.
        return ast.literal_eval(f"({text}\n)")
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
        line = f", line {error.lineno}" if isinstance(error, SyntaxError) and error.lineno else ""
        raise InputError(
            f"{path}{line} is not a Python dict of plain values, which a .cameramodel is; restore the file."
        ) from None


def _list(value: Any, where: str) -> list[Any]:
    return items(list(value) if isinstance(value, tuple) else value, where)
