"""aniposelib's calibration.toml, also that of Anipose and Pose2Sim: a table for each camera, `[cam_0]` and so on."""

from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.rig_poses import rig_of
from camera_models.formats.toml_cameras import FISHEYE, FORMS, KEYS, camera_of, pose_of, table_of
from camera_models.formats.toml_text import read_toml, toml_text
from camera_models.formats.values import mapping, text
from camera_models.pose import Pose


class Anipose(CalibrationFormat):
    """calibration.toml."""

    NAME = "anipose"
    TITLE = "aniposelib"
    SUFFIXES = (".toml",)
    RIGS = True
    NEEDS_RIG = True
    FORMS: ClassVar[tuple[Form, ...]] = FORMS

    def recognises(self, path: Path, head: str) -> bool:
        """TOML with the keys of a camera in tables at the top."""
        return path.suffix.lower() in self.SUFFIXES and "distortions" in head and "[cameras." not in head

    def names(self, calibration: Calibration) -> list[str]:
        """Their own."""
        return list(calibration)

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Every file says where its cameras stand."""
        return frozenset({"rig"})

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        cameras: dict[str, CameraModel] = {}
        rig: dict[str, Pose] = {}
        notes: list[str] = []
        beside: dict[str, list[str]] = {}
        for key, value in read_toml(path).items():
            if key == "metadata":
                continue
            table = mapping(value, key)
            name = text(table.get("name", key), f"name of {key}")
            if name in cameras:
                raise InputError(f"{path} must name each camera once, found {name} twice; rename one.")
            cameras[name], said = camera_of(table, key)
            pose = pose_of(table, key)
            if pose is not None:
                rig[name] = pose
            notes += said
            beside[name] = [item for item in table if item not in (*KEYS, "name")]
        return Content(Calibration(cameras, rig=rig_of(rig)), (*notes, *left_out(beside)))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        tables: dict[str, dict[str, Any]] = {}
        # aniposelib sorts the tables by their names.
        digits = len(str(len(calibration) - 1))
        for index, (name, model) in enumerate(calibration.items()):
            form = self.exact_form(model)
            pose = calibration.rig[name].cam_from_rig if calibration.rig else Pose.identity()
            fisheye = {"fisheye": True} if form.name == FISHEYE else {}
            tables[f"cam_{index:0{digits}d}"] = {"name": name, **table_of(model, form, pose), **fisheye}
        return {path: toml_text(tables)}
