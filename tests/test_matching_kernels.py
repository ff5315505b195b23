"""The compiled parts of matching against plain forms: depths and their noise, colours, votes."""

import itertools
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from matching_scenes import CAMERAS, every_neighbour, room, some

from camera_models.pose import Pose
from omnilines import progress
from omnilines.geometry.line import PlueckerLines
from omnilines.matching import hypotheses
from omnilines.matching.hypotheses import find_hypotheses
from omnilines.matching.kernels import hypothesis as kernel
from omnilines.matching.kernels import voting as voting_kernel
from omnilines.matching.kernels.epipolar import arcs_across, arcs_by_angle
from omnilines.matching.kernels.place import agreeing
from omnilines.matching.options import MatchingOptions

OPTIONS = MatchingOptions()
AGREE = OPTIONS.hypotheses.agree_sigmas
LOOKS = OPTIONS.likeness


def true_depths(packed: torch.Tensor, i: np.ndarray, j: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Inverse depths of pairs from the line of their planes, by from_planes and position_seen; whether there is one; flipped."""
    normal, centre = packed[:, 6:9], packed[:, 9:12]
    s = -(normal * centre).sum(-1)
    lines = PlueckerLines.from_planes(normal[i], s[i], normal[j], s[j])
    both = PlueckerLines(lines.direction[:, None].expand(-1, 2, -1), lines.moment[:, None].expand(-1, 2, -1))
    places, front = [], []
    for rows in (i, j):
        at, ahead, _ = both.position_seen(centre[rows][:, None].expand(-1, 2, -1), packed[rows, :6].unflatten(1, (2, 3)))
        places.append(at)
        front.append(ahead.all(-1))
    inverse = 1 / (both.point_at(places[0]) - centre[i][:, None]).norm(dim=-1)
    own, other = (place.sort(-1).values for place in places)
    overlap = torch.minimum(own[:, 1], other[:, 1]) - torch.maximum(own[:, 0], other[:, 0])
    shorter = torch.minimum(own[:, 1] - own[:, 0], other[:, 1] - other[:, 0])
    flipped = (places[0][:, 1] > places[0][:, 0]) ^ (places[1][:, 1] > places[1][:, 0])
    return inverse, front[0] & front[1] & (overlap > OPTIONS.hypotheses.min_overlap_share * shorter), flipped


def depth_sigmas(packed: torch.Tensor, i: np.ndarray, j: np.ndarray) -> torch.Tensor:
    """By derivatives of m . V / m . b, each end moved across its plane: n_i for the ends of i, n_j for those of j."""

    def inverse(moved: torch.Tensor, p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        ends = p[:6].unflatten(0, (2, 3)) + moved[:2, None] * p[6:9]
        others = q[:6].unflatten(0, (2, 3)) + moved[2:, None] * q[6:9]
        m = torch.linalg.cross(others[0], others[1])
        return ends @ m / (m @ (q[9:12] - p[9:12]))

    zero = torch.zeros(len(i), 4, dtype=torch.float64)
    jacobian = torch.func.vmap(torch.func.jacrev(inverse))(zero, packed[i], packed[j])
    return (jacobian.square() @ torch.cat([packed[i, 12:], packed[j, 12:]], -1).square()[..., None]).sqrt().squeeze(-1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_depths_of_all_pairs_are_those_of_the_line_of_their_planes(name: str) -> None:
    arcs = some(room(name).arcs(0.3, 1), 80)
    i, j = np.nonzero(arcs.image[:, None] != arcs.image)
    packed = torch.as_tensor(arcs.packed)
    inverse, allowed, flipped = true_depths(packed, i, j)
    sigma = depth_sigmas(packed, i, j)
    allowed &= (sigma <= OPTIONS.hypotheses.max_depth_sigma_share * inverse).all(-1)
    out = np.empty(5)
    accepted = 0
    for k, (a, b) in enumerate(zip(i, j, strict=True)):
        assert kernel.depths(a, b, arcs.packed, OPTIONS.hypotheses, out) == bool(allowed[k])
        if allowed[k]:
            accepted += 1
            np.testing.assert_allclose(out[:2], inverse[k].numpy(), rtol=1e-7)
            np.testing.assert_allclose(out[2:4], sigma[k].numpy(), rtol=1e-6)
            assert (out[4] == 1.0) == bool(flipped[k])
    assert accepted > 100 and accepted < 0.6 * len(i)


@pytest.mark.parametrize("name", CAMERAS)
def test_ends_alike_are_ends_at_the_same_places_of_the_line(name: str) -> None:
    """By `position_seen`, which states how far a radian moves a place; arcs of one line cut at random, and arcs of others."""
    arcs = some(room(name).arcs(0.3, 1), 80)
    i, j = np.nonzero(arcs.image[:, None] != arcs.image)
    packed, px_rad = torch.as_tensor(arcs.packed), torch.as_tensor(arcs.px_rad)
    normal, centre = packed[:, 6:9], packed[:, 9:12]
    s = -(normal * centre).sum(-1)
    lines = PlueckerLines.from_planes(normal[i], s[i], normal[j], s[j])
    both = PlueckerLines(lines.direction[:, None].expand(-1, 2, -1), lines.moment[:, None].expand(-1, 2, -1))
    place, variance = [], []
    for rows in (i, j):
        at, _, leverage = both.position_seen(centre[rows][:, None].expand(-1, 2, -1), packed[rows, :6].unflatten(1, (2, 3)))
        ordered = at.sort(-1)
        place.append(ordered.values)
        variance.append((leverage.gather(-1, ordered.indices) * px_rad[rows, None]).square())
    square = (place[0] - place[1]).square() / (variance[0] + variance[1])
    share = LOOKS.other_end
    expected = (share + (1 - share) / (1 + square)).prod(-1).numpy()
    out, found = np.empty(5), []
    for k, (a, b) in enumerate(zip(i, j, strict=True)):
        if kernel.depths(a, b, arcs.packed, OPTIONS.hypotheses, out):
            found.append(kernel.ends_alike(a, b, arcs.packed, arcs.px_rad, out, LOOKS))
            assert found[-1] == pytest.approx(expected[k], rel=1e-6)
    assert len(found) > 100 and share**2 <= min(found) < 0.3 and 0.9 < max(found) <= 1.0


@pytest.mark.parametrize("name", CAMERAS)
def test_the_spread_of_depths_under_noise_is_the_stated_one(name: str) -> None:
    """Pixel noise at both ends of arc j, and noise across its plane at those of i: along it they are other points of the line."""
    scene, sigma_px, draws = room(name), 0.2, 4000
    exact = scene.arcs(0.0, 0).widened(math.sqrt(sigma_px**2 - 0.01**2))
    rng, out, tried = np.random.default_rng(4), np.empty(5), 0
    for line in range(0, len(scene.ends_m), 9):
        i, j = np.flatnonzero(scene.line == line)[:2]
        if not kernel.depths(i, j, exact.packed, OPTIONS.hypotheses, out):
            continue
        tried += 1
        stated = out[2:4].copy()
        pixels = scene.pixels[[j] * draws] + sigma_px * torch.as_tensor(rng.standard_normal((draws, 2, 2)))
        noisy = replace(scene, pixels=pixels, image=scene.image[[j] * draws], line=scene.line[[j] * draws]).arcs(0.0, 0)
        own = np.repeat(exact.packed[[i]], draws, 0)
        own[:, :6] += (own[:, 12:, None] * rng.standard_normal((draws, 2, 1)) * own[:, None, 6:9]).reshape(draws, 6)
        rows, found = np.concatenate([own, noisy.packed]), np.empty((draws, 5))
        for k in range(draws):
            kernel.depths(k, draws + k, rows, OPTIONS.hypotheses, found[k])
        np.testing.assert_allclose(found[:, :2].std(0), stated, rtol=0.06)
    assert tried > 4


def dense_likeness(first: np.ndarray, second: np.ndarray, flipped: bool) -> float:
    """From multivariate normal densities relative to their largest, covariance s^2 I + t^2 1 1'."""

    def square(x: np.ndarray) -> float:
        covariance = LOOKS.colour_sigma**2 * np.eye(len(x)) + LOOKS.gain_sigma**2
        return float(x @ np.linalg.solve(covariance, x)) / len(x)

    sides = first - (second[::-1] if flipped else second)
    known = ~np.isnan(sides).any(-1)
    if not known.any():
        return 0.3
    single = min(square(x) for x in sides[known]) + LOOKS.one_side_chi_square
    if known.all():
        return math.exp(-0.5 * min(single, square(sides.ravel())))
    return math.exp(-0.5 * (single - 0.5 * LOOKS.one_side_chi_square))


def test_likeness_is_a_gaussian_with_a_common_gain() -> None:
    rng = np.random.default_rng(3)
    found = []
    for k in range(400):
        first = rng.uniform(3.0, 5.5, (2, 3))
        second = first + 0.25 * rng.standard_normal() + 0.12 * rng.standard_normal((2, 3))
        if k % 4 == 1:
            second[k // 4 % 2] = rng.uniform(3.0, 5.5, 3)
        if k % 4 == 2:
            second[k // 4 % 2] = np.nan
        flipped = bool(rng.random() < 0.5)
        second = second[::-1].copy() if flipped else second
        found.append(kernel.likeness(first, second, flipped, LOOKS))
        assert found[-1] == pytest.approx(dense_likeness(first, second, flipped), rel=1e-9)
        # Neither the order of the two arcs nor the direction in which both run matters.
        assert kernel.likeness(second, first, flipped, LOOKS) == pytest.approx(found[-1], rel=1e-9)
        assert kernel.likeness(first[::-1].copy(), second[::-1].copy(), flipped, LOOKS) == pytest.approx(found[-1], rel=1e-9)
        assert kernel.likeness(first, second[::-1].copy(), not flipped, LOOKS) == pytest.approx(found[-1], rel=1e-9)
    same = rng.uniform(3.0, 5.5, (2, 3))
    assert kernel.likeness(same, same, False, LOOKS) == 1.0 and 0 < min(found) and max(found) <= 1
    unknown = np.full((2, 3), np.nan)
    assert kernel.likeness(unknown, same, False, LOOKS) == kernel.likeness(same, unknown, True, LOOKS) == 0.3
    # Of true partners all but a few pass. With one side in common arcs do too, but weigh less than half; most strangers do not.
    true = [found[k] for k in range(400) if k % 4 in (0, 3)]
    strangers = [kernel.likeness(*rng.uniform(3.0, 5.5, (2, 2, 3)), False, LOOKS) for _ in range(400)]
    assert np.mean(np.array(true) > LOOKS.min_likeness) > 0.99 and np.mean(np.array(strangers) > LOOKS.min_likeness) < 0.08
    half = [found[k] for k in range(400) if k % 4 == 1]
    assert np.mean(np.array(half) > LOOKS.min_likeness) > 0.9 and np.median(true) > 2 * np.median(half)
    rows = rng.uniform(3.0, 5.5, (20, 2, 3))
    one, other, against = rng.integers(0, 20, 50), rng.integers(0, 20, 50), rng.random(50) < 0.5
    expected = [kernel.likeness(rows[a], rows[b], c, LOOKS) for a, b, c in zip(one, other, against, strict=True)]
    np.testing.assert_array_equal(kernel.likenesses(rows, rows, one, other, against, LOOKS), expected)


@pytest.mark.parametrize("span", [0.01, 0.5, 1.7, 2.8])
def test_cross_variance_is_that_of_the_circle_through_both_ends(span: float) -> None:
    """Derivatives of the angle of a point from the circle by moves of both ends across it."""

    def off(moved: torch.Tensor, along: float) -> torch.Tensor:
        first = torch.stack([torch.ones(()), torch.zeros(()), moved[0]])
        last = torch.stack([moved[1].new_tensor(math.cos(span)), moved[1].new_tensor(math.sin(span)), moved[1]])
        normal = torch.linalg.cross(first, last)
        point = torch.tensor([math.cos(along), math.sin(along), 0.0], dtype=torch.float64)
        return normal @ point / normal.norm()

    for along in (-0.4, 0.0, 0.3 * span, span, span + 0.7):
        jacobian = torch.func.jacrev(off)(torch.zeros(2, dtype=torch.float64), along)
        expected = float((jacobian * torch.tensor([0.002, 0.005], dtype=torch.float64)).norm())
        for far in (1.0, 3.7):
            ends = (math.cos(span), math.sin(span), 0.002, 0.005)
            variance = kernel.cross_variance(far * math.cos(along), far * math.sin(along), *ends)
            assert variance == pytest.approx((far * expected) ** 2, rel=1e-6)


def test_the_best_line_of_an_arc_is_the_one_with_the_most_votes() -> None:
    """Score, rival, supporters and depths of the kernel against all pairs in NumPy."""
    arcs = some(room("fisheye").arcs(0.3, 1, colours=True), 400)
    near = every_neighbour(arcs.images)
    near[0, 3] = near[3, 0] = False
    found = find_hypotheses(arcs, near)
    total = len(arcs)
    arc, pairs, table = np.empty(total, dtype=np.int64), np.empty((total, 4)), np.empty((total, 2))
    supported = 0
    for i in range(0, total, 9):
        photos = np.flatnonzero(near[arcs.image[i]])
        others = np.flatnonzero(np.isin(arcs.image, photos))
        count = kernel.partners(i, others, arcs.packed, arcs.px_rad, arcs.colours, OPTIONS.hypotheses, LOOKS, arc, pairs, table)
        colours, weight = table[:count].T
        assert (weight <= colours).all() and (weight >= LOOKS.other_end**2 * colours).all()
        assert count == found.candidates[i] and set(arcs.image[arc[:count]]) <= set(photos.tolist())
        depth, variance = pairs[:count, :2], pairs[:count, 2:] ** 2
        square = ((depth - depth[:, None]) ** 2 / (variance + np.minimum(variance, variance[:, None]))).sum(-1)
        votes = np.where(square <= AGREE**2, weight * np.exp(-0.25 * square), 0.0)
        image = arcs.image[arc[:count]]
        scores = sum((votes * (image == photo)).max(1, initial=0.0) for photo in photos)
        best = int(np.argmax(scores)) if count else -1
        rivals = scores[square[best] > AGREE**2] if count else np.zeros(0)
        assert found.score[i] == pytest.approx(scores[best] if count else 0.0, rel=1e-9)
        assert found.rival[i] == pytest.approx(rivals.max(initial=0.0), rel=1e-9)
        agreeing = np.flatnonzero(square[best] <= AGREE**2) if count else np.zeros(0, dtype=np.int64)
        alike = colours[agreeing] * np.exp(-0.25 * square[best, agreeing]) if count else np.zeros(0)
        each = sum(alike[image[agreeing] == photo].max(initial=0.0) for photo in photos)
        assert found.agreement[i] == pytest.approx(each, rel=1e-9)
        assert sorted(arc[agreeing].tolist()) == sorted(found.support[i][found.support[i] >= 0].tolist())
        if count:
            share = weight[agreeing, None] / variance[agreeing]
            np.testing.assert_allclose(found.inverse_depth[i], (share * depth[agreeing]).sum(0) / share.sum(0), rtol=1e-9)
            supported += len(agreeing) > 2
    assert supported > 20


@pytest.mark.parametrize("count", [1, 2, 17, 700])
def test_scores_are_those_of_all_pairs(count: int) -> None:
    """Narrow and wide pairs among each other, near 1 and far off, the weights of a photo's arcs not in order."""
    rng = np.random.default_rng(count)
    sigma = 10.0 ** rng.uniform(-4.0, -0.5, (count, 2))
    found = np.concatenate([np.exp(rng.normal(0.0, 0.3, (count, 1)) + rng.normal(0.0, 0.02, (count, 2))), sigma], 1)
    weight, photo = rng.uniform(0.05, 1.0, count), np.sort(rng.integers(0, 9, count))
    order = np.argsort(found[:, 0])
    scores = voting_kernel.pair_scores(voting_kernel.by_first_depth(found, order), order, weight, photo, AGREE)
    variance = sigma**2
    spread = variance[:, None] + np.minimum(variance[:, None], variance)
    square = ((found[:, None, :2] - found[:, :2]) ** 2 / spread).sum(-1)
    votes = np.where(square <= AGREE**2, weight[:, None] * np.exp(-0.25 * square), 0.0)
    expected = sum(votes[photo == k].max(0, initial=0.0) for k in range(9))
    np.testing.assert_allclose(scores, expected[order], rtol=1e-9)
    assert count < 700 or np.median((votes > 0).sum(0)) > 20


@pytest.mark.parametrize("name", CAMERAS)
def test_no_partner_lies_outside_the_angles_about_the_baseline_that_an_arc_reaches(name: str) -> None:
    """Also of arcs that pass a pole of a baseline, and of photos at one place."""
    arcs = some(room(name).arcs(0.3, 1, colours=True), 300)
    poses = Pose(arcs.poses.rotation, arcs.poses.translation.clone())
    poses.translation[1] = -(poses.rotation[1] @ poses.centre[0])
    arcs = replace(arcs, poses=poses)
    total = len(arcs)
    out, found, seen = np.empty(5), np.empty(total, dtype=np.int64), np.full(total, -1, dtype=np.int64)
    partners = skipped = 0
    for photo in range(arcs.images):
        others = np.flatnonzero(np.arange(arcs.images) != photo)
        if arcs.starts[photo] == arcs.starts[photo + 1]:
            continue
        frames, begin, members = arcs_by_angle(photo, others, arcs.starts, arcs.packed)
        for i in range(arcs.starts[photo], arcs.starts[photo + 1]):
            across = found[: arcs_across(arcs.packed[i], frames, begin, members, i, seen, found)].tolist()
            assert len(across) == len(set(across))
            elsewhere = np.flatnonzero(arcs.image != photo).tolist()
            true = {j for j in elsewhere if kernel.depths(i, j, arcs.packed, OPTIONS.hypotheses, out)}
            assert true <= set(across)
            partners, skipped = partners + len(true), skipped + len(elsewhere) - len(across)
    assert partners > 300 and skipped > total * total / 3


def test_arcs_agree_with_a_camera_by_the_best_line_that_it_sees_where_they_are() -> None:
    rng = np.random.default_rng(6)
    arc = np.sort(rng.integers(0, 12, 90))
    alike, normal = rng.uniform(0.05, 1.0, 90), rng.standard_normal((90, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    point, ahead, centres = rng.standard_normal((90, 3)), rng.standard_normal((90, 3)), rng.standard_normal((40, 3))
    offset, sine = (normal * point).sum(-1), 0.3
    towards = point - centres[:, None]
    near = np.abs((normal * towards).sum(-1)) < sine * np.linalg.norm(towards, axis=-1)
    given = np.where(near & ((towards * ahead).sum(-1) > 0.0), alike, 0.0)
    expected = sum(given[:, arc == k].max(1) for k in np.unique(arc))
    np.testing.assert_allclose(agreeing(arc, alike, normal, offset, point, ahead, centres, sine), expected, rtol=1e-12)
    assert expected.min() > 0.0


def test_hypotheses_do_not_depend_on_cores_or_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    arcs = some(room("scaramuzza").arcs(0.3, 1), 500)
    near, every = every_neighbour(arcs.images), None
    for cores, portion in itertools.product((1, 2), (7, 256, 1000)):
        monkeypatch.setattr(progress, "cores", lambda cores=cores: cores)
        monkeypatch.setattr(hypotheses, "AT_ONCE", portion)
        steps = []
        found = find_hypotheses(arcs, near, progress=lambda stage, done, total, to=steps: to.append((done, total)))
        assert steps == [(k + 1, math.ceil(500 / portion)) for k in range(math.ceil(500 / portion))]
        every = found if every is None else every
        for one, other in zip(vars(every).values(), vars(found).values(), strict=True):
            np.testing.assert_array_equal(one, other)
    assert every is not None
    rows = np.array([3, 77, 401])
    for name, one in vars(find_hypotheses(arcs, near, rows=rows)).items():
        np.testing.assert_array_equal(one, near if name == "neighbours" else getattr(every, name)[rows])


def test_hypotheses_of_tasks_that_travel_are_those_of_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each task has the arcs of its photos and of their neighbours alone."""
    arcs = some(room("fisheye").arcs(0.3, 1), 500)
    ring = np.abs(np.arange(arcs.images)[:, None] - np.arange(arcs.images))
    near = (ring > 0) & (np.minimum(ring, arcs.images - ring) <= 2)
    here, sent = find_hypotheses(arcs, near), []

    def elsewhere(work, items):
        sent.extend(pickle.loads(pickle.dumps(item)) for item in items)
        return [pickle.loads(pickle.dumps(work(item))) for item in sent]

    for photos in (1, 3, 100):
        monkeypatch.setattr(hypotheses, "PHOTOS_A_TASK", photos)
        sent.clear()
        found = find_hypotheses(arcs, near, workers=elsewhere)
        for name, one in vars(here).items():
            np.testing.assert_array_equal(one, getattr(found, name))
        assert len(sent) == math.ceil(arcs.images / photos)
        assert max(len(task.neighbours) for task in sent) == min(photos + 4, arcs.images)
    assert (here.support >= 0).any()
