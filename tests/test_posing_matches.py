"""Matches of features: those near a half circle against all pairs, and which photos are compared."""

import numpy as np
import pytest
import torch
from sfm_scenes import described, places, unit, world

from camera_models.pose import Pose
from omnilines.posing.carried_along import agreeing
from omnilines.posing.feature_matches import matched, matched_near, pairs_to_compare
from omnilines.posing.features import Features
from omnilines.posing.options import MatchOptions
from omnilines.scenes import scene_camera


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


def photo_of(rays: np.ndarray, descriptors: np.ndarray) -> Features:
    none = torch.zeros(len(rays), 2, 3, dtype=torch.float64)
    return Features(torch.as_tensor(rays), none, none[:, 0, 0], torch.as_tensor(descriptors))


def test_cameras_at_one_place_are_matched_near_the_direction_of_a_feature():
    rng = np.random.default_rng(4)
    rays = unit(rng.standard_normal((200, 3)))
    turn = Pose(Pose.exp(torch.as_tensor(rng.standard_normal(6))).rotation, torch.zeros(3, dtype=torch.float64))
    words = rng.integers(0, 256, (200, 128)).astype(np.uint8)
    a, b = photo_of(rays, words), photo_of(rays @ turn.rotation.numpy().T, words)
    torch.testing.assert_close(matched_near(a, b, turn, 0.01), torch.arange(200)[:, None].expand(200, 2), rtol=0, atol=0)
    elsewhere = photo_of(np.roll(b.bearings.numpy(), 1, axis=0), words)
    assert not any(i == j for i, j in matched_near(a, elsewhere, turn, 0.01).tolist())


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
