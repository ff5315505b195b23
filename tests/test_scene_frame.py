"""Unit and frame of a scene whose poses leave them open: metres by a known distance, z up, and nothing else changed by either."""

import json
import math
import re
import shutil

import numpy as np
import pytest
import torch

import camera_models
from camera_models import InputError
from camera_models.pose import Pose, rotation_from_vector
from omnilines.cli import main
from omnilines.commands import _photo_poses
from omnilines.commands._scene_frame import (
    KnownDistance,
    distance_and_sigma,
    moved_lines,
    parse_known_distance,
    scene_frame,
    unit_of_table,
)
from omnilines.commands.render_scene import render_scene
from omnilines.files import read_lines, read_poses, write_poses
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.records import ImagePoses, LengthUnit, Lines
from omnilines.structure.families import line_families

VIEWS, SIZE, SEED = 8, (480, 480), 4
UNIT_M = 1.7
"""Length in metres of the unit of the poses that are handed in for those of structure from motion."""
TURN = torch.tensor([0.9, -0.4, 0.3], dtype=torch.float64)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder `photos`, and its tables beside it."""
    folder = tmp_path_factory.mktemp("room")
    render_scene(folder / "photos", scene="plain-room", views=VIEWS, size=SIZE, seed=SEED)
    for name in ("calibration.yaml", "poses.csv", "truth.csv", "visibility.csv"):
        (folder / "photos" / name).rename(folder / name)
    return folder


def found_by_sfm(room) -> PhotoPoses:
    """The true poses in another frame and unit, as structure from motion would give them."""
    true = read_poses(room / "poses.csv")
    away = Pose(rotation_from_vector(TURN), torch.tensor([0.3, 0.2, -0.1], dtype=torch.float64))
    covariance = np.broadcast_to(np.diag([1e-8] * 3 + [1e-6] * 3), (VIEWS, 6, 6)).copy()
    poses = moved_poses(ImagePoses(true.images, true.cam_from_world, true.cameras, covariance), 1 / UNIT_M, away)
    return PhotoPoses(poses, {}, ("The scale is not known: some unit.",))


def call(room, out, *options, poses="sfm", photos=None):
    source = str(room / poses) if poses.endswith(".csv") else poses
    arguments = ["reconstruct", photos or room / "photos", "--calibration", room / "calibration.yaml", "--poses", source]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in (*arguments, "--out", out, *options)])
    return stopped.value.code


@pytest.fixture(scope="module")
def open_scene(room, tmp_path_factory):
    """The scene folder of poses whose unit is open, what was printed, and what was noted."""
    folder = tmp_path_factory.mktemp("open")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_photo_poses, "sfm_poses", lambda *_, **__: found_by_sfm(room))
        assert call(room, folder / "scene", "--colmap", "--json") == 0
    return folder / "scene"


def test_nothing_is_called_metres_where_the_scale_is_open(room, open_scene, capsys):
    capsys.readouterr()
    assert call(room, open_scene, "--colmap") == 0
    said = capsys.readouterr().out
    assert "units" in said and not re.search(r"[0-9] m\b|mm\b", said)
    assert call(room, open_scene, "--colmap", "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["length_unit"] == "units"
    page = (open_scene / "report.html").read_text(encoding="utf-8")
    page = (
        page[: page.index("/**\n* plotly.js")]
        if "/**\n* plotly.js" in page
        else re.sub(r"<script>.*?</script>", "", page, flags=re.S)
    )
    assert "units" in page and not re.search(r"\((m|mm)\)|[0-9] mm?\b|metres", page.replace("PHOTO:METRES gives metres", ""))
    for name in ("lines.ply", "lines.obj", "colmap/lines.txt"):
        head = (open_scene / name).read_text()[:400]
        assert "units whose length in metres is not known" in head and ", metres" not in head
    assert camera_models.load(open_scene / "calibration.yaml").provenance["length_unit"] == "units"
    assert unit_of_table(open_scene / "poses.csv") is LengthUnit.OPEN
    assert unit_of_table(room / "poses.csv") is LengthUnit.METRES
