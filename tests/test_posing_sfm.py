"""Structure from motion against truth: features of a synthetic scene for every camera, rendered rooms end to end."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from camera_models import Calibration, CameraEstimate, CameraModel, GeometryError, InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from camera_models.rotations import similarity_alignment
from omnilines.files import read_photo, write_png
from omnilines.posing import joining, sfm
from omnilines.posing.carried_along import agreeing
from omnilines.posing.feature_matches import matched, matched_near, pairs_to_compare
from omnilines.posing.features import Features, clear_of_surround, feature_finder
from omnilines.posing.one_place import at_one_place
from omnilines.posing.options import MatchOptions
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.posing.sfm import doubt, sfm_poses
from omnilines.records import ImagePoses
from omnilines.scenes import build_scene, eye, render_photo, scene_camera, scene_poses

CAMERAS = (
    pytest.param("opencv-fisheye", 190.0, marks=pytest.mark.full),
    pytest.param("scaramuzza", 220.0, marks=pytest.mark.full),
    ("equirectangular", None),
    ("pinhole", None),
)
NOISE_PX = 0.35


def described(model: CameraModel, pose: Pose, points: np.ndarray, words: np.ndarray, rng: np.random.Generator) -> Features:
    """What a photo shows of points: their bearings with noise, descriptors with some, in any order, and clutter."""
    pixels, valid = model.project(pose.transform(torch.as_tensor(points)))
    inside = valid & ((pixels > 0) & (pixels < torch.tensor(model.image_size) - 1.0)).all(-1)
    seen = rng.permutation(np.flatnonzero(inside.numpy() & (rng.uniform(size=len(points)) < 0.8)))
    clutter = rng.uniform(0, 1, (60, 2)) * (np.array(model.image_size) - 1)
    at = torch.as_tensor(np.concatenate([pixels[seen].numpy() + NOISE_PX * rng.normal(size=(len(seen), 2)), clutter]))
    bearings, good = model.unproject(at)
    own = np.concatenate([words[seen] + 6 * rng.normal(size=(len(seen), 128)), rng.uniform(0, 100, (60, 128))])
    descriptors = torch.as_tensor(np.clip(own, 0, 255).astype(np.uint8))
    jacobian = model.unproject_jacobian(at)
    sigma = NOISE_PX * torch.linalg.matrix_norm(jacobian, ord=2)
    return Features(bearings[good], torch.linalg.pinv(jacobian[good]) / NOISE_PX, sigma[good], descriptors[good])


def world(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the walls of a room of 5 x 4 x 3 m, and a descriptor for each."""
    rng = np.random.default_rng(seed)
    half = np.array([2.5, 2.0, 1.5])
    points = rng.uniform(-1, 1, (count, 3))
    wall = rng.integers(3, size=count)
    points[np.arange(count), wall] = np.sign(points[np.arange(count), wall])
    return points * half, rng.uniform(0, 100, (count, 128))


def places(count: int, seed: int, around_rad: float = 5.0) -> Pose:
    """Upright cameras in the room that look around by some angle."""
    rng = np.random.default_rng(seed)
    turn = Pose.exp(torch.as_tensor(np.stack([0.2 * rng.normal(size=6) * [1, 0, 1, 0, 0, 0] for _ in range(count)])))
    yaw = torch.zeros(count, 6, dtype=torch.float64)
    yaw[:, 1] = torch.linspace(0, around_rad, count, dtype=torch.float64)
    rotation = (turn @ Pose.exp(yaw)).rotation
    centre = torch.as_tensor(rng.uniform(-1, 1, (count, 3)) * [1.5, 1.2, 0.5])
    return Pose(rotation, -(rotation @ centre[..., None])[..., 0])


def errors(found: ImagePoses, truth: Pose, names: list[str], *, metric: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Errors of position (m) and rotation (degrees) after a similarity, or after a rigid motion."""
    true = truth[[names.index(name) for name in found.images]]
    scale, similarity = similarity_alignment(found.cam_from_world.centre, true.centre)
    if metric:
        assert float(scale) == pytest.approx(1.0, abs=5e-3)
    moved = moved_poses(found, float(scale), similarity).cam_from_world
    turned = (moved @ true.inverse()).log()[:, :3].norm(dim=-1)
    return (moved.centre - true.centre).norm(dim=-1).numpy(), np.degrees(turned.numpy())


def run_on(features: list[Features], monkeypatch, folder: Path, cameras, names: list[str], camera_of, **options) -> PhotoPoses:
    """Structure from motion of features that are given instead of photos."""
    monkeypatch.setattr(sfm, "_features", lambda *_: features)
    return sfm_poses(names, lambda _: np.zeros((1, 1), np.uint8), cameras, camera_of, folder, **options)


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


SECOND = Pose.exp(torch.tensor([0.1, math.pi / 2, 0.05, 0.25, 0.02, 0.1], dtype=torch.float64))
"""The right camera of a pair from the left one."""


def posed_pair(stated: Pose, monkeypatch, tmp_path, **asked):
    """What structure from motion finds of five instants of a pair, `stated` as the right camera's place, and the true poses."""
    camera, _ = scene_camera("scaramuzza", (800, 600), 0, 220.0)
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(stated)}
    calibration = Calibration(dict.fromkeys(rig, camera), {}, rig)
    points, words = world(700, 4)
    at = places(5, 6)
    names, poses, features = [], [], []
    for k in range(5):
        for name, cam_from_rig in (("left", Pose.identity()), ("right", SECOND)):
            names.append(f"{name}/{k}.png")
            poses.append(cam_from_rig @ at[k])
            features.append(described(camera, poses[-1], points, words, np.random.default_rng([len(names), 7])))
    camera_of, frame_of = {n: n.split("/")[0] for n in names}, {n: n.split("/")[1] for n in names}
    return run_on(features, monkeypatch, tmp_path, calibration, names, camera_of, frame_of=frame_of, **asked), poses


@pytest.mark.slow
def test_a_rig_moves_as_one_and_gives_the_scale(monkeypatch, tmp_path):
    found, poses = posed_pair(SECOND, monkeypatch, tmp_path)
    names = [f"{name}/{k}.png" for k in range(5) for name in ("left", "right")]
    assert found.poses.images == tuple(names)
    position, rotation = errors(found.poses, Pose.stack(poses), names, metric=True)
    assert position.max() < 0.01
    assert rotation.max() < 0.15
    assert "metres" in found.notes[0]
    relative = found.poses.cam_from_world[1] @ found.poses.cam_from_world[0].inverse()
    torch.testing.assert_close(relative.translation, SECOND.translation, rtol=0, atol=1e-9)
    assert found.poses.frames == tuple(f"{k}.png" for k in range(5) for _ in range(2))
    assert not any("do not agree with the rig" in note for note in found.notes)


@pytest.mark.slow
def test_a_rig_that_photos_contradict_is_named(monkeypatch, tmp_path):
    """Its right camera is turned by 0.6 degrees from where the calibration has it."""
    off = Pose.exp(torch.tensor([0.3, 0.4, 0.33, 0.0, 0.0, 0.0], dtype=torch.float64).deg2rad())
    found, _ = posed_pair(off @ SECOND, monkeypatch, tmp_path)
    (said,) = [note for note in found.notes if "do not agree with the rig" in note]
    (told,) = re.findall(r"They put right ([\d.]+) \(± ([\d.]+)\) degrees", said)
    turn_deg, sigma_deg = map(float, told)
    assert 0.3 < turn_deg < 0.7 and sigma_deg < 0.2 * turn_deg


@pytest.mark.slow
def test_a_rig_that_photos_contradict_is_found_anew_where_it_is_refined(monkeypatch, tmp_path):
    """Its right camera is turned by 2.5 degrees and 20 mm off; one that is right stays, to the last digit."""
    off = Pose.exp(torch.cat([torch.tensor([1.5, 2.0, 0.0]).double().deg2rad(), torch.tensor([0.012, 0.0, 0.016]).double()]))
    found, poses = posed_pair(off @ SECOND, monkeypatch, tmp_path, refine_rig=True)
    assert any("The rig is as photos tell" in note for note in found.notes)
    apart = (found.rig["right"] @ found.rig["left"].inverse() @ SECOND.inverse()).log()
    assert float(apart[:3].norm().rad2deg()) < 0.1
    mounted = found.poses.cam_from_world[1] @ found.poses.cam_from_world[0].inverse()
    torch.testing.assert_close(mounted.rotation, (found.rig["right"] @ found.rig["left"].inverse()).rotation, rtol=0, atol=1e-9)
    # The scale is that of the calibration, whose cameras are farther apart.
    names = [f"{name}/{k}.png" for k in range(5) for name in ("left", "right")]
    stretched = float((off @ SECOND).translation.norm() / SECOND.translation.norm())
    position, rotation = errors(found.poses, Pose.stack(poses).after_similarity(stretched, Pose.identity()), names, metric=True)
    assert position.max() < 0.02 and rotation.max() < 0.15
    right, _ = posed_pair(SECOND, monkeypatch, tmp_path, refine_rig=True)
    assert not right.rig


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


def test_matches_near_the_epipolar_circle_are_the_true_ones():
    camera, _ = scene_camera("equirectangular", (800, 400), 0)
    points, words = world(500, 1)
    truth = places(2, 2)
    a, b = (described(camera, truth[k], points, words, np.random.default_rng([k, 5])) for k in range(2))
    clear, faint = matched(a, b)
    assert len(clear) > 200
    assert {tuple(p) for p in clear.tolist()} <= {tuple(p) for p in faint.tolist()}
    relative = truth[1] @ truth[0].inverse()
    guided = {tuple(p) for p in matched_near(a, b, relative, 4 * float(a.sigma_rad.median())).tolist()}
    assert len(guided & {tuple(p) for p in clear.tolist()}) > 0.9 * len(clear)
    behind = Pose(relative.rotation, -relative.translation)
    wrong = {tuple(p) for p in matched_near(a, b, behind, 4 * float(a.sigma_rad.median())).tolist()}
    assert len(wrong & {tuple(p) for p in clear.tolist()}) < 0.1 * len(clear)


def plainly_matched(a: Features, b: Features, b_from_a: Pose, tolerance: float, options: MatchOptions) -> set[tuple[int, int]]:
    """`matched_near` by comparing all features with all."""
    alike = (a.unit_descriptors() @ b.unit_descriptors().mT).numpy().astype(np.float64)
    near = plain_near(alike, a.bearings.numpy(), b.bearings.numpy(), b_from_a, tolerance, options.guided_cosine)
    best, first, second, back = near
    clear = np.maximum(1.0 - first, 0.0) < options.guided_ratio**2 * np.maximum(1.0 - second, 0.0)
    return {(i, j) for i, j in enumerate(best.tolist()) if j >= 0 and clear[i] and back[j] == i}


@pytest.mark.parametrize("tolerance", [0.002, 0.03, 0.12, 0.3, 0.6, 1.2])
@pytest.mark.parametrize("towards", [[0.3, -0.2, 0.9], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
def test_features_sought_by_rings_and_sectors_are_those_that_all_pairs_have(tolerance, towards):
    """Also near the direction of the other camera, or opposite to it."""
    rng = np.random.default_rng(3)
    axis = unit(np.array(towards))
    photos = []
    for count in (300, 400):
        rays = rng.standard_normal((count, 3))
        rays[:60] = 0.2 * rays[:60] + np.where(np.arange(60) % 2, 1.0, -1.0)[:, None] * axis
        descriptors = rng.integers(0, 40, (count, 128)) + 100 * (rng.integers(0, 30, (count, 1)) == np.arange(128) % 30)
        photos.append(photo_of(unit(rays), descriptors.astype(np.uint8)))
    b_from_a = Pose(Pose.exp(torch.as_tensor(0.3 * rng.standard_normal(6))).rotation, torch.as_tensor(2.0 * axis))
    found = {tuple(pair) for pair in matched_near(*photos, b_from_a, tolerance).tolist()}
    assert found == plainly_matched(*photos, b_from_a, tolerance, MatchOptions())


def test_cameras_at_one_place_are_matched_near_the_direction_of_a_feature():
    rng = np.random.default_rng(4)
    rays = unit(rng.standard_normal((200, 3)))
    turn = Pose(Pose.exp(torch.as_tensor(rng.standard_normal(6))).rotation, torch.zeros(3, dtype=torch.float64))
    words = rng.integers(0, 256, (200, 128)).astype(np.uint8)
    a, b = photo_of(rays, words), photo_of(rays @ turn.rotation.numpy().T, words)
    torch.testing.assert_close(matched_near(a, b, turn, 0.01), torch.arange(200)[:, None].expand(200, 2), rtol=0, atol=0)
    elsewhere = photo_of(np.roll(b.bearings.numpy(), 1, axis=0), words)
    assert not any(i == j for i, j in matched_near(a, elsewhere, turn, 0.01).tolist())


def photo_of(rays: np.ndarray, descriptors: np.ndarray) -> Features:
    none = torch.zeros(len(rays), 2, 3, dtype=torch.float64)
    return Features(torch.as_tensor(rays), none, none[:, 0, 0], torch.as_tensor(descriptors))


def test_poses_with_which_matches_meet_behind_the_cameras_explain_none_of_them():
    """A camera that walks ahead has the same epipolar circles one step behind, where photos of a corridor were put."""
    camera, _ = scene_camera("equirectangular", (800, 400), 0)
    points, words = world(500, 1)
    step = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    here, ahead, behind = (Pose(torch.eye(3, dtype=torch.float64), k * step) for k in (0, 1, -1))
    photos = [described(camera, pose, points, words, np.random.default_rng([k, 5])) for k, pose in enumerate((here, ahead))]
    matches = {(0, 1): matched(*photos)[0]}
    count = len(matches[0, 1])
    assert count > 200 and agreeing(photos, matches, {0: here, 1: ahead}) > 0.95 * count
    assert agreeing(photos, matches, {0: here, 1: behind}) < 0.05 * count


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def plain_near(
    alike: np.ndarray, a: np.ndarray, b: np.ndarray, b_from_a: Pose, tolerance: float, least: float
) -> tuple[np.ndarray, ...]:
    """Best, how alike it is and the second best, and back, from the cosines of all descriptors of features on a half circle."""
    far = a @ b_from_a.rotation.numpy().T
    towards = np.broadcast_to(unit(b_from_a.translation.numpy()), far.shape)
    normal = unit(np.cross(far, towards))
    whole = np.arccos(np.clip((far * towards).sum(-1), -1.0, 1.0))
    sideways = np.cross(normal, far)
    angle = np.arctan2(sideways @ b.T, far @ b.T)
    near = (np.abs(normal @ b.T) < tolerance) & (angle > -tolerance) & (angle < whole[:, None] + tolerance) & (alike > least)
    seen = np.where(near, alike, least)
    ordered = np.sort(np.concatenate([seen, np.full((len(a), 1), least)], 1), 1)
    best = np.where(near.any(1), seen.argmax(1), -1)
    return best, ordered[:, -1], ordered[:, -2], np.where(near.any(0), seen.argmax(0), -1)


def test_of_many_photos_each_is_compared_with_those_that_look_alike():
    rng = np.random.default_rng(0)
    options = MatchOptions()
    count = options.max_exhaustive + 20
    themes = rng.uniform(0, 100, (2, 40, 128))
    own = [np.clip(themes[k % 2] + 5 * rng.normal(size=(40, 128)), 0, 255).astype(np.uint8) for k in range(count)]
    none = torch.zeros(40, 3, dtype=torch.float64)
    photos = [Features(none, torch.zeros(40, 2, 3, dtype=torch.float64), none[:, 0], torch.as_tensor(d)) for d in own]
    pairs = pairs_to_compare(photos, 0)
    assert len(pairs) <= options.neighbours * count
    assert sum((i - j) % 2 == 0 for i, j in pairs) > 0.95 * len(pairs)
    assert pairs_to_compare(photos[:4], 0) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


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
