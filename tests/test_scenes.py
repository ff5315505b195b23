"""Rendered rooms, flats and streets: photos against areas, visibility against brute-force rays, edges against closed forms."""

import dataclasses
import itertools
import json
import math

import cv2
import numpy as np
import pytest
import torch
from scene_rays import EVEN_LIGHT, PLAIN, SIZE, brute_force

from camera_models import Equirectangular, GeometryError, InputError, Scaramuzza
from omnilines.cli import main
from omnilines.files import read_poses
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.scenes import (
    SCENES,
    build_scene,
    eye,
    furnished_room,
    largest_angle,
    plain_room,
    render_clean,
    render_photo,
    scene_camera,
    scene_edges,
    scene_poses,
    visible_stretches,
)
from omnilines.scenes.building import Builder, Frame, colour
from omnilines.scenes.plain_room import THINNEST_M
from omnilines.scenes.visibility import CONTRAST_LEVELS


def test_edges_of_a_box_on_a_floor() -> None:
    """Closed form: the twelve edges of a box, those of the floor, and collinear sides joined; no seam round an opening."""
    build = Builder([PLAIN])
    floor = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]])
    surface = build.wall(floor, colour(100.0), 0, [(1.0, 1.0, 2.0, 2.0)])
    build.box(Frame.at(3.0, 3.0, 0.0, 30.0), (0.0, 0.0, 0.0), (0.5, 0.5, 0.5), colour(50.0))
    build.paint(surface, (0.0, 3.0, 1.0, 3.5), colour(60.0))
    build.paint(surface, (1.0, 3.0, 1.5, 3.5), colour(70.0))
    edges = scene_edges(build.scene(EVEN_LIGHT, np.zeros((2, 3)), np.zeros(3), np.ones(3)))
    # Of the box, the floor, the opening; of the paint two joined sides and two across (the third is part of the floor's side).
    assert len(edges) == 12 + 4 + 4 + 4
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
    assert sorted(np.round(length, 9).tolist()) == [0.5] * 14 + [1.0] * 4 + [1.5] * 2 + [4.0] * 4


@pytest.mark.parametrize("name", SCENES)
def test_no_edges_overlap(name: str) -> None:
    edges = scene_edges(build_scene(name, 1))
    assert len(edges) > {"plain-room": 200, "books": 400}.get(name, 500)
    middle = edges.mean(1)
    direction = edges[:, 1] - edges[:, 0]
    length = np.linalg.norm(direction, axis=-1)
    direction /= length[:, None]
    overlaps = 0
    every = range(0, len(edges), 7)
    for k in every:
        step = middle[k] - edges[:, 0]
        along = (step * direction).sum(-1)
        off = np.linalg.norm(step - along[:, None] * direction, axis=-1)
        parallel = np.linalg.norm(np.cross(direction, direction[k]), axis=-1) < 1e-6
        overlaps += int(((off < 1e-6) & parallel & (along > 0) & (along < length)).sum())
    assert overlaps == len(every)  # each only with itself


def test_edges_of_the_plain_room_keep_apart() -> None:
    """Parallel edges that overlap along their direction are 0.1 m or more apart, but for those of things that stand on or before
    others."""
    edges = scene_edges(plain_room(2))
    direction = edges[:, 1] - edges[:, 0]
    length = np.linalg.norm(direction, axis=-1)
    assert length.min() > 0.02 and len(edges) < 0.4 * len(scene_edges(furnished_room(2)))
    direction /= length[:, None]
    close = 0
    for k in range(len(edges)):
        step = edges.mean(1)[k] - edges[:, 0]
        along = (step * direction).sum(-1)
        off = np.linalg.norm(step - along[:, None] * direction, axis=-1)
        parallel = np.linalg.norm(np.cross(direction, direction[k]), axis=-1) < 1e-3
        close += bool((parallel & (off > 1e-6) & (off < THINNEST_M - 1e-6) & (along > 0) & (along < length)).any())
    assert close < 0.15 * len(edges)


@pytest.mark.slow
def test_equal_brightness_and_different_colour() -> None:
    for hue in np.linspace(0, 330, 12):
        tone = colour(130.0, hue, 40.0)
        assert tone @ [0.299, 0.587, 0.114] == pytest.approx(130.0, abs=1e-9)
        assert np.abs(tone - 130.0).max() > 15
    shares = []
    for seed in range(2):
        scene = furnished_room(seed)
        camera, circle = scene_camera("opencv-fisheye", SIZE, seed, 190.0)
        pose = scene_poses(scene, 1, seed)[0]
        _, _, length, contrast = visible_stretches(scene, eye(camera, circle), pose, scene_edges(scene))
        strong = contrast[:, 1] >= 10
        shares.append(length[strong & (contrast[:, 0] < 10)].sum() / length[strong].sum())
        assert (contrast[:, 1] >= contrast[:, 0] - 1e-9).all()
        # No stretch straddles a level.
        level = np.searchsorted(CONTRAST_LEVELS, contrast[:, 1])
        assert set(level.tolist()) == set(range(len(CONTRAST_LEVELS) + 1))
    assert all(0.08 < share < 0.45 for share in shares)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.slow
def test_cameras_stand_in_free_space(name: str) -> None:
    """Whatever a camera looks at first is a front: it stands in no box; and nothing is nearer than the clearance."""
    directions = np.random.default_rng(0).standard_normal((40, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    count = 0
    for seed in range(2):
        scene = build_scene(name, seed)
        poses = scene_poses(scene, 6, seed)
        backs = dataclasses.replace(scene, corners_m=scene.corners_m[:, ::-1])
        for pose in poses.centre.numpy():
            front, _ = brute_force(scene, pose, directions)
            back, _ = brute_force(backs, pose, directions)
            assert (front <= back).all()
            assert front.min() > 0.25
            count += 1
        apart = torch.cdist(poses.centre, poses.centre) + 10 * torch.eye(len(poses))
        if scene.dome is not None:
            # The middle of the table is near the middle of the photo, and the nearest photos are still apart.
            towards = (poses.rotation[:, 2] * -poses.centre).sum(-1) / poses.centre.norm(dim=-1)
            assert apart.min() > 0.1 and towards.min() > math.cos(math.radians(4.0))
            assert poses.centre[:, 2].min() > 0.4
            continue
        assert apart.min() > 0.4
        # Level to within the pitch and roll that are promised, and looking in all directions.
        up = poses.rotation[:, :, 2]
        assert (up[:, 1] < -0.9).all()
        azimuth = torch.atan2(poses.rotation[:, 2, 1], poses.rotation[:, 2, 0]).sort().values
        assert torch.diff(azimuth).max() < 2.0
    assert count == 12


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_photos_are_walked_through_the_flat(seed: int) -> None:
    """Thirteen photos, 1 to 2 m apart at the height of the eye, two to four in each of the five rooms; each sees the next one."""
    scene = build_scene("flat", seed)
    poses = scene_poses(scene, 13, seed)
    places = poses.centre.numpy()
    apart = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    assert (apart > 1.0).all() and (apart < 2.0).all()
    assert (np.abs(places[:, 2] - 1.5) < 0.1).all()
    # The plane under each is a floor, which paint shares, or the threshold of a doorway, which is of both rooms.
    under = [int(scene.plane[brute_force(scene, place, np.array([[0.0, 0.0, -1.0]]))[1][0]]) for place in places]
    size = {plane: np.ptp(scene.corners_m[scene.plane == plane].reshape(-1, 3), axis=0) for plane in under}
    rooms = [plane for plane in dict.fromkeys(under) if size[plane][:2].min() > 2.0]
    assert len(rooms) == 5 and all(size[plane][2] == 0 for plane in under)
    counts = [sum(plane == room for plane in under) for room in rooms]
    assert min(counts) >= 2 and max(counts) <= 4
    for near, far in itertools.pairwise(places):
        step = np.linalg.norm(far - near)
        distance, _ = brute_force(scene, near, (far - near)[None] / step)
        assert distance[0] > step


def test_the_image_circle_is_black_outside() -> None:
    scene = furnished_room(0)
    camera, circle = scene_camera("opencv-fisheye", SIZE, 0, 190.0)
    assert math.degrees(largest_angle(camera, circle)) == pytest.approx(95.0)
    image = render_clean(scene, eye(camera, circle), scene_poses(scene, 1, 0)[0])
    v, u = np.mgrid[:480, :640]
    bearings, valid = camera.unproject(np.stack([u, v], -1).astype(np.float64))
    theta = np.arctan2(np.hypot(bearings[..., 0], bearings[..., 1]), bearings[..., 2])
    step = math.radians(0.6)
    assert np.ptp(image[~valid | (theta > circle + step)]) == 0
    assert (image[valid & (theta < circle - step)].mean(-1) > 8).mean() > 0.95
    panorama, everything = scene_camera("equirectangular", (200, 100), 0)
    assert isinstance(panorama, Equirectangular) and everything == math.pi


def test_mirror_images_are_reversed() -> None:
    """A mirror has the lens's own curve, turned back to front, and its cameras look the other way along z."""
    camera, circle = scene_camera("scaramuzza", (160, 120), 1, 190.0)
    mirror, same = scene_camera("scaramuzza", (160, 120), 1, 190.0, mirror=True)
    assert isinstance(mirror, Scaramuzza) and circle == same
    scene = furnished_room(1)
    one, other = scene_poses(scene, 3, 1, camera), scene_poses(scene, 3, 1, mirror)
    np.testing.assert_allclose(one.centre, other.centre, atol=1e-12)
    np.testing.assert_allclose(one.rotation[:, 2], -other.rotation[:, 2], atol=1e-12)
    pixels = np.random.default_rng(0).uniform(40, 80, (50, 2))
    np.testing.assert_allclose(mirror.unproject(pixels)[0], camera.unproject(pixels)[0] * [1, 1, -1], atol=1e-14)


@pytest.mark.slow
def test_command_writes_what_it_says(tmp_path, capsys) -> None:
    arguments = ["render", "scene", "--views", "2", "--size", "160x120", "--seed", "6", "--json"]
    for folder in ("a", "b"):
        with pytest.raises(SystemExit) as end:
            main([*arguments, "--out", str(tmp_path / folder)])
        assert end.value.code == 0
    data = json.loads(capsys.readouterr().out.split("}\n{")[0] + "}")
    assert data["scene"] == "room" and data["photos"] == ["view00.png", "view01.png"] and data["holds"]
    for name in (*data["photos"], "poses.csv", "truth.csv", "visibility.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    edges = read_true_edges(tmp_path / "a" / "truth.csv")
    stretches = read_stretches(tmp_path / "a" / "visibility.csv", edges)
    assert len(edges) == data["edges"] and len(stretches) == data["stretches"] > 100
    np.testing.assert_array_equal(edges.ends_m, scene_edges(furnished_room(6)))
    poses = read_poses(tmp_path / "a" / "poses.csv")
    np.testing.assert_allclose(poses.cam_from_world.translation, scene_poses(furnished_room(6), 2, 6).translation, atol=1e-12)
    photo = cv2.imread(str(tmp_path / "a" / "view01.png"))
    assert photo.shape == (120, 160, 3)
    # Rows are sorted and those of one edge do not overlap.
    same = (np.diff(stretches.edge) == 0) & (np.diff(stretches.image) == 0)
    assert same.sum() > 10 and (stretches.t[1:, 0] >= stretches.t[:-1, 1])[same].all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: build_scene("castle", 0), "one of room, plain-room, flat, street, books, found 'castle'"),
        (lambda: furnished_room(0, (2.0, 4.0, 3.0)), "found 2 x 4 x 3 m"),
        (lambda: furnished_room(-1), "seed of at least 0"),
        (lambda: scene_camera("pinhole", SIZE, 0, 80.0, mirror=True), "--model scaramuzza, found pinhole"),
        (lambda: scene_camera("equirectangular", SIZE, 0, 190.0), "shows 360 degrees, found 190"),
        (lambda: scene_camera("pinhole", SIZE, 0, 190.0), "field of view"),
        (lambda: scene_poses(furnished_room(0), 0, 0), "At least 1 view"),
    ],
)
def test_wrong_options_are_named(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_a_scene_without_room_for_cameras_is_refused() -> None:
    scene = furnished_room(0)
    full = dataclasses.replace(scene, boxes=dataclasses.replace(scene.boxes, half_m=scene.boxes.half_m + 9.0))
    with pytest.raises(GeometryError, match="found 0 places"):
        scene_poses(full, 1, 0)


def test_options_of_a_photo() -> None:
    scene = furnished_room(1)
    camera, circle = scene_camera("pinhole", (160, 120), 1)
    look, pose = eye(camera, circle), scene_poses(scene, 1, 1)[0]
    clean = render_photo(scene, look, pose).astype(np.float64)
    noisy = render_photo(scene, look, pose, noise_grey=3.0, seed=7)
    middle = (clean > 20) & (clean < 235)
    assert np.std((noisy - clean)[middle]) == pytest.approx(math.sqrt(9 + 1 / 12), rel=0.03)
    assert (noisy == render_photo(scene, look, pose, noise_grey=3.0, seed=7)).all()
    blurred = render_photo(scene, look, pose, blur_px=2.0)
    np.testing.assert_allclose(blurred, cv2.GaussianBlur(clean, (0, 0), 2.0, borderType=cv2.BORDER_REPLICATE), atol=1.1)
    with pytest.raises(InputError, match="found -1"):
        render_photo(scene, look, pose, blur_px=-1.0)


@pytest.mark.parametrize(
    ("name", "seed"),
    [("room", 0), *(pytest.param("room", seed, marks=pytest.mark.full) for seed in (1, 2)), ("flat", 0), ("street", 0)],
)
def test_nothing_runs_into_anything(name: str, seed: int) -> None:
    """No edge passes through the inside of a face: two bodies that meet in a line unknown to the table would show that."""
    scene = build_scene(name, seed)
    edges = scene_edges(scene)
    edges = edges[:: 1 if name == "room" else 5]
    corners = scene.corners_m
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    offset = (normal * corners[:, 0]).sum(-1)
    first, second = edges[:, 0] @ normal.T - offset, edges[:, 1] @ normal.T - offset
    e, f = np.nonzero((first * second < 0) & (np.minimum(np.abs(first), np.abs(second)) > 1e-3))
    share = first[e, f] / (first[e, f] - second[e, f])
    point = edges[e, 0] + share[:, None] * (edges[e, 1] - edges[e, 0])
    inside = np.ones(len(e), dtype=bool)
    for k in range(4):
        side = corners[f, (k + 1) % 4] - corners[f, k]
        inward = np.cross(normal[f], side)
        length = np.linalg.norm(inward, axis=-1)
        distance = ((point - corners[f, k]) * inward).sum(-1) / np.maximum(length, 1e-12)
        inside &= (distance > 1e-3) | (length < 1e-9)
    assert len(e) > 1000
    assert not inside.any(), edges[e[inside]][:3].round(3).tolist()
