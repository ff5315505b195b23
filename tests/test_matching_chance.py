"""Lines that more photos show than would by chance: the shares in closed form, and lines of a fence that are not there."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matching_scenes import camera_named, looking, viewed

from camera_models import Pinhole
from camera_models.equirectangular import Equirectangular
from camera_models.pose import Pose
from omnilines.geometry.line import PlueckerLines
from omnilines.matching.chance import line_evidence
from omnilines.matching.kernels.chance import at_least, shown_and_beside
from omnilines.matching.known_lines import mean_colours
from omnilines.matching.options import MatchingOptions

SIGMA_PX, BARS, PHOTOS = 0.2, 25, 12
OPTIONS = MatchingOptions()
REACH_PX, MOST_CHI_SQUARE = OPTIONS.chance.reach_px, OPTIONS.explained.max_chi_square
CAMERA = Pinhole.from_mapping({"fx": 3000.0, "fy": 3000.0, "cx": 639.5, "cy": 479.5}, (1280, 960))


def test_the_chance_of_so_many_is_that_of_all_outcomes() -> None:
    rng = np.random.default_rng(0)
    chance = rng.uniform(0.0, 1.0, (6, 5))
    could = rng.random((6, 5)) < 0.8
    times = rng.integers(0, 4, 6)
    for line, found in enumerate(at_least(chance[could], np.nonzero(could)[0].copy(), times)):
        expected = 0.0
        for outcome in itertools.product((0, 1), repeat=int(could[line].sum())):
            come = np.array(outcome, dtype=bool)
            own = chance[line, could[line]]
            expected += float(np.prod(np.where(come, own, 1.0 - own))) if come.sum() >= times[line] else 0.0
        assert abs(found - expected) < 1e-12


def test_places_beside_a_line_are_counted_once_and_only_where_an_arc_looks_like_it() -> None:
    """One photo: an arc on the line, two beside it that overlap, one of other colours, one too far off, one past its end, one
    beside a third of it."""
    offsets = np.array([0.1, 30.0, 30.5, -50.0, REACH_PX + 20.0, -20.0, 60.0])
    low, high = np.array([400.0, 400, 400, 400, 400, 700, 420]), np.array([560.0, 560, 560, 560, 560, 800, 475])
    pixels = np.stack([np.stack([639.5 + offsets, end], -1) for end in (low, high)], 1)
    colours = np.full((7, 2, 3), math.log(80.0))
    colours[3] = math.log(200.0)
    colours[:, 0] += 1.0
    colours[3, 0] -= 2.0
    arcs = viewed(CAMERA, Pose.identity(1), np.zeros(7, dtype=np.int64), torch.as_tensor(pixels), SIGMA_PX, colours)
    ends = torch.tensor([[[0.0, (v - 479.5) / 3000.0 * 10.0, 10.0] for v in (400.0, 560.0)]], dtype=torch.float64)
    line = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    span = (ends @ line.direction[0]).numpy()
    own = np.array([0, -1, -1, -1, -1, -1, -1])
    seen = mean_colours(arcs, np.array([0]), np.array([0]), np.array([False]), 1)
    half = SIGMA_PX * math.sqrt(MOST_CHI_SQUARE / 2.0)
    for least_share, expected in ((0.0, 4.0 * half + 0.5), (0.3, 4.0 * half + 0.5), (0.4, 2.0 * half + 0.5)):
        width, beside = shown_and_beside(
            line.direction.numpy(),
            line.moment.numpy(),
            span,
            seen,
            own,
            np.array([least_share]),
            arcs.packed,
            arcs.px_rad,
            arcs.colours,
            arcs.starts,
            np.array([0, 1]),
            np.array([0]),
            REACH_PX,
            MOST_CHI_SQUARE,
            OPTIONS.hypotheses.min_overlap_share,
            OPTIONS.likeness,
        )
        assert abs(width[0] - 2.0 * half) < 0.01
        assert abs(beside[0] - expected) < 0.05


def fence(noise_px: float) -> tuple[list, Pose, torch.Tensor, np.ndarray, np.ndarray, torch.Tensor]:
    """Photos of upright bars of one colour: cameras, poses, ends (bars 2 3), photo and bar of every arc, pixels."""
    camera, _ = camera_named("pinhole")
    rng = np.random.default_rng(3)
    centres = np.stack([np.linspace(-1.5, 1.5, PHOTOS), rng.uniform(-0.3, 0.0, PHOTOS), rng.uniform(-0.4, 0.4, PHOTOS)], -1)
    poses = looking(centres, np.tile([0.0, 1.0, 0.0], (PHOTOS, 1)))
    across = torch.linspace(-1.5, 1.5, BARS, dtype=torch.float64)
    ends = torch.stack(
        [torch.stack([across, torch.full_like(across, 3.0), torch.full_like(across, z)], -1) for z in (-0.5, 0.5)], 1
    )
    photo, bar, pixels = [], [], []
    for k in range(PHOTOS):
        found, valid = camera.project(poses[k].transform(ends))
        seen = (valid & ((found > 10) & (found < torch.tensor([1270.0, 950.0])).all(-1, keepdim=True)).all(-1)).all(-1)
        photo += [k] * int(seen.sum())
        bar += torch.nonzero(seen).squeeze(-1).tolist()
        pixels.append(found[seen])
    places = torch.cat(pixels) + noise_px * torch.as_tensor(rng.standard_normal((len(bar), 2, 2)))
    return [camera] * PHOTOS, poses, ends, np.array(photo), np.array(bar), places


def test_bars_of_a_fence_are_there_and_lines_between_arcs_of_different_bars_are_not() -> None:
    cameras, poses, ends, photo, bar, pixels = fence(SIGMA_PX)
    arcs = viewed(cameras[0], poses, photo, pixels, SIGMA_PX, np.full((len(bar), 2, 3), math.log(90.0)))
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    spans = (ends * truth.direction[:, None]).sum(-1).numpy()
    assert np.all(line_evidence(arcs, truth, spans, bar, cameras).chance < 1e-8)
    # Planes of two bars in two photos meet in a line before or behind the fence; other photos show it where a bar lies there.
    false = []
    for shift in (1, 2, -1, -2):
        one = np.flatnonzero((photo == 3) & (bar > 6) & (bar < 18))
        for i in one:
            j = np.flatnonzero((photo == 8) & (bar == bar[i] + shift))
            n, s = arcs.planes.normal, -(arcs.planes.normal * arcs.planes.centre).sum(-1)
            false.append(PlueckerLines.from_planes(n[i], s[i], n[j[0]], s[j[0]]))
    lines = PlueckerLines(torch.stack([x.direction for x in false]), torch.stack([x.moment for x in false]))
    lines = PlueckerLines(lines.direction * torch.sign(lines.direction[:, 2:]), lines.moment * torch.sign(lines.direction[:, 2:]))
    spans = np.tile([-0.4, 0.4], (len(lines), 1))
    nobody = np.full(len(bar), -1)
    chance = line_evidence(arcs, lines, spans, nobody, cameras).chance
    assert len(chance) > 30 and np.mean(chance > 1e-3) > 0.9


def test_photos_that_look_at_a_line_and_do_not_show_it_count_against_it() -> None:
    cameras, poses, ends, photo, bar, pixels = fence(SIGMA_PX)
    middle = BARS // 2
    chances = []
    for shown in (PHOTOS, 4):
        kept = np.flatnonzero((bar != middle) | (photo < shown))
        arcs = viewed(cameras[0], poses, photo[kept], pixels[torch.as_tensor(kept)], SIGMA_PX, np.full((len(kept), 2, 3), 4.0))
        truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[[middle]]
        span = (ends[[middle]] * truth.direction[:, None]).sum(-1).numpy()
        chances.append(float(line_evidence(arcs, truth, span, np.where(bar[kept] == middle, 0, -1), cameras).chance[0]))
    assert chances[0] < 1e-8 and chances[1] > 1e4 * chances[0]


def test_the_share_that_photos_show_is_of_all_that_look_there() -> None:
    """Whole arcs in 8 of 12 photos; in 4 more two arcs of the first 0.4, and from 0.3 to 0.7, which overlap."""
    cameras, poses, ends, photo, bar, pixels = fence(SIGMA_PX)
    middle = BARS // 2
    rows = np.flatnonzero(bar == middle)
    assert len(rows) == PHOTOS
    span = ends[middle, 1] - ends[middle, 0]
    pieces = [(view, low, high) for view in range(8, PHOTOS) for low, high in ((0.0, 0.4), (0.3, 0.7))]
    points = torch.stack([torch.stack([ends[middle, 0] + at * span for at in (low, high)]) for _, low, high in pieces])
    views = np.array([view for view, _, _ in pieces])
    short = torch.stack([cameras[0].project(poses[view].transform(own))[0] for view, own in zip(views, points, strict=True)])
    whole = rows[photo[rows] < 8]
    image = np.append(photo[whole], views)
    arcs = viewed(
        cameras[0], poses, image, torch.cat([pixels[torch.as_tensor(whole)], short]), SIGMA_PX, np.full((16, 2, 3), 4.0)
    )
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[[middle]]
    place = (ends[[middle]] * truth.direction[:, None]).sum(-1).numpy()
    found = line_evidence(arcs, truth, place, np.zeros(16, dtype=np.int64), cameras)
    assert found.shown_share[0] == pytest.approx((8 + 4 * 0.7) / PHOTOS, abs=0.01)
    # Photos that look there and show nothing count as those that show it.
    eight = line_evidence(arcs, truth, place, np.where(image < 8, 0, -1), cameras)
    assert eight.shown_share[0] == pytest.approx(8 / PHOTOS, abs=0.01)


def test_photos_much_farther_away_than_those_that_show_a_line_are_not_asked() -> None:
    """The same bars with as many photos again, of the same places as the others but from three times as far, that show none."""
    cameras, poses, ends, photo, bar, pixels = fence(SIGMA_PX)
    colours = np.full((len(bar), 2, 3), 4.0)
    far = poses.centre - torch.tensor([0.0, 6.0, 0.0])
    both = Pose(torch.cat([poses.rotation] * 2), torch.cat([poses.translation, -(poses.rotation @ far[..., None])[..., 0]]))
    truth = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    spans = (ends * truth.direction[:, None]).sum(-1).numpy()
    alone, together = (
        line_evidence(viewed(cameras[0], those, photo, pixels, SIGMA_PX, colours), truth, spans, bar, cameras * times)
        for those, times in ((poses, 1), (both, 2))
    )
    np.testing.assert_allclose(together.chance, alone.chance)
    np.testing.assert_allclose(together.shown_share, alone.shown_share)


def test_a_line_across_the_seam_of_a_panorama_and_no_lines_at_all() -> None:
    camera = Equirectangular([], (1600, 800))
    points = torch.tensor([[[math.sin(a), 0.3, math.cos(a)] for a in (math.pi - 0.1, math.pi + 0.1)]], dtype=torch.float64) * 4.0
    line = PlueckerLines.from_points(points[:, 0], points[:, 1])
    pixels, _ = camera.project(points)
    poses = Pose.identity(1)
    arcs = viewed(camera, poses, np.zeros(1, dtype=np.int64), pixels, SIGMA_PX, np.full((1, 2, 3), 4.0))
    span = (points * line.direction[:, None]).sum(-1).numpy()
    own_px = 2.0 * SIGMA_PX * math.sqrt(MOST_CHI_SQUARE / 2.0)
    found = line_evidence(arcs, line, span, np.zeros(1, dtype=np.int64), [camera])
    assert found.shown_share == pytest.approx(1.0)
    np.testing.assert_allclose(found.chance, own_px / (2.0 * REACH_PX + own_px), rtol=0.02)
    # An arc that fits shows the line, whether it was given to it or not; a line that no arc shows is one that chance gives.
    nobody = line_evidence(arcs, line, span, np.full(1, -1), [camera])
    np.testing.assert_allclose(nobody.chance, found.chance)
    assert nobody.shown_share[0] == 0.0
    raised = PlueckerLines.through(points[:, 0] + torch.tensor([0.0, 1.0, 0.0]), line.direction)
    assert line_evidence(arcs, raised, span, np.full(1, -1), [camera]).chance[0] == 1.0
    assert [column.shape for column in line_evidence(arcs, line[[]], span[:0], np.full(1, -1), [camera])] == [(0,), (0,)]


def test_short_edges_beside_a_long_line_do_not_speak_against_it() -> None:
    """A long bar among short ones, in three photos of twelve: by its whole length it is there, by a piece it might be any."""
    cameras, poses, ends, photo, bar, pixels = fence(SIGMA_PX)
    long = BARS // 2
    few = np.isin(photo, (3, 6, 9))
    kept = few | (bar != long)
    photo, bar, pixels = photo[kept], bar[kept], pixels[torch.as_tensor(kept)]
    middle = pixels.mean(1, keepdim=True)
    pixels = torch.where(torch.as_tensor(bar == long)[:, None, None], pixels, middle + 0.3 * (pixels - middle))
    arcs = viewed(cameras[0], poses, photo, pixels, SIGMA_PX, np.full((len(bar), 2, 3), math.log(90.0)))
    line = PlueckerLines.from_points(ends[long : long + 1, 0], ends[long : long + 1, 1])
    span = (ends[long] @ line.direction[0]).numpy()[None]
    own = np.where(bar == long, 0, -1)
    chances = []
    for as_much in (0.0, OPTIONS.chance.as_much):
        options = replace(OPTIONS, chance=OPTIONS.chance._replace(as_much=as_much))
        chances.append(float(line_evidence(arcs, line, span, own, cameras, options=options).chance[0]))
    assert chances[0] > 1e-3 > chances[1]
