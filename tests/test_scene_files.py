"""Scenes for other programs: Wavefront objects read by trimesh, COLMAP models read by pycolmap, recordings read by rerun."""

import re
import sys
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pycolmap
import pytest
import torch
import trimesh
from rerun.chunk import RrdReader

from camera_models import CameraModel, InputError, model_class
from camera_models.formats import format_named
from camera_models.pose import Pose
from omnilines.files.colmap_scene import colmap_cameras, write_colmap_scene
from omnilines.files.obj import write_obj
from omnilines.files.ply import STATUS_COLOURS
from omnilines.files.recording import write_recording
from omnilines.records import ImagePoses, Lines

STATUS = ("ok", "behind", "weak", "ok")
TRACKS = ("wall 1", "lost", "#2/ü", "wall%201")


def some_lines() -> Lines:
    ends = np.random.default_rng(7).normal(size=(4, 2, 3)) * 30
    ends[1] = np.nan
    return Lines(TRACKS, ends, np.array([3, 1, 2, 9]), np.full(4, 0.25), np.full(4, 0.0012), STATUS)


def some_poses(cameras: tuple[str, ...] | None, count: int) -> ImagePoses:
    generator = torch.Generator().manual_seed(count)
    poses = Pose.exp(torch.randn(count, 6, generator=generator, dtype=torch.float64) * 1.5)
    return ImagePoses(tuple(f"day/{k}.jpg" for k in range(count)), poses, cameras)


def held_by_colmap() -> dict[str, CameraModel]:
    """The examples of all models that COLMAP holds exactly."""
    colmap = format_named("colmap")
    models = [m for name in dict.fromkeys(form.model for form in colmap.FORMS) for m in model_class(name).examples()]
    return {f"cam{k}": model for k, model in enumerate(m for m in models if colmap.why_not(m) is None)}


def test_objects_by_the_letter_of_the_format_and_by_trimesh(tmp_path: Path) -> None:
    lines, path = some_lines(), tmp_path / "lines.obj"
    write_obj(path, lines)
    points, objects = [], {}
    for words in map(str.split, path.read_text("ascii").splitlines()):
        if words[0] == "v":
            points.append([float(x) for x in words[1:]])
        elif words[0] == "o":
            objects[words[1]] = []
            last = objects[words[1]]
            assert len(words) == 2
        elif words[0] == "l":
            last.append([points[int(k) - 1] for k in words[1:]])
    assert [unquote(name) for name in objects] == ["wall 1", "#2/ü", "wall%201"]
    assert all(re.fullmatch(r"[\w.~%-]+", name, re.ASCII) for name in objects)
    assert np.array_equal(np.concatenate(list(objects.values())), lines.ends_m[lines.known])
    with path.open("rb") as file:
        cloud = trimesh.load(file, file_type="obj")
    np.testing.assert_allclose(cloud.vertices, lines.ends_m[lines.known].reshape(-1, 3), rtol=1e-15)
    with pytest.raises(InputError, match=r"lines\.obj cannot be written"):
        write_obj(tmp_path / "absent" / "lines.obj", lines)


def test_pycolmap_has_our_poses_and_projections(tmp_path: Path) -> None:
    cameras = held_by_colmap()
    assert len(cameras) >= 10
    poses = some_poses(tuple(cameras), len(cameras))
    files = write_colmap_scene(tmp_path / "colmap", cameras, poses, some_lines(), remarks=("A remark.",))
    assert [file.name for file in files] == ["cameras.txt", "images.txt", "points3D.txt", "lines.txt"]
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path / "colmap"))
    assert model.num_points3D() == 0 and model.num_reg_images() == len(cameras)
    assert files[0].read_text().startswith("# A remark.\n")
    rng = np.random.default_rng(0)
    by_name = {image.name: image for image in model.images.values()}
    for k, (name, camera) in enumerate(cameras.items()):
        image = by_name[poses.images[k]]
        matrix = image.cam_from_world().matrix()
        np.testing.assert_allclose(matrix[:, :3], poses.cam_from_world[k].rotation, atol=1e-12)
        np.testing.assert_allclose(matrix[:, 3], poses.cam_from_world[k].translation, atol=1e-12)
        # Points in front of the camera, which every model of COLMAP projects, given in the world.
        rays = rng.normal(size=(40, 3)) * [0.15, 0.15, 0] + [0, 0, 1]
        world = poses.cam_from_world[k].inverse().transform(torch.from_numpy(rays))
        pixels, valid = camera.project(poses.cam_from_world[k].transform(world))
        theirs = np.array([image.project_point(point) for point in world.numpy()])
        assert float(valid.double().mean()) > 0.9, name
        np.testing.assert_allclose(pixels[valid] + 0.5, theirs[valid.numpy()], atol=1e-8)
        assert (model.cameras[image.camera_id].width, model.cameras[image.camera_id].height) == camera.image_size


def test_lines_beside_the_model(tmp_path: Path) -> None:
    lines = some_lines()
    name, camera = next(iter(held_by_colmap().items()))
    write_colmap_scene(tmp_path, {name: camera}, some_poses(None, 3), lines)
    rows = [line.split() for line in (tmp_path / "lines.txt").read_text().splitlines() if not line.startswith("#")]
    assert [unquote(row[0]) for row in rows] == ["wall 1", "#2/ü", "wall%201"]
    assert np.array_equal(np.array([row[1:7] for row in rows], dtype=float), lines.ends_m[lines.known].reshape(-1, 6))
    assert [int(row[7]) for row in rows] == [3, 2, 9]
    # A second time over the first: nothing of it is in the way.
    write_colmap_scene(tmp_path, {name: camera}, some_poses(None, 2), lines)
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path))
    assert model.num_reg_images() == 2


def test_a_camera_that_colmap_does_not_have_is_refused_or_fitted_with_its_error(tmp_path: Path) -> None:
    colmap = format_named("colmap")
    camera = next(m for m in model_class("scaramuzza").examples() if colmap.why_not(m) is not None and float(m.parameters[5]) > 0)
    poses, lines = some_poses(("fish",), 1), some_lines()
    with pytest.raises(InputError, match=r"COLMAP was expected to hold camera fish, found that .*; fit another model to it\."):
        write_colmap_scene(tmp_path / "refused", {"fish": camera}, poses, lines)
    assert not (tmp_path / "refused").exists()
    held, remarks = colmap_cameras({"fish": camera}, fov_deg=120)
    write_colmap_scene(tmp_path, held, poses, lines, remarks=remarks)
    stated = re.search(r"fish \(scaramuzza\) is fitted by (\w+): (\S+) px RMS and (\S+) px at most within", remarks[0])
    assert stated is not None and f"# {remarks[0]}\n" in (tmp_path / "cameras.txt").read_text()
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path))
    theirs = next(iter(model.cameras.values()))
    assert theirs.model.name == stated[1]
    # The stated error is the one between our original and what COLMAP itself projects.
    theta, phi = np.meshgrid(np.radians(np.linspace(0, 55, 40)), np.linspace(0, 2 * np.pi, 60))
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    pixels, valid = camera.project(rays)
    w, h = camera.image_size
    valid &= ((pixels > 0) & (pixels < [w - 1, h - 1])).all(1)
    off = np.linalg.norm(theirs.img_from_cam(rays[valid]) - 0.5 - pixels[valid], axis=1)
    assert valid.sum() > 500 and 0.2 * float(stated[3]) < off.max() < 1.05 * float(stated[3]) + 1e-6
    exact = held_by_colmap()
    assert colmap_cameras(exact)[0] == exact


def test_what_a_colmap_model_cannot_hold_is_named(tmp_path: Path) -> None:
    name, camera = next(iter(held_by_colmap().items()))
    poses, lines = some_poses(None, 2), some_lines()
    blank = ImagePoses(("a b.jpg", "c.jpg"), poses.cam_from_world)
    with pytest.raises(InputError, match=r"names without blanks, found 'a b\.jpg'"):
        write_colmap_scene(tmp_path, {name: camera}, blank, lines)
    other = ImagePoses(poses.images, poses.cam_from_world, (name, "else"))
    with pytest.raises(InputError, match=f"one of {name}, found 'else'"):
        write_colmap_scene(tmp_path, {name: camera}, other, lines)
    for stale in ("frames.bin", "cameras.bin", "rigs.txt"):
        folder = tmp_path / stale
        folder.mkdir()
        (folder / stale).touch()
        with pytest.raises(InputError, match=rf"found .*{stale}, which COLMAP would read with the new ones; remove"):
            write_colmap_scene(folder, {name: camera}, poses, lines)
        assert [file.name for file in folder.iterdir()] == [stale]


def recorded(path: Path) -> dict[str, dict[str, list]]:
    """The components of each entity by rerun's own reader."""
    found: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(str(path)).stream():
        table = chunk.to_record_batch().to_pydict()
        assert chunk.is_static
        found.setdefault(chunk.entity_path, {}).update({name: cells[0] for name, cells in table.items()})
    return found


def test_recording_read_by_rerun(tmp_path: Path) -> None:
    fisheye = model_class("opencv-fisheye").examples()[1]
    cameras = {"wide": fisheye, "flat": model_class("pinhole").examples()[0]}
    lines, poses = some_lines(), some_poses(("wide", "flat", "wide"), 3)
    truth = lines.ends_m[[0, 2]] + 0.01
    write_recording(tmp_path / "scene.rrd", lines, poses, cameras, truth=truth)
    found = recorded(tmp_path / "scene.rrd")
    photos = [rf"/world/cameras/day\/{k}.jpg" for k in range(3)]
    assert set(found) == {"/world/lines/ok", "/world/lines/weak", "/world/truth", *photos}
    ok = found["/world/lines/ok"]
    np.testing.assert_allclose(ok["LineStrips3D:strips"], lines.ends_m[[0, 3]], rtol=1e-6)
    stated = "largest sigma across 1.2 mm, 0.25 px"
    assert ok["LineStrips3D:labels"] == [f"wall 1: 3 views, {stated}", f"wall%201: 9 views, {stated}"]
    for status, colour in STATUS_COLOURS.items():
        (packed,) = found[f"/world/lines/{status}"]["LineStrips3D:colors"]
        assert packed.to_bytes(4, "big") == bytes([*colour, 255])
    np.testing.assert_allclose(found["/world/truth"]["LineStrips3D:strips"], truth, rtol=1e-6)
    for k, photo in enumerate(photos):
        own = found[photo]
        centre, turn = poses.cam_from_world[k].centre.numpy(), poses.cam_from_world[k].rotation.numpy().T
        np.testing.assert_allclose(own["Transform3D:translation"][0], centre, rtol=1e-6)
        # rerun keeps matrices column by column.
        np.testing.assert_allclose(np.reshape(own["Transform3D:mat3x3"][0], (3, 3)).T, turn, atol=1e-6)
        rim, *rays = (np.array(strip) for strip in own["LineStrips3D:strips"])
        length = np.linalg.norm(rim, axis=1)
        np.testing.assert_allclose(length, length[0], rtol=1e-5)
        assert len(rays) == 4 and (rim[0] == rim[-1]).all() and all((ray[0] == 0).all() for ray in rays)
        model = cameras[poses.cameras[k]]
        pixels, valid = model.project(rim.astype(np.float64))
        w, h = model.image_size
        edge = np.minimum(np.abs(pixels), np.abs([w - 1, h - 1] - pixels)).min(1)
        angle = np.arctan2(np.hypot(rim[:, 0], rim[:, 1]), rim[:, 2])
        # Every point of the outline is on the rim of the image, or at the end of what the model sees.
        assert ((edge < 0.01) | (np.abs(angle - model.max_angle) < 1e-3)).all() and valid.mean() > 0.5


def test_recording_needs_the_extra_and_known_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras, poses, lines = {"flat": model_class("pinhole").examples()[0]}, some_poses(("flat", "else"), 2), some_lines()
    with pytest.raises(InputError, match="one of flat, found 'else'"):
        write_recording(tmp_path / "scene.rrd", lines, poses, cameras)
    poses = some_poses(None, 2)
    with pytest.raises(InputError, match=r"scene\.rrd cannot be written"):
        write_recording(tmp_path / "absent" / "scene.rrd", lines, poses, cameras)
    write_recording(tmp_path / "scene.rrd", lines, poses, cameras)
    assert "/world/truth" not in recorded(tmp_path / "scene.rrd")
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'omnilines\[viewer\]' brings it"):
        write_recording(tmp_path / "scene.rrd", lines, poses, cameras)
