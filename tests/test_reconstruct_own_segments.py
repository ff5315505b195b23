"""`omnilines reconstruct PHOTOS --segments`: a user's own segments are matched, and those of another detector give lines."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from camera_models import load
from omnilines.cli import main
from omnilines.commands.render_scene import render_scene
from omnilines.evaluation.scene import scene_scores
from omnilines.files import find_photos, read_lines, read_photo, read_segments, write_segments
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.records import Segments

VIEWS, SIZE = 12, (480, 480)
LEAST_PX = 13.0


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A rendered room through an ordinary lens, so that straight edges are straight segments, and LSD's table of them."""
    folder = tmp_path_factory.mktemp("room")
    render_scene(folder / "photos", views=VIEWS, size=SIZE, seed=11, model="pinhole", fov_deg=80.0)
    for name in ("calibration.yaml", "poses.csv", "truth.csv", "visibility.csv"):
        (folder / "photos" / name).rename(folder / name)
    write_segments(folder / "segments.csv", lsd(folder / "photos"))
    return folder


def lsd(photos):
    detector = cv2.createLineSegmentDetector()
    refs = find_photos([photos])
    found = [detector.detect(cv2.cvtColor(read_photo(ref.path), cv2.COLOR_BGR2GRAY))[0].reshape(-1, 2, 2) for ref in refs]
    found = [ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1) > LEAST_PX] for ends in found]
    image = np.repeat(np.arange(len(refs)), [len(ends) for ends in found])
    ends = np.concatenate(found).astype(np.float64)
    return Segments(image, tuple(ref.name for ref in refs), np.full(len(ends), -1), (), ends)


def call(room, out, *options, segments="segments.csv"):
    inputs = ["--calibration", room / "calibration.yaml", "--poses", room / "poses.csv", "--segments", room / segments]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in ["reconstruct", room / "photos", *inputs, "--out", out, *options]])
    return stopped.value.code


@pytest.mark.slow
def test_segments_of_another_detector_give_the_lines_of_the_room(room, tmp_path, capsys):
    assert call(room, tmp_path / "scene") == 0
    assert "states no noise" in capsys.readouterr().err
    lines, edges = read_lines(tmp_path / "scene" / "lines.csv"), read_true_edges(room / "truth.csv")
    found = scene_scores(lines.ends_m, edges, read_stretches(room / "visibility.csv", edges))
    # Our own arcs give 273 lines, 0.88 of them right; LSD has a bias of an eighth of a pixel, here 2 mm.
    assert len(lines) > 120
    assert found.precision[2] > 0.6
    used = read_segments(tmp_path / "scene" / "segments.csv")
    given = read_segments(room / "segments.csv")
    assert {tuple(row) for row in used.endpoints_px.reshape(-1, 4)} <= {tuple(row) for row in given.endpoints_px.reshape(-1, 4)}


@pytest.mark.slow
def test_stated_noise_is_used(room, tmp_path, capsys):
    table = read_segments(room / "segments.csv")
    write_segments(tmp_path / "stated.csv", replace(table, sigma_px=np.full(len(table), 0.3)))
    assert call(room, tmp_path / "scene", segments=tmp_path / "stated.csv") == 0
    assert "states no noise" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"tracks": ("edge",), "track": 0}, "an empty column track was expected"),
        ({"images": "other.png"}, "one of the 12 photos was expected, found the image other.png"),
        ({"cameras": "left"}, "the camera cam0 was expected"),
    ],
)
def test_a_table_that_does_not_belong_to_the_photos_is_refused(room, tmp_path, capsys, change, sentence):
    table = read_segments(room / "segments.csv")
    change = dict(change)
    if "track" in change:
        change["track"] = np.where(np.arange(len(table)) == 3, 0, -1)
    if "images" in change:
        change["images"] = (change["images"], *table.images[1:])
    if "cameras" in change:
        change["cameras"] = (change["cameras"],) * len(table.images)
    write_segments(tmp_path / "bad.csv", replace(table, **change))
    assert call(room, tmp_path / "scene", segments=tmp_path / "bad.csv") == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.slow
def test_photos_without_segments_are_skipped_and_a_mask_is_refused(room, tmp_path, capsys):
    table = read_segments(room / "segments.csv")
    rows = np.flatnonzero(table.image != 0)
    some = Segments(table.image[rows] - 1, table.images[1:], table.track[rows], (), table.endpoints_px[rows])
    write_segments(tmp_path / "some.csv", some)
    assert call(room, tmp_path / "scene", segments=tmp_path / "some.csv") == 0
    assert f"{table.images[0]} is skipped" in capsys.readouterr().err
    assert list(load(tmp_path / "scene" / "calibration.yaml")) == list(load(room / "calibration.yaml"))
    assert call(room, tmp_path / "scene", "--mask", str(room / "photos" / table.images[0])) == 2
    assert "--mask counts only without --segments" in capsys.readouterr().err
