"""Which photos are compared: near ones that look the same way, and see the same."""

import math

import numpy as np
import torch
from matched_scenes import NEIGHBOURS, matched
from matching_scenes import (
    SIZE,
    MatchingScene,
    every_neighbour,
    room,
    score,
)

from camera_models.pose import Pose
from omnilines.matching.hypotheses import neighbouring_photos
from omnilines.matching.match import match_arcs
from omnilines.matching.options import HypothesisOptions, MatchingOptions
from omnilines.matching.shared_view import neighbours_in_view


def test_few_neighbours_find_most_lines_in_less_work() -> None:
    scene = room("pinhole")
    arcs = scene.arcs(0.3, 3)
    every, few = (
        matched("pinhole"),
        match_arcs(arcs, tolerance_px=0.1, options=MatchingOptions(hypotheses=HypothesisOptions(max_neighbours=8))),
    )
    assert few.hypotheses.candidates.sum() < 0.6 * every.hypotheses.candidates.sum()
    got = score(scene, few.tracks.track)
    assert got.purity > 0.985 and got.found > 0.9


def test_neighbours_are_the_nearest_that_look_the_same_way() -> None:
    rng = np.random.default_rng(7)
    centres = rng.uniform(0.0, 10.0, (40, 3))
    axes = rng.standard_normal((40, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    near = neighbouring_photos(centres, axes, 6)
    assert bool((near == near.T).all()) and not near.diagonal().any() and int(near.sum(1).min()) >= 6
    for k in range(40):
        cost = [
            np.linalg.norm(centres[k] - centres[j]) * (2.5 - 1.5 * axes[k] @ axes[j]) if j != k else math.inf for j in range(40)
        ]
        assert bool(near[k, np.argsort(cost)[:6]].all())
    # Nobody is one's neighbour but by the own choice of one of the two.
    assert int(near.sum()) <= 2 * 40 * 6
    np.testing.assert_array_equal(neighbouring_photos(centres, axes, 39), every_neighbour(40))
    np.testing.assert_array_equal(neighbouring_photos(centres[:5], axes[:5], NEIGHBOURS), every_neighbour(5))


def two_rooms(views: int) -> MatchingScene:
    """Rooms with a wall between, the photos of the second after those of the first."""
    one, other = (room("fisheye", seed=seed, views=views) for seed in (1, 2))
    beside = torch.tensor([SIZE[0] + 0.15, 0.0, 0.0], dtype=torch.float64)
    rotation, translation = other.poses.rotation, other.poses.translation - other.poses.rotation @ beside
    return MatchingScene(
        one.camera,
        Pose(torch.cat([one.poses.rotation, rotation]), torch.cat([one.poses.translation, translation])),
        torch.cat([one.ends_m, other.ends_m + beside]),
        np.concatenate([one.image, other.image + views]),
        np.concatenate([one.line, other.line + len(one.ends_m)]),
        torch.cat([one.pixels, other.pixels]),
    )


def test_photos_behind_a_wall_are_no_neighbours() -> None:
    views = 14
    scene = two_rooms(views)
    arcs = scene.arcs(0.2, 1, colours=True).widened(0.1)
    options = MatchingOptions(hypotheses=HypothesisOptions(max_neighbours=12))
    near = neighbouring_photos(arcs.poses.centre.numpy(), arcs.poses.rotation[:, 2].numpy(), 12)
    seen = neighbours_in_view(arcs, near, 4, options)
    second = np.arange(2 * views) >= views
    across = second[:, None] != second
    assert int(near[across].sum()) > 30 and not seen[across].any()
    assert seen[~across].mean() > near[~across].mean()
    assert bool((seen == seen.T).all()) and not seen.diagonal().any()
    # Photos that are all near are all compared; one without a line keeps those that are near.
    every = every_neighbour(2 * views)
    assert neighbours_in_view(arcs, every, 4, options) is every
    blind = arcs.rows(np.flatnonzero(arcs.image != 3))
    np.testing.assert_array_equal(neighbours_in_view(blind, near, 4, options)[3], near[3])
