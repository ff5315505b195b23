"""The Oxford model house: read, rebuilt within its limits, named where it is malformed."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from camera_models import GeometryError, InputError
from omnilines.commands.experiment_house import experiment_house
from omnilines.costs import COSTS
from omnilines.files import read_lines, read_vgg_lines, read_vgg_points
from omnilines.files.vgg_house import MatchedPoints
from omnilines.studies.house import poses_of_matches
from omnilines.triangulation import TRIANGULATIONS

HOUSE = "lines/house"


def test_house_is_read_as_calibrated_cameras(shared_data: Path) -> None:
    house = read_vgg_lines(shared_data / HOUSE)
    assert len(house.poses) == 10 and len(house.segments.tracks) == 30
    rotation = house.poses.cam_from_world.rotation
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(10, dtype=torch.float64))
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(10, 3, 3))
    # The file's own 3D segments, mirrored like the world, project where P takes them.
    points = np.loadtxt(shared_data / HOUSE / "3D" / "house.l3d").reshape(-1, 3)
    mirrored = torch.as_tensor(points * [1, 1, -1])
    for k, (pose, camera) in enumerate(zip(range(10), house.cameras.values(), strict=True)):
        matrix = np.loadtxt(shared_data / HOUSE / "3D" / f"house.{k:03d}.P")
        projected = np.column_stack([points, np.ones(len(points))]) @ matrix.T
        pixels, _ = camera.project(house.poses.cam_from_world[pose].transform(mirrored))
        seen = projected[:, 2] > 0
        assert seen.sum() > 50
        np.testing.assert_allclose(pixels.numpy()[seen], projected[seen, :2] / projected[seen, 2:], atol=1e-6)


@pytest.mark.slow
def test_house_reaches_its_limits(shared_data: Path, tmp_path: Path) -> None:
    result = experiment_house(shared_data / HOUSE, tmp_path / "out")
    assert result.holds, [check for check in result.checks if not check.holds]
    data = json.loads(json.dumps(result.data, allow_nan=False))
    rows = {(row["stage"], row["method"]): row for row in data["rows"]}
    assert len(rows) == 2 * (len(TRIANGULATIONS) + 2) + len(COSTS)
    # The dissertation's figures rest on poses from the same point matches, by another method.
    for method, published_px in (("svd", 0.62), ("averaging", 0.63), ("dual, published weights", 0.85)):
        for stage in ("triangulation", "triangulation from matched points"):
            row = rows[stage, method]
            assert (row["lines"], row["published_rms_px"]) == (30, published_px)
            assert row["rms_px"] == pytest.approx(published_px, abs=0.035)
    assert rows["triangulation", "dual, published weights"]["rms_px"] == pytest.approx(0.88, abs=0.01)
    assert rows["triangulation", "svd"]["rms_px"] <= 0.65
    assert rows["adjustment", "sector"]["rms_px"] <= 0.435
    # Bartoli and Sturm's cost is the distance itself: no other has a smaller RMS.
    least = min(row["rms_px"] for (stage, _), row in rows.items() if stage == "adjustment")
    assert rows["adjustment", "bartoli-sturm"]["rms_px"] == pytest.approx(least, rel=1e-3)
    for row in rows.values():
        assert row["min_px"] < row["rms_px"] < row["max_px"]
        # RMS^2 = mean^2 + std^2.
        assert 0 < row["std_px"] < row["rms_px"]
    with open(tmp_path / "out" / "figures.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["method"] for row in table] == [row["method"] for row in data["rows"]]
    assert len(read_lines(tmp_path / "out" / "lines.csv").tracks) == 30


@pytest.mark.slow
def test_house_from_its_point_matches_stands_where_its_matrices_say(shared_data: Path) -> None:
    house, points = read_vgg_lines(shared_data / HOUSE), read_vgg_points(shared_data / HOUSE)
    assert len(np.unique(points.point)) == 672 and np.bincount(points.view).min() >= 100
    poses = poses_of_matches(house, points).cam_from_world
    given = house.poses.cam_from_world
    # The turntable's path is 8 units long; the matrices are another reconstruction of the same photos.
    path = float((given.centre[-1] - given.centre[0]).norm())
    assert float((poses.centre - given.centre).norm(dim=-1).max()) < 2e-3 * path
    assert float((poses.rotation - given.rotation).flatten(1).norm(dim=-1).max()) < 5e-3
    with pytest.raises(GeometryError, match="8 points"):
        poses_of_matches(house, MatchedPoints(points.view[:40], points.point[:40], points.pixels[:40]))


def test_a_malformed_house_is_named(shared_data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nview-lines"):
        read_vgg_lines(tmp_path)
    for name in ("2D", "3D"):
        (tmp_path / name).mkdir()
        for path in sorted((shared_data / HOUSE / name).iterdir()):
            (tmp_path / name / path.name).write_bytes(path.read_bytes())
    matches = tmp_path / "2D" / "house.nview-lines"
    good = matches.read_text()
    matches.write_text("9999 " + good)
    with pytest.raises(InputError, match="row 1: rows 0 to"):
        read_vgg_lines(tmp_path)
    matches.write_text("* " * 10)
    with pytest.raises(InputError, match="at least one match"):
        read_vgg_lines(tmp_path)
    matches.write_text(good)
    (tmp_path / "3D" / "house.003.P").write_text("1 0 0 0\n0 1 0 0\n1 1 0 0\n")
    with pytest.raises(InputError, match=r"house\.003\.P: a 3x4 matrix"):
        read_vgg_lines(tmp_path)
    (tmp_path / "3D" / "house.003.P").write_text("1 0 0\n")
    with pytest.raises(InputError, match=r"house\.003\.P: rows of 4"):
        read_vgg_lines(tmp_path)
    (tmp_path / "2D" / "house.004.lines").unlink()
    with pytest.raises((InputError, GeometryError), match="house"):
        read_vgg_lines(tmp_path)
