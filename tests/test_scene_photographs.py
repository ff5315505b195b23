"""Photographs as textures of rendered scenes: where each pixel of theirs is seen, how they look from afar, what is refused."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_models import InputError, Pinhole
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.scenes import build_scene, eye, render_clean, scene_camera, scene_edges, scene_poses, visible_stretches
from omnilines.scenes.building import Builder, Frame, colour
from omnilines.scenes.photo_texture import PLACES, photo_texture, with_photographs
from omnilines.scenes.polygon_scene import Lamps, PolygonScene, Texture

EVEN_LIGHT = Lamps(np.zeros((0, 3)), np.zeros(0), np.zeros(0), 1.0, 0.0, np.zeros(2))
WIDTH_M = 1.6


def one_wall() -> PolygonScene:
    """A wall of 8 x 8 m, 2 m in front of the origin along y, its first corner at (-4, 2, -4)."""
    build = Builder([Texture(np.zeros((0, 2)), np.zeros(0), np.zeros(0))])
    build.wall(np.array([[-4.0, 2, -4], [4, 2, -4], [4, 2, 4], [-4, 2, 4]]), colour(100.0))
    build.keep_out(Frame.at(9.0, 9.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    return build.scene(EVEN_LIGHT, np.stack([colour(128.0)] * 2), np.full(3, -1.0), np.full(3, 1.0))


def looking(yaw_deg: float) -> Pose:
    """From the origin, upright, along y turned by a yaw."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return Pose.of([[c, s, 0.0], [0.0, 0.0, -1.0], [-s, c, 0.0]], [0.0, 0.0, 0.0])


def waves(count: int) -> np.ndarray:
    """A photograph of 400 x 300 px of that many waves across, and one less up and down in another channel, 16 bits."""
    u, v = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(300) + 0.5) / 300)
    green, red = (120.0 + 80.0 * np.cos(2 * np.pi * k * x) for k, x in ((count, u), (count - 1, v)))
    return np.rint(257.0 * np.stack([np.full_like(u, 90.0), green, red], -1)).astype(np.uint16)


def pinhole() -> Pinhole:
    return Pinhole.from_mapping({"fx": 300.0, "fy": 300.0, "cx": 199.5, "cy": 149.5}, (400, 300))


@pytest.mark.parametrize("yaw_deg", [0.0, 35.0])
def test_a_photograph_lies_on_its_wall_in_perspective(yaw_deg: float) -> None:
    """Waves of the photograph, seen straight on and at a slant, against the closed form of where each ray meets the wall."""
    scene = with_photographs(one_wall(), [waves(3)], 0, WIDTH_M)
    camera, pose = pinhole(), looking(yaw_deg)
    image = render_clean(scene, eye(camera, math.pi), pose)
    v, u = np.mgrid[:300, :400]
    ray, _ = camera.unproject(np.stack([u, v], -1).astype(np.float64))
    world = ray @ pose.rotation.numpy()
    along, up = (2.0 * world[..., k] / world[..., 1] for k in (0, 2))
    inside = (np.abs(along) < 3.9) & (np.abs(up) < 3.9)
    # Cosines of whole waves are their own mirror images; coordinates begin at the world's origin.
    height_m = WIDTH_M * 300 / 400
    green = 120.0 + 80.0 * np.cos(2 * np.pi * 3 * along / WIDTH_M)
    red = 120.0 + 80.0 * np.cos(2 * np.pi * 2 * up / height_m)
    assert inside.mean() > 0.8
    assert np.abs(image[..., 1] - green)[inside].max() < 1.5
    assert np.abs(image[..., 0] - red)[inside].max() < 1.5
    assert np.abs(image[..., 2] - 90.0)[inside].max() < 0.1


def test_a_photograph_seen_from_afar_is_its_mean() -> None:
    """Waves of a third of a pixel would come out as coarse ones where single points were taken."""
    scene = with_photographs(one_wall(), [waves(100)], 0, 0.2)
    image = render_clean(scene, eye(pinhole(), math.pi), looking(0.0))
    assert np.ptp(image[10:-10, 10:-10, 1]) < 3.0
    assert image[..., 1].mean() == pytest.approx(120.0, abs=1.0)


def test_photographs_cover_what_is_named_and_leave_the_edges() -> None:
    scene = build_scene("room", 3)
    photos = [waves(5), waves(9)[:200], np.full((40, 40), 77, dtype=np.uint8)]
    covered = with_photographs(scene, photos, 3)
    np.testing.assert_array_equal(scene_edges(scene), scene_edges(covered))
    of_photo = covered.texture >= len(scene.textures)
    assert set(covered.texture[of_photo].tolist()) == {5, 6, 7}
    # One photograph for all pieces of a surface, and its mean as the colour that the tables compare.
    for surface in np.unique(scene.surface):
        assert len(set(covered.texture[scene.surface == surface].tolist())) == 1
    np.testing.assert_allclose(covered.albedo[covered.texture == 7], 77.0, rtol=1e-6)
    apart = [with_photographs(scene, photos, 3, places=[place]).texture >= len(scene.textures) for place in PLACES]
    np.testing.assert_array_equal(np.sum(apart, 0), of_photo)
    assert all(part.any() for part in apart)
    upward = np.cross(scene.corners_m[:, 1] - scene.corners_m[:, 0], scene.corners_m[:, 2] - scene.corners_m[:, 0])[:, 2]
    walls, floors, ceilings, _ = apart
    assert (upward[floors] > 0).all() and (upward[ceilings] < 0).all() and (np.abs(upward[walls]) < 1e-9).all()
    camera, circle = scene_camera("opencv-fisheye", (320, 240), 3)
    look, pose = eye(camera, circle), scene_poses(scene, 1, 3, camera)[0]
    grey = [render_clean(one, look, pose)[..., 1] for one in (scene, covered)]
    assert np.std(grey[1] - grey[0]) > 20
    assert len(visible_stretches(covered, look, pose, scene_edges(scene))[0]) > 200


@pytest.mark.slow
def test_command_takes_a_folder_of_photographs(tmp_path: Path, capsys) -> None:
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "gravel.jpg"), (waves(20) // 257).astype(np.uint8))
    arguments = ["render", "scene", "--views", "1", "--size", "160x120", "--json"]
    for folder, more in (("plain", []), ("gravel", ["--textures", str(tmp_path / "photos"), "--textured", "floors,walls"])):
        with pytest.raises(SystemExit) as end:
            main([*arguments, *more, "--out", str(tmp_path / folder)])
        assert end.value.code == 0
    assert json.loads(capsys.readouterr().out.split("}\n{")[0] + "}")["photos"] == ["view00.png"]
    assert (tmp_path / "plain" / "truth.csv").read_bytes() == (tmp_path / "gravel" / "truth.csv").read_bytes()
    assert (tmp_path / "plain" / "view00.png").read_bytes() != (tmp_path / "gravel" / "view00.png").read_bytes()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: with_photographs(one_wall(), [waves(3)], 0, places=["roofs"]), "walls, floors, ceilings, furniture .*'roofs'"),
        (lambda: with_photographs(one_wall(), [], 0), "Photographs .* expected, found none"),
        (lambda: photo_texture(waves(3)[:8], 1.0), "16x16 px or more .* found 400x8 px"),
        (lambda: photo_texture(waves(3), 0.0), "a width above 0 m .* 0 m"),
    ],
)
def test_wrong_photographs_are_named(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
