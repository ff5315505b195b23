"""Lines that are there by chance: their share in closed form, and in photos of a room among short edges of anything."""

import functools
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matching_scenes import MatchingScene, room

from camera_models import Calibration, GeometryError
from camera_models.pose import Pose
from omnilines.files import PhotoRef
from omnilines.geometry.line import PlueckerLines
from omnilines.pipelines.advice import advice
from omnilines.pipelines.chance_lines import MORE_BY_CHANCE, FoundByChance, chance_share, moved_photos, settled_share
from omnilines.pipelines.kept_lines import KeptLines
from omnilines.pipelines.lines import lines_of_arcs
from omnilines.pipelines.options import KeptLineOptions, SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.posing.still_rig import rig_that_stood_still
from omnilines.progress import silent
from omnilines.records import ImagePoses

VIEWS, CLUTTER, NEAR_M = 8, 600, 0.05
NAMES = tuple(f"photo{k}.png" for k in range(VIEWS))
LIMITS = KeptLineOptions()


def test_the_share_is_that_of_two_normal_distributions() -> None:
    """Of 4000 lines 800 are as those found by chance: the ratio of densities is known."""
    rng = np.random.default_rng(0)
    true, chance = np.array([0.7, 4.0]), np.array([0.45, 3.2])
    sigma = np.array([0.15, 0.5])
    shown = np.concatenate([true + sigma * rng.standard_normal((3200, 2)), chance + sigma * rng.standard_normal((800, 2))])
    found = chance_share(shown, chance + sigma * rng.standard_normal((800, 2)), np.ones(800))
    half = chance_share(shown, chance + sigma * rng.standard_normal((1600, 2)), np.full(1600, 0.5))
    assert np.abs(half - found).mean() < 0.03
    odds = 0.25 * np.exp((((shown - true) / sigma) ** 2 - ((shown - chance) / sigma) ** 2).sum(1) / 2.0)
    expected = odds / (1.0 + odds)
    assert found.sum() == pytest.approx(800, rel=0.05)
    np.testing.assert_allclose(found, expected, atol=0.25)
    assert np.abs(found - expected).mean() < 0.06 and np.corrcoef(found, expected)[0, 1] > 0.97


@pytest.mark.parametrize("count", [1, 2, 300])
def test_where_none_was_found_by_chance_no_line_is_dropped(count: int) -> None:
    shown = np.random.default_rng(count).uniform([0.2, 2.5], [1.0, 5.0], (count, 2))
    found = chance_share(shown, np.zeros((0, 2)), np.zeros(0))
    np.testing.assert_allclose(found, min(1.0, MORE_BY_CHANCE / count), rtol=1e-3)
    assert (found <= LIMITS.max_chance_share + 1e-6).all()


def test_what_is_found_by_chance_counts_as_far_as_its_arcs_show_no_other_line() -> None:
    """The first has two arcs in photo 0, one of which shows nothing, and one in photo 1; the second has arcs of lines in both."""
    found = FoundByChance(2, np.array([0, 0, 0, 1, 1, -1]), np.array([0, 0, 1, 0, 1, 1]), np.array([1, -1, 0, 1, 0, 2]))
    np.testing.assert_allclose(found.free(np.array([0.5, 0.2, 0.9])), [0.5, 0.1])
    np.testing.assert_allclose(found.free(np.ones(3)), 1.0)
    shown = np.random.default_rng(3).uniform([0.2, 2.5], [1.0, 5.0], (40, 2))
    nothing_else = settled_share(shown, shown[:20], lambda share: np.ones(20))
    of_lines = settled_share(shown, shown[:20], lambda share: share[:20] ** 3)
    np.testing.assert_allclose(nothing_else, chance_share(shown, shown[:20], np.ones(20)))
    np.testing.assert_allclose(of_lines, chance_share(shown, shown[:20], of_lines[:20] ** 3), atol=1e-3)
    assert nothing_else.mean() > 0.4 and of_lines.mean() < 0.1


@functools.cache
def cluttered(clutter: int = CLUTTER, edges: bool = True) -> tuple[MatchingScene, list[FoundArcs]]:
    """Panoramas of a room, and in each as many short arcs, anywhere; no arc has a colour."""
    exact = room("panorama", views=VIEWS)
    arcs, rng = exact.arcs(0.2, 1), np.random.default_rng(2)
    pixels = exact.camera.project(torch.as_tensor(arcs.bearings))[0].numpy()
    width, height = exact.camera.image_size
    found = []
    for k, name in enumerate(NAMES):
        own = pixels[(arcs.image == k) & edges]
        first = rng.uniform([20.0, 0.25 * height], [width - 20.0, 0.75 * height], (clutter, 2))
        way, long_px = rng.uniform(0.0, 2.0 * math.pi, clutter), rng.uniform(10.0, 20.0, clutter)
        last = first + long_px[:, None] * np.stack([np.cos(way), np.sin(way)], -1)
        ends = np.concatenate([own, np.stack([first, last], 1)])
        sigma_px = np.append(np.full(len(own), 0.2), rng.uniform(0.5, 1.5, clutter))
        covariance = sigma_px[:, None, None, None] ** 2 * np.ones((len(ends), 2, 1, 1)) * np.eye(2)
        length_px, unknown = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1), np.full((len(ends), 2, 3), np.nan)
        found.append(FoundArcs(PhotoRef(Path(name), name), "cam0", ends, covariance, length_px, unknown))
    return exact, found


@functools.cache
def lines_found(max_chance_share: float, clutter: int = CLUTTER, edges: bool = True) -> KeptLines:
    """The test of each line alone is lenient, so that there are some by chance."""
    exact, found = cluttered(clutter, edges)
    limits = LIMITS._replace(max_chance_share=max_chance_share, max_chance=0.2, min_meeting=1.0, min_lying=1.0)
    options = SceneOptions(refine=("lines",), tolerance_px=0.05, kept_lines=limits)
    poses = ImagePoses(NAMES, exact.poses, ("cam0",) * VIEWS)
    return lines_of_arcs(found, poses, Calibration({"cam0": exact.camera}), options, silent)


def true_lines(kept: KeptLines, exact: MatchingScene) -> np.ndarray:
    """Which lines have both ends near one line of the room."""
    lines: PlueckerLines = exact.truth()
    direction, moment = lines.direction.numpy(), lines.moment.numpy()
    off = np.linalg.norm(np.cross(kept.scene.lines.ends_m[:, :, None], direction) - moment, axis=-1)
    found: np.ndarray = (off.max(1) < NEAR_M).any(-1)
    return found


@pytest.mark.slow
def test_as_many_are_there_by_chance_as_moved_photos_tell() -> None:
    every, most = lines_found(1.0), lines_found(LIMITS.max_chance_share)
    right, share = true_lines(every, cluttered()[0]), every.scene.lines.chance_share
    wrong = ~right
    assert wrong.sum() >= 20 and right.sum() >= 80
    assert 0.6 * wrong.sum() < share.sum() < 1.4 * wrong.sum()
    assert share[right].mean() < 0.05 and share[wrong].mean() > 0.5
    kept = share <= LIMITS.max_chance_share
    assert kept[right].mean() > 0.97 and kept[wrong].mean() < 0.4
    np.testing.assert_array_equal(most.scene.lines.ends_m, every.scene.lines.ends_m[kept])
    np.testing.assert_array_equal(most.scene.lines.chance_share, share[kept])
    assert most.stages[-1].kept == kept.sum() and most.stages[-1].dropped[-1][1] == (~kept).sum()
    of_arcs = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)[every.segments.track]
    np.testing.assert_array_equal(most.segments.track, of_arcs)
    assert [most.scene.lines.tracks, sum(photo.in_lines for photo in most.photos)] == [
        tuple(every.scene.lines.tracks[k] for k in np.flatnonzero(kept)),
        (of_arcs >= 0).sum(),
    ]


@pytest.mark.slow
def test_where_many_are_it_is_said() -> None:
    every, none = lines_found(1.0), lines_found(LIMITS.max_chance_share, clutter=0)
    options = SceneOptions(refine=("lines",))
    share = every.scene.lines.chance_share
    told = f"About {share.sum():.0f} of {len(share)} lines ({100 * share.mean():.0f} %) are there by chance."
    assert told in [one.limit for one in advice(every, 0.0, "table", (), options, silent)]
    assert not [one.limit for one in advice(none, 0.0, "table", (), options, silent) if "by chance" in one.limit]


def test_arcs_that_stay_where_they_are_go_along_with_a_camera_that_photos_place() -> None:
    """Of a camera that boards place it is the camera that stood still."""
    found, options = lines_found(LIMITS.max_chance_share, clutter=0), SceneOptions(refine=("lines",))
    by_photos, by_boards = (advice(found, 0.5, source, (), options, silent) for source in ("sfm", "boards"))
    assert by_photos[0].limit.startswith("50 % of the arcs in no line stay") and "go along with the camera" in by_photos[0].limit
    assert "`mask`" in by_photos[0].do and "the camera stood still" in by_boards[0].limit
    assert not any("stay where they are" in one.limit for one in advice(found, 0.1, "sfm", (), options, silent))


@pytest.mark.parametrize(("walked_m", "stood"), [(0.001, True), (0.5, False)])
def test_a_rig_that_stood_still_while_a_board_moved_is_told(walked_m: float, stood: bool) -> None:
    """It was called a vehicle that the camera sees, and photos between its instants were asked for."""
    found, options = lines_found(LIMITS.max_chance_share, clutter=0), SceneOptions(refine=("lines", "poses"))
    options = replace(options, advice=options.advice._replace(few_explained=1.1))
    count = len(found.scene.poses) // 2
    names = found.scene.poses.images[: 2 * count]
    place = torch.zeros(2 * count, 3, dtype=torch.float64)
    place[:, 0] = 0.1 * torch.arange(2 * count).remainder(2)
    place[:, 1] = walked_m * torch.arange(2 * count).div(2, rounding_mode="floor")
    poses = ImagePoses(
        names, Pose(Pose.identity(2 * count).rotation, place), ("left", "right") * count, None,
        tuple(str(k // 2) for k in range(2 * count)),
    )  # fmt: skip
    told = rig_that_stood_still(poses, options.posing.carried.rig_still)
    assert (told is not None) == stood
    said = advice(replace(found, scene=replace(found.scene, poses=poses)), 0.5, "sfm", (), options, silent)
    assert any("hotos between" in one.do for one in said) != stood
    if told is not None:
        assert told.off <= walked_m * count and told.apart == pytest.approx(0.1) and not told.elsewhere
        assert len(said) == 1 and said[0].limit.startswith("The rig stood still: half of its instants are")


def test_an_instant_that_a_moving_board_has_taken_along_is_named() -> None:
    """In `charuco_video` one of four, by 36 cm and 15 degrees, in silence."""
    found, options = lines_found(LIMITS.max_chance_share, clutter=0), SceneOptions(refine=("lines", "poses"))
    place = torch.zeros(12, 3, dtype=torch.float64)
    place[:, 0] = 0.5 * torch.arange(12).remainder(3)
    place[9:, 1] = 0.36
    poses = ImagePoses(
        tuple(f"{k}.png" for k in range(12)), Pose(Pose.identity(12).rotation, place), ("left", "middle", "right") * 4, None,
        tuple(str(k // 3) for k in range(12)),
    )  # fmt: skip
    kept = replace(found, scene=replace(found.scene, poses=poses))
    rig, instant = advice(kept, 0.0, "sfm", (), options, silent)
    assert "give its photos alone, with `poses` rig" in rig.do
    assert instant.limit.startswith("The instant 3 is put elsewhere") and instant.do.startswith("Leave its photos out")


def test_a_room_without_clutter_keeps_all_lines() -> None:
    share = lines_found(LIMITS.max_chance_share, clutter=0).scene.lines.chance_share
    assert len(share) >= 80 and share.max() < 0.02


@pytest.mark.slow
def test_of_clutter_alone_hardly_a_line_is_left() -> None:
    """All of it is there by chance, and it is told."""
    every = lines_found(1.0, edges=False).scene.lines.chance_share
    assert len(every) >= 20 and every.mean() > 0.6
    try:
        left = len(lines_found(LIMITS.max_chance_share, edges=False).scene.lines)
    except GeometryError as error:
        assert "all are likely there by chance" in str(error)
        left = 0
    assert left < 0.3 * len(every)


def test_photos_are_moved_as_far_as_asked_and_not_turned() -> None:
    kept = lines_found(1.0)
    moved = moved_photos(kept, LIMITS, np.random.default_rng(0))
    before = kept.scene.poses.cam_from_world
    assert torch.equal(moved.cam_from_world.rotation, before.rotation) and moved.images == kept.scene.poses.images
    way_m = (moved.cam_from_world.centre - before.centre).norm(dim=-1).numpy()
    middle, image, track = kept.scene.lines.ends_m.mean(1), kept.segments.image, kept.segments.track
    for k in range(VIEWS):
        own = middle[track[(image == k) & (track >= 0)]]
        typical_m = np.median(np.linalg.norm(own - before.centre[k].numpy(), axis=-1))
        assert LIMITS.min_moved_rad <= way_m[k] / typical_m <= LIMITS.max_moved_rad


def test_instants_of_a_rig_are_named_by_what_their_photos_share_together() -> None:
    kept, options = lines_found(LIMITS.max_chance_share, clutter=0), SceneOptions(refine=("lines",))
    options = replace(options, advice=options.advice._replace(few_explained=1.1))
    rig = replace(kept.scene.poses, frames=tuple(f"instant{k // 2}" for k in range(VIEWS)))
    told = advice(replace(kept, scene=replace(kept.scene, poses=rig)), 0.0, "table", (), options, silent)[0].do
    a, b, shared = re.search(r"between the instants instant(\d) and instant(\d), which share (\d+) lines", told).groups()
    seen = [set(kept.segments.track[kept.segments.image // 2 == int(k)]) - {-1} for k in (a, b)]
    assert a != b and len(seen[0] & seen[1]) == int(shared)
    # Photos of one camera share fewer.
    alone = advice(kept, 0.0, "table", (), options, silent)[0].do
    assert int(re.search(r"which share (\d+) lines", alone)[1]) < int(shared) and "instants" not in alone


def test_nobody_is_sent_between_photos_that_a_rig_took_at_once() -> None:
    kept, options = lines_found(LIMITS.max_chance_share, clutter=0), SceneOptions(refine=("lines",))
    once = replace(kept, scene=replace(kept.scene, poses=replace(kept.scene.poses, frames=("one",) * VIEWS)))
    options = replace(options, advice=options.advice._replace(few_explained=1.1))
    (told,) = advice(once, 0.0, "rig", (), options, silent)
    assert told.do == (
        "Take photos of more instants, with poses from the photos (`poses` sfm), or `min_views` 3, with more lines by chance."
    )
    apart = replace(options, advice=options.advice._replace(few_explained=0.0, hardly_explained=1.0))
    (told,) = advice(once, 0.0, "rig", (), replace(apart, refine=("lines", "poses")), silent)
    assert told.do == "Take photos of more instants, with poses from the photos (`poses` sfm)."


def test_a_photo_of_a_rig_is_not_compared_with_another_of_its_instant() -> None:
    kept, options = lines_found(LIMITS.max_chance_share, clutter=0), SceneOptions(refine=("lines", "poses"))
    options = replace(options, advice=options.advice._replace(hardly_explained=1.0))
    weak, nearest = re.search(r"between (\S+) and (\S+)\.$", advice(kept, 0.0, "table", (), options, silent)[0].do).groups()
    rig = replace(kept.scene.poses, frames=tuple("one" if name in (weak, nearest) else name for name in NAMES))
    told = advice(replace(kept, scene=replace(kept.scene, poses=rig)), 0.0, "table", (), options, silent)[0].do
    assert f"between {weak} and photo" in told and nearest not in told
