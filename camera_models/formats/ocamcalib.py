"""OCamCalib: `calib_results.txt` of one camera, and the YAML rig configuration that OmniMVS uses for its cameras.

    # direct polynomial     n  ss_0 ... ss_(n-1)          ray ~ (x, y, ss_0 + ss_1 rho + ss_2 rho^2 + ...), ss_1 = 0
    # inverse polynomial    n  p_0 ... p_(n-1)            rho = p_0 + p_1 theta + ..., theta = atan(z / hypot(x, y))
    # centre                row column                    from 0 (in MATLAB from 1)
    # affine                c d e                         row = c x + d y + row_0, column = e x + y + column_0
    # image size            height width

Its x runs along the rows of the image (down), its y along the columns (right), its z towards the camera: a lens has ss_0 < 0.
With x and y exchanged and z reversed, a rotation, these are our axes: a_k = -ss_k, while c, d and e stay what they are.
The inverse polynomial, with which its tools project, is fitted when writing: over the image, or where no polynomial follows that,
as behind the middle of a mirror, over the angles that the data reach. When reading it is not used, but compared with the other.

The YAML has the same numbers (poly, inv_poly, center, affine, image_size) for each of `cameras`, `pose` (rotation vector in rad
and translation in m, of our axes, which take points of the camera to the rig) and max_fov (degrees).

D. Scaramuzza, A. Martinelli, R. Siegwart, A toolbox for easily calibrating omnidirectional cameras, IROS 2006.
"""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration, CameraEstimate
from camera_models.formats.contract import DEFAULT_NAME, CalibrationFormat, Content, Documents, Nearly, left_out
from camera_models.formats.disk import read_text
from camera_models.formats.forms import Form
from camera_models.formats.inverse_polynomial import HARMLESS_PX, Inverse, compare, fit_inverse
from camera_models.formats.rig_poses import pose_of_vectors, rig_of, vectors_of_pose
from camera_models.formats.values import image_size as image_size_of
from camera_models.formats.values import items, mapping, number, numbers, of_text, optional_number, required, text
from camera_models.formats.yaml_text import read_yaml, yaml_text
from camera_models.pose import Pose
from camera_models.scaramuzza import Scaramuzza, names_of_degree

_HEADINGS = (
    "direct polynomial: number of coefficients, then these from the lowest order (negative for a lens)",
    "inverse polynomial: number of coefficients, then these from the lowest order",
    "center: row and column, from 0",
    "affine parameters c d e",
    "image size: height and width",
)
_DISAGREE_PX = 1.0
_SUFFIXES_YAML = (".yaml", ".yml")


class OCamCalib(CalibrationFormat):
    """calib_results.txt; .yaml for a rig."""

    NAME = "ocamcalib"
    TITLE = "OCamCalib"
    SUFFIXES = (".txt", *_SUFFIXES_YAML)
    RIGS = True
    FORMS: ClassVar[tuple[Form, ...]] = (Form("ocam", "scaramuzza"),)

    def recognises(self, path: Path, head: str) -> bool:
        """Five lines of numbers, the first two with their counts; or a YAML list of cameras of the model ocam."""
        if path.suffix.lower() in _SUFFIXES_YAML:
            return "cameras:" in head and "poly:" in head and "inv_poly:" in head
        rows = [line.split() for line in head.splitlines() if line.strip() and not line.lstrip().startswith("#")]
        return len(rows) == 5 and [len(row) for row in rows[2:]] == [2, 3, 2] and rows[0][0] == str(len(rows[0]) - 1)

    def names(self, calibration: Calibration) -> list[str]:
        """`img_dir` of a rig."""
        return list(calibration) if len(calibration) > 1 else [DEFAULT_NAME]

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """A .yaml has `pose` and `max_fov`."""
        return frozenset({"rig", "max_angle_deg"} if path.suffix.lower() in _SUFFIXES_YAML else ())

    def nearly(self, calibration: Calibration) -> dict[str, Nearly]:
        """The inverse polynomial, where it is not one of the whole image."""
        inverses = {name: _inverse_of(calibration, name) for name in calibration}
        return {
            name: Nearly("inverse polynomial", inverse.off_px, inverse.angles_deg)
            for name, inverse in inverses.items()
            if inverse.angles_deg is not None or inverse.off_px > HARMLESS_PX
        }

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        return _read_rig(path) if path.suffix.lower() in _SUFFIXES_YAML else _read_text(path)

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        if path.suffix.lower() in _SUFFIXES_YAML:
            return {path: _rig_text(calibration)}
        if len(calibration) > 1:
            raise InputError(
                f"{path} was expected to be a .yaml for a rig, or a folder, which gets a file for each camera, found "
                f"{path.suffix} for {len(calibration)} cameras; give one of these."
            )
        (name,) = calibration
        ocam = _numbers_of(calibration, name)
        rows = [[len(ocam["poly"]), *ocam["poly"]], [len(ocam["inv_poly"]), *ocam["inv_poly"]]]
        rows += [ocam[key] for key in ("center", "affine", "image_size")]
        return {
            path: "\n\n".join(f"#{head}\n\n{' '.join(map(repr, row))}" for head, row in zip(_HEADINGS, rows, strict=True)) + "\n"
        }


def _direct_of(model: CameraModel) -> list[float]:
    a0, *higher = list(model.named_parameters().values())[5:]
    return [-a0, 0.0, *(-a for a in higher)]


def _inverse_of(calibration: Calibration, name: str) -> Inverse:
    model, estimate = calibration[name], calibration.estimates.get(name, CameraEstimate())
    reach_deg = estimate.max_angle_deg
    angles_deg = None if reach_deg is None else (estimate.min_angle_deg, reach_deg)
    return fit_inverse(_direct_of(model), model.image_radius_px, angles_deg)


def _numbers_of(calibration: Calibration, name: str) -> dict[str, list[Any]]:
    """The numbers of a camera as OCamCalib has them, polynomials without their counts."""
    model = calibration[name]
    cx, cy, c, d, e = list(model.named_parameters().values())[:5]
    width, height = model.image_size
    return {
        "poly": _direct_of(model),
        "inv_poly": _inverse_of(calibration, name).coefficients,
        "center": [cy, cx],
        "affine": [c, d, e],
        "image_size": [height, width],
    }


def _camera(ocam: dict[str, list[float]], size: tuple[int, int], where: str) -> tuple[Scaramuzza, list[str]]:
    poly = ocam["poly"]
    if len(poly) < 3:
        raise InputError(f"The direct polynomial of {where} must have at least 3 coefficients, found {len(poly)}; correct it.")
    if poly[1] != 0:
        raise InputError(
            f"The coefficient of rho of {where} must be 0, found {poly[1]:g}; calibrate with OCamCalib, which holds it."
        )
    row, column = ocam["center"]
    # Adding 0.0 turns -0.0 into 0.0.
    values = [column, row, *ocam["affine"], -poly[0] + 0.0, *(-a + 0.0 for a in poly[2:])]
    model = Scaramuzza.from_mapping(dict(zip(names_of_degree(len(poly) - 1), values, strict=True)), size)
    off_px, near_deg = compare(poly, ocam["inv_poly"], 0.5 * min(size), _DISAGREE_PX)
    if off_px <= _DISAGREE_PX:
        return model, []
    agrees, do = "", "check which of them is right"
    if near_deg is not None:
        agrees = f" (they agree from {near_deg[0]:.0f} to {near_deg[1]:.0f} degrees off axis only)"
        do = "check which of them is right, or keep to these angles"
    return model, [
        f"The inverse polynomial of {where} differs from the direct one by up to {off_px:.3g} px{agrees}. The direct one is "
        f"used; {do}."
    ]


def _read_text(path: Path) -> Content:
    lines = [
        (at + 1, line)
        for at, line in enumerate(read_text(path).splitlines())
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if len(lines) < 5:
        raise InputError(f"Five lines of numbers were expected ({'; '.join(_HEADINGS)}), found {len(lines)}; restore the file.")
    rows: list[list[float]] = []
    for (at, line), heading, count in zip(lines, _HEADINGS, (None, None, 2, 3, 2), strict=False):
        try:
            row = [of_text(item) for item in line.split()]
        except ValueError:
            raise InputError(f"Line {at} must hold numbers ({heading}), found '{line.strip()[:60]}'; correct it.") from None
        row = [number(item, f"line {at}") for item in row]
        counted = row[1:] if count is None else row
        expected = int(row[0]) if count is None else count
        if len(counted) != expected:
            raise InputError(f"Line {at} must hold {expected} numbers ({heading}), found {len(counted)}; correct it.")
        rows.append(counted)
    height, width = (_side(item, "image size") for item in rows[4])
    ocam = dict(zip(("poly", "inv_poly", "center", "affine"), rows, strict=False))
    model, notes = _camera(ocam, (width, height), "the camera")
    return Content(Calibration({DEFAULT_NAME: model}), tuple(notes))


def _side(value: float, where: str) -> int:
    if value != int(value) or value < 1:
        raise InputError(f"The {where} must be whole numbers of pixels, at least 1, found {value:g}; correct it.")
    return int(value)


def _read_rig(path: Path) -> Content:
    data = mapping(read_yaml(path), "the file")
    cameras: dict[str, Scaramuzza] = {}
    estimates: dict[str, CameraEstimate] = {}
    poses: dict[str, Pose] = {}
    beside: dict[str, list[str]] = {}
    notes: list[str] = []
    for index, value in enumerate(items(required(data, "cameras", "the file"), "cameras")):
        camera = mapping(value, f"camera {index + 1}")
        name = text(camera.get("img_dir") or f"cam{camera.get('cam_id', index + 1)}", f"img_dir of camera {index + 1}")
        if name in cameras:
            raise InputError(f"Every camera must have its own img_dir, found '{name}' twice; correct it.")
        ocam = {key: _counted(camera, key, name) for key in ("poly", "inv_poly")}
        ocam |= {
            key: numbers(required(camera, key, name), (count,), f"{key} of {name}").tolist()
            for key, count in (("center", 2), ("affine", 3))
        }
        height, width = image_size_of(required(camera, "image_size", name), f"image_size of {name} (height, width)")
        cameras[name], said = _camera(ocam, (width, height), name)
        notes += said
        fov = optional_number(camera, "max_fov", name)
        estimates[name] = CameraEstimate(max_angle_deg=None if fov is None else fov / 2)
        vector = numbers(required(camera, "pose", name), (6,), f"pose of {name}").tolist()
        poses[name] = pose_of_vectors(vector[:3], vector[3:]).inverse()
        beside[name] = [key for key, item in camera.items() if key not in _KEYS and item != ""]
    beside["the file"] = [key for key in data if key != "cameras"]
    return Content(Calibration(cameras, estimates, rig_of(poses)), (*notes, *left_out(beside)))


_KEYS = ("cam_id", "img_dir", "model", "poly", "inv_poly", "center", "affine", "image_size", "pose", "max_fov")


def _counted(camera: dict[str, Any], key: str, name: str) -> list[float]:
    values = [number(item, f"{key} of {name}") for item in items(required(camera, key, name), f"{key} of {name}")]
    if not values or values[0] != len(values) - 1:
        raise InputError(f"{key} of {name} must begin with the number of its coefficients, found {values[:1]}; correct it.")
    return values[1:]


def _rig_text(calibration: Calibration) -> str:
    cameras = []
    for index, (name, model) in enumerate(calibration.items()):
        ocam = _numbers_of(calibration, name)
        pose = calibration.rig[name].cam_from_rig if calibration.rig else Pose.identity()
        rotation, translation = vectors_of_pose(pose.inverse())
        estimate = calibration.estimates.get(name, CameraEstimate())
        reach = np.degrees(model.max_angle) if estimate.max_angle_deg is None else estimate.max_angle_deg
        cameras.append(
            {
                "cam_id": index + 1,
                "img_dir": name,
                "model": "ocam",
                **{key: [len(ocam[key]), *ocam[key]] for key in ("poly", "inv_poly")},
                **{key: ocam[key] for key in ("center", "affine", "image_size")},
                "invalid_mask": "",
                "pose": [*rotation, *translation],
                "max_fov": 2 * reach,
            }
        )
    return yaml_text({"cameras": cameras})
