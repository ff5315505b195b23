"""OpenMVG's sfm_data.json: its intrinsics, as cereal writes them. Of views and poses it has those of a scene, a calibration none.

    pinhole              pinhole           focal_length, principal_point
    pinhole_radial_k1    pinhole           and disto_k1
    pinhole_radial_k3    pinhole           and disto_k3: k1 k2 k3
    pinhole_brown_t2     pinhole           and disto_t2: k1 k2 k3 t1 t2, which are OpenCV's k1 k2 k3 p1 p2
    fisheye              opencv-fisheye    and fisheye: k1 k2 k3 k4
    spherical            equirectangular   read only

All others have one focal length. The centre of the first pixel is (0, 0): OpenMVG's undistortion takes the pixel (i, j) for the
point (i, j) and back. Its spherical camera, whose middle is w / 2 in the same coordinates, is half a pixel beside
`equirectangular`, which a note states; it is not written, and made from the size of the image there. OpenMVG's sources,
`cameras/Camera_*.hpp`, `Camera_undistort_image.hpp`.
"""

from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.equirectangular import Equirectangular
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import HAS_POSES, CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.json_text import json_text, read_json
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import items, mapping, number, numbers, required, text, whole
from camera_models.wording import listed

_CENTRE = ("f", "cx", "cy")
_TERMS = {"pinhole_radial_k1": "disto_k1", "pinhole_radial_k3": "disto_k3", "pinhole_brown_t2": "disto_t2", "fisheye": "fisheye"}
"""Key of the coefficients of each type."""
_SPHERICAL = "spherical"
_VERSION = "0.3"
_FIRST = 1 << 31
"""cereal marks a type, or an object, that a file holds for the first time by the highest bit of its number."""
_BASE, _OWN = "value0", ("width", "height", "focal_length", "principal_point")


class OpenMVG(CalibrationFormat):
    """sfm_data.json."""

    NAME = "openmvg"
    TITLE = "OpenMVG"
    SUFFIXES = (".json",)
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("pinhole", "pinhole", _CENTRE),
        Form("pinhole_radial_k1", "pinhole", (*_CENTRE, "k1")),
        Form("pinhole_radial_k3", "pinhole", (*_CENTRE, "k1", "k2", "k3")),
        Form("pinhole_brown_t2", "pinhole", (*_CENTRE, "k1", "k2", "k3", "p1", "p2")),
        Form("fisheye", "opencv-fisheye", (*_CENTRE, "k1", "k2", "k3", "k4"), ends_deg=90.0),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """JSON with its version."""
        return path.suffix.lower() in self.SUFFIXES and '"sfm_data_version"' in head

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = mapping(read_json(path), "the file")
        kinds: dict[int, str] = {}
        cameras: dict[str, CameraModel] = {}
        panoramas: list[str] = []
        beside: dict[str, list[str]] = {}
        for index, entry in enumerate(items(required(data, "intrinsics", "the file"), "intrinsics")):
            where = f"intrinsic {index}"
            value = mapping(required(mapping(entry, where), "value", where), where)
            number_of_kind = whole(required(value, "polymorphic_id", where), f"polymorphic_id of {where}") & (_FIRST - 1)
            if "polymorphic_name" in value:
                kinds[number_of_kind] = text(value["polymorphic_name"], f"polymorphic_name of {where}")
            if number_of_kind not in kinds:
                raise InputError(f"The type of {where} is not named in the file; write it again with OpenMVG.")
            wrapper = mapping(required(value, "ptr_wrapper", where), where)
            keys = mapping(required(wrapper, "data", where), where)
            name = f"cam{index}"
            if kinds[number_of_kind] == _SPHERICAL:
                cameras[name] = Equirectangular([], _size(keys, name))
                panoramas.append(name)
            else:
                cameras[name] = self._camera(self.form_named(kinds[number_of_kind], name), keys, name)
            beside[name] = [key for key in keys if key not in (_BASE, *_OWN, *_TERMS.values())]
        if not cameras:
            raise InputError("Intrinsics were expected in the file, found none; give one that OpenMVG has calibrated.")
        beside["the file"] = [key for key in ("views", "structure", "control_points") if data.get(key)]
        half = "its middle is half a pixel right of and below that of equirectangular, by which directions differ from OpenMVG's"
        notes = (f"OpenMVG's spherical camera ({listed(panoramas)}): {half}.",) if panoramas else ()
        poses = (HAS_POSES,) if data.get("extrinsics") else ()
        return Content(Calibration(cameras), (*notes, *left_out(beside), *poses))

    def _camera(self, form: Form, keys: dict[str, Any], name: str) -> CameraModel:
        base = _base(keys, name)
        size = _size(keys, name)
        focal = number(required(base, "focal_length", name), f"focal_length of {name}")
        centre = numbers(required(base, "principal_point", name), (2,), f"principal_point of {name}").tolist()
        count = len(form.order or ()) - len(_CENTRE)
        key = _TERMS.get(form.name)
        terms = numbers(required(keys, key, name), (count,), f"{key} of {name}").tolist() if key else []
        return form.camera([focal, *centre, *terms], size, name)

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        kinds: list[str] = []
        entries: list[dict[str, Any]] = []
        for index, model in enumerate(calibration.values()):
            form = self.exact_form(model)
            focal, cx, cy, *terms = form.values(model)
            width, height = model.image_size
            base = {"width": width, "height": height, "focal_length": focal, "principal_point": [cx, cy]}
            known = form.name in kinds
            kinds += [] if known else [form.name]
            kind = kinds.index(form.name) + 1
            told = {"polymorphic_id": kind} if known else {"polymorphic_id": _FIRST + kind, "polymorphic_name": form.name}
            data = {_BASE: base, _TERMS[form.name]: terms} if form.name in _TERMS else base
            entries.append({"key": index, "value": {**told, "ptr_wrapper": {"id": _FIRST + index + 1, "data": data}}})
        return {path: json_text({
            "sfm_data_version": _VERSION, "root_path": "", "views": [], "intrinsics": entries, "extrinsics": [], "structure": [],
            "control_points": [],
        })}  # fmt: skip


def _base(keys: dict[str, Any], name: str) -> dict[str, Any]:
    # Newer versions hold what all cameras have in a part of its own.
    return mapping(keys[_BASE], name) if _BASE in keys else keys


def _size(keys: dict[str, Any], name: str) -> tuple[int, int]:
    base = _base(keys, name)
    return size_of([required(base, key, name) for key in ("width", "height")], f"width and height of {name}")
