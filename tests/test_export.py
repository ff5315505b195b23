"""Scenes for other tools, read again by the tools' own readers or by the rules of their documents."""

import json
import subprocess
from pathlib import Path

import ezdxf
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from pylimap_scenes import PEERS

import omnilines as ol
from camera_models import Calibration, Equirectangular, InputError, OpenCVFisheye, Scaramuzza, save
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.files import write_lines, write_png, write_poses, write_segments
from omnilines.geometry.geodetic import Origin, geodetic
from omnilines.photo_file import read_photo
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.tools.nerfstudio import NerfstudioPoses
from omnilines.records import ImagePoses, Lines, Segments

FAR_M = np.array([500_000.0, 5_400_000.0, 300.0])
LENS, POLYNOMIAL = OpenCVFisheye.examples()[0], Scaramuzza.examples()[0]


def scene(folder: Path, cameras: Calibration, images: int = 3, middle_m: np.ndarray = FAR_M) -> Path:
    """Three known lines and one that is not, seen by photos that stand about a place, far from the origin unless given."""
    rng = np.random.default_rng(0)
    ends = middle_m + rng.normal(size=(4, 2, 3))
    ends[2] = np.nan
    unknown = np.full(4, np.nan)
    status = ("ok", "weak", "too_few_views", "ok")
    lines = Lines(("a b", "c", "d", "e"), ends, np.array([3, 2, 0, 2]), unknown, unknown, status)
    turns = torch.as_tensor(rng.normal(size=(images, 3))), torch.as_tensor(middle_m + rng.normal(size=(images, 3)))
    poses = Pose.exp(torch.cat([turns[0], torch.zeros(images, 3)], -1))
    poses = Pose(poses.rotation, -(poses.rotation @ turns[1][..., None])[..., 0])
    names = tuple(f"in/{k}.png" for k in range(images))
    of = tuple(list(cameras)[k % len(cameras)] for k in range(images))
    image, track = np.array([0, 1, 2, 1, 0, 2, 1]), np.array([0, 0, 0, 1, 1, 3, -1])
    segments = Segments(image, names, track, lines.tracks, rng.uniform(100, 500, (7, 2, 2)), cameras=of)
    folder.mkdir()
    save(folder / "calibration.yaml", cameras)
    write_poses(folder / "poses.csv", ImagePoses(names, poses, of))
    write_segments(folder / "segments.csv", segments)
    write_lines(folder / "lines.csv", lines)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return scene(tmp_path / "scene", Calibration({"cam0": LENS}))


def ends_of(folder: Path) -> np.ndarray:
    lines = ol.read_lines(folder / "lines.csv")
    return lines.ends_m[lines.known]


def test_dxf_is_read_by_ezdxf(folder: Path, tmp_path: Path) -> None:
    export = ol.export(folder, tmp_path / "lines.dxf")
    assert repr(export) == f"SceneExport({export.scene.lines}, format='dxf', out={str(tmp_path / 'lines.dxf')!r})"
    ((path,), lost) = ol.export(folder, tmp_path / "lines.dxf").save()
    document = ezdxf.readfile(path)
    assert not document.audit().errors
    found = list(document.modelspace().query("LINE"))
    assert [line.dxf.layer for line in found] == ["ok", "weak", "ok"]
    np.testing.assert_array_equal([[line.dxf.start, line.dxf.end] for line in found], ends_of(folder))
    assert "cameras and poses" in lost


def test_glb_is_read_by_trimesh_upright_and_to_a_millimetre_far_from_the_origin(folder: Path, tmp_path: Path) -> None:
    ((path,), _) = ol.export(folder, tmp_path / "scene.glb").save()
    drawn = trimesh.load(path)
    found = {}
    for node in drawn.graph.nodes_geometry:
        placed, name = drawn.graph.get(node)
        found[node] = trimesh.transformations.transform_points(drawn.geometry[name].vertices, placed)
    up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    wanted = ends_of(folder) @ up.T
    for node, rows in (("lines ok", [0, 2]), ("lines weak", [1])):
        ends = wanted[rows].reshape(-1, 3)
        off = np.linalg.norm(found[node][:, None] - ends, axis=-1)
        assert len(found[node]) == len(ends) and off.min(0).max() < 1e-3 and off.min(1).max() < 1e-3
    assert len(found["camera centres"]) == 3


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (0.48, -0.6, 0.64)])
def test_what_is_up_in_a_scene_is_up_in_glb_and_said_for_geojson(folder: Path, tmp_path: Path, up: tuple) -> None:
    save(folder / "calibration.yaml", Calibration({"cam0": LENS}, provenance={"up": list(up)}))
    ((path,), _) = ol.export(folder, tmp_path / "scene.glb").save()
    drawn = trimesh.load(path)
    ends = ends_of(folder)[[0, 2]].reshape(-1, 3)
    placed, name = drawn.graph.get("lines ok")
    points = trimesh.transformations.transform_points(drawn.geometry[name].vertices, placed)
    heights, wanted = (points - points.mean(0))[:, 1], (ends - ends.mean(0)) @ up
    np.testing.assert_allclose(np.sort(heights), np.sort(wanted), atol=1e-3)
    near = scene(tmp_path / "near", Calibration({"cam0": LENS}, provenance={"up": list(up)}), middle_m=np.zeros(3))
    _, lost = ol.export(near, tmp_path / "lines.geojson", origin=(48.0, 11.0, 0.0)).save()
    assert any("vertical" in one and "degrees from z" in one for one in lost)


@pytest.mark.parametrize("up", ["z", [0.0, 0.0], [0.0, 0.0, 0.0], [0.0, "a", 1.0]])
def test_an_up_that_is_no_direction_is_refused(folder: Path, tmp_path: Path, up: object) -> None:
    save(folder / "calibration.yaml", Calibration({"cam0": LENS}, provenance={"up": up}))
    with pytest.raises(InputError, match="three numbers, a direction"):
        ol.export(folder, tmp_path / "scene.glb")


PLACES = (
    ((48.1, 11.6, 520.0), (377.19066, -396.31459, 64.04227), (11.6050634392, 48.0964359861, 584.065727)),
    ((-33.8, 151.2, 30.0), (-1165.43494, -826.10232, -124.01112), (151.1874131343, -33.8074472764, -93.851060)),
    ((89.99, 10.0, 0.0), (-4055.59389, -1987.71634, -8.18003), (-42.5650749968, 89.9542721810, -6.586266)),
    ((-90.0, 0.0, 100.0), (964.42012, -2434.75245, 44.80918), (158.3911830577, -89.9765543054, 145.344993)),
    ((0.0, 179.9999, 5.0), (509.22026, -3195.03345, -0.18911), (-179.9955256000, -0.0288948828, 5.636863)),
)
"""Origin (latitude, longitude, height), metres east, north, up -> longitude, latitude, height, by PROJ 9.5.1 (pyproj 3.7.2)."""


@pytest.mark.parametrize(("origin", "place", "wanted"), PLACES)
def test_geojson_lies_where_proj_says(origin: tuple, place: tuple, wanted: tuple, tmp_path: Path) -> None:
    off = np.abs(geodetic(np.array([place, place]), Origin(*origin)) - wanted)
    assert off[:, :2].max() < 1e-9 and off[:, 2].max() < 1e-5
    folder = scene(tmp_path / "scene", Calibration({"cam0": LENS}), middle_m=np.array(place))
    ((path,), lost) = ol.export(folder, tmp_path / "lines.geojson", origin=origin).save()
    features = json.loads(path.read_text())["features"]
    assert [feature["properties"]["track"] for feature in features] == ["a b", "c", "e"]
    seen = [["in/0.png", "in/1.png", "in/2.png"], ["in/1.png", "in/0.png"], ["in/2.png"]]
    assert [feature["properties"]["photos"] for feature in features] == seen
    for feature, ends in zip(features, ends_of(folder), strict=True):
        assert feature["geometry"]["type"] == "LineString" and feature["properties"]["sigma_m"] is None
        assert feature["properties"]["length_m"] == pytest.approx(np.linalg.norm(ends[1] - ends[0]), abs=1e-4)
        np.testing.assert_allclose(feature["geometry"]["coordinates"], geodetic(ends, Origin(*origin)), rtol=0, atol=6e-5)
    assert "cameras and poses" in lost


def test_geojson_asks_for_an_origin_and_metres(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lines.geojson"
    with pytest.raises(InputError, match="needs `origin`"):
        ol.export(folder, out)
    with pytest.raises(InputError, match=r"`origin` is for geojson, .* found dxf"):
        ol.export(folder, tmp_path / "lines.dxf", origin=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="latitude of -90 to 90"):
        ol.export(folder, out, origin=(91.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"within 100 km of `origin`.* 5,423 km away; .*UTM"):
        ol.export(folder, out, origin=(48.0, 11.0, 0.0)).save()
    with pytest.raises(SystemExit) as stopped:
        main(["export", str(folder), str(out), "--origin", "48.1;11.6"])
    assert stopped.value.code == 2 and "--origin was expected as three numbers" in capsys.readouterr().err
    near = scene(tmp_path / "near", Calibration({"cam0": LENS}), middle_m=np.zeros(3))
    with pytest.raises(SystemExit) as stopped:
        main(["export", str(near), str(out), "--origin", "-33.8,151.2,30"])
    assert not stopped.value.code and out.is_file()
    save(near / "calibration.yaml", Calibration({"cam0": LENS}, provenance={"length_unit": "units"}))
    with pytest.raises(
        InputError,
        match=r"a scene in metres was expected, found units whose length .* reconstruct --scale-from",
    ):
        ol.export(near, out, origin=(48.0, 11.0, 0.0)).save()


@pytest.mark.parametrize("cameras", [{"cam0": LENS}, {"left": LENS, "right": Equirectangular([], (2048, 1024))}])
def test_nerfstudio_frames_project_as_ours(cameras: dict, tmp_path: Path) -> None:
    """By its documents: x right, y up, z backwards; pixels count from the corner of the image."""
    folder = scene(tmp_path / "scene", Calibration(cameras))
    poses = ol.read_poses(folder / "poses.csv")
    (tmp_path / "photos" / "in").mkdir(parents=True)
    for image in poses.images:
        (tmp_path / "photos" / image).touch()
    ((path,), _) = ol.export(folder, tmp_path / "transforms.json", photos=tmp_path / "photos").save()
    data = json.loads(path.read_text())
    assert [frame["file_path"] for frame in data["frames"]] == [f"photos/in/{k}.png" for k in range(3)]
    again = NerfstudioPoses().read(path)
    assert again.names == tuple(f"photos/{image}" for image in poses.images)
    torch.testing.assert_close(again.cam_from_world.translation, poses.cam_from_world.translation)
    torch.testing.assert_close(again.cam_from_world.rotation, poses.cam_from_world.rotation)
    for k, frame in enumerate(data["frames"]):
        lens = data | frame
        camera = list(cameras.values())[k % len(cameras)]
        bearings = np.random.default_rng(k).normal([0, 0, 1.5], 1, (50, 3))
        world = (poses.cam_from_world[k].inverse().transform(torch.as_tensor(bearings))).numpy()
        seen = (world - np.array(frame["transform_matrix"])[:3, 3]) @ np.array(frame["transform_matrix"])[:3, :3]
        x, y, z = (seen * [1, -1, -1]).T
        if lens["camera_model"] == "EQUIRECTANGULAR":
            across, down = np.arctan2(x, z) / np.pi, np.arctan2(y, np.hypot(x, z)) / np.pi
        else:
            r = np.hypot(x, y)
            theta = np.arctan2(r, z)
            scale = theta * (1 + sum(lens[f"k{n}"] * theta ** (2 * n) for n in range(1, 5))) / r
            across, down = scale * x, scale * y
        pixels = np.stack([lens["fl_x"] * across + lens["cx"], lens["fl_y"] * down + lens["cy"]], -1)
        ours, valid = camera.project(bearings)
        assert valid.mean() > 0.5
        np.testing.assert_allclose(pixels[valid] - 0.5, ours[valid], atol=1e-5)


@pytest.mark.parametrize("out", ["transforms.json", "colmap"])
def test_photos_that_are_missing_are_named(out: str, folder: Path, tmp_path: Path) -> None:
    photos, images = tmp_path / "photos", ol.read_poses(folder / "poses.csv").images
    (photos / "in").mkdir(parents=True)
    for image in images[:-1]:
        (photos / image).touch()
    with pytest.raises(InputError, match=rf"{images[-1]} does not exist; check the path\."):
        ol.export(folder, tmp_path / out, photos=photos)
    assert not (tmp_path / out).exists()


def test_what_nerfstudio_does_not_hold_is_fitted_and_said(tmp_path: Path) -> None:
    folder = scene(tmp_path / "scene", Calibration({"cam0": POLYNOMIAL}))
    _, lost = ol.export(folder, tmp_path / "transforms.json").save()
    assert any("cam0 (scaramuzza) fitted by" in one and "px RMS" in one for one in lost)


def test_photos_turned_by_their_exif_are_named(folder: Path, tmp_path: Path) -> None:
    """Trainers read photos as they stand in their files, and the cameras here are those of the upright ones."""
    photos, exif = tmp_path / "photos", Image.Exif()
    (photos / "in").mkdir(parents=True)
    for k, orientation in enumerate((1, 3, 3)):
        exif[0x0112] = orientation
        Image.new("L", (8, 6)).save(photos / "in" / f"{k}.png", exif=exif)
    _, lost = ol.export(folder, tmp_path / "transforms.json", photos=photos).save()
    assert lost[-1].startswith("2 of 3 photos, such as in/1.png, are used as their EXIF orientation turns them, and COLMAP, Nerf")
    _, lost = ol.export(folder, tmp_path / "transforms.json").save()
    assert not any("EXIF" in one for one in lost)


def test_limap_files_hold_lines_segments_and_photos(folder: Path, tmp_path: Path) -> None:
    ol.export(folder, tmp_path / "limap").save()
    rows = (tmp_path / "limap" / "structures" / "lines3D.txt").read_text().splitlines()
    assert rows[:2] == ["3", "1"] and rows[3:8] == ["3", "1 0", "2 0", "3 0", "-1.0"]
    np.testing.assert_array_equal(np.array(rows[2].split(), dtype=float).reshape(2, 3), ends_of(folder)[0])
    # The second segment of the second photo, and the second of the first.
    assert rows[10:13] == ["2", "2 1", "1 1"]
    segments = ol.read_segments(folder / "segments.csv")
    photos = (tmp_path / "limap" / "structures" / "structures2d.txt").read_text().splitlines()
    assert photos[:3] == ["3", "1", "0 2 0 0"]
    first = np.array(photos[3].split(), dtype=float)
    np.testing.assert_array_equal(first[:4], segments.endpoints_px[0].ravel() + 0.5)


def test_limap_itself_reads_them(folder: Path, tmp_path: Path) -> None:
    if not PEERS.is_file():
        pytest.skip(f"LIMAP reads its files in an environment of its own, which is absent: {PEERS}; `make bench` installs it")
    ol.export(folder, tmp_path / "limap").save()
    script = (
        "import sys, json, limap.scene as scene\n"
        "whole = scene.HolisticReconstruction(); whole.read_text(sys.argv[1])\n"
        "lines = whole.structure_recon.lines3D\n"
        "ends = [[*map(float, lines[k].start), *map(float, lines[k].end)] for k in sorted(lines)]\n"
        "print(json.dumps([ends, [len(lines[k].track.elements) for k in sorted(lines)]]))"
    )
    done = subprocess.run([PEERS, "-c", script, tmp_path / "limap"], capture_output=True, text=True, check=True)
    ends, seen = json.loads(done.stdout.splitlines()[-1])
    np.testing.assert_allclose(np.reshape(ends, (-1, 2, 3)), ends_of(folder), rtol=1e-15)
    assert seen == [3, 2, 1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "{scene} {out}/lines.dwg",
            "A name that tells the format was expected (*.dxf, *.glb, *.geojson, *.json, *limap*, *colmap*), found 'lines.dwg'",
        ),
        (
            "{scene} {out}/lines.dxf --to dwg",
            "A format of scenes is one of dxf, glb, geojson, nerfstudio, limap, colmap, found 'dwg'",
        ),
        ("{out} {out}/lines.dxf", "found no calibration.yaml in it"),
        ("{scene} {out}/lines.dxf --photos {out}", "--photos is for nerfstudio"),
        ("{scene} {out}/t.json --photos {out}/nowhere", "which is none"),
        ("{scene} {scene}/lines.csv --to dxf", "lines.csv"),
        ("{scene} {out} --to nerfstudio", "A file was expected for Nerfstudio, found the folder"),
        ("{scene} {out}/ns --to nerfstudio", "A file name ending in .json was expected for Nerfstudio, found"),
    ],
)
def test_what_cannot_be_exported_is_said(
    arguments: str, said: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    before = sorted(path.name for path in folder.iterdir())
    with pytest.raises(SystemExit) as stopped:
        main(["export", *arguments.format(scene=folder, out=tmp_path / "out").split()])
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err
    assert not list((tmp_path / "out").iterdir()) and sorted(path.name for path in folder.iterdir()) == before


def test_a_scene_without_poses_has_no_frames(folder: Path, tmp_path: Path) -> None:
    table = folder / "poses.csv"
    table.write_text(table.read_text().splitlines()[0] + "\n")
    with pytest.raises(InputError, match=r"poses"):
        ol.export(folder, tmp_path / "transforms.json").save()


def test_masks_are_not_written_among_the_photos(folder: Path, tmp_path: Path) -> None:
    """The next run took them for photos."""
    photos = tmp_path / "photos"
    for name in ol.read_poses(folder / "poses.csv").images:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        write_png(photos / name, np.full((240, 320), 90, dtype=np.uint8))
    with pytest.raises(InputError, match=r"Pictures were expected outside of the photos, found .*masks"):
        ol.export(folder, photos, to_format="colmap", photos=photos).save()
    assert not (photos / "masks").exists()


def test_colmap_for_splatting_is_read_by_pycolmap(tmp_path: Path) -> None:
    """A fisheye of 200 degrees whose image circle is black outside: native camera, poses, points to begin from, masks."""
    lens = OpenCVFisheye([80.0, 80.5, 159.5, 119.5, 0.01, -0.002, 0.0, 0.0], (320, 240))
    folder = scene(tmp_path / "scene", Calibration({"cam0": lens}))
    column, row = np.meshgrid(np.arange(320), np.arange(240))
    inside = (column - 160.0) ** 2 + (row - 119.0) ** 2 <= 115.0**2
    photos = tmp_path / "data" / "images"
    (photos / "in").mkdir(parents=True)
    for k in range(3):
        picture = np.where(inside, np.random.default_rng(k).integers(60, 200, (240, 320)), 0).astype(np.uint8)
        write_png(photos / "in" / f"{k}.png", picture)
    files, lost = ol.export(folder, tmp_path / "data", to_format="colmap", photos=photos).save()
    assert {path.relative_to(tmp_path / "data").as_posix() for path in files} == {
        *(f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D")),
        *(f"masks/in/{k}.png.png" for k in range(3)),
    }
    assert any("lines" in one for one in lost)
    model = pycolmap().Reconstruction(tmp_path / "data" / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert camera.model.name == "OPENCV_FISHEYE" and model.num_images() == 3
    bearings = np.random.default_rng(0).normal([0, 0, 2.0], 0.7, (40, 3))
    bearings = bearings[bearings[:, 2] > 0.2]
    np.testing.assert_allclose(np.array(camera.img_from_cam(bearings)) - 0.5, lens.project(bearings)[0], atol=1e-6)
    poses = ol.read_poses(folder / "poses.csv")
    for image in model.images.values():
        k = poses.images.index(image.name)
        ours = poses.cam_from_world[k]
        np.testing.assert_allclose(image.cam_from_world().matrix()[:, :3], ours.rotation, atol=1e-9)
    points = np.array([point.xyz for point in model.points3D.values()])
    ends = ends_of(folder)
    way = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1, keepdims=True)
    off = np.linalg.norm(np.cross(points[:, None] - ends[:, 0], way), axis=-1).min(-1)
    assert len(points) > 1000 and off.max() < 1e-6
    mask = read_photo(tmp_path / "data" / "masks" / "in" / "1.png.png") > 0
    bearing = lens.unproject(np.stack([column, row], -1).astype(float))[0]
    wanted = inside & (bearing[..., 2] > 0)
    # The rim is found a little inside, where it is not blurred.
    assert (mask & ~wanted).mean() < 0.002 and (wanted & ~mask).mean() < 0.02
    _, told = ol.export(folder, tmp_path / "other_colmap").save()
    assert any("image circles" in one for one in told)
    write_png(photos / "in" / "0.png", picture[:100])
    with pytest.raises(InputError, match="expected to be 320x240 px as its camera, found 320x100"):
        ol.export(folder, tmp_path / "more_colmap", photos=photos).save()
    assert not (tmp_path / "more_colmap").exists()
