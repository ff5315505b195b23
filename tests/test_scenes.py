"""Rendered rooms, flats and streets: photos against areas, visibility against brute-force rays, edges against closed forms."""

import dataclasses
import itertools
import json
import math

import cv2
import numpy as np
import pytest
import torch

from camera_models import Equirectangular, GeometryError, InputError, Pinhole, Scaramuzza
from camera_models.pose import Pose
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
    visibility,
    visible_stretches,
)
from omnilines.scenes.building import Builder, Frame, colour
from omnilines.scenes.plain_room import THINNEST_M
from omnilines.scenes.polygon_scene import Lamps, PolygonScene, Texture
from omnilines.scenes.visibility import CONTRAST_LEVELS

SIZE = (640, 480)
CAMERAS = [
    pytest.param("pinhole", 90.0, False, id="pinhole"),
    pytest.param("opencv-fisheye", 190.0, False, id="fisheye-190"),
    pytest.param("scaramuzza", 220.0, False, id="scaramuzza-220"),
    pytest.param("scaramuzza", 200.0, True, id="mirror"),
    pytest.param("double-sphere", 190.0, False, id="double-sphere"),
    pytest.param("equirectangular", None, False, id="equirectangular"),
    pytest.param("cylindrical", 200.0, False, id="cylindrical"),
]
EVEN_LIGHT = Lamps(np.zeros((0, 3)), np.zeros(0), np.zeros(0), 1.0, 0.0, np.zeros(2))
PLAIN = Texture(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def inside_out_cube(seed: int) -> PolygonScene:
    """A cube of 4 m seen from inside, in even light, with turned squares painted on all six sides: every pixel has one of few
    colours, or a share of two of them."""
    rng = np.random.default_rng(seed)
    build = Builder([PLAIN])
    directions = [np.eye(3)[axis] * sign for axis in range(3) for sign in (-1.0, 1.0)]
    for k, outward in enumerate(directions):
        right = np.roll(outward, 1)
        up = np.cross(right, outward)
        wall = 2.0 * (outward + np.array([-right - up, right - up, right + up, -right + up]))
        surface = build.wall(wall, colour(40.0 + 12.0 * k))
        for x, y in ((-0.9, -0.8), (1.0, -0.9), (-0.8, 1.0), (0.9, 0.9)):
            angle = rng.uniform(0.0, 0.5 * math.pi) + 0.5 * math.pi * np.arange(4)
            corners = 2.0 * outward + np.outer(x + 0.75 * np.cos(angle), right) + np.outer(y + 0.75 * np.sin(angle), up)
            build.paint_shape(surface, corners, colour(rng.uniform(160.0, 230.0)))
    build.keep_out(Frame.at(9.0, 9.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    return build.scene(EVEN_LIGHT, np.stack([colour(128.0)] * 2), np.full(3, -1.0), np.full(3, 1.0))


def looking(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    return Pose.of(rotation, -rotation @ rng.uniform(-0.4, 0.4, 3))


def edge_offsets(image: np.ndarray, pixels: np.ndarray) -> list[float]:
    """Measured minus true place of an edge, in pixels, in every row that a nearly upright curve of pixels (dense) crosses.

    In a row of two colours the sum of the pixels says where, on average over the height of the row, the one ends. Rows in which
    anything else is near are left out.
    """
    offsets = []
    v = pixels[:, 1]
    order = np.argsort(v)
    u, v = pixels[order, 0], v[order]
    for row in range(math.ceil(v[0] + 4), math.floor(v[-1] - 4) + 1):
        # The mean of u over the height of the row, by the trapezoidal rule.
        true = float(np.interp(np.linspace(row - 0.5, row + 0.5, 21), v, u) @ np.r_[0.5, np.ones(19), 0.5] / 20)
        middle = round(true)
        if not (6 <= middle < image.shape[1] - 6 and 0 <= row < image.shape[0]):
            continue
        window = image[row, middle - 5 : middle + 6]
        if np.ptp(window[:4]) > 1e-3 or np.ptp(window[-4:]) > 1e-3 or abs(window[0] - window[-1]) < 15:
            continue
        steps = np.diff(window) * np.sign(window[-1] - window[0])
        if (steps < -1e-3).any():
            continue
        place = middle - 5.5 + float((window - window[-1]).sum() / (window[0] - window[-1]))
        offsets.append(place - true)
    return offsets


@pytest.mark.parametrize(("name", "fov_deg", "mirror"), CAMERAS)
def test_edges_lie_where_they_project(name: str, fov_deg: float | None, mirror: bool) -> None:
    """The place of a step, from the sum of the grey levels across it, against the projected edge."""
    scene = inside_out_cube(3)
    camera, circle = scene_camera(name, SIZE, 5, fov_deg, mirror)
    look, pose, edges = eye(camera, circle), looking(1), scene_edges(scene)
    image = render_clean(scene, look, pose)[..., 1].astype(np.float64)
    edge, t, length, _ = visible_stretches(scene, look, pose, edges)
    biases, everything = [], []
    for e, (t1, t2), pixels_long in zip(edge.tolist(), t, length, strict=True):
        if pixels_long < 40:
            continue
        share = np.linspace(t1, t2, int(20 * pixels_long))[:, None]
        points = edges[e, 0] + share * (edges[e, 1] - edges[e, 0])
        pixels, _ = camera.project(pose.transform(torch.as_tensor(points)).numpy())
        step = np.abs(np.diff(pixels, axis=0))
        if step.max() > 5:  # across the seam of a panorama
            continue
        if (step[:, 1] > step[:, 0]).all():
            offsets = edge_offsets(image, pixels)
        elif (step[:, 0] > step[:, 1]).all():
            offsets = edge_offsets(image.T, pixels[:, ::-1])
        else:
            continue
        if len(offsets) >= 15:
            biases.append(float(np.mean(offsets)))
            everything += offsets
    assert len(biases) >= 8 and len(everything) > 300
    assert np.abs(biases).max() < 0.02
    assert abs(np.mean(everything)) < 0.003
    assert np.sqrt(np.mean(np.square(everything))) < 0.03


def test_a_thin_thing_is_not_missed() -> None:
    """A rod a tenth of a pixel wide takes a tenth of the light of every pixel along it."""
    build = Builder([PLAIN])
    build.wall(np.array([[-9.0, 5, -9], [9, 5, -9], [9, 5, 9], [-9, 5, 9]]), colour(200.0))
    width = 0.1 * 2.0 / 300.0
    build.box(Frame.at(0.0, 2.0), (-width / 2, 0.0, -1.0), (width / 2, 0.01, 1.0), colour(50.0))
    scene = build.scene(EVEN_LIGHT, np.stack([colour(128.0)] * 2), np.zeros(3), np.ones(3))
    camera = Pinhole.from_mapping({"fx": 300.0, "fy": 300.0, "cx": 99.8, "cy": 74.5}, (200, 150))
    pose = Pose.of([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], [0.0, 0, 0])
    image = render_clean(scene, eye(camera, math.pi), pose)[..., 0]
    lost = (200.0 - image).sum(1) / 150.0
    np.testing.assert_allclose(lost.mean(), 0.1, atol=0.01)
    assert (lost > 0.05).all()


def brute_force(scene: PolygonScene, centre: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the first face along each ray and the face, by the intersection of Möller and Trumbore with all triangles."""
    corners = scene.corners_m[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    owner = np.repeat(np.arange(len(scene)), 2)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    front = (np.cross(e1, e2) * (centre - corners[:, 0])).sum(-1) > 1e-12
    corners, owner, e1, e2 = corners[front], owner[front], e1[front], e2[front]
    s = centre - corners[:, 0]
    q = np.cross(s, e1)
    distance, face = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for k, ray in enumerate(rays):
        p = np.cross(ray, e2)
        determinant = (e1 * p).sum(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, t = (s * p).sum(-1) / determinant, (q @ ray) / determinant, (q * e2).sum(-1) / determinant
            hit = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9))
        if len(hit):
            nearest = t[hit].min()
            at = hit[t[hit] < nearest * (1 + 1e-9)]
            distance[k], face[k] = nearest, owner[at[scene.layer[owner[at]].argmax()]]
    return distance, face


@pytest.mark.parametrize(
    ("name", "model", "fov_deg", "size"),
    [
        ("room", "opencv-fisheye", 190.0, SIZE),
        ("flat", "equirectangular", None, (640, 320)),
        ("street", "scaramuzza", 220.0, (320, 240)),
    ],
)
def test_visibility_against_brute_force(monkeypatch, name: str, model: str, fov_deg: float | None, size) -> None:
    """Random points of random edges: what rays beside them meet first, found without tiles, cones and masks."""
    monkeypatch.setattr(visibility, "SHORTEST_PX", 0.0)
    scene = build_scene(name, 2)
    camera, circle = scene_camera(model, size, 2, fov_deg)
    pose, edges = scene_poses(scene, 1, 2)[0], scene_edges(scene)
    edge, t, _, _ = visible_stretches(scene, eye(camera, circle), pose, edges)
    rng = np.random.default_rng(0)
    # Half of the points on edges that the photo sees somewhere, where both answers are frequent.
    picked = np.concatenate([rng.choice(np.unique(edge), 200), rng.integers(len(edges), size=200)])
    place = rng.uniform(0.0, 1.0, len(picked))
    centre, rotation = pose.centre.numpy(), pose.rotation.numpy()
    world = edges[picked, 0] + place[:, None] * (edges[picked, 1] - edges[picked, 0])
    away = world - centre
    distance = np.linalg.norm(away, axis=-1)
    pixels, valid = camera.project(away @ rotation.T)
    angle = np.arccos((away @ rotation[2]) / distance)
    inside = valid & (angle < circle - 0.01) & (pixels > 2).all(-1) & (pixels < np.array(size) - 3).all(-1)
    across = np.cross(away, edges[picked, 1] - edges[picked, 0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    # The angle of 0.05 px across the edge, by differences.
    unit, step = away / distance[:, None], 1e-5
    along = np.cross(across, unit)
    moved = [camera.project((unit + step * direction) @ rotation.T)[0] - pixels for direction in (along, across)]
    area = np.abs(moved[0][:, 0] * moved[1][:, 1] - moved[0][:, 1] * moved[1][:, 0])
    angle_px = 0.05 * step * np.linalg.norm(moved[0], axis=-1) / np.maximum(area, 1e-300)
    surfaces, holds = [], np.zeros(len(picked), dtype=bool)
    for sign in (-1.0, 1.0):
        rays = unit + sign * np.minimum(angle_px, 0.01)[:, None] * across
        _, face = brute_force(scene, centre, rays)
        first = scene.corners_m[face]
        normal = np.cross(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        holds |= (np.abs(((world - first[:, 0]) * normal).sum(-1)) < 1e-6) & (face >= 0)
        surfaces.append(np.where(face >= 0, scene.surface[face], -1))
    seen = inside & holds & (surfaces[0] != surfaces[1])
    told = np.zeros(len(picked), dtype=bool)
    for k, (e, at) in enumerate(zip(picked.tolist(), place, strict=True)):
        own = t[edge == e]
        told[k] = bool(((own[:, 0] <= at) & (at <= own[:, 1])).any())
    plain = inside | ~told
    assert plain.sum() > 200 and (seen & plain).sum() > 60
    # Not all: within a hundredth of a pixel of the end of a stretch both may be right.
    assert (seen != told)[plain].mean() < 0.008


def test_contrast_is_that_of_the_photo() -> None:
    """The step in the photo two pixels to either side of long edges, against the contrast in the table."""
    scene = dataclasses.replace(furnished_room(4), textures=(PLAIN,) * 5)
    camera, circle = scene_camera("opencv-fisheye", (1280, 960), 4, 190.0)
    look, pose, edges = eye(camera, circle), scene_poses(scene, 1, 4)[0], scene_edges(scene)
    image = render_photo(scene, look, pose, vignetting=0.3)[..., ::-1].astype(np.float64)
    edge, t, length, contrast = visible_stretches(scene, look, pose, edges, vignetting=0.3)
    errors = []
    for e, span, told in zip(edge[length > 60], t[length > 60], contrast[length > 60], strict=True):
        share = np.linspace(*span, 42)[1:-1, None]
        points = pose.transform(torch.as_tensor(edges[e, 0] + share * (edges[e, 1] - edges[e, 0]))).numpy()
        pixels, _ = camera.project(points)
        along = np.gradient(pixels, axis=0)
        normal = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
        sides = []
        for sign in (-2.0, 2.0):
            u, v = np.rint(pixels + sign * normal).astype(int).T
            sides.append(image[np.clip(v, 0, 959), np.clip(u, 0, 1279)])
        step = sides[1] - sides[0]
        seen = [np.median(np.abs(step @ [0.299, 0.587, 0.114])), np.median(np.abs(step).max(-1))]
        errors.append(np.array(seen) - told)
    assert len(errors) > 60
    # Beside some edges another one runs within two pixels.
    assert np.median(np.abs(errors), axis=0).max() < 1.0
    assert (np.abs(errors) < 3.0).all(-1).mean() > 0.75


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
