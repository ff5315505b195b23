"""Scores of reconstructed lines: scenes whose recall, precision and errors are known in closed form, and sampled ones."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_models import GeometryError, InputError
from camera_models.pose import Pose
from omnilines.evaluation.scene import SceneScores, aligned_ends, scene_scores
from omnilines.files.true_edges import Stretches, TrueEdges
from omnilines.records import ImagePoses

# Far apart, 2 m, 1 m and 3 m long.
EDGES = TrueEdges(
    ("post", "beam", "sill"),
    np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]], [[3.0, 0.0, 2.0], [4.0, 0.0, 2.0]], [[0.0, 5.0, 1.0], [0.0, 8.0, 1.0]]]),
)
LENGTHS = np.array([2.0, 1.0, 3.0])
PHOTOS = tuple(f"{k}.png" for k in range(6))


def table(rows: list[tuple[int, int, float, float, float]]) -> Stretches:
    """(photo, edge, t1, t2, contrast of the colour that differs most); in grey it is half of that."""
    image, edge = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    t, contrast = np.array([row[2:4] for row in rows]), np.array([row[4] for row in rows])
    return Stretches(PHOTOS, image, edge, t, np.full(len(rows), 100.0), 0.5 * contrast, contrast)


ALL_SEEN = table([(photo, edge, 0.0, 1.0, 50.0) for photo in range(4) for edge in range(3)])


def part(edge: int, t1: float, t2: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    first, second = EDGES.ends_m[edge]
    return first + np.array([[t1], [t2]]) * (second - first) + np.array(shift)


def scored(lines: list[np.ndarray], seen: Stretches = ALL_SEEN, **options) -> SceneScores:
    return scene_scores(np.array(lines).reshape(-1, 2, 3), EDGES, seen, **options)


def test_perfect_lines() -> None:
    score = scored([part(k, 1.0, 0.0) for k in range(3)])
    np.testing.assert_allclose(score.recall, 1.0)
    np.testing.assert_allclose(score.length_recall_m, 6.0)
    assert (score.precision == 1).all() and (score.inlier_share == 1).all()
    assert score.lines == 3 and score.total_m == 6.0 and score.visible_m == 6.0
    assert score.edge.tolist() == [0, 1, 2] and score.median_error_m == 0.0 and score.direction_deg(100) == 0.0
    assert score.repeated_share == 0.0
    np.testing.assert_allclose(score.visible_of_edge_m, LENGTHS)
    np.testing.assert_allclose(score.found_of_edge_m, np.tile(LENGTHS, (3, 1)))


def test_a_shifted_line_counts_from_its_shift_on() -> None:
    """4 mm beside the post, along it from 0.5 to 1.5 m: the capsule adds sqrt(tau^2 - 4^2) mm of the post at either end."""
    score = scored([part(0, 0.25, 0.75, (0.0, 0.004, 0.0))])
    more = 2 * math.sqrt(0.005**2 - 0.004**2), 2 * math.sqrt(0.010**2 - 0.004**2)
    np.testing.assert_allclose(score.recall, [0.0, (1 + more[0]) / 6, (1 + more[1]) / 6])
    np.testing.assert_allclose(score.length_recall_m, [0.0, 1.0, 1.0])
    assert score.precision.tolist() == score.inlier_share.tolist() == [0.0, 1.0, 1.0]
    assert score.median_error_m == pytest.approx(0.004)


def test_a_tilted_line() -> None:
    """Through the middle of the beam at alpha, half a metre to either side: tau / sin(alpha) of each side is near."""
    alpha = 0.05
    along = 0.5 * np.array([math.cos(alpha), math.sin(alpha), 0.0])
    middle = part(1, 0.5, 0.5)[0]
    score = scored([np.stack([middle - along, middle + along])])
    near = 2 * np.array([0.001, 0.005, 0.010]) / math.sin(alpha)
    np.testing.assert_allclose(score.length_recall_m, near)
    # Of the beam a point is near where its distance from the line, sin(alpha) times that from the middle, is below the threshold.
    np.testing.assert_allclose(score.recall, near / 6)
    assert score.precision.tolist() == [0.0, 0.0, 0.0] and score.inlier_share.tolist() == [1.0, 1.0, 1.0]
    assert score.direction_deg(50) == pytest.approx(math.degrees(alpha))
    assert score.median_error_m == pytest.approx(0.5 * math.sin(alpha))


def test_a_line_past_the_end() -> None:
    """The beam with 40 cm too much: the error is that excess, and of it only the threshold is near."""
    score = scored([part(1, 0.0, 1.4)])
    np.testing.assert_allclose(score.length_recall_m, 1.0 + np.array([0.001, 0.005, 0.010]))
    assert score.precision.tolist() == [0.0] * 3 and score.median_error_m == pytest.approx(0.4)
    # 1.09 of 1.21 m are above 0.9.
    assert scored([part(1, 0.0, 1.21)], thresholds_m=[0.08, 0.09]).precision.tolist() == [0.0, 1.0]


def test_a_line_across() -> None:
    """At a right angle, 3 mm past the post: a chord of 2 sqrt(tau^2 - 3^2) mm, and it repeats nothing."""
    across = np.array([[-1.0, 0.003, 1.0], [1.0, 0.003, 1.0]])
    score = scored([across, across])
    chord = 2 * np.array([0.0, 0.004, math.sqrt(0.010**2 - 0.003**2)])
    np.testing.assert_allclose(score.length_recall_m, 2 * chord)
    np.testing.assert_allclose(score.recall, chord / 6)
    assert score.inlier_share.tolist() == [0.0, 1.0, 1.0] and score.repeated_share == 0.0
    assert score.direction_deg(50) == pytest.approx(90.0)


def test_what_enough_photos_see() -> None:
    """Five photos see parts of the post, one of them too faintly; a stretch may be cut where its contrast changes."""
    rows = [
        (0, 0, 0.0, 0.5, 50.0),
        (0, 0, 0.5, 1.0, 12.0),
        (1, 0, 0.0, 0.9, 50.0),
        (2, 0, 0.2, 1.0, 50.0),
        (3, 0, 0.1, 0.6, 50.0),
    ]
    seen = table([*rows, (4, 0, 0.0, 1.0, 9.0)])
    found = [part(0, 0.3, 0.4)]
    score = scored(found, seen)
    np.testing.assert_allclose(score.visible_of_edge_m, [2 * 0.4, 0.0, 0.0])
    np.testing.assert_allclose(score.recall, (0.2 + 2 * np.array([0.001, 0.005, 0.010])) / 0.8)
    assert scored(found, seen, min_views=3).visible_m == pytest.approx(2 * 0.8)
    # The faint photo sees it all, so that three of the other four are enough.
    assert scored(found, seen, min_contrast=5.0).visible_m == pytest.approx(2 * 0.8)
    assert scored(found, seen, colour=False).visible_m == pytest.approx(2 * 0.3)
    assert math.isnan(scored(found, seen, min_views=6).recall[0])
    # Every row is 100 px: only the first photo's two, which touch, are a stretch of more.
    assert scored(found, seen, min_px=100.0).visible_m == pytest.approx(0.8)
    assert scored(found, seen, min_px=150.0, min_views=1).visible_m == pytest.approx(2.0)
    assert scored(found, seen, min_px=150.0).visible_m == 0.0


def test_repeated_lines() -> None:
    """The sill found from 0 to 2 m and from 1 to 3 m, the beam three times: of 4 + 3 m of lines, 1 + 2 m are repeats."""
    lines = [part(2, 0.0, 2 / 3), part(2, 1.0, 1 / 3), *[part(1, 0.0, 1.0, (0.0, y, 0.0)) for y in (0.0, 0.009, -0.009)]]
    assert scored(lines).repeated_share == pytest.approx(3 / 7)
    far = [*lines, part(1, 0.0, 1.0, (0.0, 0.011, 0.0))]
    assert scored(far).repeated_share == pytest.approx(3 / 7)


@pytest.mark.slow
def test_against_samples() -> None:
    """Random lines near random edges, in three blocks, by points 0.5 mm apart and the distance from a point to a segment."""
    rng = np.random.default_rng(0)
    first = rng.uniform(-0.5, 0.5, (40, 3))
    edges = np.stack([first, first + rng.normal(0.0, 0.3, (40, 3))], 1)
    lines = edges[rng.integers(0, 40, 60)] + rng.normal(0.0, 0.01, (60, 2, 3))
    image, edge = np.repeat(np.arange(6), 40), np.tile(np.arange(40), 6)
    t = np.sort(rng.uniform(0.0, 1.0, (240, 2)), -1)
    seen = Stretches(PHOTOS, image, edge, t, np.ones(240), np.full(240, 50.0), np.full(240, 50.0))
    thresholds = (0.004, 0.02)
    score = scene_scores(lines, TrueEdges(tuple(map(str, range(40))), edges), seen, thresholds, min_views=2)

    def sampled(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        share = (np.arange(2000) + 0.5) / 2000
        return share, ends[:, :1] + share[:, None] * (ends[:, 1:] - ends[:, :1])

    def distance(points: np.ndarray, others: np.ndarray) -> np.ndarray:
        axis = others[:, 1] - others[:, 0]
        step = points[:, :, None] - others[:, 0]
        share = np.clip((step * axis).sum(-1) / (axis * axis).sum(-1), 0.0, 1.0)
        return np.linalg.norm(step - share[..., None] * axis, axis=-1).min(-1)

    _, points = sampled(lines)
    to_edges = distance(points, edges)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1)
    share, points = sampled(edges)
    to_lines = distance(points, lines)
    true_length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
    depth = ((share >= t.reshape(6, 40, 2)[..., :1]) & (share <= t.reshape(6, 40, 2)[..., 1:])).sum(0)
    visible = (true_length[:, None] * (depth >= 2)).sum() / 2000
    assert score.visible_m == pytest.approx(visible, rel=2e-3)
    for k, tau in enumerate(thresholds):
        inside = (to_edges <= tau).mean(-1)
        assert score.length_recall_m[k] == pytest.approx((length * inside).sum(), rel=2e-3)
        assert score.precision[k] == pytest.approx((inside >= 0.9).mean(), abs=1e-9)
        assert score.inlier_share[k] == pytest.approx((inside > 0).mean(), abs=1e-9)
        found = (true_length[:, None] * ((depth >= 2) & (to_lines <= tau))).sum() / 2000
        assert 0.05 < score.recall[k] == pytest.approx(found / visible, rel=4e-3)


def test_scores_do_not_depend_on_the_frame_or_the_order() -> None:
    """Axis-parallel lines are the special cases of the closed forms; the same scene turned has none of them."""
    lines = np.array([part(0, 0.1, 1.05), part(1, 0.0, 0.4, (0.0, 0.002, 0.003)), part(2, 0.9, 0.2), part(2, 0.5, 0.1)])
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    turned = dataclasses.replace(EDGES, ends_m=EDGES.ends_m @ turn.T + 3.0)
    a, b = scene_scores(lines, EDGES, ALL_SEEN), scene_scores(lines[::-1] @ turn.T + 3.0, turned, ALL_SEEN)
    for name in ("recall", "length_recall_m", "precision", "inlier_share", "found_of_edge_m", "repeated_share", "visible_m"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-12)
    np.testing.assert_allclose(a.error_m, b.error_m[::-1], atol=1e-12)
    assert b.direction_rad.max() < 1e-9


def test_alignment_by_the_poses() -> None:
    """Lines and poses turned, moved and made 2.5 times as large come back; a photo of one of both sets only is nothing."""
    rng = np.random.default_rng(1)
    rotation, centre = Rotation.random(6, rng=rng).as_matrix(), rng.normal(size=(6, 3))

    def poses(centres: np.ndarray, rotations: np.ndarray, images: list[int]) -> ImagePoses:
        each = [Pose.of(rotations[k], -rotations[k] @ centres[k]) for k in images]
        return ImagePoses(tuple(PHOTOS[k] for k in images), Pose.stack(each))

    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    moved = 2.5 * centre @ turn.T + 3.0
    truth, found = poses(centre, rotation, [0, 1, 2, 3, 4]), poses(moved, rotation @ turn.T, [5, 3, 0, 2, 1])
    ends = 2.5 * EDGES.ends_m @ turn.T + 3.0
    np.testing.assert_allclose(aligned_ends(ends, found, truth), EDGES.ends_m, atol=1e-12)
    with pytest.raises(InputError, match=r"At least 3 photos .* found 2"):
        aligned_ends(ends, poses(moved, rotation @ turn.T, [5, 3, 0]), truth)
    with pytest.raises(GeometryError, match="do not lie on one line"):
        aligned_ends(ends, poses(np.outer(np.arange(6.0), [1.0, 2.0, 3.0]), rotation, [0, 1, 2]), truth)


def test_no_lines() -> None:
    score = scored([])
    assert score.recall.tolist() == [0.0] * 3 and score.length_recall_m.tolist() == [0.0] * 3
    assert np.isnan(score.precision).all() and math.isnan(score.median_error_m) and math.isnan(score.direction_deg(95))
    assert score.lines == 0 and score.repeated_share == 0.0 and score.visible_m == 6.0


def test_wrong_lines_are_named() -> None:
    with pytest.raises(InputError, match=r"two finite ends apart were expected, found .* in row 1"):
        scored([part(0, 0.0, 1.0), part(1, 0.5, 0.5)])
    with pytest.raises(InputError, match="in row 0"):
        scored([part(0, math.nan, 1.0)])
    with pytest.raises(InputError, match="Thresholds above 0 m"):
        scored([part(0, 0.0, 1.0)], thresholds_m=(0.0,))
    with pytest.raises(InputError, match="True edges were expected"):
        scene_scores(np.zeros((0, 2, 3)), TrueEdges((), np.zeros((0, 2, 3))), ALL_SEEN.keep(np.zeros(12, dtype=bool)))
    with pytest.raises(InputError, match="Stretches with their contrast"):
        scored([], dataclasses.replace(ALL_SEEN, contrast_rgb=np.full(12, math.nan)))
