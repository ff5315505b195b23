"""The compiled parts that make tracks, against plain forms: supporters, lines near arcs, sets claimed, united and needed."""

import numpy as np
import pytest
import torch
from matching_scenes import CAMERAS, room, some

from omnilines.geometry.line import PlueckerLines
from omnilines.matching.asked import AskedLines
from omnilines.matching.kernels.supporters import free_supporters, photos_of_tracks, supporting_photos
from omnilines.matching.kernels.track import claim, near_lines, needed, united


def test_supporters_are_counted_and_thinned_out_as_in_sets() -> None:
    rng = np.random.default_rng(4)
    arcs, images = 60, 7
    image, track = np.sort(rng.integers(0, images, arcs)), rng.integers(-1, 9, arcs)
    support = np.full((arcs, 12), -1, dtype=np.int32)
    for k, many in enumerate(rng.integers(0, 13, arcs)):
        support[k, :many] = rng.permutation(arcs)[:many]
    rows = np.flatnonzero(track >= 0)
    own = [{image[j] for j in support[k] if j >= 0 and track[j] == track[k]} for k in rows]
    assert supporting_photos(rows, support, track, image, images).tolist() == list(map(len, own)) and any(own)
    free = [[j for j in row if j >= 0 and track[j] < 0] for row in support.tolist()]
    assert [[j for j in row if j >= 0] for row in free_supporters(support, track).tolist()] == free and any(free)
    seen = [len(set(image[track == t].tolist())) for t in range(9)]
    assert photos_of_tracks(track, image, 9).tolist() == seen and max(seen) > 1


@pytest.mark.parametrize("name", CAMERAS)
def test_lines_near_arcs_are_those_of_a_plain_search(name: str) -> None:
    scene = room(name)
    arcs = some(scene.arcs(0.5, 2), 150)
    rng = np.random.default_rng(8)
    truth = scene.truth()
    ends = torch.einsum("tkx,tx->tk", scene.ends_m - truth.foot[:, None], truth.direction)
    low = rng.uniform(0.0, 0.8, len(ends))
    spans = (ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * torch.as_tensor(np.stack([low, low + 0.2], -1))).numpy()
    gate = rng.uniform(1.0, 12.0, len(arcs)) * arcs.px_rad
    rows = np.sort(rng.permutation(len(arcs))[:120])
    asked = AskedLines.every(arcs.images, len(ends))
    arc, line = near_lines(
        rows,
        arcs.image,
        arcs.packed,
        truth.direction.numpy(),
        truth.moment.numpy(),
        spans,
        gate[rows],
        asked.starts,
        asked.lines,
    )
    centre, bearings = arcs.planes.centre[rows], torch.as_tensor(arcs.packed[rows, :6]).unflatten(1, (2, 3))
    moment = truth[None].moment_about(centre[:, None].expand(120, len(ends), 3))
    angle = torch.asin((bearings @ (moment / moment.norm(dim=-1, keepdim=True)).mT).abs().clamp_max(1)).amax(1)
    lines = PlueckerLines(
        truth.direction[None, :, None].expand(120, -1, 2, -1), truth.moment[None, :, None].expand(120, -1, 2, -1)
    )
    expand = (120, len(ends), 2, 3)
    place, front, _ = lines.position_seen(centre[:, None, None].expand(expand), bearings[:, None].expand(expand))
    meets = torch.minimum(place.amax(-1), torch.as_tensor(spans[:, 1])) > torch.maximum(
        place.amin(-1), torch.as_tensor(spans[:, 0])
    )
    expected = (angle <= torch.as_tensor(gate[rows])[:, None]) & front.all(-1) & meets
    pairs = np.argwhere(expected.numpy())
    np.testing.assert_array_equal(np.stack([arc, line], -1), np.stack([rows[pairs[:, 0]], pairs[:, 1]], -1))
    assert len(pairs) > 40
    # Photos that are asked for some of the lines only find these.
    chosen = rng.random((arcs.images, len(ends))) < 0.5
    starts = np.concatenate([[0], np.cumsum(chosen.sum(1))])
    lines_of = (truth.direction.numpy(), truth.moment.numpy(), spans)
    some_arc, some_line = near_lines(rows, arcs.image, arcs.packed, *lines_of, gate[rows], starts, np.nonzero(chosen)[1].copy())
    kept = chosen[arcs.image[arc], line]
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(np.stack([some_arc, some_line]), np.stack([arc[kept], line[kept]]))


def test_the_list_of_near_lines_grows() -> None:
    arcs = room("fisheye").arcs(0.3, 1)
    truth = room("fisheye").truth()
    everywhere = np.repeat([[-np.inf, np.inf]], len(truth), 0)
    asked, gate = AskedLines.every(arcs.images, len(truth)), np.full(len(arcs), 1.5)
    lines_of = (truth.direction.numpy(), truth.moment.numpy(), everywhere)
    arc, line = near_lines(np.arange(len(arcs)), arcs.image, arcs.packed, *lines_of, gate, asked.starts, asked.lines)
    assert len(arc) > 4096 and len(np.unique(arc * len(truth) + line)) == len(arc)
    assert bool((np.diff(arc * len(truth) + line) > 0).all())


def plain_claim(order: list, support: list, image: list, least_views: int) -> list:
    track, made = [-1] * len(image), 0
    for i in order:
        if track[i] < 0:
            free = [j for j in support[i] if j >= 0 and track[j] < 0]
            if len({image[j] for j in [i, *free]}) >= least_views:
                for j in [i, *free]:
                    track[j] = made
                made += 1
    return track


def plain_united(order: list, others: list) -> list:
    root: dict[int, int] = {}
    for track in order:
        if track not in root:
            root |= dict.fromkeys([other for other in [track, *others[track]] if other not in root], track)
    return [root[k] for k in range(len(order))]


def test_a_track_that_agrees_with_many_joins_one_of_them_only() -> None:
    """Tracks 0 to 3 are lines; 4, of few arcs, lies across all of them; 5 is a part of 2."""
    others = [[4], [4], [4, 5], [4], [0, 1, 2, 3], [2]]
    starts = np.cumsum([0, *map(len, others)])
    root = united(np.array([2, 0, 1, 3, 5, 4]), starts, np.array([k for one in others for k in one], dtype=np.int64))
    assert root.tolist() == [0, 1, 2, 3, 2, 2]


def test_claimed_and_united_sets_are_those_of_plain_python() -> None:
    rng = np.random.default_rng(5)
    most = 0
    for _ in range(60):
        count, images = int(rng.integers(1, 40)), int(rng.integers(1, 8))
        image = np.sort(rng.integers(0, images, count))
        support = np.full((count, 6), -1, dtype=np.int32)
        for i in range(count):
            others = rng.permutation(count)[: rng.integers(0, 6)]
            support[i, : len(others)] = others[image[others] != image[i]].tolist() + [-1] * int((image[others] == image[i]).sum())
        order = rng.permutation(count)
        track, made = claim(order, support, image, images, 3)
        assert track.tolist() == plain_claim(order.tolist(), support.tolist(), image.tolist(), 3)
        assert made == track.max() + 1
        most = max(most, made)
        others = [rng.permutation(count)[: rng.integers(0, 4)].tolist() for _ in range(count)]
        starts = np.cumsum([0, *map(len, others)])
        root = united(order, starts, np.array([k for one in others for k in one], dtype=np.int64))
        assert root.tolist() == plain_united(order.tolist(), others)
        assert bool((root[root] == root).all())
    assert most >= 3


def plain_needed(order: list, members: list, image: list, explaining: list, enough: list) -> list:
    kept: set[int] = set()
    for track in order:
        own = {image[i] for i in members[track] if not kept & set(explaining[i])}
        if len(own) >= enough[track]:
            kept.add(track)
    return [k in kept for k in range(len(order))]


def test_needed_tracks_are_those_of_plain_python() -> None:
    rng = np.random.default_rng(6)
    dropped = kept = 0
    for _ in range(60):
        arcs, images, tracks = int(rng.integers(1, 60)), int(rng.integers(1, 8)), int(rng.integers(1, 9))
        image, own = np.sort(rng.integers(0, images, arcs)), rng.integers(0, tracks, arcs)
        members = [np.flatnonzero(own == k) for k in range(tracks)]
        # The line of an arc explains it too: it must not stand in its own way.
        explaining = [np.unique(np.append(rng.integers(0, tracks, rng.integers(0, 3)), own[i])) for i in range(arcs)]
        order, enough = rng.permutation(tracks), rng.integers(1, 4, tracks)
        found = needed(
            order,
            np.cumsum([0, *map(len, members)]),
            np.concatenate(members),
            image,
            images,
            np.cumsum([0, *map(len, explaining)]),
            np.concatenate(explaining),
            enough,
        )
        expected = plain_needed(
            order.tolist(), [m.tolist() for m in members], image.tolist(), [e.tolist() for e in explaining], enough.tolist()
        )
        assert found.tolist() == expected
        kept, dropped = kept + sum(expected), dropped + tracks - sum(expected)
    assert kept >= 20 and dropped >= 20
