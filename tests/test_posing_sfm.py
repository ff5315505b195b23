"""Structure from motion against truth: features of a synthetic scene for every camera, rendered rooms end to end."""

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from sfm_scenes import NOISE_PX, described, errors, places, run_on, unit, world

from camera_models import CameraEstimate, CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from omnilines.files import read_photo, write_png
from omnilines.pipelines import poses as kept_poses
from omnilines.posing import joining
from omnilines.posing.feature_matches import matched, pairs_to_compare
from omnilines.posing.features import Features, clear_of_surround, feature_finder
from omnilines.posing.one_place import at_one_place
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.sfm import doubt, sfm_poses
from omnilines.records import ImagePoses
from omnilines.scenes import build_scene, eye, render_photo, scene_camera, scene_poses

CAMERAS = (
    pytest.param("opencv-fisheye", 190.0, marks=pytest.mark.full),
    pytest.param("scaramuzza", 220.0, marks=pytest.mark.full),
    ("equirectangular", None),
    ("pinhole", None),
)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "fov"), CAMERAS)
def test_poses_of_a_known_scene_are_found_with_every_camera(monkeypatch, tmp_path, model, fov):
    camera, _ = scene_camera(model, (800, 600), 0, fov)
    narrow = model == "pinhole"
    points, words = world(1200 if narrow else 600, 1)
    truth = places(6, 2, 1.2 if narrow else 5.0)
    features = [described(camera, truth[k], points, words, np.random.default_rng([k, 5])) for k in range(6)]
    if model in ("scaramuzza", "equirectangular"):
        assert min(float((f.bearings[:, 2] < 0).double().mean()) for f in features) > 0.02
    names = [f"{k}.png" for k in range(6)]
    found = run_on(features, monkeypatch, tmp_path, {"cam0": camera}, names, dict.fromkeys(names, "cam0"))
    assert found.poses.images == tuple(names)
    position, rotation = errors(found.poses, truth, names)
    # Noise of 0.35 px is some 0.1 degrees a feature; hundreds of them make up a pose.
    assert position.max() < 0.015
    assert rotation.max() < 0.4
    assert "scale is not known" in found.notes[0]
    centre = found.poses.cam_from_world.centre
    assert float((centre - centre.mean(0)).square().sum(-1).mean()) == pytest.approx(1.0)
    torch.testing.assert_close(found.poses.cam_from_world[0].rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)
    assert found.poses.covariance is not None
    assert np.isfinite(found.poses.covariance).all()
    # The camera is right: points ask of it what their noise makes; of a panorama they have nothing to ask.
    assert set(found.cameras) <= ({"cam0"} if camera.calibration_basis().shape[1] else set())
    for one in found.cameras.values():
        sigma = np.sqrt(np.diag(one.covariance))
        np.testing.assert_array_less(np.abs(one.change[:2]), 4.0 * sigma[:2])
    assert found.cameras or not narrow
    kept_poses._write(tmp_path / "poses.npz", "these", found)
    again = kept_poses._read(tmp_path / "poses.npz", "these")
    assert again is not None and set(again.cameras) == set(found.cameras)
    for name, one in again.cameras.items():
        np.testing.assert_array_equal(one.change, found.cameras[name].change)
        np.testing.assert_array_equal(one.covariance, found.cameras[name].covariance)
        assert one.max_angle_rad == found.cameras[name].max_angle_rad


@pytest.mark.slow
def test_the_same_seed_gives_the_same_poses(monkeypatch, tmp_path):
    camera, _ = scene_camera("scaramuzza", (800, 600), 0, 200.0)
    points, words = world(400, 1)
    truth = places(5, 2)
    features = [described(camera, truth[k], points, words, np.random.default_rng([k, 5])) for k in range(5)]
    names = [f"{k}.png" for k in range(5)]
    runs = [
        run_on(features, monkeypatch, tmp_path / str(k), {"c": camera}, names, dict.fromkeys(names, "c"), seed=3)
        for k in range(2)
    ]
    assert torch.equal(runs[0].poses.cam_from_world.rotation, runs[1].poses.cam_from_world.rotation)
    assert torch.equal(runs[0].poses.cam_from_world.translation, runs[1].poses.cam_from_world.translation)


@pytest.mark.slow
def test_photos_of_elsewhere_are_left_out_with_a_reason_and_nothing_in_common_is_refused(monkeypatch, tmp_path):
    camera, _ = scene_camera("opencv-fisheye", (800, 600), 0, 190.0)
    points, words = world(500, 1)
    truth = places(6, 2)
    features = [described(camera, truth[k], points, words, np.random.default_rng([k, 5])) for k in range(5)]
    features.append(described(camera, truth[5], *world(500, 77), np.random.default_rng(6)))
    names = [f"{k}.png" for k in range(6)]
    found = run_on(features, monkeypatch, tmp_path, {"c": camera}, names, dict.fromkeys(names, "c"))
    assert found.poses.images == tuple(names[:5])
    assert len(found.left_out) == 1
    assert "5.png has no pose: too few of its" in found.left_out["5.png"]
    strangers = [described(camera, truth[k], *world(300, 50 + k), np.random.default_rng(k)) for k in range(3)]
    with pytest.raises(GeometryError, match="COLMAP could not join"):
        run_on(strangers, monkeypatch, tmp_path, {"c": camera}, names[:3], dict.fromkeys(names, "c"))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["opencv-fisheye", "equirectangular"])
def test_photos_from_one_place_are_told_from_those_with_nothing_in_common(monkeypatch, tmp_path, model):
    """Also where the camera moved by a centimetre, or one photo is from elsewhere; steps in a row are no one place."""
    camera, _ = scene_camera(model, (800, 400), 0, 190.0 if model == "opencv-fisheye" else None)
    points, words = world(500, 1)
    still = places(6, 2)
    away = 0.006 * np.random.default_rng(3).normal(size=(6, 3))
    row = np.stack([0.2 * np.arange(6), np.zeros(6), np.zeros(6)], -1)
    names = [f"{k}.png" for k in range(6)]

    def seen(centres: np.ndarray) -> list[Features]:
        poses = Pose(still.rotation, -(still.rotation @ torch.as_tensor(centres)[..., None])[..., 0])
        return [described(camera, poses[k], points, words, np.random.default_rng([k, 5])) for k in range(6)]

    for centres, here in ((np.zeros((6, 3)), 6), (away, 6), (np.concatenate([away[:5], [[1.0, 0.5, 0.0]]]), 5)):
        features = seen(centres)
        clear = {pair: matched(features[pair[0]], features[pair[1]])[0] for pair in pairs_to_compare(features, 0)}
        assert at_one_place(features, clear) == list(range(here))
    features = seen(row)
    clear = {pair: matched(features[pair[0]], features[pair[1]])[0] for pair in pairs_to_compare(features, 0)}
    assert len(at_one_place(features, clear)) <= 3
    with pytest.raises(GeometryError, match=r"found 6 of 6 at one place, .*; move the camera between photos"):
        run_on(seen(np.zeros((6, 3))), monkeypatch, tmp_path, {"c": camera}, names, dict.fromkeys(names, "c"))


@pytest.mark.slow
def test_photos_from_one_place_that_colmap_joins_are_told_too(monkeypatch, tmp_path):
    """Poses some millimetres apart, as it has them of real photos, leave no points: "give photos that overlap more" was said."""
    camera, _ = scene_camera("pinhole", (800, 600), 0, None)
    names, turns = [f"{k}.png" for k in range(4)], places(4, 2, 1.0).rotation
    still, apart = (
        Pose(turns, -(turns @ torch.as_tensor(centres)[..., None])[..., 0])
        for centres in (np.zeros((4, 3)), 0.003 * np.random.default_rng(3).normal(size=(4, 3)))
    )
    features = [described(camera, still[k], *world(2000, 1), np.random.default_rng([k, 5])) for k in range(4)]
    monkeypatch.setattr(joining, "map_photos", lambda *_: [{k: apart[k] for k in range(4)}])
    with pytest.raises(GeometryError, match="found 4 of 4 at one place"):
        run_on(features, monkeypatch, tmp_path, {"c": camera}, names, dict.fromkeys(names, "c"))


def test_poses_from_about_one_place_are_called_doubtful(monkeypatch, tmp_path):
    """Where structure from motion found some all the same, as in photos of a camera that is turned in the hand."""
    camera, _ = scene_camera("equirectangular", (800, 400), 0)
    points, words = world(500, 1)
    still, names = places(6, 2), [f"{k}.png" for k in range(6)]
    for apart_m, doubtful in ((0.02, True), (0.3, False)):
        centre = torch.as_tensor(apart_m * np.random.default_rng(3).normal(size=(6, 3)))
        poses = Pose(still.rotation, -(still.rotation @ centre[..., None])[..., 0])
        photos = [described(camera, poses[k], points, words, np.random.default_rng([k, 5])) for k in range(6)]
        monkeypatch.setattr(joining, "map_photos", lambda *_, poses=poses: [{k: poses[k] for k in range(6)}])
        notes = run_on(photos, monkeypatch, tmp_path, {"c": camera}, names, dict.fromkeys(names, "c")).notes
        assert any("turn of the camera alone explains most of what 6 of 6 photos" in note for note in notes) == doubtful


def test_what_a_camera_keeps_looking_at_does_not_go_along_with_it(monkeypatch, tmp_path):
    camera, _ = scene_camera("equirectangular", (800, 400), 0)
    points, words = world(500, 1)
    names, target = [f"{k}.png" for k in range(6)], np.array([0.0, 0.0, 1.5])
    points[:80] = target + 0.05 * np.random.default_rng(0).normal(size=(80, 3))
    angle = np.linspace(0.0, 1.0, 6)
    centres = np.stack([1.5 * np.sin(angle) - 0.7, 0 * angle, 0.6 - 1.5 * np.cos(angle)], -1)
    ahead = unit(target - centres)
    right = unit(np.cross([0.0, 1.0, 0.0], ahead))
    rotation = torch.as_tensor(np.stack([right, np.cross(ahead, right), ahead], 1))
    truth = Pose(rotation, -(rotation @ torch.as_tensor(centres)[..., None])[..., 0])
    photos = [described(camera, truth[k], points, words, np.random.default_rng([k, 5])) for k in range(6)]
    found = run_on(photos, monkeypatch, tmp_path, {"c": camera}, names, dict.fromkeys(names, "c"))
    assert errors(found.poses, truth, names)[0].max() < 0.03
    assert not any("lies at the same place" in note for note in found.notes)


def with_body(model: CameraModel, features: list[Features], count: int, noise_px: float = NOISE_PX) -> list[Features]:
    """The same photos, which also see a vehicle below the camera that goes along with it."""
    rng, size = np.random.default_rng(9), np.array(model.image_size)
    places, words = (
        np.stack([rng.uniform(0, 1, count), rng.uniform(0.7, 0.95, count)], -1) * size,
        rng.uniform(0, 100, (count, 128)),
    )
    found = []
    for k, own in enumerate(features):
        draw = np.random.default_rng([k, 7])
        at = torch.as_tensor(places + noise_px * draw.normal(size=(count, 2)))
        bearings, good = model.unproject(at)
        descriptors = torch.as_tensor(np.clip(words + 6 * draw.normal(size=words.shape), 0, 255).astype(np.uint8))
        jacobian = model.unproject_jacobian(at)
        rows, sigma = torch.linalg.pinv(jacobian) / NOISE_PX, NOISE_PX * torch.linalg.matrix_norm(jacobian, ord=2)
        fields = ((own.bearings, bearings), (own.rows, rows), (own.sigma_rad, sigma), (own.descriptors, descriptors))
        found.append(Features(*(torch.cat([scene, body[good]]) for scene, body in fields)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "said"), [(100, "lies at the same place in them although the camera turned"), (900, "joined only without")]
)
def test_what_goes_along_with_the_camera_is_told_and_keeps_no_pose_from_being_found(monkeypatch, tmp_path, count, said):
    camera, _ = scene_camera("equirectangular", (800, 400), 0)
    points, words = world(500, 1)
    truth, names = places(6, 2), [f"{k}.png" for k in range(6)]
    scene = [described(camera, truth[k], points, words, np.random.default_rng([k, 5])) for k in range(6)]
    call = (monkeypatch, tmp_path, {"c": camera}, names, dict.fromkeys(names, "c"))
    assert not any("`mask`" in note for note in run_on(scene, *call).notes)
    found = run_on(with_body(camera, scene, count), *call)
    assert found.poses.images == tuple(names) and any(said in note and "`mask`" in note for note in found.notes)
    position, rotation = errors(found.poses, truth, names)
    assert position.max() < 0.03 and rotation.max() < 0.6
    # A camera that stood still sees all at one place.
    stood = [described(camera, truth[0], points, words, np.random.default_rng([k, 5])) for k in range(6)]
    with pytest.raises(GeometryError, match="most of what 6 of 6 photos have in common lies at the same place in each"):
        run_on(stood, *call)


@pytest.mark.slow
def test_features_keep_away_from_the_surround_and_from_angles_without_support():
    camera, _ = scene_camera("opencv-fisheye", (400, 300), 0, 190.0)
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(400.0), np.arange(300.0)), -1)
    bearings, valid = camera.unproject(grid)
    angle = np.degrees(np.arctan2(np.hypot(bearings[..., 0], bearings[..., 1]), bearings[..., 2]))
    circle = valid & (angle < 95.0)
    noise = np.kron(rng.integers(40, 255, (38, 50)), np.ones((8, 8)))[:300, :400]
    photo = np.where(circle, noise, 3.0).astype(np.uint8)
    clear = clear_of_surround(photo)
    assert not clear[~circle].any()
    assert clear[angle < 75.0].all()
    found = feature_finder()(photo, camera, None, None)
    assert len(found) > 100
    assert found.unit_descriptors().norm(dim=-1).allclose(torch.ones(len(found)), atol=1e-3)
    estimate = CameraEstimate(max_angle_deg=60.0)
    narrow = feature_finder()(photo, camera, estimate, None)
    assert 50 < len(narrow) < len(found)
    assert float(torch.atan2(narrow.bearings[:, :2].norm(dim=-1), narrow.bearings[:, 2]).max()) <= math.radians(62.0)
    left = np.arange(400) < 200
    masked = feature_finder()(photo, camera, None, np.broadcast_to(left, (300, 400)))
    pixels, _ = camera.project(masked.bearings)
    assert 30 < len(masked) < 0.7 * len(found) and float(pixels[:, 0].max()) < 200
    with pytest.raises(InputError, match="400x300 px was expected"):
        feature_finder()(photo[:-1], camera, None, None)


def of_room(
    folder: Path,
    model: str,
    fov_deg: float | None,
    views: int,
    size: tuple[int, int],
    seed: int = 5,
    drawn: Callable[[np.ndarray, int], None] = lambda *_: None,
) -> tuple[PhotoPoses, ImagePoses]:
    """Poses found from photos of a furnished room, and the true ones. The truth of its edges is not computed. `drawn` draws into
    the photo of a number."""
    room = build_scene("room", seed)
    camera, circle = scene_camera(model, size, seed, fov_deg)
    poses = scene_poses(room, views, seed, camera)
    names = tuple(f"view{k:02d}.png" for k in range(views))
    look = eye(camera, circle)
    for k, name in enumerate(names):
        photo = render_photo(room, look, poses[k], blur_px=0.5, noise_grey=2.0, vignetting=0.3, seed=[seed, k])
        drawn(photo, k)
        write_png(folder / name, photo)
    camera_of = dict.fromkeys(names, "cam0")
    found = sfm_poses(names, lambda name: read_photo(folder / name), {"cam0": camera}, camera_of, folder / "work")
    return found, ImagePoses(names, poses, ("cam0",) * views)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "fov", "views"),
    [
        pytest.param("opencv-fisheye", 190.0, 12, marks=pytest.mark.full),
        pytest.param("scaramuzza", 220.0, 12, marks=pytest.mark.full),
        ("equirectangular", None, 9),
        pytest.param("equirectangular", None, 12, marks=pytest.mark.full),
        # A pinhole camera needs photos that overlap more: 18 degrees from one to the next.
        pytest.param("pinhole", 100.0, 20, marks=pytest.mark.full),
    ],
)
def test_poses_of_rendered_rooms_are_found(tmp_path, model, fov, views):
    found, truth = of_room(tmp_path, model, fov, views, (800, 400) if model == "equirectangular" else (640, 640))
    assert len(found.poses) >= 0.9 * views
    assert len(found.poses) + len(found.left_out) == views
    assert doubt(len(found.left_out), views) == ()
    position, rotation = errors(found.poses, truth.cam_from_world, list(truth.images))
    assert np.median(position) < 0.03
    assert np.median(rotation) < 0.8


@pytest.mark.slow
def test_a_tripod_and_a_date_in_all_photos_move_no_pose(tmp_path):
    """They are 44 percent of the matches; with them COLMAP joins all photos, four of ten at one place."""

    def tripod(photo: np.ndarray, k: int) -> None:
        cv2.putText(photo, f"2026-11-29 06:3{k}", (250, 480), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (0, 220, 255), 2, cv2.LINE_AA)
        for foot in (340, 400, 460):
            cv2.line(photo, (400, 420), (foot, 580), (30, 30, 30), 9, cv2.LINE_AA)
        cv2.rectangle(photo, (520, 380), (620, 440), (200, 120, 40), -1)

    found, truth = of_room(tmp_path, "opencv-fisheye", 190.0, 10, (800, 600), 11, tripod)
    position, rotation = errors(found.poses, truth.cam_from_world, list(truth.images))
    assert len(found.poses) == 10 and position.max() < 0.1 and rotation.max() < 2.0
    assert any("goes along with it, and poses are found without it" in note for note in found.notes)


@pytest.mark.full
def test_poses_of_photos_that_share_little_are_called_doubtful(tmp_path):
    """80 degrees, 30 from photo to photo: a third is left out, and half of the others are 15 cm off with good residuals."""
    found, truth = of_room(tmp_path, "pinhole", None, 12, (640, 640))
    position, _ = errors(found.poses, truth.cam_from_world, list(truth.images))
    said = doubt(len(found.left_out), 12)
    assert np.median(position) < 0.03 or (len(said) == 1 and f"{len(found.left_out)} of 12 photos" in said[0])
