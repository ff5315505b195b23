"""Edges that photos of scenes see: where they lie, what hides them and how strong they are, against areas and rays."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scene_rays import EVEN_LIGHT, PLAIN, SIZE, brute_force

from camera_models import Pinhole
from camera_models.pose import Pose
from omnilines.scenes import (
    build_scene,
    eye,
    furnished_room,
    render_clean,
    render_photo,
    scene_camera,
    scene_edges,
    scene_poses,
    visibility,
    visible_stretches,
)
from omnilines.scenes.building import Builder, Frame, colour
from omnilines.scenes.polygon_scene import PolygonScene

CAMERAS = [
    pytest.param("pinhole", 90.0, False, id="pinhole"),
    pytest.param("opencv-fisheye", 190.0, False, id="fisheye-190"),
    pytest.param("scaramuzza", 220.0, False, id="scaramuzza-220"),
    pytest.param("scaramuzza", 200.0, True, id="mirror"),
    pytest.param("double-sphere", 190.0, False, id="double-sphere"),
    pytest.param("equirectangular", None, False, id="equirectangular"),
    pytest.param("cylindrical", 200.0, False, id="cylindrical"),
]


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


@pytest.mark.slow
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


@pytest.mark.slow
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
