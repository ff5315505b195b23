"""The CSV tables: what is written reads back the same, to the bit, and what could not be read is not written."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from table_checks import assert_same, read_npz

from camera_models.errors import InputError
from camera_models.formats.values import stray
from camera_models.pose import Pose, rotation_from_vector
from omnilines.files import (
    read_corners,
    read_lines,
    read_poses,
    read_segments,
    write_corners,
    write_covariance,
    write_lines,
    write_poses,
    write_segments,
)
from omnilines.files.tables import LARGEST_PX, LEAST_SIGMA_PX
from omnilines.records import LINE_STATUSES, Corners, ImagePoses, Lines, Segments

finite = st.floats(-LARGEST_PX, LARGEST_PX)
positive = st.floats(LEAST_SIGMA_PX, LARGEST_PX)
name = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=5).filter(lambda s: bool(s.strip()))
photo = name.filter(lambda s: stray(s) is None)
Folders = pytest.TempPathFactory


def arrays(draw: Any, elements: st.SearchStrategy[float], *shape: int) -> np.ndarray:
    size = int(np.prod(shape))
    return np.array(draw(st.lists(elements, min_size=size, max_size=size)), dtype=np.float64).reshape(shape)


def in_order(draw: Any, n: int, names: st.SearchStrategy[str] = name) -> tuple[np.ndarray, tuple[str, ...]]:
    """Indices into distinct names, numbered in the order of first appearance, as a table that was read has them."""
    pick = draw(st.lists(st.integers(0, 3), min_size=n, max_size=n))
    numbers = {value: k for k, value in enumerate(dict.fromkeys(pick))}
    texts = draw(st.lists(names, min_size=len(numbers), max_size=len(numbers), unique=True))
    return np.array([numbers[value] for value in pick], dtype=np.int64), tuple(texts)


# The strategies draw fields, not records: beartype, which checks records while testing, uses `random`, which hypothesis forbids.
Fields = tuple[Any, ...]


@st.composite
def corner_fields(draw: Any) -> Fields:
    n = draw(st.integers(1, 6))
    view, view_names = in_order(draw, n)
    images = tuple(draw(st.lists(photo, min_size=len(view_names), max_size=len(view_names))))
    board = arrays(draw, finite, n, 3)
    board[:, 0] = np.arange(n) / 7
    sigma = arrays(draw, positive, n) if draw(st.booleans()) else None
    ids = (
        np.array(draw(st.lists(st.integers(-1, 2**62), min_size=n, max_size=n)), dtype=np.int64) if draw(st.booleans()) else None
    )
    return view, view_names, images, board, arrays(draw, finite, n, 2), sigma, ids


@st.composite
def segment_fields(draw: Any) -> Fields:
    n = draw(st.integers(1, 6))
    image, images = in_order(draw, n, photo)
    track, tracks = in_order(draw, n)
    matched = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    kept = list(dict.fromkeys(track[matched].tolist()))
    track = np.array([kept.index(t) if m else -1 for t, m in zip(track.tolist(), matched, strict=True)], dtype=np.int64)
    ends = arrays(draw, finite, n, 2, 2)
    ends[:, 1, 0] = np.where(ends[:, 0, 0] == 1.0, 2.0, 1.0)
    covariance = None
    if draw(st.booleans()):
        factor = arrays(draw, st.floats(0.01, 10), n, 2, 2, 2)
        covariance = factor @ np.swapaxes(factor, -1, -2)
        covariance[..., 1, 0] = covariance[..., 0, 1]
    cameras = tuple(draw(st.lists(name, min_size=len(images), max_size=len(images)))) if draw(st.booleans()) else None
    sigma = arrays(draw, positive, n) if draw(st.booleans()) else None
    return image, images, track, tuple(tracks[k] for k in kept), ends, sigma, covariance, cameras


@st.composite
def pose_fields(draw: Any) -> Fields:
    images = tuple(draw(st.lists(photo, min_size=1, max_size=6, unique=True)))
    n = len(images)
    cameras = tuple(draw(st.lists(name, min_size=n, max_size=n))) if draw(st.booleans()) else None
    return images, arrays(draw, st.floats(-4, 4), n, 3), arrays(draw, finite, n, 3), cameras


@st.composite
def line_fields(draw: Any) -> Fields:
    tracks = tuple(draw(st.lists(name, max_size=6, unique=True)))
    n = len(tracks)
    status = tuple(draw(st.lists(st.sampled_from(LINE_STATUSES), min_size=n, max_size=n)))
    ends = arrays(draw, finite, n, 2, 3)
    ends[[s not in ("ok", "weak") for s in status]] = np.nan
    views = np.array(draw(st.lists(st.integers(0, 2**40), min_size=n, max_size=n)), dtype=np.int64)
    known_or_not = st.one_of(finite, st.just(np.nan))
    return tracks, ends, views, arrays(draw, known_or_not, n), arrays(draw, known_or_not, n), status


@given(fields=corner_fields())
@settings(max_examples=100, deadline=None)
def test_corners_come_back(fields: Fields, tmp_path_factory: Folders) -> None:
    table = Corners(*fields)
    path = tmp_path_factory.mktemp("t") / "corners.csv"
    write_corners(path, table)
    assert_same(table, read_corners(path))


@given(fields=segment_fields())
@settings(max_examples=100, deadline=None)
@pytest.mark.slow
def test_segments_come_back(fields: Fields, tmp_path_factory: Folders) -> None:
    table = Segments(*fields)
    ends = [frozenset(map(tuple, pair)) for pair in (table.endpoints_px + 0.0).tolist()]
    # A track does not hold a segment of a photo twice.
    assume(len(set(zip(table.image.tolist(), table.track.tolist(), ends, strict=True))) == len(table))
    path = tmp_path_factory.mktemp("t") / "segments.csv"
    write_segments(path, table)
    assert_same(table, read_segments(path))


@given(fields=pose_fields())
@settings(max_examples=100, deadline=None)
def test_poses_come_back(fields: Fields, tmp_path_factory: Folders) -> None:
    images, turns, translation, cameras = fields
    pose = Pose(rotation_from_vector(torch.from_numpy(turns)), torch.from_numpy(translation))
    table = ImagePoses(images, pose, cameras)
    path = tmp_path_factory.mktemp("t") / "poses.csv"
    write_poses(path, table)
    read = read_poses(path)
    assert_same(table, read)
    assert torch.equal(table.cam_from_world.translation, read.cam_from_world.translation)
    assert (table.cam_from_world.rotation - read.cam_from_world.rotation).abs().max() < 3e-14
    first = path.read_bytes()
    write_poses(path, read)
    assert path.read_bytes() == first and torch.equal(read_poses(path).cam_from_world.rotation, read.cam_from_world.rotation)


@given(fields=line_fields())
@settings(max_examples=100, deadline=None)
def test_lines_come_back(fields: Fields, tmp_path_factory: Folders) -> None:
    table = Lines(*fields)
    path = tmp_path_factory.mktemp("t") / "lines.csv"
    write_lines(path, table)
    assert_same(table, read_lines(path))


@pytest.fixture
def corners() -> Corners:
    zero = np.zeros(2, dtype=np.int64)
    return Corners(zero, ("0",), ("a.jpg",), np.eye(3)[:2], np.ones((2, 2)), np.ones(2), np.arange(2))


def test_writing_refuses_what_reading_would_and_keeps_the_old_file(corners: Corners, tmp_path: Path) -> None:
    path = tmp_path / "corners.csv"
    write_corners(path, corners)
    before = path.read_bytes()
    corners.pixels[1, 0] = np.nan
    with pytest.raises(InputError, match=r"corners\.csv, column u_px: row 2 would be nan; expected finite numbers"):
        write_corners(path, corners)
    corners.pixels[1, 0] = 1.0
    with pytest.raises(InputError, match=r"column view: expected names that are not blank"):
        write_corners(path, Corners(corners.view, (" ",), corners.images, corners.board_m, corners.pixels))
    for name in ("a\udcff.jpg", "a\x1b[31m.jpg", "a\n.jpg", "../a.jpg", "/tmp/a.jpg"):
        with pytest.raises(InputError, match=r"column image: a name was expected, found '[^\x00-\x1f]*', which (holds|leads|is)"):
            write_corners(path, Corners(corners.view, ("0",), (name,), corners.board_m, corners.pixels))
    with pytest.raises(InputError, match=r"cannot be written \(No such file or directory\)"):
        write_corners(tmp_path / "absent" / "corners.csv", corners)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["corners.csv"]


def test_lines_that_are_known_must_have_ends(tmp_path: Path) -> None:
    one = np.ones(1)
    lines = Lines(("t",), np.full((1, 2, 3), np.nan), np.array([3]), one, one, ("ok",))
    with pytest.raises(InputError, match="column x1_m: row 1 would be nan"):
        write_lines(tmp_path / "lines.csv", lines)
    with pytest.raises(InputError, match="column rms_px: row 1 would be inf"):
        write_lines(tmp_path / "lines.csv", Lines(("t",), np.ones((1, 2, 3)), np.array([3]), one * np.inf, one, ("ok",)))


def test_covariances_of_poses_and_lines(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    poses = ImagePoses(("a.jpg", "é.jpg"), Pose.identity(2), covariance=generator.normal(size=(2, 6, 6)))
    one = np.ones(1)
    centre, covariance = generator.normal(size=(1, 3)), generator.normal(size=(1, 4, 4))
    lines = Lines(("t",), np.ones((1, 2, 3)), np.array([3]), one, one, ("ok",), covariance, centre, 2 * one)
    write_covariance(tmp_path / "covariance.npz", poses, lines)
    data = read_npz(tmp_path / "covariance.npz")
    assert data["image"].tolist() == ["a.jpg", "é.jpg"] and np.array_equal(data["pose_covariance"], poses.covariance)
    assert data["track"].tolist() == ["t"] and np.array_equal(data["line_covariance"], covariance)
    assert np.array_equal(data["line_chart_centre_m"], centre) and data["line_chart_scale_m"].tolist() == [2.0]
    first = (tmp_path / "covariance.npz").read_bytes()
    write_covariance(tmp_path / "covariance.npz", poses, lines)
    assert (tmp_path / "covariance.npz").read_bytes() == first
    write_covariance(tmp_path / "poses.npz", poses)
    assert sorted(read_npz(tmp_path / "poses.npz")) == ["image", "pose_covariance"]


def test_covariances_that_are_absent_or_without_their_chart_are_refused(tmp_path: Path) -> None:
    one = np.ones(1)
    with pytest.raises(InputError, match="expected poses or lines with a covariance, found none"):
        write_covariance(tmp_path / "c.npz", ImagePoses(("a",), Pose.identity(1)))
    with pytest.raises(InputError, match="needs the centre and scale of their charts"):
        write_covariance(
            tmp_path / "c.npz", None, Lines(("t",), np.ones((1, 2, 3)), np.array([3]), one, one, ("ok",), np.ones((1, 4, 4)))
        )
    assert not list(tmp_path.iterdir())
