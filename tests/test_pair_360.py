"""A 360 degree camera from photos of a board: two lenses back to back that overlap only in a rim, their images in one file."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pair_360 import BOARDS, NAMES, mounts, write_boards, write_room
from rig_views import twin_lenses

from camera_models import Calibration, CameraModel, Equirectangular, load, save
from camera_models.blending import axis_from_rig
from camera_models.formats.calibration_data import RigCamera
from omnilines.cli import main
from omnilines.evaluation.scene import aligned_ends, scene_scores
from omnilines.files import read_lines, read_poses
from omnilines.files.levels import read_levels
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.scenes import build_scene, eye, render_photo, scene_poses


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def check_truth(out: Path, models: tuple[CameraModel, ...], most_px: float, most_deg: float, most_mm: float) -> None:
    """Where the lenses see what is up to 98 degrees off axis, and where the second stands."""
    found = load(out / "calibration.yaml")
    assert tuple(found.rig) == NAMES
    off = (found.rig["right"].cam_from_rig @ mounts()[1].inverse()).log()
    turned_deg, moved_mm = math.degrees(float(off[:3].norm())), 1e3 * float(off[3:].norm())
    theta, phi = np.meshgrid(np.radians(np.arange(2.0, 99.0, 4.0)), np.radians(np.arange(0.0, 360.0, 15.0)))
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    away_px = [
        np.linalg.norm(found[name].project(rays)[0] - truth.project(rays)[0], axis=-1).max()
        for name, truth in zip(NAMES, models, strict=True)
    ]
    print(f"largest error {max(away_px):.3f} px; turned by {turned_deg:.4f} degrees, moved by {moved_mm:.3f} mm")
    assert max(away_px) < most_px and turned_deg < most_deg and moved_mm < most_mm


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side_px", "frames", "limits"),
    [(400, 10, (0.2, 0.04, 0.15)), pytest.param(640, 40, (0.1, 0.02, 0.08), marks=pytest.mark.full)],
)
def test_both_lenses_are_calibrated_from_photos_that_hold_both(
    tmp_path: Path, side_px: int, frames: int, limits: tuple[float, float, float]
) -> None:
    models = twin_lenses("double-sphere", side_px)
    write_boards(tmp_path / "both", models, frames)
    out = tmp_path / "rig"
    given = ["calibrate", tmp_path / "both", "--split", ",".join(NAMES), "--pattern", BOARDS]
    assert run(*given, "--model", "double-sphere", "--out", out) == 0
    check_truth(out, models, *limits)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two instants of the room with both lenses in one image, the true rig, and what a panorama sees from between the lenses."""
    folder = tmp_path_factory.mktemp("room")
    models = twin_lenses("double-sphere", 400)
    write_room(folder / "both", models, 2, seed=1)
    save(
        folder / "rig.yaml",
        Calibration(dict(zip(NAMES, models, strict=True)), rig={name: RigCamera(mounts()[k]) for k, name in enumerate(NAMES)}),
    )
    scene = build_scene("room", 1)
    middle = axis_from_rig(models, mounts()) @ scene_poses(scene, 2, 1, models[0])
    for k in range(2):
        seen = render_photo(scene, eye(Equirectangular([], (512, 256)), math.pi), middle[k])
        cv2.imwrite(str(folder / f"seen{k}.png"), seen)
    return folder


def likeness(made: np.ndarray, seen: np.ndarray) -> float:
    """Correlation around the seams, which lie 90 degrees to the left and right; below, a hand's width of parallax shows."""
    rows = slice(40, 180)
    seams = np.r_[108:148, 364:404]
    first, second = (cv2.GaussianBlur(image[rows, seams].mean(-1), (0, 0), 1.0).ravel() for image in (made, seen))
    return float(np.corrcoef(first, second)[0, 1])


@pytest.mark.slow
def test_both_lenses_become_one_panorama(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Against photos rendered by a panoramic camera between the lenses."""
    given = ["rectify", room / "both", "--calibration", room / "rig.yaml", "--view", "panorama", "--size", "512x256"]
    likely = {}
    for distance in ("0.1", "2.5", None):
        out = tmp_path / f"out{distance}"
        more = [] if distance is None else ["--distance-m", distance]
        assert run(*given, "--split", ",".join(NAMES), *more, "--out", out) == 0
        assert "100.0 percent of the views" in capsys.readouterr().out
        made = [cv2.imread(str(out / f"view0{k}.png")) for k in range(2)]
        likely[distance] = [likeness(image, cv2.imread(str(room / f"seen{k}.png"))) for k, image in enumerate(made)]
    print(likely)
    assert min(likely["2.5"]) > 0.97 and np.mean(likely["2.5"]) > np.mean(likely[None]) > np.mean(likely["0.1"])
    folders = tmp_path / "outNone/frames"
    (folders / "right/view01.png").unlink()
    assert run("rectify", folders, *given[2:], "--out", tmp_path / "half") == 0
    whole, half = (cv2.imread(str(tmp_path / name / "view01.png")) for name in ("outNone", "half"))
    assert (whole[60:200, 200:300] == half[60:200, 200:300]).all()
    assert not half[60:200, :20].any() and whole[60:200, :20].any()
    assert run("rectify", folders / "left", *given[2:], "--distance-m", "0", "--out", tmp_path / "no") == 2
    assert "--distance-m was expected above 0" in " ".join(capsys.readouterr().err.split())


def test_lines_of_both_lenses_turn_the_panorama_level(room: Path, tmp_path: Path) -> None:
    given = ["rectify", room / "both", "--calibration", room / "rig.yaml", "--view", "panorama", "--size", "512x256"]
    assert run(*given, "--split", ",".join(NAMES), "--upright", "--out", tmp_path) == 0
    rows = read_levels(tmp_path / "upright.csv")
    assert [row.image for row in rows] == ["view00.png", "view01.png"]
    models = twin_lenses("double-sphere", 400)
    middle = axis_from_rig(models, mounts()) @ scene_poses(build_scene("room", 1), 2, 1, models[0])
    for row, rotation in zip(rows, middle.rotation.numpy(), strict=True):
        up = row.view_from_camera @ rotation[:, 2]
        assert np.abs(up - [0, -1, 0]).max() < 2e-3
        assert row.tilt_rad == pytest.approx(math.acos(-rotation[1, 2]), abs=2e-3) and row.arcs > 20


@pytest.mark.full
def test_recipe_from_photos_to_lines(tmp_path: Path) -> None:
    """docs/recipes.md: both lenses in every image, a board, then a room; against the edges of the room, in its metres."""
    models = twin_lenses("double-sphere", 640)
    write_boards(tmp_path / "board", models, 20)
    left, _ = write_room(tmp_path / "walk", models, 12, seed=1)
    left.save(tmp_path / "truth")
    split = ("--split", ",".join(NAMES))
    given = ["calibrate", tmp_path / "board", *split, "--pattern", BOARDS, "--model", "double-sphere"]
    assert run(*given, "--out", tmp_path / "camera") == 0
    camera = ("--calibration", tmp_path / "camera/calibration.yaml")
    assert run("reconstruct", tmp_path / "walk", *split, *camera, "--poses", "sfm", "--out", tmp_path / "scene") == 0
    lines, poses = read_lines(tmp_path / "scene/lines.csv"), read_poses(tmp_path / "scene/poses.csv")
    truth = read_poses(tmp_path / "truth/poses.csv")
    truth = replace(truth, images=tuple(f"left/{name}" for name in truth.images))
    assert len(poses) == 24
    ends = aligned_ends(lines.ends_m, poses, truth)
    edges = read_true_edges(tmp_path / "truth/truth.csv")
    scores = scene_scores(ends, edges, read_stretches(tmp_path / "truth/visibility.csv", edges))
    print(f"{scores.lines} lines; right at 10 mm {scores.precision[-1]:.3f}; edges found {scores.recall[-1]:.3f}")
    assert scores.precision[-1] > 0.85 and scores.recall[-1] > 0.6
    scale = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1) / np.linalg.norm(lines.ends_m[:, 1] - lines.ends_m[:, 0], axis=-1)
    assert abs(scale.mean() - 1.0) < 0.02
