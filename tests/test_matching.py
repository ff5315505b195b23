"""Arcs of photos put into tracks, against rooms of known lines in four kinds of cameras."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matched_scenes import OPTIONS, SLACKS_PX, assert_consistent, matched
from matching_scenes import (
    VIEWS,
    MatchingScene,
    camera_named,
    every_neighbour,
    from_views,
    looking,
    random_arcs,
    room,
    score,
    shaken,
)

from camera_models.errors import GeometryError, InputError
from camera_models.pose import Pose
from omnilines.geometry.sphere import points_on_arc
from omnilines.matching import tracks as tracks_module
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import Hypotheses, find_hypotheses
from omnilines.matching.match import Matched, match_arcs
from omnilines.matching.options import HypothesisOptions, MatchingOptions
from omnilines.matching.tracks import build_tracks, spare_tracks

CAMERAS = list(VIEWS)
FEW_CAMERAS = ["fisheye", "panorama", *(pytest.param(name, marks=pytest.mark.full) for name in ("scaramuzza", "pinhole"))]
MOST_ARCS_RANDOMLY_IN_TRACKS = 0.03


def line_errors(scene: MatchingScene, found: Matched) -> np.ndarray:
    """Larger distance (m) of both true ends from the line of each track, the line being that of most of its arcs."""
    track = found.tracks.track
    table = np.zeros((len(found.tracks), len(scene.ends_m)), dtype=np.int64)
    np.add.at(table, (track[track >= 0], scene.line[track >= 0]), 1)
    ends = scene.ends_m[table.argmax(1)]
    return torch.stack([found.tracks.lines.lines.distance_to(ends[:, k]) for k in range(2)]).amax(0).numpy()


def same_partition(one: np.ndarray, other: np.ndarray) -> bool:
    pairs = set(zip(one.tolist(), other.tolist(), strict=True))
    return len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs}) and all((a < 0) == (b < 0) for a, b in pairs)


@pytest.mark.parametrize("name", CAMERAS)
def test_nearly_all_arcs_find_their_line(name: str) -> None:
    scene = room(name)
    lines = int((scene.views_of_lines() >= 4).sum())
    for colours, purity in ((False, 0.985), (True, 0.998)):
        found = match_arcs(scene.arcs(0.3, 3, colours)) if colours else matched(name)
        assert_consistent(found)
        got = score(scene, found.tracks.track)
        # With colours a pinhole camera, which sees lines in the fewest photos, loses one of them.
        complete = 0.995 if colours and name != "pinhole" else 0.985
        assert got.purity > purity and got.completeness > complete and got.found > 0.985
        assert abs(len(found.tracks) - lines) <= 2 and found.tolerance_px <= SLACKS_PX[1]
        assert float(np.median(line_errors(scene, found))) < 0.006


@pytest.mark.parametrize("name", FEW_CAMERAS)
def test_arcs_in_pieces_find_their_line(name: str) -> None:
    scene = room(name).cut(4)
    found = match_arcs(scene.arcs(0.3, 5))
    assert_consistent(found)
    got = score(scene, found.tracks.track)
    assert len(scene.image) > 1.8 * len(room(name).image)
    assert got.purity > 0.985 and got.completeness > 0.97 and got.found > 0.98


@pytest.mark.parametrize("name", CAMERAS)
def test_arcs_beyond_90_degrees_and_across_a_seam_are_matched(name: str) -> None:
    """As completely as the others; a pinhole camera has no such arcs."""
    scene, found = room(name), matched(name)
    bearings = scene.camera.unproject(scene.pixels)[0]
    pixels, _ = scene.camera.project(points_on_arc(bearings[:, 0], bearings[:, 1], torch.linspace(0, 1, 64, dtype=torch.float64)))
    jump = (pixels[:, 1:, 0] - pixels[:, :-1, 0]).abs().amax(1).numpy() > 0.5 * scene.camera.image_size[0]
    beyond = (bearings[..., 2] < 0).any(-1).numpy()
    expected = {"fisheye": (20, 0), "scaramuzza": (100, 0), "panorama": (400, 40), "pinhole": (0, 0)}[name]
    assert beyond.sum() >= expected[0] and jump.sum() >= expected[1]
    if name != "panorama":
        assert not jump.any()
    for chosen in (beyond, jump):
        if chosen.any():
            tracks = found.tracks.track[chosen]
            assert float((tracks >= 0).mean()) > 0.97
            part = replace(scene, image=scene.image[chosen], line=scene.line[chosen])
            assert score(part, tracks, 1).purity > 0.985


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.full)])
@pytest.mark.parametrize("name", FEW_CAMERAS)
def test_arcs_of_no_common_lines_give_next_to_no_tracks(name: str, seed: int) -> None:
    arcs = random_arcs(name, VIEWS[name], 40, seed)
    assert len(arcs) > 300
    found = match_arcs(arcs)
    assert_consistent(found)
    # Nothing stands out, so nothing asks for tolerance; a line in a hundred arcs would be one track in 25.
    assert found.tolerance_px == SLACKS_PX[0] and len(found.tracks) <= 4
    assert float((found.tracks.track >= 0).mean()) < MOST_ARCS_RANDOMLY_IN_TRACKS


def test_too_little_tolerance_costs_tracks() -> None:
    scene = room("fisheye")
    arcs = scene.arcs(0.3, 3, poses=shaken(scene.poses, 0.2, 10.0, 9))
    assert score(scene, match_arcs(arcs, tolerance_px=0.1).tracks.track).found < 0.7


def with_twins(name: str, gap_m: float) -> tuple[MatchingScene, np.ndarray]:
    """A room in which every sixth line has a second one beside it, and which lines (k, 2) are pairs."""
    scene = room(name)
    direction = scene.truth().direction[::6]
    side = torch.linalg.cross(direction, torch.tensor([0.3, 0.5, 1.0], dtype=torch.float64).expand_as(direction))
    twins = scene.ends_m[::6] + gap_m * (side / side.norm(dim=-1, keepdim=True))[:, None]
    both = from_views(*camera_named(name), scene.poses, torch.cat([scene.ends_m, twins]))
    count = len(scene.ends_m)
    return both, np.stack([np.arange(0, count, 6), count + np.arange(len(twins))], -1)


def separation_px(scene: MatchingScene, arcs: ViewedArcs, line: int, other: int) -> float:
    """How far one line lies from another in the middle one of the photos that see it, at its farther end."""
    rows = np.flatnonzero(scene.line == line)
    truth = scene.truth()
    normal = truth.moment[other] - torch.linalg.cross(arcs.planes.centre[rows], truth.direction[other].expand(len(rows), 3))
    off = (torch.as_tensor(arcs.packed[rows, :6]).unflatten(1, (2, 3)) @ normal[..., None]).squeeze(-1) / normal.norm(dim=-1)[
        :, None
    ]
    return float(np.median(off.abs().amax(-1).numpy() / arcs.px_rad[rows]))


@pytest.mark.parametrize("name", FEW_CAMERAS)
def test_parallel_edges_two_centimetres_apart_stay_two_lines(name: str) -> None:
    """Those that the photos tell apart: by five standard deviations in the middle one of them."""
    scene, pairs = with_twins(name, 0.02)
    arcs = scene.arcs(0.15, 3)
    track = match_arcs(arcs).tracks.track
    table = np.zeros((track.max() + 1, len(scene.ends_m)), dtype=np.int64)
    np.add.at(table, (track[track >= 0], scene.line[track >= 0]), 1)
    total = np.bincount(scene.line, minlength=len(scene.ends_m))
    kept, tried = 0, 0
    for pair in pairs:
        apart = min(separation_px(scene, arcs, *pair), separation_px(scene, arcs, *pair[::-1]))
        if apart < 5 * math.hypot(0.15, SLACKS_PX[0]) or total[pair].min() < 4:
            continue
        tried += 1
        best = table[:, pair].argmax(0)
        own = table[best, pair] / np.maximum(total[pair], table[best].sum(1))
        kept += best[0] != best[1] and own.min() > 0.6
    assert tried >= 6 and kept >= 0.85 * tried


def shutters(seed: int) -> MatchingScene:
    """Four shutters of 30 slats, 10 cm apart, seen by a fisheye that moves along; photos show 40 percent of them."""
    rng = np.random.default_rng(seed)
    first = np.array([[1.6 * column, 0.0, 0.1 * row] for column in range(4) for row in range(30)])
    ends_m = torch.as_tensor(np.stack([first, first + np.array([1.0, 0.0, 0.0])], 1))
    camera, half_rad = camera_named("fisheye")
    centres = np.stack([rng.uniform(0.0, 6.4, 14), rng.uniform(-4.0, -2.0, 14), rng.uniform(0.0, 3.0, 14)], -1)
    axes = np.array([0.0, 1.0, 0.0]) + 0.2 * rng.standard_normal((14, 3))
    whole = from_views(camera, half_rad, looking(centres, axes), ends_m)
    seen = rng.random(len(whole.image)) < 0.4
    return replace(whole, image=whole.image[seen], line=whole.line[seen], pixels=whole.pixels[seen])


@pytest.mark.slow
def test_lines_that_others_explain_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Among equal edges arcs of several of them meet in lines that are not there, far fewer where it counts where arcs end."""
    wrong, right, explained = np.zeros(3, dtype=int), np.zeros(3, dtype=int), 0
    wherever = replace(OPTIONS, likeness=OPTIONS.likeness._replace(other_end=1.0))
    for seed in range(3):
        scene = shutters(seed)
        arcs = scene.arcs(0.3, seed)
        for k, options in enumerate((wherever, wherever, OPTIONS)):
            with monkeypatch.context() as patch:
                if k != 1:
                    patch.setattr(tracks_module, "needed", lambda order, *rest: np.ones(len(order), dtype=bool))
                found = match_arcs(arcs, tolerance_px=SLACKS_PX[0], options=options)
            assert_consistent(found)
            off = line_errors(scene, found)
            wrong[k] += int((off > 0.03).sum())
            right[k] += int((off <= 0.03).sum())
            explained += found.tracks.explained if k == 1 else 0
    assert wrong[0] >= 12 and explained >= 10
    assert wrong[1] <= 0.75 * wrong[0] and right[1] >= 0.96 * right[0]
    assert wrong[2] <= 0.5 * wrong[0] and right[2] >= right[0]


def test_three_photos_are_enough_where_every_arc_agrees() -> None:
    """Of six photos: more lines than four photos see, and right ones."""
    scene = room("fisheye", views=6)
    seen = scene.views_of_lines()
    found = match_arcs(scene.arcs(0.2, 1, colours=True), tolerance_px=SLACKS_PX[0])
    assert_consistent(found)
    got = score(scene, found.tracks.track, 3)
    assert got.purity > 0.99 and len(found.tracks) > (seen >= 4).sum() + 0.3 * (seen == 3).sum()
    assert np.median(line_errors(scene, found)) < 0.02


def test_what_tracks_of_four_photos_leave_gives_spare_ones_of_three() -> None:
    """Without colours four photos have to see a line; those that three see are spare, and right, and nothing is in both."""
    scene = room("fisheye", views=6)
    found = match_arcs(scene.arcs(0.2, 1), tolerance_px=SLACKS_PX[0])
    spare = replace(found, tracks=spare_tracks(found.arcs, found.hypotheses, found.tracks, 3))
    assert_consistent(spare)
    track, three = spare.tracks.track, int((scene.views_of_lines() == 3).sum())
    assert not ((track >= 0) & (found.tracks.track >= 0)).any() and set(spare.tracks.enough_views.tolist()) == {3}
    assert 0.6 * three <= len(spare.tracks) <= 1.1 * three
    assert np.mean(line_errors(scene, spare) < 0.1) > 0.8
    nothing = spare_tracks(found.arcs, found.hypotheses, found.tracks, 7)
    assert len(nothing) == 0 and bool((nothing.track == -1).all())


def test_an_arc_that_leads_elsewhere_asks_for_another_photo() -> None:
    scene = room("fisheye", views=4)
    arcs = scene.arcs(0.2, 1)
    track = np.full(len(arcs), -1)
    first = [np.flatnonzero(arcs.image == k)[:3] for k in range(4)]
    support, agreement = np.full((len(arcs), 4), -1), np.full(len(arcs), 3.0)
    for k in range(3):
        # Three tracks of the photos 0 to 2; of the second one arc does not see photo 2, the third has photo 3 too.
        members = [first[photo][k] for photo in range(4 if k == 2 else 3)]
        track[members] = k
        for i in members:
            others = [j for j in members if j != i and not (k == 1 and i == members[0] and j == members[2])]
            support[i, : len(others)] = others
    blank = np.zeros(len(arcs))
    found = Hypotheses(
        np.zeros((len(arcs), 2)),
        blank,
        blank,
        agreement,
        support.astype(np.int32),
        blank.astype(np.int64),
        every_neighbour(arcs.images),
    )
    assert tracks_module._enough_views(arcs, track, 3, found, 4, OPTIONS.tracks.min_agreement).tolist() == [3, 4, 3]
    assert tracks_module._enough_views(arcs, track, 3, found, 3, OPTIONS.tracks.min_agreement).tolist() == [3, 3, 3]
    # Seen alike on one side only.
    agreement[first[0][2]] = 1.4
    assert tracks_module._enough_views(arcs, track, 3, found, 4, OPTIONS.tracks.min_agreement).tolist() == [3, 4, 4]


def test_tracks_do_not_depend_on_the_frame_or_on_the_direction_of_arcs() -> None:
    """The world moved far away and turned; every other arc from its other end; the same arcs twice."""
    scene = room("scaramuzza")
    arcs = scene.arcs(0.3, 3, colours=True)
    expected = match_arcs(arcs, tolerance_px=0.2)
    assert same_partition(match_arcs(arcs, tolerance_px=0.2).tracks.track, expected.tracks.track)
    moved = Pose.exp(torch.tensor([[0.3, -1.0, 0.5, 3000.0, -2e4, 500.0]], dtype=torch.float64))[
        torch.zeros(12, dtype=torch.int64)
    ]
    elsewhere = match_arcs(arcs.with_poses(arcs.poses @ moved), tolerance_px=0.2)
    assert same_partition(elsewhere.tracks.track, expected.tracks.track)
    turn = np.arange(len(arcs)) % 2 == 0

    def turned(values: np.ndarray) -> np.ndarray:
        return np.where(turn.reshape(-1, *[1] * (values.ndim - 1)), values[:, ::-1], values)

    other = replace(
        arcs,
        bearings=turned(arcs.bearings),
        by_pixel=turned(arcs.by_pixel),
        covariance_px2=turned(arcs.covariance_px2),
        colours=turned(arcs.colours),
    )
    assert same_partition(match_arcs(other, tolerance_px=0.2).tracks.track, expected.tracks.track)


def test_scale_of_the_world_does_not_matter() -> None:
    scene = room("fisheye")
    arcs = scene.arcs(0.3, 3)
    expected = matched("fisheye")
    for scale in (1e-3, 1e4):
        poses = Pose(arcs.poses.rotation, scale * arcs.poses.translation)
        found = match_arcs(arcs.with_poses(poses), tolerance_px=expected.tolerance_px)
        assert same_partition(found.tracks.track, expected.tracks.track)
        errors_m = line_errors(replace(scene, ends_m=scale * scene.ends_m), found)
        np.testing.assert_allclose(errors_m, scale * line_errors(scene, expected), rtol=1e-4, atol=scale * 1e-6)


def test_photos_and_arcs_that_are_not_there() -> None:
    """Photos without arcs, arcs without partners, and no arcs at all."""
    scene = room("fisheye")
    arcs = scene.arcs(0.3, 3)
    some = arcs.rows(np.flatnonzero((arcs.image % 3 != 0) & (arcs.image != 11)))
    found = match_arcs(some, min_views=3)
    assert_consistent(found, 3)
    assert len(found.tracks) > 60
    lonely = arcs.rows(np.array([np.flatnonzero(arcs.image == k)[k] for k in range(0, 12, 4)]))
    nothing = match_arcs(lonely)
    assert_consistent(nothing)
    assert len(nothing.tracks) == 0 and bool((nothing.tracks.track == -1).all()) and nothing.tolerance_px == SLACKS_PX[0]
    assert nothing.tracks.lines.ends_m.shape == (0, 2, 3)
    none = arcs.rows(np.zeros(0, dtype=np.int64))
    assert none.packed.shape == (0, 14) and none.px_rad.shape == (0,) and none.starts.tolist() == [0] * 13
    hypotheses = find_hypotheses(none, every_neighbour(12))
    assert hypotheses.support.shape[0] == len(hypotheses.score) == 0
    assert len(build_tracks(none, hypotheses, 4)) == 0
    places, sigma, usable = arcs.places(scene.truth(), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    assert places.shape == sigma.shape == (0, 2) and usable.shape == (0,)


def test_positions_are_where_the_ends_meet_the_line() -> None:
    """Exact arcs of exact lines: between the true ends, and the stated deviation is that of an end moved by a pixel along it."""
    scene = room("scaramuzza")
    arcs, truth = scene.arcs(0.0, 0), scene.truth()
    rows = np.arange(len(arcs))
    places, sigma, usable = arcs.places(truth, rows, scene.line)
    np.testing.assert_array_equal(places, arcs.positions(truth, rows, scene.line)[0])
    assert bool(usable.all()) and bool((places[:, 0] < places[:, 1]).all())
    own = truth[torch.as_tensor(scene.line)]
    for k in range(2):
        points = own.point_at(torch.as_tensor(np.ascontiguousarray(places[:, k])))
        seen, _ = scene.camera.project(scene.poses[torch.as_tensor(scene.image)].transform(points[:, None])[:, 0])
        assert float((seen[:, None] - scene.pixels).norm(dim=-1).amin(1).max()) < 1e-3
    ends = torch.einsum("tkx,tx->tk", scene.ends_m - truth.foot[:, None], truth.direction).numpy()[scene.line]
    assert float((ends.min(1) - places[:, 0]).max()) < 1e-6 and float((places[:, 1] - ends.max(1)).max()) < 1e-6
    moved = points_on_arc(
        torch.as_tensor(arcs.bearings[:, 0]), torch.as_tensor(arcs.bearings[:, 1]), torch.tensor([1e-4], dtype=torch.float64)
    )
    angle = torch.acos((moved[:, 0] * torch.as_tensor(arcs.bearings[:, 0])).sum(-1).clamp_max(1)).numpy()
    shifted = replace(arcs, bearings=np.stack([moved[:, 0].numpy(), arcs.bearings[:, 1]], 1))
    after, _, _ = shifted.places(truth, rows, scene.line)
    change = np.abs(after - places).max(1)
    end = np.abs(after - places).argmax(1)
    rate = sigma[rows, end] / arcs.px_rad
    np.testing.assert_allclose(change, rate * angle, rtol=0.02)


def test_wrong_options_and_photos_are_refused_in_one_sentence() -> None:
    arcs = room("fisheye").arcs(0.3, 3)
    alone = {"options": MatchingOptions(hypotheses=HypothesisOptions(max_neighbours=1))}
    for options in ({"min_views": 2}, alone, {"tolerance_px": 0.0}, {"tolerance_px": -1.0}, {"tolerance_px": float("nan")}):
        with pytest.raises(InputError, match="`min_views` of 3 or more, 2 neighbours of a photo and a `tol"):
            match_arcs(arcs, **options)
    with pytest.raises(GeometryError, match="in at least 3 photos with poses were expected to match lines, found 2;"):
        match_arcs(arcs.rows(np.flatnonzero(arcs.image < 2)))
    with pytest.raises(GeometryError, match="found 0; give more photos"):
        match_arcs(arcs.rows(np.zeros(0, dtype=np.int64)))
    centre = torch.tensor([1e3, 2e3, -5.0], dtype=torch.float64)
    together = Pose(arcs.poses.rotation, -(arcs.poses.rotation @ centre))
    with pytest.raises(GeometryError, match="found all 12 at one place"):
        match_arcs(arcs.with_poses(together))
