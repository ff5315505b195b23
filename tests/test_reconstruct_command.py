"""`omnilines reconstruct` and `adjust` from a user's own files: what can be refined, robust tracks, priors, and bad requests."""

import json

import numpy as np
import pytest
import torch
from rig_scene import RigScene, disturbed, moved_models

import camera_models
from camera_models import Calibration, InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.adjustment.arcs import cameras_of_images
from omnilines.cli import main
from omnilines.files import read_lines, read_poses, write_poses, write_segments
from omnilines.records import ImagePoses, Segments

NOISE_PX = 0.2


def write_scene(folder, scene, *, models=None, poses=None, wrong=0, rig=True, seed=0):
    """The three files of a user; `wrong` observations get the pixels of another line in the same photo."""
    rng = np.random.default_rng(seed)
    names = [f"cam{k}" for k in range(len(scene.models))]
    mounts = {name: RigCamera(scene.rig.cam_from_rig[k]) for k, name in enumerate(names)} if rig else {}
    camera_models.save(
        folder / "calibration.yaml", Calibration(dict(zip(names, models or scene.models, strict=True)), rig=mounts)
    )
    frame, camera = scene.rig.frame.tolist(), scene.rig.camera.tolist()
    images = tuple(f"{names[c]}/{f:03d}.png" for f, c in zip(frame, camera, strict=True))
    frames = tuple(str(f) for f in frame) if rig else None
    cameras = tuple(names[c] for c in camera)
    write_poses(folder / "poses.csv", ImagePoses(images, poses or scene.cam_from_world, cameras, None, frames))
    pixels = scene.pixels.numpy() + NOISE_PX * rng.standard_normal(scene.pixels.shape)
    image, track = scene.image.numpy(), scene.track.numpy()
    chosen = np.zeros(0, int)
    if wrong:
        often = np.flatnonzero(np.bincount(track)[track] >= 8)
        chosen = rng.permutation(often)[:wrong]
        for row in chosen:
            others = np.flatnonzero((image == image[row]) & (track != track[row]))
            pixels[row] = scene.pixels[rng.choice(others)].numpy()
    tracks = tuple(f"t{k}" for k in range(len(scene.ends)))
    write_segments(folder / "segments.csv", Segments(image, images, track, tracks, pixels, np.full(len(image), NOISE_PX)))
    return images, {(tracks[track[k]], images[image[k]]) for k in chosen}


def run(capsys, verb, folder, *options):
    files = [
        item
        for name in ("calibration.yaml", "poses.csv", "segments.csv")
        for item in (f"--{name[:-4].rstrip('.')}", folder / name)
    ]
    arguments = [verb, *files, *options, "--out", folder / "out", "--json"]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in arguments])
    status, out = stopped.value.code, capsys.readouterr()
    return status, json.loads(out.out) if status == 0 else None, out.err


def distances(folder, scene):
    """Largest distance of the true ends from each line of the table."""
    lines = read_lines(folder / "out/lines.csv")
    first, second = lines.ends_m[:, :1], lines.ends_m[:, 1:]
    along = second - first
    off = scene.ends.numpy()[[int(track[1:]) for track in lines.tracks]] - first
    return (np.linalg.norm(np.cross(off, along), axis=-1) / np.linalg.norm(along, axis=-1)).max(-1)


@pytest.mark.slow
def test_cameras_are_refined_and_written_with_their_uncertainty(tmp_path, capsys):
    scene = RigScene(frames=12, lines=60)
    write_scene(tmp_path, scene, models=moved_models(scene.models), poses=disturbed(scene.cam_from_world, 0.2, 0.01), rig=False)
    status, data, _ = run(capsys, "adjust", tmp_path, "--refine", "lines,poses,intrinsics", "--cost", "whitened")
    assert status == 0 and data["outcome"] == "converged"
    stored = camera_models.load(tmp_path / "out/calibration.yaml")
    for name, true in zip(stored, scene.models, strict=True):
        sigma = np.array(list(stored.estimates[name].sigma.values()))
        error = (stored[name].parameters - true.parameters).numpy()
        free = sigma > 0
        assert free.sum() >= 8 and np.abs(error[free] / sigma[free]).max() < 4.5
        assert data["cameras"][name] == pytest.approx(stored[name].named_parameters())


@pytest.mark.parametrize(
    ("own", "posed", "said"),
    [
        (
            "x",
            "a",
            "Photo 0 needs one of the cameras a, b of the calibration, found camera 'x'; correct the camera column of segm",
        ),
        ("a", "x", "needs one of the cameras a, b of the calibration, found camera 'x'; correct the camera column of poses.csv"),
        ("a", "b", "Photo 0 was expected to be of one camera, found 'a' in segments.csv and 'b' in poses.csv; correct the one"),
        (None, None, "found no camera; fill the camera column of poses.csv"),
    ],
)
def test_the_table_that_names_a_wrong_camera_is_named(own, posed, said):
    cameras = dict(zip("ab", RigScene(frames=1, lines=1).models, strict=False))
    segments = Segments(np.zeros(1, int), ("0",), np.zeros(1, int), ("t",), np.zeros((1, 2, 2)), cameras=own and (own,))
    with pytest.raises(InputError, match=said):
        cameras_of_images(segments, ImagePoses(("0",), Pose.identity(1), posed and (posed,)), cameras)
    if own != "x":
        assert cameras_of_images(segments, None, {"a": cameras["a"]}) == ["a"]


@pytest.mark.slow
def test_rig_is_refined_and_written(tmp_path, capsys):
    scene = RigScene(frames=10, lines=50)
    true = scene.rig.cam_from_rig
    off = Pose.exp(torch.tensor([[0.0] * 6, [0.008, -0.006, 0.005, 0.01, -0.008, 0.01]], dtype=torch.float64))
    images, _ = write_scene(tmp_path, scene)
    calibration = camera_models.load(tmp_path / "calibration.yaml")
    wrong = off @ true
    rig = {name: RigCamera(wrong[k]) for k, name in enumerate(calibration)}
    camera_models.save(tmp_path / "calibration.yaml", Calibration(calibration.cameras, rig=rig))
    status, data, _ = run(capsys, "reconstruct", tmp_path, "--refine", "lines,poses,rig", "--cost", "whitened")
    assert status == 0 and data["outcome"] == "converged"
    stored = camera_models.load(tmp_path / "out/calibration.yaml").rig["cam1"]
    error = (stored.cam_from_rig @ true[1].inverse()).log()[:3].numpy()
    assert np.abs(error / stored.sigma[:3]).max() < 4 and stored.sigma[:3].max() < 1e-3
    poses = read_poses(tmp_path / "out/poses.csv")
    assert poses.images == images and poses.frames is not None
    assert "no column frame" in refused(tmp_path, capsys, scene)


def refused(folder, capsys, scene):
    poses = read_poses(folder / "poses.csv")
    write_poses(folder / "poses.csv", ImagePoses(poses.images, poses.cam_from_world, poses.cameras))
    status, _, err = run(capsys, "reconstruct", folder, "--refine", "lines,poses,rig")
    assert status == 2
    return err


@pytest.mark.slow
def test_robust_names_the_wrong_observations(tmp_path, capsys):
    scene = RigScene(frames=12, lines=50)
    _, wrong = write_scene(tmp_path, scene, wrong=30, rig=False)
    status, data, err = run(capsys, "reconstruct", tmp_path, "--robust", "--cost", "whitened", "--triangulation", "ml")
    assert status == 0
    named = {(item["track"], item["image"]) for item in data["wrong"]}
    assert len(named & wrong) >= 0.95 * len(wrong)
    assert len(named - wrong) <= 0.02 * len(scene.image)
    assert "do not belong to their track" in err
    robust = np.nanmedian(distances(tmp_path, scene))
    status, plain, _ = run(capsys, "reconstruct", tmp_path, "--cost", "whitened")
    assert status == 0 and plain["wrong"] == [] and len(plain["suspect"]) > 0
    assert robust < 0.01


@pytest.mark.slow
def test_a_prior_anchors_the_poses(tmp_path, capsys):
    scene = RigScene(frames=10, lines=50)
    write_scene(tmp_path, scene, poses=disturbed(scene.cam_from_world, 0.05, 0.002), rig=False)
    prior = ("--pose-sigma-deg", "0.05", "--pose-sigma-m", "0.002")
    status, data, _ = run(capsys, "adjust", tmp_path, "--cost", "whitened", *prior)
    assert status == 0 and data["outcome"] == "converged"
    # The frame is that of the given poses, good to their deviations over the root of 20 photos.
    assert np.nanmedian(distances(tmp_path, scene)) < 0.005
    for options, word in (((*prior, "--refine", "lines"), "poses held"), (prior[:2], "both or neither")):
        status, _, err = run(capsys, "adjust", tmp_path, *options)
        assert status == 2 and word in err


def test_what_can_be_refined_is_said(tmp_path, capsys):
    scene = RigScene(frames=4, lines=20)
    write_scene(tmp_path, scene, rig=False)
    said = "lines, with any of poses, intrinsics and rig"
    for wrong, message in (("poses", said), ("lines,cameras", said), ("", "A value was expected")):
        status, _, err = run(capsys, "adjust", tmp_path, "--refine", wrong)
        assert status == 2 and message in err and "Traceback" not in err


@pytest.mark.full
def test_a_prior_weighs_alike_for_every_cost_and_the_noise_is_told(tmp_path, capsys):
    """A loose prior beside residuals in rad^1.5 left 12 px and said that it had converged."""
    scene = RigScene(frames=6, lines=20)
    write_scene(tmp_path, scene, poses=disturbed(scene.cam_from_world, 0.5, 0.02), rig=False)
    found = {}
    for cost in ("default", "sector", "bartoli-sturm"):
        options = () if cost == "default" else ("--cost", cost)
        status, found[cost], _ = run(capsys, "adjust", tmp_path, "--pose-sigma-deg", "1", "--pose-sigma-m", "0.05", *options)
        assert status == 0 and found[cost]["outcome"] == "converged"
    assert max(data["rms_px"] for data in found.values()) < 1.05 * found["default"]["rms_px"]
    assert set(found["default"]["noise"]) == {"stated", "measured", "redundancy", "holds"}
