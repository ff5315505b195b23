"""Caliscope's camera_array.toml: a table for each camera, `[cameras.0]` and so on, with a pose where it is known."""

from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.formats.calibration_data import Calibration, CameraEstimate
from camera_models.formats.contract import CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.rig_poses import rig_of
from camera_models.formats.toml_cameras import FISHEYE, FORMS, KEYS, camera_of, pose_of, table_of
from camera_models.formats.toml_text import read_toml, toml_text
from camera_models.formats.values import mapping, optional_number, required
from camera_models.pose import Pose

_OWN: dict[str, Any] = {"rotation_count": 0}
"""Keys of Caliscope that say nothing about a camera, as it writes them."""
_ERROR = "error"


class Caliscope(CalibrationFormat):
    """camera_array.toml."""

    NAME = "caliscope"
    TITLE = "Caliscope"
    SUFFIXES = (".toml",)
    RIGS = True
    FORMS: ClassVar[tuple[Form, ...]] = FORMS
    KEEPS = frozenset({"rms_px_per_point"})

    def recognises(self, path: Path, head: str) -> bool:
        """TOML with tables of cameras in a table."""
        return path.suffix.lower() in self.SUFFIXES and "[cameras." in head

    def names(self, calibration: Calibration) -> list[str]:
        """Their numbers."""
        return [str(number) for number in _ids(calibration)]

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Each camera has its pose and its error."""
        return self.KEEPS | {"rig"}

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        tables = mapping(required(read_toml(path), "cameras", "the file"), "cameras")
        cameras: dict[str, CameraModel] = {}
        estimates: dict[str, CameraEstimate] = {}
        poses: dict[str, Pose | None] = {}
        notes: list[str] = []
        beside: dict[str, list[str]] = {}
        for name, value in tables.items():
            table = mapping(value, f"camera {name}")
            cameras[name], said = camera_of(table, f"camera {name}")
            notes += said
            poses[name] = pose_of(table, f"camera {name}")
            error = optional_number(table, _ERROR, f"camera {name}")
            if error is not None:
                estimates[name] = CameraEstimate(rms_px_per_point=error)
            beside[name] = [key for key in table if key not in (*KEYS, _ERROR, "cam_id") and table[key] != _OWN.get(key)]
        known = {name: pose for name, pose in poses.items() if pose is not None}
        if known and len(known) < len(poses):
            without = ", ".join(name for name in poses if name not in known)
            notes.append(f"Not kept: the poses, which camera {without} has not; here a rig has every camera of the file.")
            known = {}
        return Content(Calibration(cameras, estimates, rig_of(known)), (*notes, *left_out(beside)))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        tables: dict[str, dict[str, Any]] = {}
        for number, (name, model) in zip(_ids(calibration), calibration.items(), strict=True):
            form = self.exact_form(model)
            pose = calibration.rig[name].cam_from_rig if calibration.rig else None
            rms = calibration.estimates.get(name, CameraEstimate()).rms_px_per_point
            tables[f"cameras.{number}"] = {
                "cam_id": number,
                **_OWN,
                **({} if rms is None else {_ERROR: rms}),
                **table_of(model, form, pose),
                "fisheye": form.name == FISHEYE,
            }
        return {path: toml_text(tables)}


def _ids(calibration: Calibration) -> list[int]:
    """The names where they are whole numbers, as in a calibration that was read from Caliscope, else 0, 1, ..."""
    names = list(calibration)
    if all(name.isdecimal() and str(int(name)) == name for name in names):
        return [int(name) for name in names]
    return list(range(len(names)))
