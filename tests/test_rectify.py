"""omnilines rectify: views against photos rendered directly with the camera and pose that the command states."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from camera_models import Calibration, load, save
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.files import read_poses, write_poses
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.pipelines.rendered import RenderedScene
from omnilines.records import ImagePoses
from omnilines.scenes import eye, render_photo

CASES = [
    ("perspective", ["--size", "320x240", "--fov-deg", "80", "--yaw-deg", "20", "--pitch-deg", "-10"], 1),
    ("cylindrical", ["--size", "480x240", "--fov-deg", "170"], 1),
    ("panorama", ["--size", "480x240"], 1),
    ("cube", ["--size", "200x200"], 6),
]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> tuple[RenderedScene, str]:
    folder = tmp_path_factory.mktemp("scene")
    options = RenderOptions(fov_deg=190.0, views=2, size_px=(800, 600), noise_grey=0.0, blur_px=0.0, seed=1)
    made = render_scene("room", "opencv-fisheye", options)
    made.save(folder)
    return made, str(folder)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    return int(end.value.code or 0)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "options", "faces"), CASES, ids=[case[0] for case in CASES])
def test_views_are_what_their_camera_would_see(rendered, tmp_path, capsys, kind: str, options: list[str], faces: int) -> None:
    scene, folder = rendered
    inputs = ["--calibration", f"{folder}/calibration.yaml", "--poses", f"{folder}/poses.csv", "--out", str(tmp_path)]
    assert run("rectify", folder, *inputs, "--view", kind, *options, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert len(data["views"]) == 2 * faces and data["photos"] == 2
    camera, poses = load(tmp_path / "calibration.yaml")[kind], read_poses(tmp_path / "poses.csv")
    assert list(poses.images) == data["views"] and set(poses.cameras) == {kind}
    compared = 0
    for k, name in enumerate(poses.images):
        view = cv2.imread(str(tmp_path / name)).astype(int)
        direct = render_photo(scene.scene, eye(camera, np.pi), poses.cam_from_world[k]).astype(int)
        # Where the photo saw it, away from its dimmer rim: the direction in the frame of the photo.
        photo = scene.poses.cam_from_world[list(scene.poses.images).index(photo_of(name))]
        v, u = np.mgrid[: view.shape[0], : view.shape[1]]
        bearings, valid = camera.unproject(np.stack([u, v], -1).astype(np.float64))
        photo_from_view = (photo.rotation @ poses.cam_from_world[k].rotation.T).numpy()
        theta = np.degrees(np.arccos(np.clip((bearings @ photo_from_view.T)[..., 2], -1, 1)))
        shown = valid & (theta < 85)
        assert (view[theta > 100] <= 5).all()
        if shown.sum() < 500:
            continue
        ratio = (view[shown].mean(-1) + 1) / (direct[shown].mean(-1) + 1)
        dimmed = 1 - 0.3 * (theta[shown] / 95) ** 2 * 0.36  # vignetting by the square of the radius, 480 of 800 px at the corner
        off = ratio / dimmed - 1
        assert abs(np.median(off)) < 0.03
        assert (np.abs(off) < 0.12).mean() > 0.85
        compared += 1
    assert compared >= 2


def photo_of(view: str) -> str:
    return view.split(".")[0].split("_")[0] + ".png"


def test_colmap_model_has_the_same_cameras(rendered, tmp_path) -> None:
    _, folder = rendered
    inputs = ["--calibration", f"{folder}/calibration.yaml", "--poses", f"{folder}/poses.csv", "--out", str(tmp_path)]
    assert run("rectify", folder, *inputs, "--view", "cube", "--size", "100x100") == 0
    rows = [line.split() for line in (tmp_path / "colmap/cameras.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(rows) == 1 and rows[0][:4] == ["1", "SIMPLE_PINHOLE", "100", "100"]
    np.testing.assert_allclose([float(x) for x in rows[0][4:]], [50.0, 50.0, 50.0], atol=1e-12)
    lines = [line for line in (tmp_path / "colmap/images.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == 24 and not any(lines[1::2])
    poses = read_poses(tmp_path / "poses.csv")
    camera = load(tmp_path / "calibration.yaml")["cube"]
    point = np.random.default_rng(0).uniform(-1, 4, (20, 3))
    for k, line in enumerate(lines[::2]):
        cells = line.split()
        assert cells[0] == str(k + 1) and cells[8:] == ["1", poses.images[k]]
        w, x, y, z, *translation = map(float, cells[1:8])
        in_camera = Rotation.from_quat([x, y, z, w]).apply(point) + translation
        ours = poses.cam_from_world[k].transform(torch.as_tensor(point)).numpy()
        np.testing.assert_allclose(in_camera, ours, atol=1e-12)
        pixels, valid = camera.project(ours)
        front = in_camera[:, 2] > 1e-3
        assert (valid[in_camera[:, 2] > 1e-2]).all()
        theirs = 50.0 * in_camera[front, :2] / in_camera[front, 2:] + 50.0
        np.testing.assert_allclose(theirs, pixels[front] + 0.5, atol=1e-8)
    assert (tmp_path / "colmap/points3D.txt").read_text().startswith("#")


def test_without_poses_and_in_subfolders(rendered, tmp_path) -> None:
    _, folder = rendered
    (tmp_path / "in" / "left").mkdir(parents=True)
    for name in ("view00.png", "view01.png"):
        (tmp_path / "in" / "left" / name).write_bytes((Path(folder) / name).read_bytes())
    calibration = ["--calibration", f"{folder}/calibration.yaml"]
    assert run("rectify", str(tmp_path / "in"), *calibration, "--size", "100x80", "--out", str(tmp_path / "out")) == 0
    assert (tmp_path / "out/left/view01.png").exists()
    assert not (tmp_path / "out/poses.csv").exists() and not (tmp_path / "out/colmap").exists()
    assert load(tmp_path / "out/calibration.yaml")["perspective"].image_size == (100, 80)


def test_photos_of_16_bits_give_views_of_16_bits(rendered, tmp_path) -> None:
    _, folder = rendered
    (tmp_path / "in").mkdir()
    photo = cv2.imread(f"{folder}/view00.png")
    cv2.imwrite(f"{tmp_path}/in/shallow.png", photo)
    cv2.imwrite(f"{tmp_path}/in/deep.tif", photo.astype(np.uint16) * 257)
    inputs = ["--calibration", f"{folder}/calibration.yaml", "--size", "100x80", "--out", str(tmp_path / "out")]
    assert run("rectify", str(tmp_path / "in"), *inputs) == 0
    shallow, deep = (cv2.imread(str(tmp_path / "out" / name), cv2.IMREAD_UNCHANGED) for name in ("shallow.png", "deep.png"))
    assert deep.dtype == np.uint16
    assert np.abs(deep / 257 - shallow).max() <= 1


def test_photos_that_cannot_be_used_are_skipped(rendered, tmp_path, capsys) -> None:
    """Also one that its EXIF orientation turns by half a turn: it has the right size, and other pixels of the sensor."""
    _, folder = rendered
    (tmp_path / "in").mkdir()
    photo = cv2.imread(f"{folder}/view00.png")
    for name, pixels in (("a", photo), ("b", photo[::-1]), ("small", photo[:300]), ("tall", photo.transpose(1, 0, 2))):
        cv2.imwrite(f"{tmp_path}/in/{name}.png", pixels)
    (tmp_path / "in/empty.jpg").write_bytes(b"")
    turned = Image.Exif()
    turned[0x0112] = 3
    Image.fromarray(photo[..., ::-1]).save(tmp_path / "in/turned.jpg", exif=turned.tobytes())
    inputs = ["--calibration", f"{folder}/calibration.yaml", "--size", "100x80", "--out", str(tmp_path / "out")]
    assert run("rectify", str(tmp_path / "in"), *inputs, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["views"] == ["a.png", "b.png"] and data["photos"] == 2
    for sentence in (
        "small.png is skipped: A photo of 800x600 px was expected, as the camera has, found 800x300 px; give the one that the",
        "tall.png is skipped: A photo of 800x600 px was expected, as the camera has, found 600x800 px, which looks turned; turn",
        "empty.jpg is skipped: The image",
        "turned.jpg is skipped: its EXIF orientation turns it by 180 degrees",
    ):
        assert sum(sentence in note for note in data["notes"]) == 1, sentence
    assert run("rectify", str(tmp_path / "in/small.png"), *inputs) == 2
    assert "No photo of 1 can be used (first reason: A photo of 800x600 px was expected" in capsys.readouterr().err


def test_black_views_are_named_in_one_sentence(tmp_path, capsys) -> None:
    made = render_scene("room", "pinhole", RenderOptions(fov_deg=60.0, views=1, size_px=(160, 120), seed=1))
    made.save(tmp_path / "in")
    inputs = ["rectify", f"{tmp_path}/in", "--calibration", f"{tmp_path}/in/calibration.yaml", "--out", f"{tmp_path}/out"]
    assert run(*inputs, "--view", "cube", "--size", "40x40") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("note: ") == 1
    assert "The photos show nothing of the views right, back, left, up, down; they are black." in said
    assert run(*inputs, "--yaw-deg", "180") == 0
    assert "The photos show nothing of the view perspective; it is black." in " ".join(capsys.readouterr().err.split())


def test_several_cameras(rendered, tmp_path, capsys) -> None:
    """Each photo through its own camera; the frame of a rig is kept."""
    scene, folder = rendered
    wide = scene.camera.with_parameters(scene.camera.parameters * torch.tensor([1.1, 1.1, 1, 1, 1, 1, 1, 1]))
    save(tmp_path / "two.yaml", Calibration({"a": scene.camera, "b": wide}))
    poses = ImagePoses(scene.poses.images, scene.poses.cam_from_world, ("a", "b"), None, ("7", "8"))
    write_poses(tmp_path / "poses.csv", poses)
    inputs = ["--calibration", str(tmp_path / "two.yaml"), "--size", "120x90", "--fov-deg", "70"]
    assert run("rectify", folder, *inputs, "--out", str(tmp_path / "x")) == 2
    assert "give --poses with the camera of every photo" in " ".join(capsys.readouterr().err.split())
    assert run("rectify", folder, *inputs, "--poses", str(tmp_path / "poses.csv"), "--out", str(tmp_path / "x")) == 0
    assert run("rectify", folder, *inputs[2:], "--calibration", f"{folder}/calibration.yaml", "--out", str(tmp_path / "y")) == 0
    first, second = ((cv2.imread(str(tmp_path / way / "view01.png")).astype(int)) for way in "xy")
    assert np.abs(first - second).mean() > 1
    same = [cv2.imread(str(tmp_path / way / "view00.png")) for way in "xy"]
    assert (same[0] == same[1]).all()
    assert read_poses(tmp_path / "x/poses.csv").frames == ("7", "8")


def test_poses_of_another_tool_are_taken_and_photos_that_it_did_not_place_left_out(rendered, tmp_path, capsys) -> None:
    """They had to be made a poses.csv first; photos without a pose had to be taken out of their folder."""
    scene, folder = rendered
    first, name = scene.poses.cam_from_world.inverse()[0], scene.poses.images[0]
    matrix = np.vstack([np.column_stack([first.rotation.numpy(), first.translation.numpy()]), [0.0, 0.0, 0.0, 1.0]])
    frame = {"file_path": f"./{name}", "transform_matrix": (matrix @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV_FISHEYE", "frames": [frame]}))
    base = ["rectify", folder, "--calibration", f"{folder}/calibration.yaml", "--size", "60x40", "--out", str(tmp_path / "out")]
    assert run(*base, "--poses", str(tmp_path / "transforms.json")) == 0
    assert f"{scene.poses.images[1]} is left out" in " ".join(capsys.readouterr().err.split())
    views = read_poses(tmp_path / "out" / "poses.csv")
    assert views.images == (name,)
    torch.testing.assert_close(views.cam_from_world.translation, scene.poses.cam_from_world.translation[:1], atol=1e-9, rtol=0)
    assert (tmp_path / "out" / "colmap" / "images.txt").is_file()
    assert run(*base, "--poses", "sfm") == 2
    assert "run omnilines reconstruct with --poses sfm first" in " ".join(capsys.readouterr().err.split())


def test_cameras_on_the_body_of_a_trajectory_are_told_where_they_sit(rendered, tmp_path) -> None:
    """`reconstruct` was, here the views had the poses of the body."""
    scene, folder = rendered
    (tmp_path / "in").mkdir()
    for k, image in enumerate(scene.poses.images):
        (tmp_path / "in" / f"{k}.png").write_bytes(Path(folder, image).read_bytes())
    cam_from_body = Pose.exp(torch.tensor([[0.2, -0.1, 0.3, 0.05, 0.1, -0.02]], dtype=torch.float64))[0]
    world_from_body = scene.poses.cam_from_world.inverse() @ cam_from_body
    rows = torch.cat([world_from_body.rotation, world_from_body.translation[..., None]], -1).flatten(1)
    (tmp_path / "poses.txt").write_text("".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()))
    matrix = [[*row, t] for row, t in zip(cam_from_body.rotation.tolist(), cam_from_body.translation.tolist(), strict=True)]
    (tmp_path / "camchain.yaml").write_text(f"cam0:\n  T_cam_imu: {[*matrix, [0.0, 0.0, 0.0, 1.0]]}\n")
    given = ["--poses", str(tmp_path / "poses.txt"), "--body", str(tmp_path / "camchain.yaml")]
    base = ["--calibration", f"{folder}/calibration.yaml", "--size", "60x40", "--out", str(tmp_path / "out")]
    assert run("rectify", str(tmp_path / "in"), *base, *given) == 0
    views = read_poses(tmp_path / "out" / "poses.csv").cam_from_world
    torch.testing.assert_close(views.translation, scene.poses.cam_from_world.translation, atol=1e-9, rtol=0)


def test_wrong_inputs_are_named(rendered, tmp_path, capsys) -> None:
    scene, folder = rendered
    one = ImagePoses(scene.poses.images[:1], scene.poses.cam_from_world[:1])
    write_poses(tmp_path / "one.csv", one)
    write_poses(tmp_path / "other.csv", ImagePoses(scene.poses.images, scene.poses.cam_from_world, ("cam7", "cam7")))
    base = ["rectify", folder, "--calibration", f"{folder}/calibration.yaml", "--out", str(tmp_path / "out")]
    for options, message in (
        (["--poses", str(tmp_path / "one.csv")], "A pose of every photo was expected, found none of 'view01.png'"),
        (["--poses", str(tmp_path / "other.csv")], "found 'cam7'; name one of cam0"),
        (["--view", "globe"], "one of perspective, cylindrical, panorama, cube, found 'globe'"),
        (["--size", "12"], "--size was expected as WIDTHxHEIGHT"),
    ):
        assert run(*base, *options) == 2
        assert message in " ".join(capsys.readouterr().err.split())
