"""A camera as aniposelib and Caliscope write it in TOML: OpenCV's matrix and coefficients, and its pose.

size            width height
matrix          K
distortions     k1 k2 p1 p2 k3; of a fisheye (`fisheye = true`) k1 k2 k3 k4
rotation        a rotation vector (rad), translation: camera from world
"""

from collections.abc import Mapping
from typing import Any

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.forms import Form
from camera_models.formats.opencv_cameras import check_matrix
from camera_models.formats.rig_poses import pose_of_vectors, rotation_of_matrix, vectors_of_pose
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import items, number, numbers, required
from camera_models.pose import Pose

_K = ("fx", "fy", "cx", "cy")
PINHOLE, FISHEYE = "pinhole", "fisheye"
FORMS = (
    Form(PINHOLE, "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3")),
    Form(FISHEYE, "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4"), ends_deg=90.0),
)
KEYS = ("size", "matrix", "distortions", "rotation", "translation", "fisheye")


def camera_of(table: Mapping[str, Any], where: str) -> tuple[CameraModel, tuple[str, ...]]:
    """The camera of a table, and a note on its skew, which OpenCV takes for zero."""
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise InputError(f"fisheye of {where} must be true or false, found {fisheye!r}; correct it.")
    form = FORMS[int(fisheye)]
    size = size_of(items(required(table, "size", where), f"size of {where}"), f"size of {where}")
    matrix = numbers(required(table, "matrix", where), (3, 3), f"matrix of {where}").ravel().tolist()
    check_matrix(matrix, where)
    given = _flat(required(table, "distortions", where), f"distortions of {where}")
    count = len(form.order or ()) - len(_K)
    if any(given[count:]):
        raise InputError(
            f"distortions of {where} must be {count} for a {form.name} camera, found {len(given)}; calibrate with {count}."
        )
    fx, skew, cx, _, fy, cy = matrix[:6]
    full = (given + [0.0] * count)[:count]
    note = f"The skew of {skew:g} px in the matrix of {where} is not kept: OpenCV takes it for zero."
    return form.camera([fx, fy, cx, cy, *full], size, where), (note,) if skew else ()


def pose_of(table: Mapping[str, Any], where: str) -> Pose | None:
    """cam_from_world, None where the table has none."""
    rotation, translation = table.get("rotation"), table.get("translation")
    if rotation is None or translation is None:
        return None
    t = _flat(translation, f"translation of {where}")
    if len(t) != 3:
        raise InputError(f"translation of {where} must hold 3 numbers, found {len(t)}; correct it.")
    rows = items(rotation, f"rotation of {where}")
    if rows and all(isinstance(row, list) and len(row) == 3 for row in rows):
        return Pose.of(rotation_of_matrix(numbers(rows, (3, 3), f"rotation of {where}"), where), t)
    vector = _flat(rotation, f"rotation of {where}")
    if len(vector) != 3:
        raise InputError(f"rotation of {where} must hold 3 numbers, or 3 x 3, found {len(vector)}; correct it.")
    return pose_of_vectors(vector, t)


def table_of(model: CameraModel, form: Form, pose: Pose | None) -> dict[str, Any]:
    """What is written of a camera."""
    fx, fy, cx, cy, *rest = form.values(model)
    table: dict[str, Any] = {"size": list(model.image_size), "matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]}
    table["distortions"] = rest
    if pose is not None:
        table["rotation"], table["translation"] = vectors_of_pose(pose)
    return table


def _flat(value: Any, where: str) -> list[float]:
    """Numbers in a row, or in rows of one or of many."""
    row: list[float] = []
    for item in items(value, where):
        row += [number(part, where) for part in item] if isinstance(item, list) else [number(item, where)]
    return row
