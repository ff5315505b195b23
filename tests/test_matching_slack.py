"""The slack that poses and arcs ask for, chosen by the photos."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from matched_scenes import NEIGHBOURS, SLACKS_PX, assert_consistent, matched
from matching_scenes import (
    every_neighbour,
    room,
    score,
    shaken,
)

from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import neighbouring_photos
from omnilines.matching.match import match_arcs
from omnilines.matching.slack import evidence_of_lines


@pytest.mark.parametrize(
    "name", ["panorama", *(pytest.param(name, marks=pytest.mark.full) for name in ("fisheye", "scaramuzza", "pinhole"))]
)
def test_errors_of_poses_widen_the_slack(name: str) -> None:
    scene = room(name)
    poor, good = (scene.arcs(0.3, 3, poses=shaken(scene.poses, *errors, 9)) for errors in ((0.2, 10.0), (0.05, 2.0)))
    near = neighbouring_photos(good.poses.centre.numpy(), good.poses.rotation[:, 2].numpy(), NEIGHBOURS)
    slack = evidence_of_lines(good, near, 0).tolerance_px
    for arcs, tolerance_px, share in ((good, slack, 0.95), (poor, None, 0.9)):
        found = match_arcs(arcs, tolerance_px=tolerance_px)
        assert_consistent(found)
        got = score(scene, found.tracks.track)
        assert got.found > share and got.purity > 0.94
    assert matched(name).tolerance_px < slack < found.tolerance_px


def together(parts: Sequence[ViewedArcs]) -> ViewedArcs:
    """The arcs of all parts, sorted by photo."""
    order = np.argsort(np.concatenate([arcs.image for arcs in parts]), kind="stable")
    names = ("image", "bearings", "by_pixel", "covariance_px2", "colours")
    return replace(parts[0], **{name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fisheye", pytest.param("panorama", marks=pytest.mark.full)])
def test_arcs_that_err_more_than_they_state_ask_for_no_slack(name: str) -> None:
    """All by the same factor, precise ones and others: hardly any beside the noise of the precise ones."""
    scene = room(name)
    parts = []
    for kind, noise_px in enumerate((0.2, 0.6)):
        arcs = scene.arcs(noise_px, 3 + kind).rows(np.flatnonzero(scene.line % 2 == kind))
        parts.append(replace(arcs, covariance_px2=arcs.covariance_px2 / 1.35**2))
    arcs = together(parts)
    near = neighbouring_photos(arcs.poses.centre.numpy(), arcs.poses.rotation[:, 2].numpy(), NEIGHBOURS)
    assert max(evidence_of_lines(arcs, near, seed).tolerance_px for seed in range(5)) < 0.2 / 1.35
    moved = arcs.with_poses(shaken(scene.poses, 0.1, 5.0, 9))
    assert min(evidence_of_lines(moved, near, seed).tolerance_px for seed in range(5)) >= 0.2


@pytest.mark.parametrize("name", ["fisheye", pytest.param("pinhole", marks=pytest.mark.full)])
@pytest.mark.slow
def test_poor_arcs_of_other_lines_do_not_widen_the_slack(name: str) -> None:
    """Half of the lines give precise arcs, the others pieces that are twice as noisy as they say, as texture does."""
    scene = room(name)
    precise = scene.arcs(0.1, 3)
    parts = [precise.rows(np.flatnonzero(scene.line % 2 == 0))]
    for seed in (4, 5):
        pieces = scene.cut(seed)
        texture = pieces.arcs(1.0, seed + 1).rows(np.flatnonzero(pieces.line % 2 == 1))
        parts.append(replace(texture, covariance_px2=texture.covariance_px2 / 4))
    arcs = together(parts)
    near = neighbouring_photos(arcs.poses.centre.numpy(), arcs.poses.rotation[:, 2].numpy(), NEIGHBOURS)
    assert max(evidence_of_lines(arcs, near, seed).tolerance_px for seed in range(3)) <= 0.1


def test_the_slack_is_the_same_for_the_same_seed() -> None:
    scene = room("fisheye")
    arcs = scene.arcs(0.3, 3)
    near = every_neighbour(12)
    first = evidence_of_lines(arcs, near, 5).tolerance_px
    assert first == evidence_of_lines(arcs, near, 5).tolerance_px and first in SLACKS_PX
    steps = []
    match_arcs(arcs, tolerance_px=first, progress=lambda stage, done, total: steps.append((stage, done, total)))
    for stage in ("matching arcs", "building tracks"):
        own = [(done, total) for name, done, total in steps if name == stage]
        assert own and own[-1][0] == own[-1][1] and [done for done, _ in own] == sorted(done for done, _ in own)
