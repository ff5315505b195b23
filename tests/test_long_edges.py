"""Long edges that are not quite straight: how much the arcs tell of it, and that they are not lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matching_scenes import MatchingScene, room, score

from camera_models import Calibration, InputError
from omnilines.files import PhotoRef
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.match import Matched, match_arcs, with_long_edges
from omnilines.pipelines.kept_lines import KeptLines
from omnilines.pipelines.lines import lines_of_arcs
from omnilines.pipelines.options import KeptLineOptions, SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.pipelines.reconstruct import check_options
from omnilines.progress import silent
from omnilines.records import ImagePoses

NOISE_PX, LONG_PX, NEAR_M = 0.1, 100.0, 0.05


def bent(arcs: ViewedArcs, bow_share: float, seed: int) -> ViewedArcs:
    """The arcs, both ends of each moved across it by normal errors of that share of its length, which they do not state."""
    normal = np.cross(arcs.bearings[:, 0], arcs.bearings[:, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    away_rad = bow_share * arcs.reach_rad[:, None] * np.random.default_rng(seed).standard_normal((len(arcs), 2))
    moved = arcs.bearings + away_rad[..., None] * normal[:, None]
    return replace(arcs, bearings=moved / np.linalg.norm(moved, axis=-1, keepdims=True))


def matched_twice(scene: MatchingScene, bow_share: float) -> tuple[Matched, Matched]:
    """As if edges were straight, and with what is found of long ones."""
    found = match_arcs(bent(scene.arcs(NOISE_PX, 1), bow_share, 2), tolerance_px=0.05)
    return found, with_long_edges(found)


@pytest.mark.parametrize(
    "name", ["panorama", "fisheye", *(pytest.param(n, marks=pytest.mark.full) for n in ("scaramuzza", "pinhole"))]
)
def test_straight_edges_stay_as_they_are(name: str) -> None:
    found, longer = matched_twice(room(name), 0.0)
    assert longer is found and found.bow_share == 0.0 and not found.bow_px.any()


@pytest.mark.parametrize(
    "name", ["panorama", "fisheye", *(pytest.param(n, marks=pytest.mark.full) for n in ("scaramuzza", "pinhole"))]
)
def test_long_arcs_of_edges_that_bow_are_found_again(name: str) -> None:
    scene, bow_share = room(name), 0.0015
    found, longer = matched_twice(scene, bow_share)
    assert 0.6 * bow_share < longer.bow_share < 1.4 * bow_share
    before, after = score(scene, found.tracks.track), score(scene, longer.tracks.track)
    long = found.arcs.length_px >= LONG_PX
    in_track = [float((one.tracks.track[long] >= 0).mean()) for one in (found, longer)]
    assert in_track[0] < 0.75 and in_track[1] > in_track[0] + 0.2
    assert after.completeness > before.completeness + 0.1 and after.found > 0.97 and after.purity > 0.98
    taken = longer.tracks.bowed & (longer.tracks.track >= 0)
    np.testing.assert_allclose(longer.bow_px[taken], longer.bow_share * found.arcs.length_px[taken])
    more = longer.arcs.covariance_px2 - found.arcs.covariance_px2
    added_px2 = np.broadcast_to((longer.bow_px**2)[:, None, None, None] * np.eye(2), more.shape)
    np.testing.assert_allclose(more, added_px2, atol=1e-12)
    np.testing.assert_array_equal(longer.tracks.rows, np.flatnonzero(longer.tracks.track >= 0))
    assert len(longer.tracks.lines) == len(longer.tracks) == len(longer.tracks.enough_views) >= len(found.tracks)


def test_tracks_of_straight_edges_keep_their_arcs() -> None:
    """Those of other lines come after them, and what is added to them is long."""
    found, longer = matched_twice(room("panorama"), 0.0015)
    before, after = found.tracks.track, longer.tracks.track
    kept = (before >= 0) & (after >= 0)
    assert kept.sum() > 0.97 * (before >= 0).sum()
    np.testing.assert_array_equal(after[kept], before[kept])
    added = (before < 0) & (after >= 0)
    assert added.any() and longer.tracks.bowed[added].all()
    assert (longer.bow_share * found.arcs.length_px[added] > found.arcs.sigma_px[added]).all()


def test_a_given_bow_is_taken_and_none_where_lines_do_not_stand_out() -> None:
    scene = room("fisheye")
    found = match_arcs(scene.arcs(NOISE_PX, 1), tolerance_px=0.05)
    assert with_long_edges(found, bow_share=0.0) is found
    assert with_long_edges(found, bow_share=0.001).bow_share == 0.001
    nothing = replace(found, beyond_chance=False)
    assert with_long_edges(nothing) is nothing


def lines_of(bow_share: float | None) -> tuple[KeptLines, np.ndarray]:
    """The lines of a room whose edges bow, and how far (m) both ends of each lie from the nearest line of the room."""
    scene = room("panorama")
    arcs = bent(scene.arcs(NOISE_PX, 1), 0.0015, 2)
    pixels, names = scene.camera.project(torch.as_tensor(arcs.bearings))[0].numpy(), [f"{k}.png" for k in range(len(scene.poses))]
    found = []
    for k, name in enumerate(names):
        own = arcs.image == k
        photo = PhotoRef(Path(name), name)
        found.append(FoundArcs(photo, "cam0", pixels[own], arcs.covariance_px2[own], arcs.length_px[own], arcs.colours[own]))
    # Arcs that no line takes may be confirmed by planes in either run.
    limits = KeptLineOptions(min_lying=1.0)
    options = SceneOptions(refine=("lines",), tolerance_px=0.05, bow_share=bow_share, kept_lines=limits)
    poses = ImagePoses(tuple(names), scene.poses, ("cam0",) * len(names))
    kept = lines_of_arcs(found, poses, Calibration({"cam0": scene.camera}), options, silent)
    direction, moment = scene.truth().direction.numpy(), scene.truth().moment.numpy()
    off_m = np.linalg.norm(np.cross(kept.scene.lines.ends_m[:, :, None], direction) - moment, axis=-1).max(1)
    return kept, off_m.min(-1)


@pytest.mark.slow
def test_lines_of_photos_hold_their_long_arcs() -> None:
    (straight, off_m), (bowed, bowed_off_m) = lines_of(0.0), lines_of(None)
    assert straight.matched.bow_share == 0.0 and 0.001 < bowed.matched.bow_share < 0.002
    in_line = [int((kept.segments.track >= 0).sum()) for kept in (straight, bowed)]
    assert in_line[1] > 1.1 * in_line[0]
    assert (bowed_off_m < NEAR_M).sum() >= (off_m < NEAR_M).sum() and (bowed_off_m >= NEAR_M).sum() <= 1
    assert (bowed_off_m < 3.0 * bowed.scene.lines.sigma_m).mean() > 0.9
    taken = bowed.matched.tracks.bowed
    assert taken.any() and (bowed.segments.covariance_px2[taken] > straight.segments.covariance_px2[taken])[:, :, 0, 0].all()


@pytest.mark.parametrize("bow_share", [-0.001, 1.0])
def test_a_wrong_bow_is_refused(bow_share: float) -> None:
    with pytest.raises(InputError, match="`bow_share` from 0 to below 1"):
        check_options(SceneOptions(bow_share=bow_share), Calibration({"cam0": room("panorama").camera}))


def test_nothing_to_add_and_no_line_to_add_to() -> None:
    """Every arc short, and arcs of which none has a partner."""
    scene = room("fisheye")
    found = match_arcs(scene.arcs(NOISE_PX, 1), tolerance_px=0.05)
    longer = with_long_edges(found, bow_share=1e-6)
    assert not longer.tracks.bowed.any()
    np.testing.assert_array_equal(longer.tracks.track, found.tracks.track)
    alone = found.arcs.rows(np.flatnonzero(scene.line == scene.image % 7))
    nothing = with_long_edges(match_arcs(alone, tolerance_px=0.05), bow_share=0.002)
    assert len(nothing.tracks) == 0 and (nothing.tracks.track == -1).all()
