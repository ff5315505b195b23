"""Every triangulation against exact lines, under rigid motions and scalings, and where geometry decides nothing."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from triangulation_scenes import METHODS, normal, observe, unit, upright

from camera_models import OpenCVFisheye
from camera_models.errors import InputError
from camera_models.pose import Pose
from omnilines.adjustment.scene import reconstruct_lines
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.sphere import angle_between
from omnilines.records import LINE_STATUSES, ImagePoses, Segments
from omnilines.triangulation import method_options, triangulate
from omnilines.triangulation.averaging import members, subsets
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation

DUAL_VARIANTS = [("unit", "shifted"), ("published", "shifted"), ("unit", "file"), ("published", "file")]


def scene(
    tracks: int, seed: int, views: Sequence[int] = (3, 4, 5, 8, 12)
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Segments, camera centres by row, tracks of unequal length in random order, and a point on each segment's line."""
    ends = 3 * normal(tracks, 2, 3, seed=seed)
    counts = torch.tensor([views[i % len(views)] for i in range(tracks)])
    track = torch.arange(tracks).repeat_interleave(counts)
    track = track[torch.randperm(len(track), generator=torch.Generator().manual_seed(seed))]
    return ends, 5 * normal(len(track), 3, seed=seed + 1), track, counts


def assert_exact(result: Triangulation, ends: torch.Tensor, size: float, tolerance: float = 1e-9) -> None:
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    assert bool(result.known.all()), result.status_names
    assert float(truth.angle_to(result.lines).max()) < tolerance
    distance = torch.stack([result.lines.distance_to(ends[:, e]) for e in range(2)])
    assert float(distance.max()) < tolerance * size


@pytest.mark.parametrize("with_arcs", [True, False])
@pytest.mark.parametrize("method", METHODS)
def test_noise_free_lines_are_exact_in_tracks_of_unequal_length(method: str, with_arcs: bool) -> None:
    ends, centres, track, counts = scene(60, seed=1)
    ends[:10] -= ends[:10, :1]
    # Ten lines through the world origin, ten more with the origin in the middle of the segment.
    ends[10:20, 1] = -0.7 * ends[10:20, 0]
    observations = observe(ends, centres, track)
    assert float(angle_between(observations.arcs[:, 0], observations.arcs[:, 1]).max()) > math.pi / 2
    result = triangulate(method, observations if with_arcs else replace(observations, arcs=None))
    assert_exact(result, ends, size=5)
    assert torch.equal(result.views, counts)
    assert float(result.residual_rad.max()) < 1e-9
    pluecker = (result.lines.direction * result.lines.moment).sum(-1)
    assert float(pluecker.abs().max()) < 1e-12


@pytest.mark.parametrize("weights, origin", DUAL_VARIANTS)
def test_noise_free_lines_are_exact_for_every_form_of_the_dual_method(weights: str, origin: str) -> None:
    ends, centres, track, _ = scene(40, seed=2)
    result = triangulate("dual", observe(ends, centres, track), weights=weights, origin=origin)
    assert_exact(result, ends, size=5)


def test_the_published_origin_names_lines_whose_planes_all_pass_through_it() -> None:
    ends, centres, track, _ = scene(6, seed=3)
    ends[2, 1] = -2 * ends[2, 0]
    names = triangulate("dual", observe(ends, centres, track), origin="file").status_names
    assert names[2] == "unsupported" and set(names) - {"unsupported"} <= {"ok", "weak"}


@pytest.mark.parametrize("method", METHODS)
def test_results_follow_rigid_motion_scale_and_the_order_of_rows(method: str) -> None:
    # Up to 8 views averaging takes all subsets; beyond its budget the draw depends on the order of the rows.
    ends, centres, track, _ = scene(30, seed=4, views=(3, 4, 5, 8))
    clean = observe(ends, centres, track)
    arcs = unit(clean.arcs + 1e-3 * normal(*clean.arcs.shape, seed=5))
    upright = Pose(torch.eye(3, dtype=torch.float64).expand(len(track), 3, 3), -centres)
    base = triangulate(method, PlaneObservations.from_arcs(arcs, upright, track, 30))
    motion = Pose.exp(torch.tensor([0.4, -1.1, 0.8, 3.0, -70.0, 20.0], dtype=torch.float64))
    scale = 250.0
    order = torch.randperm(len(track), generator=torch.Generator().manual_seed(6))
    moved_centres = scale * motion.transform(centres)[order]
    moved = PlaneObservations.from_arcs(
        (arcs @ motion.rotation.mT)[order], Pose(upright.rotation, -moved_centres), track[order], 30
    )
    result = triangulate(method, moved)
    one = base.lines.transform(Pose(motion.rotation.expand(30, 3, 3), motion.translation.expand(30, 3)))
    expected = PlueckerLines(one.direction, scale * one.moment)
    assert result.status_names == base.status_names and set(base.status_names) <= {"ok", "weak"}
    assert float(result.lines.angle_to(expected).max()) < 1e-9
    away = result.lines.distance_to(scale * motion.transform(ends[:, 0]))
    torch.testing.assert_close(away / scale, base.lines.distance_to(ends[:, 0]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_a_far_away_track_does_not_change_the_others(method: str) -> None:
    ends, centres, track, _ = scene(8, seed=7)
    alone = triangulate(method, observe(ends, centres, track))
    more = torch.cat([ends, ends[:1] + 1e5])
    joint = triangulate(method, observe(more, torch.cat([centres, 1e5 + centres[:8]]), torch.cat([track, torch.full((8,), 8)])))
    torch.testing.assert_close(joint.lines[:8].moment, alone.lines.moment, rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_a_line_a_million_metres_away_has_its_direction_and_is_weak(method: str) -> None:
    centres = 4 * normal(8, 3, seed=8)
    ends = torch.tensor([[[1e6, 0.0, 0.0], [1e6, 2e5, 3e5]]], dtype=torch.float64)
    result = triangulate(method, observe(ends, centres, torch.zeros(8, dtype=torch.int64)))
    assert result.status_names == ("weak",)
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    # A plane angle of 1e-5 leaves 1e-16 / 1e-5 of double precision, times the few planes.
    assert float(truth.angle_to(result.lines)) < 1e-9


# --- degeneracies are named


def named(method: str, ends: list[list[float]], centres: list[list[float]], noise: float = 0.0) -> str:
    rows = torch.tensor(centres, dtype=torch.float64)
    segment = torch.tensor([ends], dtype=torch.float64)
    clean = unit(segment[0] - rows[:, None])
    arcs = unit(clean + noise * normal(*clean.shape, seed=11))
    upright = Pose(torch.eye(3, dtype=torch.float64).expand(len(rows), 3, 3), -rows)
    result = triangulate(method, PlaneObservations.from_arcs(arcs, upright, torch.zeros(len(rows), dtype=torch.int64), 1))
    (name,) = result.status_names
    assert bool(torch.isnan(result.lines.moment).all()) == (name not in ("ok", "weak"))
    return name


@pytest.mark.parametrize("method", METHODS)
def test_two_views_give_a_weak_line_and_one_gives_none(method: str) -> None:
    ends, centres, track, _ = scene(3, seed=9, views=(2, 2, 1))
    result = triangulate(method, observe(ends, centres, track))
    assert result.status_names == ("weak", "weak", "too_few_views")
    assert torch.isnan(result.lines.moment[2]).all() and torch.isnan(result.residual_rad).all()
    assert_exact(triangulate(method, observe(ends[:2], centres[track < 2], track[track < 2])), ends[:2], size=5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise", [0.0, 3e-4])
def test_degenerate_geometry_is_named(method: str, noise: float) -> None:
    up = [[-1.0, 0.0, 5.0], [1.0, 0.2, 5.0]]
    flat = [[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0]]
    # Cameras and segment in the plane y = 0.
    in_plane = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.5], [0.5, 0.0, 1.0]]
    assert named(method, flat, in_plane[:2], noise) == "epipolar"
    assert named(method, flat, in_plane, noise) in ("epipolar", "parallel_planes")
    # A baseline of 1 m, 2 cm of it across the plane.
    assert named(method, flat, [[0.0, 0.0, 0.0], [1.0, 0.02, 0.0]], noise) == "parallel_planes"
    assert named(method, [[-1e5, 0.0, 5e5], [1e5, 0.0, 5e5]], [[0.0, 0.0, 0.0], [0.1, 1.0, 0.0]]) == "at_infinity"
    assert named(method, up, [[0.0, 0.0, 0.0], [0.3, 1.0, 0.0], [-0.4, -1.0, 0.2]], noise) == "ok"


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise", [0.0, 3e-4])
def test_a_line_that_rests_on_one_camera_is_weak(method: str, noise: float) -> None:
    """Cameras and line in the plane y = 0, but for one camera, or for two: the one has nobody to confirm it."""
    flat = [[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0]]
    in_plane = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.5], [0.5, 0.0, 1.0], [-1.5, 0.0, 0.2]]
    beside, other = [0.3, 1.0, 0.1], [-0.4, -1.0, 0.4]
    assert named(method, flat, [*in_plane, beside], noise) == "weak"
    assert named(method, flat, [*in_plane, beside, beside], noise) == "weak"
    assert named(method, flat, [*in_plane, beside, other], noise) == "ok"


def test_a_scene_says_which_lines_are_weak_for_resting_on_one_camera_alone() -> None:
    """Track 0 rests on one camera, track 1 on two views, track 2 on all."""
    camera = OpenCVFisheye([300.0, 300.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0], (1280, 960))
    centres = torch.tensor([[0, 0, 0], [1, 0, 0], [2, 0, 0.5], [-1, 0, 0.2], [0.3, 1, 0.1]], dtype=torch.float64)
    poses = ImagePoses(tuple("abcde"), Pose(torch.eye(3, dtype=torch.float64).expand(5, 3, 3), -centres))
    ends = torch.tensor([[[-1, 0, 5], [1, 0, 5]], [[-1, 1, 5], [1, 2, 5]], [[0, -1, 4], [0.5, 1, 4]]], dtype=torch.float64)
    rows = [(view, track) for track in range(3) for view in range(5) if track != 1 or view in (0, 4)]
    image, track = (np.array(column) for column in zip(*rows, strict=True))
    pixels, _ = camera.project(ends[track] - centres[image][:, None])
    noisy = pixels.numpy() + 0.2 * np.random.default_rng(0).normal(size=pixels.shape)
    segments = Segments(image, tuple("abcde"), track, ("0", "1", "2"), noisy, np.full(len(rows), 0.2))
    found = reconstruct_lines(segments, poses, {"cam0": camera})
    assert found.lines.status == ("weak", "weak", "ok")
    assert found.rests_on_one.tolist() == [True, False, False]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_pieces_of_a_line_in_one_photo_are_one_view(method: str, noise: float) -> None:
    """Track 0 in three pieces in one photo, 1 in three in each of two, 2 in two in each of three."""
    ends = torch.tensor([[-1.0, 0.0, 5.0], [1.0, 0.2, 5.0]], dtype=torch.float64)
    centres = torch.tensor([[0.0, 0.0, 0.0], [0.3, 1.0, 0.0], [-0.4, -1.0, 0.2]], dtype=torch.float64)
    shown = [
        (track, view, piece) for track, pieces in enumerate((3, 3, 2)) for view in range(track + 1) for piece in range(pieces)
    ]
    track, view, piece = torch.tensor(shown).T
    share = torch.stack([piece, piece + 0.8], -1)[..., None] / 3
    rays = unit(ends[0] + share * (ends[1] - ends[0]) - centres[view][:, None])
    rays = unit(rays + noise * normal(*rays.shape, seed=21))
    found = triangulate(method, PlaneObservations.from_arcs(rays, upright(centres[view]), track, 3))
    assert found.status_names == ("too_few_views", "weak", "ok")
    assert found.views.tolist() == [1, 2, 3]


def test_views_of_lines_are_photos() -> None:
    """In two pieces in each of three photos, two of one place, and one piece in each of two."""
    camera = OpenCVFisheye([300.0, 300.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0], (1280, 960))
    centres = torch.tensor([[0, 0, 0], [0, 0, 0], [0.3, 1, 0.1]], dtype=torch.float64)
    lines = torch.tensor([[[-1, 0.5, 5], [1, 0.7, 5]], [[-1, 1, 5], [1, 2, 5]]], dtype=torch.float64)
    rows = [(image, 0, low) for image in range(3) for low in (0.0, 0.6)] + [(image, 1, 0.0) for image in (0, 2)]
    image, track, low = (np.array(column) for column in zip(*rows, strict=True))
    share = torch.as_tensor(np.stack([low, low + 0.4], -1))[..., None]
    pixels, _ = camera.project(
        lines[track][:, :1] + share * (lines[track][:, 1:] - lines[track][:, :1]) - centres[image][:, None]
    )
    poses = ImagePoses(tuple("abc"), Pose(torch.eye(3, dtype=torch.float64).expand(3, 3, 3), -centres))
    segments = Segments(image, tuple("abc"), track, ("0", "1"), pixels.numpy(), np.full(len(rows), 0.2))
    for robust in (False, True):
        found = reconstruct_lines(segments, poses, {"cam0": camera}, robust=robust)
        assert found.lines.views.tolist() == found.before.views.tolist() == [3, 2]
        assert found.lines.status == ("weak", "weak")


@pytest.mark.parametrize("method", ["dual", "svd", "ml"])
def test_a_far_line_is_not_taken_for_parallel_planes(method: str) -> None:
    """Noise leaves an angle between the planes that would be at a hundred metres; the baseline is wide across them."""
    centres = (2 * normal(8, 3, seed=18)).tolist()
    for seed in range(20):
        middle, half = unit(normal(2, 3, seed=19 + seed))
        ends = 1e6 * torch.stack([middle + 0.5 * half, middle - 0.5 * half])
        assert named(method, ends.tolist(), centres, 2e-4) == "at_infinity"


@pytest.mark.parametrize("method", METHODS)
def test_a_line_through_a_camera_centre_and_one_behind_are_named(method: str) -> None:
    # The second plane contains the first centre, so the planes meet in a line through that centre.
    arcs = unit(torch.tensor([[[-1.0, 0, 5], [1, 0, 5]], [[-1, 0, 0], [-2, 1, 5]]], dtype=torch.float64))
    centres = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64)
    upright = Pose(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), -centres)
    observations = PlaneObservations.from_arcs(arcs, upright, torch.zeros(2, dtype=torch.int64), 1)
    assert triangulate(method, observations).status_names == ("through_centre",)
    ends, centres, track, _ = scene(5, seed=12)
    behind = observe(ends, centres, track)
    flipped = triangulate(method, replace(behind, arcs=-behind.arcs))
    assert flipped.status_names == ("behind",) * 5
    assert torch.isnan(flipped.lines.direction).all()


@pytest.mark.parametrize("method", METHODS)
def test_arcs_that_are_not_of_one_line_are_inconsistent_and_errors_of_poses_are_not(method: str) -> None:
    ends, centres, track, _ = scene(40, seed=15, views=(8, 12))
    clean = observe(ends, centres, track)
    upright = Pose(torch.eye(3, dtype=torch.float64).expand(len(track), 3, 3), -centres)
    random = PlaneObservations.from_arcs(unit(normal(len(track), 2, 3, seed=16)), upright, track, 40)
    names = triangulate(method, random).status_names
    assert names.count("inconsistent") >= 36 and not {"ok", "weak"} & set(names)
    off = Pose.exp(0.05 * normal(len(track), 6, seed=17))
    perturbed = PlaneObservations.from_arcs(clean.arcs, off @ upright, track, 40)
    assert float(triangulate(method, perturbed).known.double().mean()) > 0.9


# --- what users can get wrong


def test_wrong_input_is_refused_in_one_sentence() -> None:
    ends, centres, track, _ = scene(3, seed=13)
    good = observe(ends, centres, track)
    with pytest.raises(InputError, match="dual, averaging, svd, ml, found 'magic'"):
        triangulate("magic", good)
    with pytest.raises(InputError, match="0 to 1, found 0 to 2"):
        replace(good, tracks=2)
    with pytest.raises(InputError, match="1 of"):
        replace(good, normal=good.normal * torch.where(torch.arange(len(track)) == 1, 0.0, 1.0)[:, None].double())
    with pytest.raises(InputError, match="weights unit or published"):
        triangulate("dual", good, iterations=-1)
    with pytest.raises(InputError, match="at least 2 planes"):
        triangulate("averaging", good, subset=1)


def test_options_of_methods_are_refused_where_they_do_nothing() -> None:
    assert method_options("averaging", subset=5, bandwidth=0.1) == {"subset": 5, "bandwidth": 0.1}
    assert method_options("dual", weights="published") == {"weights": "published", "origin": "file"}
    assert method_options("ml") == {}
    wrong: list[tuple[str, dict[str, object], str]] = [
        ("dual", {"subset": 4}, "`subset` was expected with `triangulation` averaging"),
        ("ml", {"bandwidth": 0.1}, "`bandwidth` was expected with `triangulation` averaging"),
        ("averaging", {"weights": "unit"}, "`weights` was expected with `triangulation` dual"),
        ("dual", {"weights": "heavy"}, "unit, published, most-likely, found 'heavy'"),
        ("averaging", {"subset": 1}, "2 planes or more, found 1"),
        ("averaging", {"bandwidth": 0.0}, "radians above 0, found 0"),
        ("averaging", {"bandwidth": math.nan}, "radians above 0, found nan"),
    ]
    for method, options, message in wrong:
        with pytest.raises(InputError, match=message):
            method_options(method, **options)


def test_an_empty_table_gives_no_lines() -> None:
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    ran = 0
    for method in METHODS:
        result = triangulate(method, PlaneObservations(nothing, nothing, torch.zeros(0, dtype=torch.int64), 4))
        assert result.status_names == ("too_few_views",) * 4
        ran += 1
    assert ran == len(METHODS)


def test_every_status_is_one_of_the_records() -> None:
    ends, centres, track, _ = scene(4, seed=14)
    result = triangulate("dual", observe(ends, centres, track))
    assert set(result.status_names) <= set(LINE_STATUSES) and len(result) == 4


def test_subsets_are_all_of_them_or_a_seeded_draw() -> None:
    assert len(subsets(8, 4, 128, 0)) == 70
    drawn = subsets(20, 10, 128, 0)
    assert drawn.shape == (128, 10) and torch.equal(drawn, subsets(20, 10, 128, 0))
    assert not torch.equal(drawn, subsets(20, 10, 128, 1))
    assert bool((drawn[:, 1:] > drawn[:, :-1]).all())


def test_samples_are_all_subsets_of_three_planes_or_more_or_a_draw_from_them() -> None:
    every = members(8, 3, 1024, 0)
    assert torch.bincount(every.sum(-1)).tolist() == [0, 0, 0, 56, 70, 56, 28, 8, 1]
    assert len(torch.unique(every, dim=0)) == 219
    # 3.38 says 2^N - N - 1, which counts the pairs too.
    assert len(members(8, 2, 1024, 0)) == 2**8 - 8 - 1
    assert members(2, 3, 1024, 0).tolist() == [[True, True]]
    drawn = members(12, 3, 1024, 0)
    assert len(drawn) == 1024 and torch.equal(drawn, members(12, 3, 1024, 0))
    assert not torch.equal(drawn, members(12, 3, 1024, 1))
    # Sizes come in proportion to the number of subsets of each.
    share = torch.bincount(drawn.sum(-1), minlength=13).double() / 1024
    expected = torch.tensor([math.comb(12, k) if k >= 3 else 0 for k in range(13)]).double()
    torch.testing.assert_close(share, expected / expected.sum(), rtol=0, atol=0.04)
    # Large subsets of many planes are as easy to draw.
    assert int(members(60, 50, 64, 0).sum(-1).min()) >= 50
