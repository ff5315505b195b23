"""Unit and frame of a scene whose poses leave them open: metres by a known distance, z up, and nothing else changed by either."""

import itertools
import json
import math
import re
import shutil

import numpy as np
import pytest
import torch

import camera_models
from camera_models import Calibration, Pinhole
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose, rotation_from_vector
from omnilines.cli import main
from omnilines.commands.render_scene import render_scene
from omnilines.evaluation.scene import scene_scores
from omnilines.files import read_lines, read_poses, write_poses, write_segments
from omnilines.files.scene_folder import read_scene
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.pipelines import poses as _poses
from omnilines.pipelines.frame import (
    BY_PHOTOS,
    UNDECIDED,
    KnownDistance,
    distance_and_sigma,
    parse_known_distance,
    scene_frame,
)
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.pose_tables import has_open_scale, unit_of_file
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.posing.sfm import OPEN_SCALE
from omnilines.records import ImagePoses, LengthUnit, Lines
from omnilines.structure.families import line_families
from omnilines.structure.upright import agreed_up, vertical_family
from omnilines.synthetic.lines import room_world

VIEWS, SIZE, SEED = 6, (400, 400), 4
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


def framed(lines, poses, families, source, unit, known, verticals=(), stated_up=None):
    ups = np.reshape(verticals, (-1, 3))
    return scene_frame(
        lines, poses, families, source=source, unit=unit, stated_up=stated_up, known=known, verticals=lambda: ups,
        options=SceneOptions(),
    )  # fmt: skip


def found_by_sfm(room) -> PhotoPoses:
    """The true poses in another frame and unit, as structure from motion would give them."""
    true = read_poses(room / "poses.csv")
    away = Pose(rotation_from_vector(TURN), torch.tensor([0.3, 0.2, -0.1], dtype=torch.float64))
    covariance = np.broadcast_to(np.diag([1e-8] * 3 + [1e-6] * 3), (VIEWS, 6, 6)).copy()
    poses = moved_poses(ImagePoses(true.images, true.cam_from_world, true.cameras, covariance), 1 / UNIT_M, away)
    return PhotoPoses(poses, {}, (OPEN_SCALE,))


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
        patch.setattr(_poses, "sfm_poses", lambda *_, **__: found_by_sfm(room))
        assert call(room, folder / "scene", "--colmap", "--json") == 0
    return folder / "scene"


@pytest.mark.slow
def test_nothing_is_called_metres_where_the_scale_is_open(room, open_scene, capsys):
    capsys.readouterr()
    assert call(room, open_scene, "--colmap") == 0
    said = capsys.readouterr().out
    assert "units" in said and not re.search(r"[0-9] m\b|mm\b", said)
    assert call(room, open_scene, "--colmap", "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["length_unit"] == "units"
    page = (open_scene / "report.html").read_text(encoding="utf-8")
    plots = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.S)
    prose = re.sub(r"<(script|style)[^>]*>.*?</\1>", "", page, flags=re.S).replace("PHOTO:METRES gives metres", "")
    assert "Sigma across (1e-3 units)" in prose and any("x (units)" in plot for plot in plots)
    for text in (prose, *plots):
        assert not re.search(r"\((m|mm)\)|[0-9] mm?\b|metres", text)
    for name in ("lines.ply", "lines.obj", "colmap/lines.txt"):
        text = (open_scene / name).read_text()[:400]
        assert "units whose length in metres is not known" in text and ", metres" not in text
    assert camera_models.load(open_scene / "calibration.yaml").provenance["length_unit"] == "units"


@pytest.mark.slow
def test_a_trajectory_of_one_camera_gets_its_scale(room, tmp_path, capsys):
    """KITTI's rows, as SLAM with one camera would write them: in a unit of its own."""
    true = read_poses(room / "poses.csv")
    world_from_cam = true.cam_from_world.inverse()
    rows = torch.cat([world_from_cam.rotation, world_from_cam.translation[..., None] / UNIT_M], -1).reshape(VIEWS, 12)
    assert true.images == tuple(f"view{k:02d}.png" for k in range(VIEWS))
    trajectory = tmp_path / "trajectory.txt"
    np.savetxt(trajectory, rows.numpy())
    metres = float((world_from_cam.translation[4] - world_from_cam.translation[1]).norm())
    assert call(room, tmp_path / "scene", "--scale-from", f"view01,view04:{metres}", poses=str(trajectory)) == 0
    printed = capsys.readouterr()
    said = " ".join((printed.out + printed.err).split())
    assert "Lengths are metres by the" in said and "read as metres" not in said
    edges = read_true_edges(room / "truth.csv")
    scores = scene_scores(read_lines(tmp_path / "scene/lines.csv").ends_m, edges, read_stretches(room / "visibility.csv", edges))
    assert scores.lines > 50 and scores.precision[-1] > 0.9


def test_the_trajectory_of_a_rig_has_no_open_scale(tmp_path):
    trajectory = tmp_path / "trajectory.txt"
    trajectory.write_text("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    camera = Pinhole.from_mapping({"fx": 300.0, "fy": 300.0, "cx": 199.5, "cy": 149.5}, (400, 300))
    alone = Calibration({"cam0": camera})
    rig = Calibration({"cam0": camera, "cam1": camera}, rig={name: RigCamera(Pose.identity()) for name in ("cam0", "cam1")})
    assert has_open_scale(str(trajectory), alone, {"1.0.png": "cam0"})
    assert not has_open_scale(str(trajectory), rig, {"1.0.png": "cam0"})


@pytest.mark.slow
def test_a_scene_folder_stays_without_metres_when_it_is_adjusted(room, open_scene, tmp_path, capsys):
    assert unit_of_file(open_scene / "poses.csv") is LengthUnit.OPEN
    assert unit_of_file(room / "poses.csv") is LengthUnit.METRES
    arguments = ["adjust", "--calibration", open_scene / "calibration.yaml", "--poses", open_scene / "poses.csv"]
    arguments += ["--segments", open_scene / "segments.csv", "--refine", "lines", "--out", tmp_path]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in arguments])
    assert stopped.value.code == 0
    assert re.search(r"uncertainty of a line across it .* units\n", capsys.readouterr().out)
    assert camera_models.load(tmp_path / "calibration.yaml").provenance["length_unit"] == "units"


@pytest.mark.slow
def test_a_colmap_model_gives_poses_to_segments_as_its_table_does(open_scene, tmp_path, capsys):
    for verb, source in itertools.product(("adjust", "reconstruct"), ("poses.csv", "colmap")):
        arguments = [verb, "--calibration", open_scene / "calibration.yaml", "--poses", open_scene / source]
        arguments += ["--segments", open_scene / "segments.csv", "--refine", "lines", "--out", tmp_path / f"{verb}-{source}"]
        with pytest.raises(SystemExit) as stopped:
            main([str(item) for item in arguments])
        assert stopped.value.code == 0 and "scale the positions of the poses by it." in capsys.readouterr().out
        assert camera_models.load(tmp_path / f"{verb}-{source}/calibration.yaml").provenance["length_unit"] == "units"
    by_table, by_model = (read_lines(tmp_path / f"adjust-{source}/lines.csv") for source in ("poses.csv", "colmap"))
    assert by_model.tracks == by_table.tracks
    # Which end comes first is a matter of rounding.
    turned = np.linalg.norm(by_model.ends_m[:, 0] - by_table.ends_m[:, 0], axis=-1) > 1e-6
    ends = np.where(turned[:, None, None], by_model.ends_m[:, ::-1], by_model.ends_m)
    np.testing.assert_allclose(ends, by_table.ends_m, atol=1e-6)


def test_the_scene_stands_upright_with_x_along_its_walls(room, open_scene):
    """The rendered room has z up and its walls along x and y; the poses handed in were turned by an arbitrary rotation."""
    poses, true = read_poses(open_scene / "poses.csv"), read_poses(room / "poses.csv")
    turn = (poses.cam_from_world.rotation.mT @ true.cam_from_world.rotation).numpy()
    np.testing.assert_allclose(turn, np.broadcast_to(turn[0], turn.shape), atol=2e-3)
    np.testing.assert_allclose(turn[:, :, 2], np.broadcast_to([0.0, 0.0, 1.0], (VIEWS, 3)), atol=2e-3)
    assert np.abs(turn[:, 0, :2]).max(-1).min() > 1 - 1e-4
    # x to the right of the first photo.
    assert float(poses.cam_from_world.rotation[0, 0, 0]) > 0


@pytest.mark.slow
def test_a_known_distance_gives_metres(room, open_scene, tmp_path, capsys):
    true = read_poses(room / "poses.csv")
    metres = float((true.cam_from_world.centre[1] - true.cam_from_world.centre[4]).norm())
    shutil.copytree(open_scene / "work", tmp_path / "scene" / "work")
    # The poses that were found are kept in the folder: nothing is handed in here.
    assert call(room, tmp_path / "scene", "--scale-from", f"view01.png,view04:{metres!r}", "--json") == 0
    said = capsys.readouterr()
    data = json.loads(said.out)
    assert data["length_unit"] == "m" and "Lengths are metres by the" in said.err and "scale is not known" not in said.err
    poses, lines = read_poses(tmp_path / "scene" / "poses.csv"), read_lines(tmp_path / "scene" / "lines.csv")
    centres, open_lines = poses.cam_from_world.centre, read_lines(open_scene / "lines.csv")
    assert float((centres[1] - centres[4]).norm()) == pytest.approx(metres, rel=1e-9)
    scale = data["median_sigma_m"] / float(np.median(open_lines.sigma_m))
    assert scale == pytest.approx(UNIT_M, rel=2e-3)
    np.testing.assert_allclose(lines.ends_m, scale * open_lines.ends_m, atol=1e-9)
    with np.load(tmp_path / "scene" / "covariance.npz") as ours, np.load(open_scene / "covariance.npz") as open_:
        np.testing.assert_allclose(ours["line_covariance"], open_["line_covariance"], rtol=1e-6)
        np.testing.assert_allclose(ours["line_chart_scale_m"], scale * open_["line_chart_scale_m"], rtol=1e-9)
        unit = np.array([1.0] * 3 + [scale] * 3)
        np.testing.assert_allclose(ours["pose_covariance"], open_["pose_covariance"] * unit[:, None] * unit, rtol=1e-6)
    assert "metres, world frame" in (tmp_path / "scene" / "lines.ply").read_text()[:200]


@pytest.mark.parametrize(
    ("text", "poses", "sentence"),
    [
        ("view01.png,view09.png:2", "sfm", "name two of the photos"),
        ("view01.png,view01.png:2", "sfm", "name two of the photos"),
        ("view01.png,view02.png:0", "sfm", "distance above 0"),
        ("view01.png,view02.png:-1", "sfm", "distance above 0"),
        ("view01.png,view02.png:far", "sfm", "distance above 0"),
        ("view01.png:2", "sfm", "distance above 0"),
        ("view01.png,view02.png:2", "poses.csv", "found poses in metres"),
    ],
)
def test_bad_distances_are_refused_before_work_begins(room, tmp_path, capsys, text, poses, sentence):
    assert call(room, tmp_path / "scene", "--scale-from", text, poses=poses) == 2
    said = capsys.readouterr().err
    assert sentence in said and "\n" not in said.strip()
    assert not (tmp_path / "scene").exists()


def test_a_distance_to_a_photo_without_a_pose_is_refused(room, open_scene, tmp_path, capsys, monkeypatch):
    shutil.copytree(open_scene / "work", tmp_path / "work", ignore=shutil.ignore_patterns("poses*", "colmap"))
    posed = found_by_sfm(room)
    few = ImagePoses(posed.poses.images[1:], posed.poses.cam_from_world[1:], posed.poses.cameras[1:])
    lost = {"view00.png": "view00.png has no pose: it is dark."}
    monkeypatch.setattr(_poses, "sfm_poses", lambda *_, **__: PhotoPoses(few, lost))
    assert call(room, tmp_path, "--scale-from", "view00.png,view04.png:2") == 2
    assert "found view00.png: view00.png has no pose: it is dark. Name others." in capsys.readouterr().err
    assert not (tmp_path / "lines.csv").exists()


def a_scene(seed: int, lines: int = 60) -> tuple[Lines, ImagePoses]:
    """Lines of three directions at right angles in an arbitrary frame, and upright cameras that look at them."""
    rng = np.random.default_rng(seed)
    frame = rotation_from_vector(torch.tensor(rng.normal(size=3))).numpy()
    own = frame[:, np.arange(lines) % 3].T
    middle = rng.uniform(-2, 2, (lines, 3)) + 5.0
    ends = np.stack([middle - 0.5 * own, middle + 0.5 * own], 1)
    found = PlueckerLines.from_points(torch.from_numpy(ends[:, 0]), torch.from_numpy(ends[:, 1]))
    chart = LineChart.from_lines(found, torch.from_numpy(middle + rng.normal(size=(lines, 3))), torch.ones(lines).double())
    mix = 1e-3 * rng.normal(size=(lines, 4, 4))
    covariance = mix @ mix.transpose(0, 2, 1)
    scale, status = chart.scale.numpy(), ("ok",) * lines
    table = Lines(
        tuple(map(str, range(lines))), ends, np.full(lines, 4), scale, scale, status, covariance, chart.centre.numpy(), scale
    )
    # Cameras have y down; they lean by some degrees.
    level = np.stack([frame[:, 0], -frame[:, 2], frame[:, 1]])
    lean = rotation_from_vector(torch.from_numpy(0.1 * rng.normal(size=(5, 3))))
    rotation = lean @ torch.from_numpy(level)
    centre = torch.from_numpy(rng.uniform(-1, 1, (5, 3)))
    spread = 1e-2 * rng.normal(size=(5, 6, 6))
    pose = Pose(rotation, -(rotation @ centre[..., None])[..., 0])
    names = tuple(f"{k}.jpg" for k in range(5))
    return table, ImagePoses(names, pose, ("cam0",) * 5, spread @ spread.transpose(0, 2, 1))


def normals(lines: Lines, poses: ImagePoses, delta: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Unit normals (photos, lines, 3) of the planes of lines moved in their charts by delta, of poses perturbed by shift."""
    found = PlueckerLines.from_points(torch.from_numpy(lines.ends_m[:, 0]), torch.from_numpy(lines.ends_m[:, 1]))
    centre, scale = torch.from_numpy(lines.chart_centre_m), torch.from_numpy(lines.chart_scale_m)
    moved = LineChart.from_lines(found, centre, scale).retract(torch.from_numpy(delta))
    pose = Pose.exp(torch.from_numpy(shift)) @ poses.cam_from_world
    seen = torch.stack([moved.projection_normal(Pose(pose.rotation[[k]], pose.translation[[k]]))[0] for k in range(len(pose))])
    return (seen / seen.norm(dim=-1, keepdim=True)).numpy()


@pytest.mark.parametrize("seed", range(3))
def test_turning_and_scaling_keeps_reprojection_and_mahalanobis_distances(seed):
    """Steps of lines and poses that are as long in units of their covariances have the same images before and after."""
    lines, poses = a_scene(seed)
    known = KnownDistance("0.jpg", "3.jpg", 7.3)
    families = line_families(lines)
    frame = framed(lines, poses, families, "sfm", LengthUnit.OPEN, known)
    np.testing.assert_allclose(frame.poses.cam_from_world.rotation.mT.numpy()[:, 2, 1].mean(), -1, atol=0.1)
    assert frame.lines.unit is LengthUnit.METRES and distance_and_sigma(known, frame.poses)[0] == pytest.approx(7.3)
    rng = np.random.default_rng(seed)
    whitened = rng.normal(size=(len(lines), 4)), rng.normal(size=(len(poses), 6))

    def step(covariance, white):
        return (np.linalg.cholesky(covariance) @ white[..., None])[..., 0]

    scenes = [(lines, poses), (frame.lines, frame.poses)]
    none = [normals(*scene, np.zeros_like(whitened[0]), np.zeros_like(whitened[1])) for scene in scenes]
    moved = [
        normals(table, views, step(table.covariance, whitened[0]), step(views.covariance, whitened[1])) for table, views in scenes
    ]
    np.testing.assert_allclose(none[0], none[1], atol=1e-12)
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-12)
    assert np.abs(moved[0] - none[0]).max() > 1e-4
    # The families are those that would be found in the new frame; the vertical one is z, another is x.
    again = line_families(frame.lines)
    np.testing.assert_array_equal(again.family, frame.families.family)
    np.testing.assert_allclose(again.direction, frame.families.direction, atol=1e-9)
    np.testing.assert_allclose(again.covariance, frame.families.covariance, atol=1e-12)
    along = np.abs(frame.families.direction).max(0)
    assert along[2] == pytest.approx(1, abs=1e-9) and along[0] == pytest.approx(1, abs=1e-6)


def test_a_frame_that_was_given_is_left_and_a_scene_without_a_clear_vertical_says_so(tmp_path):
    lines, poses = a_scene(1)
    families = line_families(lines)
    given = framed(lines, poses, families, "colmap", LengthUnit.OPEN, None)
    np.testing.assert_array_equal(given.lines.ends_m, lines.ends_m)
    np.testing.assert_array_equal(given.poses.cam_from_world.rotation, poses.cam_from_world.rotation)
    # The report's view has the vertical family's direction up: -y of the cameras, about.
    ups = -poses.cam_from_world.rotation[:, 1].numpy() @ np.array(given.up)
    assert ups.min() > 0.9 and "units of the given poses" in given.notes[0]
    # Every photo lies on a side of its own: none of the three families is up.
    turns = torch.eye(3).double()[torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 1, 2], [1, 2, 0]])]
    rolled = Pose(turns @ poses.cam_from_world.rotation, poses.cam_from_world.translation)
    lying = framed(lines, ImagePoses(poses.images, rolled), families, "sfm", LengthUnit.METRES, None)
    assert "No family of parallel lines is clearly vertical" in lying.notes[-1]
    np.testing.assert_array_equal(lying.lines.ends_m, lines.ends_m)


def test_photos_tell_up_where_families_do_not():
    """By the vertical that each shows by itself, if most of them agree."""
    lines, poses = a_scene(1)
    families = line_families(lines)
    turns = torch.eye(3).double()[torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 1, 2], [1, 2, 0]])]
    rolled = ImagePoses(poses.images, Pose(turns @ poses.cam_from_world.rotation, poses.cam_from_world.translation))
    up = vertical_family(families, poses.cam_from_world).up
    seen = up + 2e-3 * np.random.default_rng(0).normal(size=(5, 3))
    seen[1] = families.direction[np.abs(families.direction @ up).argmin()]
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    frame = framed(lines, rolled, families, "sfm", LengthUnit.METRES, None, seen)
    assert frame.up == (0.0, 0.0, 1.0) and frame.notes == (BY_PHOTOS,)
    before, after = (scene.ends_m[:, 1] - scene.ends_m[:, 0] for scene in (lines, frame.lines))
    np.testing.assert_allclose(after[:, 2], before @ up, atol=4e-3 * np.abs(before).max())
    for disagreeing in (seen[:1], np.concatenate([seen[:2], -seen[:1]]), seen[1::-1]):
        frame = framed(lines, rolled, families, "sfm", LengthUnit.METRES, None, disagreeing)
        assert frame.notes == (UNDECIDED,) and (frame.lines.ends_m == lines.ends_m).all()


def test_up_is_that_of_lines_or_photos_whichever_is_known_better():
    lines, poses = a_scene(1)
    families = line_families(lines)
    by_lines = vertical_family(families, poses.cam_from_world)
    level = families.direction[np.abs(families.direction @ by_lines.up).argmin()]
    rng = np.random.default_rng(1)

    def up_with(sigma, tilted=0.0):
        seen = by_lines.up + tilted * level + sigma * rng.normal(size=(6, 3))
        seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
        return seen, framed(lines, poses, families, "sfm", LengthUnit.METRES, None, seen)

    def vertical(frame):
        return np.abs(frame.families.direction[by_lines.family])

    seen, frame = up_with(0.1 * by_lines.sigma_rad, 1e-3)
    assert agreed_up(seen).sigma_rad == pytest.approx(0.1 * by_lines.sigma_rad / np.sqrt(6), rel=0.7)
    assert 7e-4 < math.acos(vertical(frame)[2]) < 1.3e-3 and frame.notes == ()
    for seen, frame in (up_with(20 * by_lines.sigma_rad, 1e-3), up_with(0.1 * by_lines.sigma_rad, 0.2)):
        assert vertical(frame)[2] == pytest.approx(1, abs=1e-9), seen


def test_two_photos_lying_on_their_side_of_five_do_not_turn_the_scene():
    lines, poses = a_scene(2)
    roll = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rotation = poses.cam_from_world.rotation.clone()
    rotation[3:] = roll @ rotation[3:]
    families = line_families(lines)
    upright = vertical_family(families, poses.cam_from_world)
    rolled = vertical_family(families, Pose(rotation, poses.cam_from_world.translation))
    assert upright is not None and rolled is not None
    np.testing.assert_array_equal(upright.up, rolled.up)


@pytest.mark.slow
def test_what_is_up_in_a_scene_folder_stays_up_when_it_is_adjusted(tmp_path, capsys):
    world, up = room_world(1), [0.0, -0.6, 0.8]
    camera_models.save(tmp_path / "calibration.yaml", Calibration({"cam0": world.camera}, provenance={"up": up}))
    write_poses(tmp_path / "poses.csv", world.poses())
    write_segments(tmp_path / "segments.csv", world.segments(0.5, 0))
    arguments = ["adjust", "--calibration", tmp_path / "calibration.yaml", "--poses", tmp_path / "poses.csv", "--json"]
    arguments += ["--segments", tmp_path / "segments.csv", "--refine", "lines", "--out", tmp_path / "again"]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in arguments])
    assert stopped.value.code == 0 and json.loads(capsys.readouterr().out)["up"] == up
    assert list(read_scene(tmp_path / "again").up) == up


def test_what_is_up_is_taken_from_a_scene_where_no_family_tells_it():
    lines, poses = a_scene(2)
    none, stated = line_families(lines.rows(np.arange(0))), (0.0, -1.0, 0.0)
    assert framed(lines, poses, none, "table", LengthUnit.METRES, None).up == (0.0, 0.0, 1.0)
    assert framed(lines, poses, none, "table", LengthUnit.METRES, None, stated_up=stated).up == stated
    told = framed(lines, poses, line_families(lines), "table", LengthUnit.METRES, None, stated_up=stated).up
    assert told == framed(lines, poses, line_families(lines), "table", LengthUnit.METRES, None).up


def test_the_distance_is_known_as_well_as_the_poses_say():
    """The standard deviation of the distance of two centres against poses that are drawn from their covariances."""
    _, poses = a_scene(0)
    poses = ImagePoses(poses.images, poses.cam_from_world, poses.cameras, 1e-4 * poses.covariance)
    known = KnownDistance("1.jpg", "2.jpg", 1.0)
    _, sigma = distance_and_sigma(known, poses)
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(poses.covariance[[1, 2]])
    delta = torch.from_numpy((root @ rng.normal(size=(4000, 2, 6, 1)))[..., 0])
    drawn = (Pose.exp(delta) @ poses.cam_from_world[[1, 2]]).centre
    assert float((drawn[:, 0] - drawn[:, 1]).norm(dim=-1).std()) == pytest.approx(sigma, rel=0.05)


def test_a_distance_is_read_with_any_name_that_is_clear():
    photos = ["a/1.jpg", "b/2.jpg", "x,y.jpg"]
    assert parse_known_distance("a/1.jpg,2:2.5m", photos, scale_is_open=True) == KnownDistance("a/1.jpg", "b/2.jpg", 2.5)
    assert parse_known_distance("x,y,1.jpg:2", photos, scale_is_open=True) == KnownDistance("x,y.jpg", "a/1.jpg", 2.0)
