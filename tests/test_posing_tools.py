"""Poses in the files of other tools, each made from what that tool's documentation says of its numbers."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import omnilines as ol
from camera_models import Calibration, InputError, OpenCVFisheye
from camera_models.pose import Pose
from omnilines.files import write_poses
from omnilines.geometry.geodetic import AXIS_M, FLATTENING
from omnilines.posing.from_tool import poses_from_tool
from omnilines.posing.tools import POSE_FILES, pose_file_of
from omnilines.records import ImagePoses, LengthUnit

NAMES = ("left/a.jpg", "left/b.jpg", "c.jpg")
PHOTOS = list(NAMES)
CAMERA_OF = dict.fromkeys(NAMES, "cam0")
CAMERAS = Calibration({"cam0": OpenCVFisheye([30.0, 30.0, 31.5, 23.5, 0.0, 0.0, 0.0, 0.0], (64, 48))})
POINTS = np.array([[0.3, -0.2, 5.0], [-1.0, 2.0, 7.0], [4.0, 0.5, -3.0]])


def poses() -> Pose:
    steps = torch.randn(len(NAMES), 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return Pose.exp(steps)


def matrices() -> list[np.ndarray]:
    """world_from_cam, 4 x 4."""
    return [np.vstack([np.column_stack([p.rotation.numpy(), p.translation.numpy()]), [0, 0, 0, 1]]) for p in poses().inverse()]


def nerfstudio() -> str:
    """The camera looks along -z, y is up."""
    frames = [
        {"file_path": f"./{name}", "transform_matrix": (matrix @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()}
        for name, matrix in zip(NAMES, matrices(), strict=True)
    ]
    return json.dumps({"camera_model": "OPENCV", "fl_x": 300.0, "w": 640, "h": 480, "frames": frames}, indent=1)


def opensfm(reference: dict[str, float] | None = None) -> str:
    """X_cam = R X + t, the rotation vector as OpenCV has it."""
    vectors = [cv2.Rodrigues(p.rotation.numpy())[0].ravel().tolist() for p in poses()]
    shots = {
        name: {"rotation": vector, "translation": p.translation.tolist(), "camera": "v2"}
        for name, vector, p in zip(NAMES, vectors, poses(), strict=True)
    }
    cameras = {"v2": {"projection_type": "fisheye", "width": 640, "height": 480, "focal": 0.5, "k1": 0.0, "k2": 0.0}}
    small = {"cameras": cameras, "shots": {"d.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 0]}}}
    lla = reference or {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    return json.dumps([small, {"cameras": cameras, "shots": shots, "reference_lla": lla, "points": {}}], indent=1)


def openmvg() -> str:
    """X_cam = R (X - C); cereal keeps the base of a view in a pointer of its own. One view has no pose."""
    views: list[dict[str, Any]] = []
    for k, name in enumerate((*NAMES, "d.jpg")):
        folder, _, file = name.rpartition("/")
        view = {
            "local_path": folder,
            "filename": file,
            "width": 640,
            "height": 480,
            "id_view": k,
            "id_intrinsic": 0,
            "id_pose": 10 + k,
        }
        views.append({"key": k, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": 2147483649 + k, "data": view}}})
    extrinsics = [
        {"key": 10 + k, "value": {"rotation": p.rotation.tolist(), "center": p.centre.tolist()}} for k, p in enumerate(poses())
    ]
    data = {"sfm_data_version": "0.3", "root_path": "/x", "views": views, "intrinsics": [], "extrinsics": extrinsics}
    return json.dumps(data, indent=1)


def metashape(scale: float = 2.0, turn: np.ndarray = np.eye(3), shift: np.ndarray = np.zeros(3)) -> str:
    """World X = s R X_component + t, the cameras in groups; labels without endings, as Metashape has them. One is not aligned."""
    rows = []
    for k, (name, matrix) in enumerate(zip(NAMES, matrices(), strict=True)):
        own = matrix.copy()
        own[:3, 3] = turn.T @ (matrix[:3, 3] - shift) / scale
        own[:3, :3] = turn.T @ matrix[:3, :3]
        cells = " ".join(map(repr, own.ravel().tolist()))
        rows.append(f'<camera id="{k}" component_id="0" label="{name[:-4]}"><transform>{cells}</transform></camera>')
    rows.append('<camera id="9" sensor_id="0" label="d"/>')
    numbers = {"rotation": turn.ravel(), "translation": shift, "scale": np.array([scale])}
    own_text = "".join(f'<{key} locked="true">{" ".join(map(repr, value.tolist()))}</{key}>' for key, value in numbers.items())
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">\n'
        f'<components next_id="1" active_id="0"><component id="0"><transform>{own_text}</transform></component></components>\n'
        f'<cameras><group id="0" label="Group 1" type="folder">{"".join(rows[:2])}</group>{"".join(rows[2:])}</cameras>\n'
        "</chunk>\n</document>\n"
    )


def omega_phi_kappa() -> str:
    """Rx Ry Rz of cameras that look along -z, y up; degrees."""
    axes = np.diag([1.0, -1.0, -1.0])
    angles = [Rotation.from_matrix(matrix[:3, :3] @ axes).as_euler("XYZ", degrees=True) for matrix in matrices()]
    rows = [
        " ".join([name, *map(repr, [*matrix[:3, 3].tolist(), *turn.tolist()])])
        for name, matrix, turn in zip(NAMES, matrices(), angles, strict=True)
    ]
    return "\n".join(["imageName X Y Z Omega Phi Kappa", *rows]) + "\n"


FILES: dict[str, tuple[str, Callable[[], str]]] = {
    "NerfstudioPoses": ("transforms.json", nerfstudio),
    "OpenSfMPoses": ("reconstruction.json", opensfm),
    "OpenMVGPoses": ("sfm_data.json", openmvg),
    "MetashapePoses": ("cameras.xml", metashape),
    "OmegaPhiKappaPoses": ("cameras.txt", omega_phi_kappa),
}
NAMED = [tool for tool in POSE_FILES if type(tool).__name__ in FILES]
IN_METRES = ("MetashapePoses", "OmegaPhiKappaPoses")


def written(folder: Path, kind: str, text: str | None = None) -> Path:
    name, made = FILES[kind]
    path = folder / name
    path.write_text(made() if text is None else text)
    return path


@pytest.mark.parametrize("tool", NAMED, ids=lambda tool: type(tool).__name__)
def test_poses_come_back_whatever_convention_the_file_has(tmp_path: Path, tool: Any) -> None:
    path = written(tmp_path, type(tool).__name__)
    assert pose_file_of(path) is tool
    found = poses_from_tool(path, tool, [*PHOTOS, "d.jpg", "e.jpg"], CAMERAS, {**CAMERA_OF, "d.jpg": "cam0", "e.jpg": "cam0"})
    assert found.poses.images == NAMES
    for own, expected in zip(found.poses.cam_from_world, poses(), strict=True):
        np.testing.assert_allclose(own.transform(POINTS), expected.transform(POINTS), atol=1e-12)
    assert set(found.left_out) == {"d.jpg", "e.jpg"}
    assert found.unit is (LengthUnit.METRES if type(tool).__name__ in IN_METRES else LengthUnit.OPEN)


@pytest.mark.parametrize("tool", NAMED, ids=lambda tool: type(tool).__name__)
def test_a_damaged_file_of_a_tool_is_refused_with_one_sentence(tmp_path: Path, tool: Any) -> None:
    """Cut, and each of its lines lost or with other numbers: poses of it, or one sentence with its path."""
    whole = written(tmp_path, type(tool).__name__).read_text()
    lines = whole.splitlines()
    harmed = [whole[: len(whole) * k // 20] for k in range(1, 20)]
    harmed += ["\n".join(lines[:k] + lines[k + 1 :]) for k in range(0, len(lines), max(1, len(lines) // 40))]
    for old, new in (("0", "1e999"), ("0.", "x"), (".", "..."), ("[", "{"), ("0", "null"), ("1", "-1"), ("<transform>", "<t>")):
        harmed.append(whole.replace(old, new))
    refused = 0
    for text in harmed:
        path = written(tmp_path, type(tool).__name__, text)
        try:
            found = tool.read(path)
        except InputError as error:
            refused += 1
            assert str(path) in str(error)
            assert "\n" not in str(error)
        else:
            found.cam_from_world.require_rigid()
    assert refused > len(harmed) // 3


def test_reflections_and_sheared_rotations_are_refused(tmp_path: Path) -> None:
    data = json.loads(nerfstudio())
    for change, told in ((np.diag([1.0, 1.0, -1.0, 1.0]), "a reflection"), (np.diag([1.1, 1.0, 1.0, 1.0]), "not orthonormal")):
        frames = [dict(frame) for frame in data["frames"]]
        frames[1]["transform_matrix"] = (np.array(frames[1]["transform_matrix"]) @ change).tolist()
        path = written(tmp_path, "NerfstudioPoses", json.dumps(data | {"frames": frames}))
        with pytest.raises(InputError, match=rf"left/b\.jpg, found .*{told}"):
            poses_from_tool(*_file(path), PHOTOS, CAMERAS, CAMERA_OF)
    frames = [*data["frames"], data["frames"][0]]
    path = written(tmp_path, "NerfstudioPoses", json.dumps(data | {"frames": frames}))
    with pytest.raises(InputError, match="each photo was expected once"):
        poses_from_tool(*_file(path), PHOTOS, CAMERAS, CAMERA_OF)


def test_a_world_on_the_earth_says_what_is_up_and_its_unit(tmp_path: Path) -> None:
    latitude, longitude = np.radians(46.5), np.radians(7.9)
    level = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    semi = AXIS_M * (1 - FLATTENING)
    # The place of the ellipsoid with this normal: (a^2 n_x, a^2 n_y, b^2 n_z) over their length in its metric.
    place = np.array([AXIS_M**2, AXIS_M**2, semi**2]) * level
    place /= np.sqrt(AXIS_M**2 * (level[0] ** 2 + level[1] ** 2) + semi**2 * level[2] ** 2)
    turn = Pose.exp([0.3, -0.2, 0.5, 0, 0, 0]).rotation.numpy()
    text = metashape(3.0, turn, np.zeros(3)).replace(
        '<translation locked="true">0.0 0.0 0.0', f'<translation locked="true">{" ".join(map(repr, place.tolist()))}'
    )
    found = poses_from_tool(*_file(written(tmp_path, "MetashapePoses", text)), PHOTOS, CAMERAS, CAMERA_OF)
    assert found.unit is LengthUnit.METRES
    np.testing.assert_allclose(found.up, level, atol=1e-6)
    assert "earth-centred" in found.notes[0]
    np.testing.assert_allclose(found.poses.cam_from_world.centre - torch.from_numpy(place), poses().centre, atol=1e-7)
    # Without a transform of its own nothing is known of the world.
    own = poses_from_tool(*_file(written(tmp_path, "MetashapePoses", metashape(1.0))), PHOTOS, CAMERAS, CAMERA_OF)
    assert (own.unit, own.up, own.notes) == (LengthUnit.OPEN, None, ())
    gps = opensfm({"latitude": 46.5, "longitude": 7.9, "altitude": 500.0})
    enu = poses_from_tool(*_file(written(tmp_path, "OpenSfMPoses", gps)), PHOTOS, CAMERAS, CAMERA_OF)
    assert (enu.unit, enu.up) == (LengthUnit.METRES, (0.0, 0.0, 1.0))


def _file(path: Path) -> tuple[Path, Any]:
    return path, pose_file_of(path)


@pytest.mark.parametrize("kind", list(FILES))
def test_photos_have_the_same_poses_by_a_table_and_by_a_file_of_a_tool(tmp_path: Path, kind: str) -> None:
    photos = tmp_path / "photos"
    for k, name in enumerate(NAMES):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(photos / name), np.random.default_rng(k).integers(0, 255, (48, 64), dtype=np.uint8))
    write_poses(tmp_path / "poses.csv", ImagePoses(NAMES, poses(), ("cam0",) * len(NAMES)))
    table = ol.estimate_poses(photos, CAMERAS, tmp_path / "poses.csv")
    own = ol.estimate_poses(photos, CAMERAS, written(tmp_path, kind))
    assert own.source == "tool"
    assert own.unit is (LengthUnit.METRES if kind in IN_METRES else LengthUnit.OPEN)
    order = [own.poses.images.index(name) for name in table.poses.images]
    np.testing.assert_allclose(own.poses.cam_from_world[order].translation, table.poses.cam_from_world.translation, atol=1e-9)
    with pytest.raises(InputError, match="give the photos that it was run on"):
        other = tmp_path / "other"
        other.mkdir()
        cv2.imwrite(str(other / "z.png"), np.zeros((48, 64), np.uint8))
        ol.estimate_poses(other, CAMERAS, written(tmp_path, kind))
    with pytest.raises(InputError, match=r"Metashape's XML of cameras, Nerfstudio's transforms\.json"):
        ol.estimate_poses(photos, CAMERAS, tmp_path / "missing.json")


def test_files_of_cameras_alone_are_no_files_of_poses(shared_data: Path) -> None:
    assert pose_file_of(shared_data / "rigs" / "charuco_video" / "camera_array.toml") is None
    assert pose_file_of(shared_data / "calibration" / "fisheye1" / "reference.json") is None
