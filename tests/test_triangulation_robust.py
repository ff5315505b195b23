"""Tracks with wrong members: what is named, what the lines lose, and where no consensus is possible."""

import pytest
import torch
from triangulation_scenes import LINES, VIEWS, LineSet, circle, generator, room, square_error, with_wrong_members

from camera_models.errors import InputError
from camera_models.pose import Pose
from omnilines.triangulation import TRIANGULATIONS, consensus, likelihood, triangulate
from omnilines.triangulation.consensus import judge, majority
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.robust import RobustTriangulation, noise_level, robust_triangulate

METHODS = [name for name, _ in TRIANGULATIONS]
SCENES = {"wide": lambda trials: circle(trials), "short": lambda trials: circle(trials, 9.0), "room": lambda trials: room(trials)}


def swap(scene: LineSet, pixels: torch.Tensor, wrong: torch.Tensor, step: int = 7) -> torch.Tensor:
    """The wrong members of a track are all those of the same other line."""
    tracks = torch.arange(len(pixels))
    other = tracks // LINES * LINES + (tracks % LINES + step) % LINES
    return torch.where(wrong[..., None, None], pixels[other], pixels)


def first_views(scene: LineSet, views: int) -> torch.Tensor:
    return (torch.arange(VIEWS) < views).repeat(len(scene.ends))


def inconsistent(found: RobustTriangulation) -> torch.Tensor:
    return torch.tensor([name == "inconsistent" for name in found.triangulation.status_names])


def shares(found: RobustTriangulation, wrong: torch.Tensor) -> tuple[float, float]:
    """Shares of the wrong and of the good observations that are named as wrong."""
    named = ~found.inlier
    return float((named & wrong).sum() / wrong.sum()), float((named & ~wrong).sum() / (~wrong).sum())


def assert_as_good_as_without(
    found: RobustTriangulation, observations: PlaneObservations, wrong: torch.Tensor, scene: LineSet
) -> None:
    clean = triangulate("ml", observations.rows(~wrong))
    both = found.triangulation.known & clean.known
    assert int(both.sum()) >= 0.98 * int(clean.known.sum())
    error, least = (square_error(r, scene.ends)[both].mean().sqrt() for r in (found.triangulation, clean))
    assert float(error) < 1.1 * float(least)


@pytest.mark.parametrize("noise", ["stated", "unknown size", "unknown shape"])
@pytest.mark.parametrize("name", SCENES)
def test_up_to_three_wrong_of_eight_are_named_and_cost_nothing(name: str, noise: str) -> None:
    scene = SCENES[name](8)
    pixels, wrong = with_wrong_members(scene, scene.noisy(0.5, seed=70), seed=71)
    observations = scene.observe(pixels, 0.5 if noise == "stated" else None, in_pixels=noise != "unknown shape")
    found = robust_triangulate(observations)
    wrong_named, good_named = shares(found, wrong.flatten())
    print(f"{name}, {noise}: {100 * wrong_named:.2f} percent of the wrong named, {100 * good_named:.3f} of the good")
    assert wrong_named > 0.95 and good_named < 0.02
    assert_as_good_as_without(found, observations, wrong.flatten(), scene)
    assert float(inconsistent(found).double().mean()) < 0.02
    if noise != "unknown shape":
        assert found.sigma == (1.0 if noise == "stated" else pytest.approx(0.5, rel=0.05))


@pytest.mark.parametrize("method", METHODS)
def test_any_method_takes_the_inliers(method: str) -> None:
    scene = circle(2)
    pixels, _ = with_wrong_members(scene, scene.noisy(0.5, seed=72), seed=73)
    observations = scene.observe(pixels, 0.5)
    found = robust_triangulate(observations, method=method)
    plain = triangulate(method, observations.rows(found.inlier))
    kept = ~inconsistent(found)
    torch.testing.assert_close(found.triangulation.lines[kept].moment, plain.lines[kept].moment, rtol=0, atol=0)
    assert float(square_error(found.triangulation, scene.ends)[kept].mean().sqrt()) < 0.003
    assert float(square_error(triangulate(method, observations), scene.ends).nanmedian().sqrt()) > 0.02


@pytest.mark.parametrize("name", SCENES)
def test_three_wrong_members_of_one_other_line_are_outvoted(name: str) -> None:
    scene = SCENES[name](4)
    wrong = torch.rand(len(scene.ends), VIEWS, generator=generator(74)).argsort(-1).argsort(-1) < 3
    observations = scene.observe(swap(scene, scene.noisy(0.5, seed=75), wrong), 0.5)
    found = robust_triangulate(observations)
    wrong_named, good_named = shares(found, wrong.flatten())
    assert wrong_named > 0.95 and good_named < 0.02
    assert_as_good_as_without(found, observations, wrong.flatten(), scene)


def test_half_of_a_track_on_another_line_is_inconsistent() -> None:
    scene = circle(2)
    wrong = torch.rand(len(scene.ends), VIEWS, generator=generator(76)).argsort(-1).argsort(-1) < 4
    found = robust_triangulate(scene.observe(swap(scene, scene.noisy(0.5, seed=77), wrong), 0.5))
    assert float(inconsistent(found).double().mean()) > 0.97
    lost = inconsistent(found)
    assert bool(torch.isnan(found.triangulation.lines.direction[lost]).all())
    assert bool(found.inlier.view(-1, VIEWS)[lost].all())


def test_tracks_without_wrong_members_keep_them() -> None:
    scene = room(5)
    observations = scene.observe(scene.noisy(0.5, seed=78), 0.5)
    found = robust_triangulate(observations)
    assert float((~found.inlier).double().mean()) < 0.005
    assert not bool(inconsistent(found).any())
    exact = robust_triangulate(scene.observe(scene.pixels))
    assert bool(exact.inlier.all()) and float(square_error(exact.triangulation, scene.ends).max().sqrt()) < 1e-8


def test_wrong_members_are_named_in_exact_data() -> None:
    scene = circle(3)
    pixels, wrong = with_wrong_members(scene, scene.pixels, seed=79)
    found = robust_triangulate(scene.observe(pixels))
    assert torch.equal(~found.inlier, wrong.flatten())
    assert float(square_error(found.triangulation, scene.ends).max().sqrt()) < 1e-8


def test_tracks_of_unequal_length_and_longer_ones_with_more_wrong_members() -> None:
    """Twelve rows with five wrong ones (two segments of eight cameras are seen twice), eight, five and two."""
    scene = circle(4)
    pixels = torch.cat([scene.noisy(0.5, seed=80), scene.noisy(0.5, seed=81)[:, :4]], 1)
    poses = Pose.stack([scene.poses[k] for k in [*range(8), *range(4)]])
    double = LineSet(scene.camera, poses, scene.ends, pixels)
    length = torch.tensor([12, 8, 5, 2]).repeat(len(pixels) // 4)
    allowed = torch.tensor([5, 3, 1, 0]).repeat(len(pixels) // 4)
    order = torch.rand(length.shape[0], 12, generator=generator(82))
    place = torch.arange(12)[None] < length[:, None]
    wrong = (order.masked_fill(~place, 2.0).argsort(-1).argsort(-1) < allowed[:, None]) & place
    observations = double.observe(swap(double, pixels, wrong), 0.5).rows(place.flatten())
    found = robust_triangulate(observations)
    flat = wrong[place]
    wrong_named, good_named = shares(found, flat)
    assert wrong_named > 0.95 and good_named < 0.02
    assert found.triangulation.views[3::4].tolist() == [2] * (len(pixels) // 4)
    assert_as_good_as_without(found, observations, flat, double)


@pytest.mark.parametrize("views", [3, 4])
def test_short_tracks_are_inconsistent_rather_than_guessed(views: int) -> None:
    scene = circle(10)
    pixels, wrong = with_wrong_members(scene, scene.noisy(0.5, seed=83), seed=84, most=1)
    keep = first_views(scene, views)
    observations, flat = scene.observe(pixels, 0.5).rows(keep), wrong.flatten()[keep]
    found = robust_triangulate(observations)
    dirty = wrong[:, :views].any(-1)
    lost = inconsistent(found)
    named = ~found.inlier
    assert int(lost[~dirty].sum()) <= 1
    assert float((named & ~flat).double().mean()) < 0.005
    if views == 3:
        # A wrong plane that happens to fit cannot be told from a right one.
        assert not bool(named.any()) and float(lost[dirty].double().mean()) > 0.95
    else:
        solved = dirty & ~lost
        assert float(solved.sum() / dirty.sum()) > 0.8
        assert bool(named.view(-1, 4)[solved].sum(-1).eq(1).all())
        assert float((named & flat).sum() / solved.sum()) > 0.97


def test_two_views_are_left_alone() -> None:
    scene = circle(1)
    pixels, _ = with_wrong_members(scene, scene.noisy(0.5, seed=85), seed=86)
    found = robust_triangulate(scene.observe(pixels).rows(first_views(scene, 2)))
    assert bool(found.inlier.all()) and found.sigma != found.sigma
    assert "inconsistent" not in found.triangulation.status_names


def test_an_arc_that_faces_away_from_the_line_is_wrong() -> None:
    scene = room(1)
    good = scene.observe(scene.noisy(0.5, seed=87), 0.5)
    flipped = torch.arange(len(scene.track)) % VIEWS == 3
    assert good.arcs is not None
    arcs = torch.where(flipped[:, None, None], -good.arcs, good.arcs)
    turned = PlaneObservations(good.normal, good.centre, good.track, good.tracks, arcs, good.noise, good.noise_stated)
    found = robust_triangulate(turned)
    assert bool((~found.inlier)[flipped].all()) and float((~found.inlier)[~flipped].double().mean()) < 0.01
    every = PlaneObservations(good.normal, good.centre, good.track, good.tracks, -good.arcs, good.noise, good.noise_stated)
    assert set(robust_triangulate(every).triangulation.status_names) == {"behind"}


def test_rows_are_judged_by_the_residual_that_they_have_without_them() -> None:
    """s is chi-square with 2 degrees of freedom, for members of the fit and for rows that had no part in it."""
    scene = circle(60)
    observations = scene.observe(scene.noisy(0.2, seed=88), 0.2)
    member = torch.arange(len(scene.track)) % VIEWS < 5
    lines = triangulate("ml", observations.rows(member)).lines
    square = judge(observations, lines, member, 1.0)
    for chosen in (member, ~member):
        assert float(square[chosen].mean()) == pytest.approx(2.0, rel=0.05)
        assert float((square[chosen] > 13.816).double().mean()) < 0.004
        assert float((square[chosen] > 5.9915).double().mean()) == pytest.approx(0.05, abs=0.01)


def test_noise_is_estimated_from_majorities_and_shows_errors_of_poses() -> None:
    scene = circle(3)
    pixels, wrong = with_wrong_members(scene, scene.noisy(0.5, seed=89), seed=90)
    assert noise_level(scene.observe(pixels)) == pytest.approx(0.5, rel=0.05)
    assert noise_level(scene.observe(pixels, 0.5)) == pytest.approx(1.0, rel=0.05)
    shaken = Pose.exp(0.002 * torch.randn(VIEWS, 6, generator=generator(91), dtype=torch.float64)) @ scene.poses
    observations = LineSet(scene.camera, shaken, scene.ends, pixels).observe(pixels, 0.5)
    level = noise_level(observations)
    assert 3 < level < 10
    strict, tolerant = robust_triangulate(observations), robust_triangulate(observations, sigma=level)
    # Errors of poses are common to all lines of a photo, which no noise level describes well.
    assert float(inconsistent(strict).double().mean()) > 0.5 and float(inconsistent(tolerant).double().mean()) < 0.2
    wrong_named, good_named = shares(tolerant, wrong.flatten())
    assert wrong_named > 0.8 and good_named < 0.05


def test_the_result_is_the_same_for_the_same_seed_and_for_a_moved_world() -> None:
    scene = circle(1)
    pixels, _ = with_wrong_members(scene, scene.noisy(0.5, seed=92), seed=93)
    observations = scene.observe(pixels, 0.5)
    one, two = (robust_triangulate(observations, budget=10, seed=4) for _ in range(2))
    assert torch.equal(one.inlier, two.inlier)
    shift = torch.tensor([1e4, -3e3, 500.0], dtype=torch.float64)
    moved = robust_triangulate(
        PlaneObservations(
            observations.normal, observations.centre + shift, observations.track, 40, observations.arcs, observations.noise, True
        ),
        budget=10,
        seed=4,
    )
    assert torch.equal(one.inlier, moved.inlier)
    known = one.triangulation.known
    expected = one.triangulation.lines.shifted(-shift[None])[known]
    assert float(moved.triangulation.lines[known].angle_to(expected).max()) < 1e-9


def test_wrong_options_are_refused_in_one_sentence() -> None:
    scene = circle(1)
    observations = scene.observe(scene.pixels)
    for options in ({"sigma": 0.0}, {"sigma": float("nan")}, {"budget": 2}):
        with pytest.raises(InputError, match="a sigma above 0 and a budget of at least 3 pairs"):
            robust_triangulate(observations, **options)
    with pytest.raises(InputError, match="found 'magic'"):
        robust_triangulate(observations, method="magic")
    assert [majority(views) for views in (2, 3, 4, 5, 8, 9)] == [3, 3, 3, 3, 5, 5]


def test_an_empty_table_gives_no_lines() -> None:
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    found = robust_triangulate(PlaneObservations(nothing, nothing, torch.zeros(0, dtype=torch.int64), 3))
    assert found.triangulation.status_names == ("too_few_views",) * 3 and not len(found.inlier)


@pytest.mark.parametrize("noise", ["stated", "unknown size", "unknown shape"])
def test_the_compiled_consensus_is_that_of_torch(monkeypatch: pytest.MonkeyPatch, noise: str) -> None:
    """Tracks of three to eight views with wrong members, some that face away: members, tracks and lines of both ways."""
    scene = room(3)
    pixels, _ = with_wrong_members(scene, scene.noisy(0.5, seed=72), seed=73)
    whole = scene.observe(pixels, 0.5 if noise == "stated" else None, in_pixels=noise != "unknown shape")
    views = torch.arange(VIEWS).repeat(len(scene.ends))
    observations = whole.rows(views < 3 + whole.track % (VIEWS - 2))
    found = robust_triangulate(observations)
    for module in (consensus, likelihood):
        monkeypatch.setattr(module, "on_processor", lambda values: False)
    expected = robust_triangulate(observations)
    assert found.sigma == pytest.approx(expected.sigma, rel=1e-6)
    assert int((~expected.inlier).sum()) > 20
    assert torch.equal(found.inlier, expected.inlier)
    assert found.triangulation.status_names == expected.triangulation.status_names
    known = expected.triangulation.known
    assert float(found.triangulation.lines[known].angle_to(expected.triangulation.lines[known]).max()) < 1e-6
