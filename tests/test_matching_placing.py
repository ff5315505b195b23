"""Photos placed by the lines of others: in rooms of known lines, four kinds of cameras, with and without colours."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matching_scenes import looking, random_arcs, room, shaken

from camera_models.pose import Pose
from omnilines.matching.known_lines import KnownLines
from omnilines.matching.match import Matched, match_arcs
from omnilines.matching.options import MatchingOptions, PlacingOptions
from omnilines.matching.photo_starts import meeting_directions, parallel_directions, start_poses
from omnilines.matching.placing import lines_of_others, lines_of_tracks, mended_pose, placed_anywhere
from omnilines.matching.resection import _linearised, explained_by_lines, refined_by_lines

FEW_CAMERAS = ["fisheye", "panorama", *(pytest.param(name, marks=pytest.mark.full) for name in ("scaramuzza", "pinhole"))]
ONE_CAMERA = ["fisheye", *(pytest.param(name, marks=pytest.mark.full) for name in ("panorama", "scaramuzza", "pinhole"))]
SEEN, SEEN_GREY = 20, 45
"""Arcs from which on a photo shows enough to be placed, with colours and without: an arc may be of any line then."""


@functools.cache
def matched(name: str, colours: bool) -> Matched:
    return match_arcs(room(name).arcs(0.3, 3, colours))


def asked(found: Matched, least: int = SEEN) -> list[int]:
    """Some photos that show enough."""
    return np.flatnonzero(np.bincount(found.arcs.image, minlength=found.arcs.images) >= least)[::4].tolist()


def apart(one: Pose, other: Pose) -> tuple[float, float]:
    """Degrees and metres between two poses of one photo."""
    cosine = ((one.rotation[0] @ other.rotation[0].mT).trace() - 1) / 2
    return math.degrees(math.acos(min(1.0, float(cosine)))), float((one.centre - other.centre).norm())


@pytest.mark.slow
@pytest.mark.parametrize("least", [SEEN, pytest.param(SEEN_GREY, marks=pytest.mark.full)])
@pytest.mark.parametrize("name", ONE_CAMERA)
def test_a_photo_without_a_pose_is_placed_by_the_lines_of_the_others(name: str, least: int) -> None:
    truth, found = room(name).poses, matched(name, least == SEEN)
    for k in asked(found, least):
        own = found.arcs.of_photo(k).with_poses(Pose.identity(1))
        one = placed_anywhere(own, others(found, k), 0)
        assert one is not None
        degrees, metres = apart(one.pose, truth[[k]])
        assert degrees < 0.2 and metres < 0.01
        assert len(one.arc) > 0.8 * (found.arcs.image == k).sum()


def everything(found: Matched) -> KnownLines:
    return lines_of_tracks(found.arcs, found.tracks.track, len(found.tracks))


def others(found: Matched, k: int) -> KnownLines:
    return lines_of_others(everything(found), found.arcs, found.tracks, np.array([k]))


def test_lines_of_the_others_are_those_of_all_their_arcs() -> None:
    found = matched("fisheye", True)
    for k in (0, 3):
        track = np.where(found.arcs.image == k, -1, found.tracks.track)
        expected, fast = lines_of_tracks(found.arcs, track, len(found.tracks)), others(found, k)
        order = np.argsort(fast.track)
        np.testing.assert_array_equal(fast.track[order], expected.track)
        for name in ("direction", "moment", "spans", "colours"):
            np.testing.assert_allclose(getattr(fast, name)[order], getattr(expected, name), rtol=1e-6, atol=1e-6)
        # Charts may differ where two cameras are equally far; what the lines explain does not.
        arcs = found.arcs.of_photo(k)
        assert abs(explained_by_lines(arcs, fast).score - explained_by_lines(arcs, expected).score) < 1e-6


@pytest.mark.parametrize("name", FEW_CAMERAS)
@pytest.mark.slow
def test_a_pose_that_is_off_is_mended_and_a_right_one_is_left(name: str) -> None:
    truth, found = room(name).poses, matched(name, True)
    off = shaken(truth, 0.7, 30.0, 8)
    for k in asked(found):
        known, own = others(found, k), found.arcs.of_photo(k)
        assert mended_pose(own, known, 0) is None
        better = mended_pose(own.with_poses(off[[k]]), known, 0)
        assert better is not None
        degrees, metres = apart(better.pose, truth[[k]])
        assert degrees < 0.2 and metres < 0.01


def test_a_photo_that_is_moved_again_and_again_keeps_a_rotation() -> None:
    """Rounding doubled with every step: after eight rounds its rotation was refused as none."""
    found = matched("fisheye", True)
    known, own = others(found, 0), found.arcs.of_photo(0)
    for _ in range(8):
        one = refined_by_lines(own, known)
        assert one is not None
        own = own.with_poses(one.pose)
    off = one.pose.rotation @ one.pose.rotation.mT - torch.eye(3, dtype=torch.float64)
    assert float(off.abs().max()) < 1e-13


@pytest.mark.slow
def test_a_pose_that_is_found_anew_is_judged_by_all_lines() -> None:
    """It was sought by the longest ones, and compared by these with a pose that all of them were asked of."""
    truth, found = room("fisheye").poses, matched("fisheye", True)
    away = Pose.exp(torch.tensor([[0.0, math.pi / 2.0, 0.0, 0.5, 0.0, 0.0]], dtype=torch.float64))
    k = asked(found)[0]
    known, own = others(found, k), found.arcs.of_photo(k)
    options = MatchingOptions(placing=PlacingOptions(max_lines=len(known) // 2))
    better = mended_pose(own.with_poses(away @ truth[[k]]), known, 0, options=options)
    assert better is not None
    assert len(better.arc) > 0.8 * len(own)


@pytest.mark.slow
@pytest.mark.parametrize("name", ONE_CAMERA)
def test_a_pose_that_is_wrong_altogether_is_found_anew(name: str) -> None:
    """Turned by a right angle and half a metre away: no line near it is right."""
    truth, found = room(name).poses, matched(name, True)
    away = Pose.exp(torch.tensor([[0.0, math.pi / 2.0, 0.0, 0.5, 0.0, 0.0]], dtype=torch.float64))
    for k in asked(found):
        known, own = others(found, k), found.arcs.of_photo(k)
        better = mended_pose(own.with_poses(away @ truth[[k]]), known, 0)
        assert better is not None
        degrees, metres = apart(better.pose, truth[[k]])
        assert degrees < 0.2 and metres < 0.01


def test_the_pose_scatters_as_its_arcs_do() -> None:
    """Refined from the true pose with other noise each time: the residuals of arcs in their noise are as noise is."""
    found = matched("fisheye", True)
    known = others(found, 2)
    one = refined_by_lines(found.arcs.of_photo(2), known)
    assert one is not None
    residual, _ = _linearised(found.arcs.of_photo(2).with_poses(one.pose), known, one.arc, one.line)
    ratio = residual / found.arcs.of_photo(2).with_poses(one.pose).packed[one.arc, 12:]
    assert 0.6 < float(np.sqrt((ratio**2).mean())) < 1.3


@pytest.mark.parametrize("name", ONE_CAMERA)
@pytest.mark.slow
def test_a_photo_of_elsewhere_is_not_placed(name: str) -> None:
    found = matched(name, True)
    known = everything(found)
    strangers = random_arcs(name, 2, 60, 9)
    for k in range(2):
        own = strangers.of_photo(k).with_poses(Pose.identity(1))
        seen = np.random.default_rng(k).uniform(3.0, 5.5, (len(own), 2, 3))
        assert placed_anywhere(own, known, 0) is None
        assert placed_anywhere(replace(own, colours=seen), known, 0) is None


def test_the_jacobian_is_that_of_finite_differences() -> None:
    found = matched("scaramuzza", True)
    own, known = found.arcs.of_photo(1), everything(found)
    pairs = explained_by_lines(own, known)
    _, jacobian = _linearised(own, known, pairs.arc, pairs.line)
    for k, step in enumerate(1e-6 * torch.eye(6, dtype=torch.float64)):
        ahead, behind = (
            _linearised(own.with_poses(Pose.exp(sign * step[None]) @ own.poses), known, pairs.arc, pairs.line)[0]
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose((ahead - behind) / 2e-6, jacobian[..., k], atol=1e-7)


def test_photos_that_move_as_one_have_one_jacobian() -> None:
    found = matched("fisheye", True)
    own, known = found.arcs.of_photos(np.array([1, 4])), everything(found)
    pairs = explained_by_lines(own, known)
    assert set(own.image[pairs.arc]) == {0, 1}
    _, jacobian = _linearised(own, known, pairs.arc, pairs.line)
    for k, step in enumerate(1e-6 * torch.eye(6, dtype=torch.float64)):
        ahead, behind = (
            _linearised(own.moved_to(Pose.exp(sign * step[None]) @ own.poses[[0]]), known, pairs.arc, pairs.line)[0]
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose((ahead - behind) / 2e-6, jacobian[..., k], atol=1e-7)


def test_directions_are_those_of_parallel_lines_and_where_their_circles_meet() -> None:
    rng = np.random.default_rng(4)
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    lines = np.repeat(axes.T, [12, 9, 6], axis=0) * rng.choice([-1.0, 1.0], 27)[:, None] + 0.003 * rng.standard_normal((27, 3))
    lines /= np.linalg.norm(lines, axis=-1, keepdims=True)
    normals = np.cross(lines, rng.standard_normal((27, 3)))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    for found in (parallel_directions(lines), meeting_directions(normals)):
        np.testing.assert_allclose(np.abs(found[:3] @ axes), np.eye(3), atol=0.02)


def test_lines_of_one_direction_place_nothing() -> None:
    """Nor do photos with hardly any arcs: the height of the camera along the lines stays open."""
    found = matched("fisheye", True)
    own, known = found.arcs.of_photo(0), everything(found)
    upright = np.flatnonzero(np.abs(known.direction[:, 2]) > 0.99)
    assert len(upright) >= 4
    members = np.isin(found.tracks.track, upright)
    only = lines_of_tracks(found.arcs, np.where(members, found.tracks.track, -1), len(found.tracks))
    for arcs in (own, own.rows(np.arange(3))):
        assert len(start_poses(arcs.with_poses(Pose.identity(1)), only, 0)) == 0
        assert placed_anywhere(arcs, only, 0) is None
    nowhere = looking(np.array([[50.0, 50.0, 50.0]]), np.array([[1.0, 0.0, 0.0]]))
    assert refined_by_lines(own.with_poses(nowhere), known) is None
