"""`omnilines reconstruct PHOTOS`: a rendered room from photos to lines and what is kept between runs."""

import json
import re
import shutil

import numpy as np
import pytest
import torch
from reconstruct_call import call

from camera_models.pose import Pose
from camera_models.rotations import similarity_alignment
from omnilines.cli import main
from omnilines.commands.render_scene import render_scene
from omnilines.evaluation.scene import scene_scores
from omnilines.files import read_lines, read_poses, read_segments, write_poses
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.records import ImagePoses

VIEWS, SIZE, SEED = 8, (480, 480), 11
TABLES = ("calibration.yaml", "poses.csv", "truth.csv", "visibility.csv")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder `photos`, and its tables beside it."""
    folder = tmp_path_factory.mktemp("room")
    render_scene(folder / "photos", views=VIEWS, size=SIZE, seed=SEED)
    for name in TABLES:
        (folder / "photos" / name).rename(folder / name)
    return folder


@pytest.fixture(scope="module")
def rebuilt(room):
    """The room rebuilt once by the command line."""
    status = call(room / "photos", room, room / "scene", "--colmap", "--recording")
    assert status == 0
    return room / "scene"


def scores(room, lines):
    edges = read_true_edges(room / "truth.csv")
    return scene_scores(lines.ends_m, edges, read_stretches(room / "visibility.csv", edges))


@pytest.mark.slow
def test_lines_lie_on_the_edges_of_the_room(room, rebuilt):
    lines = read_lines(rebuilt / "lines.csv")
    found = scores(room, lines)
    assert len(lines) > 60
    # Weak are those that rest on one photo beside others of one place.
    assert set(lines.status) <= {"ok", "weak"} and lines.status.count("ok") > 0.85 * len(lines)
    # Three where all of their arcs agree.
    assert (lines.views >= 3).all() and (lines.views >= 4).mean() > 0.5
    # A pixel is 7 mm a metre away. Eight such rooms: 0.73 to 0.82, 2.0 to 4.7 mm.
    assert found.precision[2] > 0.7
    assert found.median_error_m < 0.005
    assert found.direction_deg(50) < 0.3
    assert found.repeated_share < 0.05


def test_what_is_stated_of_a_line_explains_its_error(room, rebuilt):
    lines = read_lines(rebuilt / "lines.csv")
    edges = read_true_edges(room / "truth.csv").ends_m
    found = scores(room, lines)
    along = edges[found.edge, 1] - edges[found.edge, 0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.linalg.norm(np.cross(lines.ends_m - edges[found.edge, :1], along[:, None]), axis=-1).max(-1)
    on_edge = across < 0.02
    assert on_edge.sum() > 50
    # sigma_m is the largest standard deviation of either end: two dimensions across, the worse of two ends.
    assert (across[on_edge] < 3.0 * lines.sigma_m[on_edge]).mean() > 0.75


@pytest.mark.slow
def test_uncertain_lines_are_guided_by_families_planes_and_corners_unless_told_otherwise(room, rebuilt, tmp_path):
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    no_corners = [word for what in ("corners", "planes") for word in ("--set", f"scene.kept_lines.guided_by_{what}=false")]
    assert call(room / "photos", room, tmp_path / "scene", *no_corners) == 0
    guided = read_lines(tmp_path / "scene" / "lines.csv")
    assert call(room / "photos", room, tmp_path / "scene", *no_corners, "--set", "scene.kept_lines.guided_by_families=false") == 0
    cornered, measured = (read_lines(folder / "lines.csv") for folder in (rebuilt, tmp_path / "scene"))
    assert cornered.tracks == guided.tracks == measured.tracks
    assert np.median(cornered.sigma_m) < np.median(guided.sigma_m)
    corners, families = scores(room, cornered), scores(room, guided)
    assert all(one >= other for one, other in zip(corners.precision, families.precision, strict=True))
    assert corners.recall[0] > 1.1 * families.recall[0] and np.mean(corners.error_m) < np.mean(families.error_m)
    assert np.all(guided.sigma_m <= measured.sigma_m * 1.001) and np.any(guided.sigma_m < 0.8 * measured.sigma_m)
    assert families.precision[0] >= scores(room, measured).precision[0]


def test_the_scene_folder_is_whole(rebuilt):
    lines, segments = read_lines(rebuilt / "lines.csv"), read_segments(rebuilt / "segments.csv")
    assert set(segments.tracks) <= set(lines.tracks)
    rows = [segments.track == segments.tracks.index(name) for name in lines.tracks[:20]]
    seen = [len(np.unique(segments.image[own])) for own in rows]
    assert min(seen) >= 3
    for name in ("report.html", "lines.ply", "lines.obj", "covariance.npz", "poses.csv", "scene.rrd", "colmap/lines.txt"):
        assert (rebuilt / name).stat().st_size > 0
    with np.load(rebuilt / "covariance.npz") as kept:
        assert tuple(kept["track"]) == lines.tracks
    assert "Stages" in (rebuilt / "report.html").read_text()


def test_adjust_reads_the_scene_folder(rebuilt, tmp_path, capsys):
    arguments = ["adjust", "--calibration", rebuilt / "calibration.yaml", "--poses", rebuilt / "poses.csv"]
    arguments += [
        "--segments",
        rebuilt / "segments.csv",
        "--refine",
        "lines",
        "--cost",
        "whitened",
        "--out",
        tmp_path / "again",
        "--json",
    ]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in arguments])
    assert stopped.value.code == 0
    data = json.loads(capsys.readouterr().out)
    assert data["rms_px"] < 0.5
    assert data["tracks"] == len(read_lines(rebuilt / "lines.csv"))


@pytest.mark.slow
def test_a_second_run_does_nothing_and_a_changed_one_only_what_changed(room, rebuilt, capsys):
    lines, report = (rebuilt / "lines.csv").read_bytes(), (rebuilt / "report.html").stat().st_mtime_ns
    capsys.readouterr()
    assert call(room / "photos", room, rebuilt, "--colmap", "--recording", "--json") == 0
    said = capsys.readouterr()
    assert "nothing was done" in said.err
    assert (rebuilt / "report.html").stat().st_mtime_ns == report
    again = json.loads(said.out)
    assert again["lines"] == len(read_lines(rebuilt / "lines.csv"))
    assert f"{again['lines']} lines from {VIEWS} photos" in again["verdict"] and again["advice"] and len(again["notes"]) > 1
    assert call(room / "photos", room, rebuilt, "--colmap", "--recording") == 0
    shown = capsys.readouterr().out
    assert again["verdict"] in shown and f"Next: omnilines export {rebuilt} lines.dxf" in shown
    kept = {path.name: path.stat().st_mtime_ns for path in (rebuilt / "work" / "arcs").iterdir()}
    assert len(kept) == VIEWS
    (rebuilt / "lines.csv").write_bytes(b"")
    assert call(room / "photos", room, rebuilt, "--colmap", "--recording") == 0
    assert (rebuilt / "lines.csv").read_bytes() == lines
    assert {path.name: path.stat().st_mtime_ns for path in (rebuilt / "work" / "arcs").iterdir()} == kept


@pytest.mark.full
def test_lines_of_three_photos_are_kept_where_a_corner_confirms_them(room, rebuilt, tmp_path, capsys):
    """The others stay as they are; those that are added follow them, and are right."""
    held = [*(f"guided_by_{what}=false" for what in ("families", "planes", "corners")), "min_lying=1"]
    measured = [f"scene.kept_lines.{what}" for what in held]
    found = []
    for least in (1.0, 0.8):
        out = tmp_path / f"{least}"
        shutil.copytree(rebuilt / "work", out / "work")
        options = [word for one in (*measured, f"scene.kept_lines.min_meeting={least}") for word in ("--set", one)]
        assert call(room / "photos", room, out, *options, "--json") == 0
        found.append((read_lines(out / "lines.csv"), json.loads(capsys.readouterr().out)["stages"]))
    (without, before), (lines, stages) = found
    assert [one["stage"] for one in stages[-2:]] == ["lines", "lines, with confirmed ones of one photo fewer"]
    assert before == stages[:-1] and stages[-2]["kept"] == len(without) < stages[-1]["kept"] == len(lines)
    assert lines.tracks[: len(without)] == without.tracks and (lines.views[len(without) :] == 3).all()
    np.testing.assert_array_equal(lines.ends_m[: len(without)], without.ends_m)
    assert scores(room, lines).recall[2] >= scores(room, without).recall[2]
    assert scores(room, lines).precision[2] > scores(room, without).precision[2] - 0.01


@pytest.mark.full
def test_lines_of_which_photos_show_little_are_left_out_where_that_is_asked(room, rebuilt, tmp_path, capsys):
    """All others stay as they are; without guidance, which lines that are left out would change."""
    guided = [f"guided_by_{what}=false" for what in ("families", "planes", "corners")]
    held = [f"scene.kept_lines.{what}" for what in (*guided, "min_meeting=1", "min_lying=1")]
    found = []
    for least in (0.0, 0.6):
        out = tmp_path / f"{least}"
        shutil.copytree(rebuilt / "work", out / "work")
        options = [word for one in (*held, f"scene.kept_lines.min_shown_share={least}") for word in ("--set", one)]
        assert call(room / "photos", room, out, *options, "--json") == 0
        found.append((read_lines(out / "lines.csv"), json.loads(capsys.readouterr().out)["stages"][-1]))
    (every, _), (some, stage) = found
    assert (every.shown_share > 0).all() and (every.shown_share <= 1).all()
    kept = every.shown_share >= 0.6
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(some.ends_m, every.ends_m[kept])
    np.testing.assert_array_equal(some.shown_share, every.shown_share[kept])
    assert "photos that look there show too little of them" in json.dumps(stage)


@pytest.mark.slow
def test_lines_that_are_likely_there_by_chance_are_left_out(room, rebuilt, tmp_path, capsys):
    """With a lower limit those above it go, and all others stay as they are."""
    lines = read_lines(rebuilt / "lines.csv")
    assert "Chance (%)" in (rebuilt / "report.html").read_text()
    confirmed = np.isnan(lines.chance_share)
    assert (lines.views[confirmed] >= 3).all() and np.median(lines.views[confirmed]) == 3
    assert 0.0 < np.nansum(lines.chance_share) < 0.15 * len(lines)
    guided = [f"guided_by_{what}=false" for what in ("families", "planes", "corners")]
    held = [f"scene.kept_lines.{what}" for what in (*guided, "min_meeting=1", "min_lying=1")]
    found = []
    least = float(np.nanquantile(lines.chance_share, 0.9))
    for most in (1.0, least):
        out = tmp_path / f"{most}"
        shutil.copytree(rebuilt / "work", out / "work")
        options = [word for one in (*held, f"scene.kept_lines.max_chance_share={most}") for word in ("--set", one)]
        assert call(room / "photos", room, out, *options, "--json") == 0
        found.append((read_lines(out / "lines.csv"), json.loads(capsys.readouterr().out)))
    (every, before), (some, after) = found
    kept = every.chance_share <= least
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(some.ends_m, every.ends_m[kept])
    np.testing.assert_array_equal(some.chance_share, every.chance_share[kept])
    assert "nearly as many like them are found where photos are moved" in json.dumps(after["stages"][-1])
    assert before["lines_by_chance"] == pytest.approx(every.chance_share.sum(), abs=1e-6)


@pytest.mark.slow
def test_poses_of_a_colmap_model_give_the_same_lines(room, rebuilt, tmp_path):
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    model = tmp_path / "colmap"
    model.mkdir()
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        shutil.copy(rebuilt / "colmap" / name, model)
    assert call(room / "photos", room, tmp_path / "scene", poses=str(model)) == 0
    first, second = (read_lines(folder / "lines.csv") for folder in (rebuilt, tmp_path / "scene"))
    assert len(first) == len(second)
    # The last digits of the poses decide in which order lines of as many arcs come, and which end is the first.
    distance = np.abs(first.ends_m[:, None] - second.ends_m[None]).max((-2, -1))
    turned = np.abs(first.ends_m[:, None] - second.ends_m[None, :, ::-1]).max((-2, -1))
    nearest = np.minimum(distance, turned)
    assert (nearest.min(1) < 1e-6 + 1e-4 * first.sigma_m).all() and np.median(nearest.min(1)) < 1e-6
    assert sorted(nearest.argmin(1).tolist()) == list(range(len(first)))


@pytest.mark.slow
def test_poses_that_are_off_are_refined(room, rebuilt, tmp_path):
    poses = read_poses(room / "poses.csv")
    rng = np.random.default_rng(3)
    turn = np.concatenate([np.radians(0.1) * rng.standard_normal((VIEWS, 3)), 0.003 * rng.standard_normal((VIEWS, 3))], -1)
    write_poses(
        tmp_path / "poses.csv", ImagePoses(poses.images, Pose.exp(torch.as_tensor(turn)) @ poses.cam_from_world, poses.cameras)
    )
    shutil.copy(room / "calibration.yaml", tmp_path)
    shutil.copytree(rebuilt / "work", tmp_path / "refined" / "work")
    assert call(room / "photos", tmp_path, tmp_path / "refined", "--refine", "lines,poses") == 0
    # Up to the similarity that lines leave free. 3 mm and 0.1 degrees along each axis are 4 mm and 0.2 degrees in all.
    given, refined = (read_poses(path / "poses.csv") for path in (tmp_path, tmp_path / "refined"))
    before_m, after_m = (off_m(found, poses) for found in (given, refined))
    assert before_m > 0.003 and after_m < 0.25 * before_m


@pytest.mark.full
def test_photos_without_a_pose_are_placed_by_the_lines_of_the_others(room, rebuilt, tmp_path, capsys):
    """Two have none, and that of a third is wrong by a degree and 5 cm."""
    poses = read_poses(room / "poses.csv")
    given, lost = poses.cam_from_world[2:], poses.images[:2]
    wrong = torch.tensor([[np.radians(1.0), 0.0, 0.0, 0.05, 0.0, 0.0]], dtype=torch.float64)
    given = Pose.stack([*given[:-1], (Pose.exp(wrong) @ given[-1:])[0]])
    write_poses(tmp_path / "poses.csv", ImagePoses(poses.images[2:], given, ("cam0",) * (VIEWS - 2)))
    shutil.copy(room / "calibration.yaml", tmp_path)
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    assert call(room / "photos", tmp_path, tmp_path / "scene", "--refine", "lines,poses") == 0
    assert f"{lost[0]}, {lost[1]} had no pose and were placed by the lines of other photos." in capsys.readouterr().err
    found = read_poses(tmp_path / "scene" / "poses.csv")
    assert set(found.images) == set(poses.images)
    rows = [poses.images.index(name) for name in found.images]
    truth = ImagePoses(found.images, poses.cam_from_world[rows])
    assert off_m(found, truth) < 0.002


@pytest.mark.slow
def test_a_photo_whose_pose_no_line_confirms_is_named(room, rebuilt, tmp_path, capsys):
    """Poses are held: that of one photo is wrong by 40 degrees."""
    poses = read_poses(room / "poses.csv")
    turn = torch.tensor([[0.0, np.radians(40.0), 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    given = Pose.stack([(Pose.exp(turn) @ poses.cam_from_world[:1])[0], *poses.cam_from_world[1:]])
    write_poses(tmp_path / "poses.csv", ImagePoses(poses.images, given, ("cam0",) * VIEWS))
    shutil.copy(room / "calibration.yaml", tmp_path)
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    assert call(room / "photos", tmp_path, tmp_path / "scene", "--tolerance-px", "0.1") == 0
    said = capsys.readouterr().out
    assert "- Lines explain few of the arcs of view00.png (" in said and "view01.png" not in said
    assert "Lines explain few of the arcs of view00.png (" in (tmp_path / "scene" / "report.html").read_text()


@pytest.mark.full
def test_a_pose_that_is_a_little_off_is_said_to_be_at_fault(room, rebuilt, tmp_path, capsys):
    """Poses are held: that of one photo is wrong by 3 degrees. Of the eight photos seven are named, each by itself; lines of the
    other, view03, explain enough of it by chance."""
    poses = read_poses(room / "poses.csv")
    turn = torch.tensor([[0.0, np.radians(3.0), 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    given = Pose.stack([*poses.cam_from_world[:5], (Pose.exp(turn) @ poses.cam_from_world[5:6])[0], *poses.cam_from_world[6:]])
    write_poses(tmp_path / "poses.csv", ImagePoses(poses.images, given, ("cam0",) * VIEWS))
    shutil.copy(room / "calibration.yaml", tmp_path)
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    assert call(room / "photos", tmp_path, tmp_path / "scene", "--tolerance-px", "0.1", "--json") == 0
    said = capsys.readouterr()
    wrong = json.loads(said.out)["advice"][0]
    named = re.fullmatch(
        r"The lines of the other photos put view05.png \((\S+) degrees and (\S+) m from its pose\) elsewhere.", wrong["limit"]
    )
    assert named and 2.7 < float(named[1]) < 3.3 and float(named[2]) < 0.05
    assert "--refine lines,poses" in wrong["do"] and "view0" not in said.err
    counts = {photo["image"]: photo for photo in json.loads(said.out)["arcs"]}
    assert counts["view05.png"]["share"] < 0.5 * min(one["share"] for name, one in counts.items() if name != "view05.png")
    for one in counts.values():
        stages = [one[stage] for stage in ("arcs", "matched", "confirmed", "in_enough", "in_tracks", "in_lines")]
        assert stages == sorted(stages, reverse=True) and one["share"] == pytest.approx(one["in_lines"] / one["arcs"])
    assert "Arcs of every photo" in (tmp_path / "scene" / "report.html").read_text()


@pytest.mark.slow
def test_a_photo_of_another_room_is_told_from_one_with_a_wrong_pose(room, rebuilt, tmp_path, capsys):
    """Its pose is as good as any, but what it shows no other photo does."""
    shutil.copytree(room / "photos", tmp_path / "photos")
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    render_scene(tmp_path / "other", scene="plain-room", views=1, size=SIZE, seed=SEED + 1)
    shutil.copy(tmp_path / "other" / "view00.png", tmp_path / "photos" / "view03.png")
    assert call(tmp_path / "photos", room, tmp_path / "scene", "--tolerance-px", "0.1") == 0
    said = capsys.readouterr().out
    assert "- Lines explain few of the arcs of view03.png (" in said and "elsewhere" not in said
    near = re.search(r"Take photos between view03.png and (view\d\d.png)", said)
    poses = read_poses(room / "poses.csv")
    away = (poses.cam_from_world.centre - poses.cam_from_world.centre[3]).norm(dim=-1)
    assert near and near[1] == poses.images[int(away.argsort()[1])]


def off_m(found: ImagePoses, truth: ImagePoses) -> float:
    """Mean distance of the camera centres from the true ones after the best similarity."""
    centres, true = found.cam_from_world.centre, truth.cam_from_world.centre
    scale, turn = similarity_alignment(centres, true)
    return float((turn.transform(scale * centres) - true).norm(dim=-1).mean())


@pytest.mark.slow
def test_a_bad_photo_is_skipped_and_a_photo_without_pose_is_named(room, rebuilt, tmp_path, capsys):
    shutil.copytree(room / "photos", tmp_path / "photos")
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    (tmp_path / "photos" / "broken.png").write_bytes(b"no photo")
    shutil.copy(tmp_path / "photos" / "view00.png", tmp_path / "photos" / "extra.png")
    assert call(tmp_path / "photos", room, tmp_path / "scene") == 0
    said = capsys.readouterr().err
    assert "broken.png is skipped" in said
    assert "extra.png has no pose: it is not in poses.csv." in said
    assert len(read_lines(tmp_path / "scene" / "lines.csv")) == len(read_lines(rebuilt / "lines.csv"))


@pytest.mark.slow
def test_no_lines_comes_with_the_stage_and_the_reason(room, rebuilt, tmp_path, capsys):
    poses = read_poses(room / "poses.csv")
    order = np.random.default_rng(5).permutation(VIEWS)
    swapped = tuple(poses.images[k] for k in order[:3])
    write_poses(tmp_path / "poses.csv", ImagePoses(swapped, poses.cam_from_world[:3], ("cam0",) * 3))
    shutil.copy(room / "calibration.yaml", tmp_path)
    shutil.copytree(rebuilt / "work", tmp_path / "scene" / "work")
    assert call(room / "photos", tmp_path, tmp_path / "scene", "--min-views", "4") == 2
    said = capsys.readouterr().err
    assert "No line was found" in said and "Traceback" not in said
    assert f"Of {VIEWS} photos, 3 have poses:" in said
    assert set(read_poses(tmp_path / "scene" / "work" / "poses.csv").images) == set(swapped)
    assert not (tmp_path / "scene" / "lines.csv").exists()
