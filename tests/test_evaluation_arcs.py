"""Scores of extracted arcs: segments made from the truth, then broken, shifted, turned and cut, with scores known beforehand."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from camera_models import Equirectangular, InputError, OpenCVFisheye
from camera_models.pose import Pose
from omnilines.evaluation.arcs import ArcScores, arc_scores, lines_of_edges
from omnilines.files.true_edges import (
    Stretches,
    TrueEdges,
    read_stretches,
    read_true_edges,
    write_stretches,
    write_true_edges,
)
from omnilines.records import ImagePoses, Segments

FISHEYE = OpenCVFisheye([286.0, 286.0, 639.5, 479.5, -0.01, 0.003, -0.001, 0.0001], (1280, 960))
PANORAMA = Equirectangular([], (1600, 800))
POSES = ImagePoses(("a.png", "b.png"), Pose.stack([Pose.of(np.eye(3), np.zeros(3)), Pose.of(np.eye(3), [0.1, 0.0, 0.2])]))
# Upright and level edges 2 m in front, an upright one behind, a faint one, and a short one.
EDGES = TrueEdges(
    ("post", "beam", "behind", "faint", "short"),
    np.array(
        [
            [[-1.0, -0.8, 2.0], [-1.0, 0.9, 2.0]],
            [[-0.8, 0.5, 2.0], [1.4, 0.5, 2.2]],
            [[0.05, -0.9, -2.0], [-0.05, 0.9, -2.0]],
            [[1.5, -0.8, 2.0], [1.5, 0.8, 2.0]],
            [[0.2, -0.5, 2.0], [0.3, -0.5, 2.0]],
        ]
    ),
)


def lengths_px(camera, image: int, edge: int, t: np.ndarray) -> float:
    share = np.linspace(*t, 4001)[:, None]
    points = EDGES.ends_m[edge, 0] + share * (EDGES.ends_m[edge, 1] - EDGES.ends_m[edge, 0])
    pixels, _ = camera.project(POSES.cam_from_world[image].transform(torch.as_tensor(points)).numpy())
    step = np.diff(pixels, axis=0)
    if camera.PERIODIC:
        step[:, 0] -= camera.image_size[0] * np.round(step[:, 0] / camera.image_size[0])
    return float(np.linalg.norm(step, axis=-1).sum())


def table(camera, rows: list[tuple[int, int, float, float, float]]) -> Stretches:
    """(image, edge, t1, t2, contrast)."""
    image, edge = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    t, contrast = np.array([row[2:4] for row in rows]), np.array([row[4] for row in rows])
    length = np.array([lengths_px(camera, i, e, span) for i, e, span in zip(image, edge, t, strict=True)])
    return Stretches(POSES.images, image, edge, t, length, 0.5 * contrast, contrast)


def segments(camera, rows: list[tuple[int, int, float, float]], shift_px: float = 0.0) -> Segments:
    """Parts of edges as exact segments, shifted across by some pixels."""
    ends = []
    for image, edge, t1, t2 in rows:
        points = EDGES.ends_m[edge, 0] + np.array([[t1], [t2]]) * (EDGES.ends_m[edge, 1] - EDGES.ends_m[edge, 0])
        pixels, _ = camera.project(POSES.cam_from_world[image].transform(torch.as_tensor(points)).numpy())
        along = pixels[1] - pixels[0]
        ends.append(pixels + shift_px * np.array([-along[1], along[0]]) / np.linalg.norm(along))
    image = np.array([row[0] for row in rows])
    return Segments(image, POSES.images, np.full(len(rows), -1), (), np.stack(ends))


SEEN = [(0, 0, 0.0, 1.0, 50.0), (0, 1, 0.1, 0.9, 30.0), (0, 3, 0.0, 1.0, 6.0), (0, 4, 0.0, 1.0, 60.0), (1, 0, 0.2, 0.8, 50.0)]
PERFECT = [(image, edge, t1, t2) for image, edge, t1, t2, _ in SEEN]


def scored(camera, rows, found, **options) -> ArcScores:
    return arc_scores(camera, POSES, EDGES, table(camera, rows), found, **options)


@pytest.mark.parametrize("camera", [FISHEYE, PANORAMA], ids=["fisheye", "panorama"])
def test_perfect_arcs(camera) -> None:
    score = scored(camera, SEEN, segments(camera, PERFECT))
    assert score.covered_share == pytest.approx(1.0, abs=1e-9)
    assert score.stretches == 3 and score.arcs == 5 and score.arcs_per_stretch == 1.0
    assert score.on_edge.all() and score.on_edge_share == 1.0
    assert score.edge.tolist() == [0, 1, 3, 4, 0]
    # A billionth of a radian is what atan2 leaves of rounding in the end points.
    assert score.direction_deg(100) < 1e-6
    counted = sum(lengths_px(camera, i, e, np.array(t)) for i, e, *t in [PERFECT[0], PERFECT[1], PERFECT[4]])
    assert score.length_px == pytest.approx(counted, rel=1e-4)
    assert score.mean_arc_px == pytest.approx(np.mean([lengths_px(camera, i, e, np.array(t)) for i, e, *t in PERFECT]), rel=1e-3)


def test_missing_and_broken_arcs() -> None:
    """The beam found in two halves, a quarter of the post not at all."""
    found = [(0, 0, 0.0, 0.75), (0, 1, 0.1, 0.5), (0, 1, 0.5, 0.9), (1, 0, 0.2, 0.8)]
    score = scored(FISHEYE, SEEN, segments(FISHEYE, found))
    assert score.arcs_per_stretch == pytest.approx(4 / 3)
    lost = lengths_px(FISHEYE, 0, 0, np.array([0.75, 1.0]))
    # The end of an arc covers up to a step of half a pixel more.
    assert score.covered_share == pytest.approx(1 - lost / score.length_px, abs=1.0 / score.length_px)
    nothing = segments(FISHEYE, PERFECT[2:3])
    empty = scored(FISHEYE, SEEN, nothing)
    assert empty.covered_share == 0 and math.isnan(empty.arcs_per_stretch) and empty.on_edge.all()


@pytest.mark.parametrize(("shift", "near"), [(0.9, True), (-0.9, True), (1.2, False), (-1.2, False)])
def test_one_pixel_is_the_limit(shift: float, near: bool) -> None:
    found = segments(FISHEYE, PERFECT, shift)
    score = scored(FISHEYE, SEEN, found)
    # The chord's offset at the ends is that of the arc to within its curvature.
    assert (score.covered_share > 0.97) if near else (score.covered_share < 0.1)
    assert score.on_edge.all() if near else not score.on_edge.any()


def test_crossing_and_foreign_arcs() -> None:
    """An arc that crosses an edge, one that leaves it half way, one in the void, one on an edge that the photo does not see."""
    ends = segments(FISHEYE, [(0, 0, 0.1, 0.9)]).endpoints_px[0]
    middle, half = ends.mean(0), 0.5 * (ends[1] - ends[0])
    across = np.array([-half[1], half[0]])
    strays = np.stack(
        [
            [middle - across, middle + across],
            [ends[0], ends[1] + 0.08 * across],
            [[900.0, 800.0], [1000.0, 800.0]],
            segments(FISHEYE, [(0, 2, 0.0, 1.0)]).endpoints_px[0],
        ]
    )
    found = Segments(np.zeros(4, dtype=np.int64), ("a.png",), np.full(4, -1), (), strays)
    score = scored(FISHEYE, SEEN, found)
    assert not score.on_edge.any()
    assert score.edge[0] == -1 and score.edge[2] == -1 and math.isnan(score.direction_rad[2])
    assert score.covered_share < 0.15


def test_stretches_that_touch_are_one() -> None:
    rows = [(0, 0, 0.0, 0.4, 50.0), (0, 0, 0.4, 1.0, 12.0), (0, 1, 0.1, 0.3, 30.0), (0, 1, 0.5, 0.9, 30.0)]
    score = scored(FISHEYE, rows, segments(FISHEYE, [(0, 0, 0.0, 1.0), (0, 1, 0.1, 0.9)]))
    # The arc over the gap in the beam lies on both of its stretches.
    assert score.stretches == 3 and score.arcs_per_stretch == 1.0
    assert score.covered_share == pytest.approx(1.0)
    assert score.on_edge.tolist() == [True, False]
    grey = scored(FISHEYE, rows, segments(FISHEYE, [(0, 0, 0.0, 1.0)]), colour=False)
    assert grey.stretches == 3 and grey.length_px < score.length_px


def test_edges_of_one_line() -> None:
    """An arc over two sills of one line is on a line, but on no edge; so it is not where the second sill stands back."""
    for back, on_line in ((0.0, True), (0.05, False)):
        ends = np.array([[[-1.0, 0.3, 2.0], [0.0, 0.3, 2.0]], [[0.0, 0.3, 2.0], [1.0, 0.3, 2.0]]])
        ends[1] *= 1.0 + back
        sills = TrueEdges(("left", "right"), ends)
        assert len(set(lines_of_edges(sills).tolist())) == (1 if on_line else 2)
        seen = Stretches(
            ("a.png",), np.zeros(2, dtype=np.int64), np.arange(2), np.tile([0.0, 1.0], (2, 1)), *np.full((3, 2), 150.0)
        )
        pixels, _ = FISHEYE.project(np.stack([ends[0, 0], ends[1, 1]]))
        found = Segments(np.zeros(1, dtype=np.int64), ("a.png",), np.full(1, -1), (), pixels[None])
        score = arc_scores(FISHEYE, ImagePoses(("a.png",), Pose.stack([POSES.cam_from_world[0]])), sills, seen, found)
        assert score.on_edge.tolist() == [False] and score.on_line.tolist() == [on_line]
        assert score.covered_share == pytest.approx(1.0)


def test_direction_of_the_great_circle() -> None:
    """One end moved by 0.5 px: the normal turns by that over the focal length and the sine of the arc."""
    exact = segments(FISHEYE, [(0, 0, 0.0, 1.0)])
    bearings, _ = FISHEYE.unproject(exact.endpoints_px[0])
    normal = np.cross(*bearings)
    normal /= np.linalg.norm(normal)
    off = 0.0015
    turned = bearings[1] + off * normal
    pixel, _ = FISHEYE.project(turned)
    found = dataclasses.replace(exact, endpoints_px=np.stack([exact.endpoints_px[0, 0], pixel])[None])
    score = scored(FISHEYE, SEEN, found)
    expected = math.atan(off / np.linalg.norm(np.cross(*bearings)))
    assert score.on_edge.all()
    assert score.direction_rad[0] == pytest.approx(expected, rel=1e-3)


def test_across_the_seam_of_a_panorama() -> None:
    rows = [(0, 2, 0.0, 1.0, 40.0)]
    pixels = segments(PANORAMA, [(0, 2, 0.0, 1.0)])
    assert abs(pixels.endpoints_px[0, 0, 0] - pixels.endpoints_px[0, 1, 0]) > 1500
    score = scored(PANORAMA, rows, pixels)
    assert score.covered_share == 1.0 and score.on_edge.all() and score.arcs_per_stretch == 1.0


def test_tables_come_back(tmp_path) -> None:
    stretches = table(FISHEYE, SEEN)
    write_true_edges(tmp_path / "truth.csv", EDGES)
    edges = read_true_edges(tmp_path / "truth.csv")
    assert edges.names == EDGES.names
    np.testing.assert_array_equal(edges.ends_m, EDGES.ends_m)
    write_stretches(tmp_path / "visibility.csv", stretches, EDGES)
    again = read_stretches(tmp_path / "visibility.csv", edges)
    np.testing.assert_array_equal(again.t, stretches.t)
    np.testing.assert_array_equal(again.edge, stretches.edge)
    np.testing.assert_allclose(again.length_px, stretches.length_px, atol=1e-4)
    (tmp_path / "short.csv").write_text("image,edge,t1,t2\nb.png,post,0.5,0.75\na.png,beam,0,1\na.png,post,0,0.25\n")
    short = read_stretches(tmp_path / "short.csv", edges)
    assert [short.images[k] for k in short.image] == ["b.png", "a.png", "a.png"] and short.edge.tolist() == [0, 0, 1]
    assert np.isnan(short.contrast_rgb).all()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("truth.csv", "edge,x1_m,y1_m,z1_m,x2_m,y2_m,z2_m\na,0,0,0,1,0,0\na,0,0,0,0,1,0\n", "line 3, column edge"),
        ("truth.csv", "edge,x1_m,y1_m,z1_m,x2_m,y2_m,z2_m\na,0,0,0,0,0,0\n", "column x2_m"),
        ("visibility.csv", "image,edge,t1,t2\na.png,wall,0,1\n", "an edge of truth.csv, found 'wall'"),
        ("visibility.csv", "image,edge,t1,t2\na.png,post,0.5,0.5\n", "column t2"),
        ("visibility.csv", "image,edge,t1,t2\na.png,post,-0.5,0.5\n", "column t1"),
    ],
)
def test_wrong_tables_are_named(tmp_path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_true_edges(tmp_path / name) if name == "truth.csv" else read_stretches(tmp_path / name, EDGES)


def test_photos_without_a_pose_are_named() -> None:
    found = dataclasses.replace(segments(FISHEYE, PERFECT), images=("a.png", "c.png"))
    with pytest.raises(InputError, match=r"found none of 'c\.png'"):
        scored(FISHEYE, SEEN, found)
