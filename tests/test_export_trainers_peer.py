"""Nerfstudio's own parsers, in an environment of their own, see along the rays along which we see, in what we export."""

import functools
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from pylimap_scenes import PEERS

import omnilines as ol
from camera_models import Calibration, OpenCVFisheye, save
from camera_models.pose import Pose
from omnilines.files import write_lines, write_png, write_poses, write_segments
from omnilines.records import ImagePoses, Lines, Segments

PEER = Path(__file__).parent / "bench" / "peer_nerfstudio.py"
LENS = OpenCVFisheye([80.0, 80.5, 159.5, 119.5, 0.01, -0.002, 0.0, 0.0], (320, 240))
PHOTOS = 3
PIXELS = np.stack(np.meshgrid(np.arange(60.0, 260.0, 20.0), np.arange(40.0, 200.0, 20.0)), -1).reshape(-1, 2)
"""With the centre of the first at (0, 0), within 80 degrees off axis."""
RADIANS = 1e-4
"""Nerfstudio counts in single precision, and undistorts in ten steps."""


@functools.cache
def why_absent() -> str | None:
    if not PEERS.is_file():
        return f"Nerfstudio's parsers are run in an environment of their own, which is absent: {PEERS}"
    found = subprocess.run([PEERS, "-c", "import nerfstudio.data.dataparsers.colmap_dataparser"], capture_output=True, text=True)
    return f"Nerfstudio cannot be imported by {PEERS}: see {PEER.name}" if found.returncode else None


@pytest.mark.parametrize("to", ["colmap", "nerfstudio"])
def test_nerfstudio_reads_the_fisheyes_themselves(to: str, tmp_path: Path) -> None:
    reason = why_absent()
    if reason is not None:
        pytest.skip(reason)
    poses = scene(tmp_path / "scene")
    images = tmp_path / "data" / "images"
    images.mkdir(parents=True)
    for name in poses.images:
        write_png(images / name, np.random.default_rng(0).integers(60, 200, (240, 320)).astype(np.uint8))
    out = tmp_path / "data" if to == "colmap" else tmp_path / "data" / "transforms.json"
    ol.export(tmp_path / "scene", out, to_format=to, photos=images).save()
    corner = (PIXELS + 0.5).tolist()
    done = subprocess.run([PEERS, "-W", "ignore", PEER, out, json.dumps(corner)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert sorted(told["frames"]) == sorted(poses.images)
    assert told["points"] > 1000 if to == "colmap" else told["points"] == 0
    bearings, valid = LENS.unproject(PIXELS)
    assert valid.all()
    for index, name in enumerate(poses.images):
        pose = poses.cam_from_world[index]
        frame = told["frames"][name]
        np.testing.assert_allclose(frame["centre"], pose.centre, atol=1e-5)
        ours = np.asarray(bearings) @ pose.rotation.numpy()
        theirs = np.array(frame["directions"])
        assert np.linalg.norm(np.cross(ours, theirs), axis=-1).max() < RADIANS and (ours * theirs).sum(-1).min() > 0


def scene(folder: Path) -> ImagePoses:
    """Two lines in three photos."""
    rng = np.random.default_rng(1)
    twists = torch.as_tensor(rng.normal(size=(PHOTOS, 6)))
    names = tuple(f"{k}.png" for k in range(PHOTOS))
    poses = ImagePoses(names, Pose.exp(twists), ("cam0",) * PHOTOS)
    unknown = np.full(2, np.nan)
    lines = Lines(("a", "b"), rng.normal(size=(2, 2, 3)), np.array([3, 3]), unknown, unknown, ("ok", "ok"))
    image, track = np.repeat(np.arange(PHOTOS), 2), np.tile([0, 1], PHOTOS)
    segments = Segments(image, names, track, lines.tracks, rng.uniform(50, 200, (6, 2, 2)), cameras=poses.cameras)
    folder.mkdir()
    save(folder / "calibration.yaml", Calibration({"cam0": LENS}))
    write_poses(folder / "poses.csv", poses)
    write_segments(folder / "segments.csv", segments)
    write_lines(folder / "lines.csv", lines)
    return poses
