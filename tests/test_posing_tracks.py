"""Tracks of features against the points that they were made from, and the compiled joining against plain sets."""

import math

import numpy as np
import torch

from camera_models.pose import Pose
from omnilines.posing.bearing_residual import across
from omnilines.posing.features import Features
from omnilines.posing.kernels.join import joined
from omnilines.posing.tracks import triangulated_tracks

SIGMA_RAD = 1e-3
PHOTOS, POINTS, WRONG = 8, 150, 40


def plainly_joined(links: np.ndarray, photo: np.ndarray) -> list[frozenset[int]]:
    """Sets of features, joined link by link where no photo is then in one twice."""
    track = [{k} for k in range(len(photo))]
    for i, j in links.tolist():
        both = track[i] | track[j]
        if len({int(photo[k]) for k in both}) == len(both):
            for k in both:
                track[k] = both
    return [frozenset(one) for one in track]


def test_links_join_features_as_plain_sets_do():
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(20):
        photo = np.sort(rng.integers(0, 6, 60))
        links = rng.integers(0, 60, (120, 2))
        links = links[photo[links[:, 0]] != photo[links[:, 1]]]
        found, expected = joined(links, photo), plainly_joined(links, photo)
        members = [frozenset(np.flatnonzero(found == track).tolist()) for track in found]
        assert members == expected
        assert all(found[track] == track for track in found)
        refused += int((found[links[:, 0]] != found[links[:, 1]]).sum())
    assert refused > 100
    np.testing.assert_array_equal(joined(np.zeros((0, 2), dtype=np.int64), np.zeros(3, dtype=np.int64)), [0, 1, 2])


def walk() -> tuple[list[Features], Pose, np.ndarray]:
    """Photos that all see the same points in the same order, their poses, and the points."""
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, (POINTS, 3)) * [4.0, 2.0, 4.0]
    words = rng.uniform(0, 100, (POINTS, 128))
    twist = rng.normal(size=(PHOTOS, 6)) * np.repeat([0.3, 1.0], 3)
    poses = Pose.exp(torch.as_tensor(twist))
    photos = []
    for k in range(PHOTOS):
        seen = poses[k].transform(torch.as_tensor(points))
        bearings = torch.nn.functional.normalize(seen, dim=-1)
        noise = torch.as_tensor(rng.normal(size=(POINTS, 2, 1)))
        bearings = torch.nn.functional.normalize(bearings + SIGMA_RAD * (across(bearings).mT @ noise)[..., 0], dim=-1)
        looks = torch.as_tensor(np.clip(words + 6 * rng.normal(size=words.shape), 0, 255).astype(np.uint8))
        sigma = torch.full((POINTS,), SIGMA_RAD, dtype=torch.float64)
        photos.append(Features(bearings, across(bearings) / SIGMA_RAD, sigma, looks))
    return photos, poses, points


def test_a_few_wrong_matches_do_not_join_points_to_one():
    photos, poses, points = walk()
    rng = np.random.default_rng(9)
    right = torch.arange(POINTS)[:, None].expand(POINTS, 2)
    matches = {}
    for i in range(PHOTOS):
        for j in range(i + 1, PHOTOS):
            wrong = torch.as_tensor(rng.integers(0, POINTS, (WRONG, 2)))
            matches[i, j] = torch.cat([wrong[wrong[:, 0] != wrong[:, 1]], right])
    seen, found = triangulated_tracks(photos, matches, poses, 4.0, math.radians(1.0))
    assert len(found) == POINTS
    # Four standard deviations leave out 3 in ten thousand.
    assert len(seen) > 0.99 * POINTS * PHOTOS
    assert len(torch.unique(seen.point * PHOTOS + seen.photo)) == len(seen)
    of_point = torch.zeros(POINTS, dtype=torch.long).index_put_((seen.point,), seen.feature)
    assert torch.equal(of_point[seen.point], seen.feature)
    assert len(torch.unique(of_point)) == POINTS
    # 4 m away at most, some 1 m between photos: 1e-3 rad are a centimetre.
    off = (found - torch.as_tensor(points)[of_point]).norm(dim=-1)
    assert float(off.median()) < 0.01


def test_no_matches_give_no_points():
    photos, poses, _ = walk()
    seen, found = triangulated_tracks(photos, {(0, 1): torch.zeros(0, 2, dtype=torch.long)}, poses, 4.0, math.radians(1.0))
    assert len(seen) == len(found) == 0
