"""pycolmap, in an environment of its own, reads what we write and writes what we read."""

import functools
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from pylimap_scenes import PEERS

from camera_models import Calibration, CameraModel, model_class
from camera_models.formats import format_named, read, write
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose

PEER = Path(__file__).parent / "bench" / "peer_colmap_files.py"
MODELS = [
    model
    for form in dict.fromkeys(form.model for form in format_named("colmap").FORMS)
    for model in model_class(form).examples()
    if format_named("colmap").why_not(model) is None
]
pytestmark = pytest.mark.usefixtures("peer")


@functools.cache
def why_absent() -> str | None:
    if not PEERS.is_file():
        return f"pycolmap is compared in an environment of its own, which is absent: {PEERS}; `make bench` installs it"
    found = subprocess.run([PEERS, "-c", "import pycolmap"], capture_output=True, text=True)
    return f"pycolmap cannot be imported by {PEERS}" if found.returncode else None


@pytest.fixture(scope="module")
def peer() -> None:
    """Skips where pycolmap is not installed: CI does not install the peers."""
    reason = why_absent()
    if reason is not None:
        pytest.skip(reason)


def told_by_pycolmap(folder: Path, out: Path | str, rays: np.ndarray) -> dict:
    done = subprocess.run([PEERS, PEER, folder, out, json.dumps(rays.tolist())], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def rig_of(models: list[CameraModel]) -> Calibration:
    generator = torch.Generator().manual_seed(5)
    poses = [Pose.identity(), *(Pose.exp(torch.randn(6, generator=generator, dtype=torch.float64)) for _ in models[1:])]
    names = [str(index + 1) for index in range(len(models))]
    rig = {name: RigCamera(pose) for name, pose in zip(names, poses, strict=True)}
    return Calibration(dict(zip(names, models, strict=True)), rig=rig)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_pycolmap_and_back(suffix: str, tmp_path: Path) -> None:
    """Same pixels, half a pixel apart by the origin; same poses; its own files of both kinds give our calibration back."""
    calibration = rig_of(MODELS)
    assert len(MODELS) >= 10
    folder = tmp_path / "ours"
    write(folder / f"cameras.{suffix}", calibration, "colmap")
    rays = np.random.default_rng(0).normal(size=(50, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    told = told_by_pycolmap(folder, tmp_path / "theirs", rays)
    for name, model in calibration.items():
        theirs = told["cameras"][name]
        assert theirs["size"] == list(model.image_size)
        pixels, valid = model.project(rays)
        assert valid.mean() > 0.9
        np.testing.assert_allclose(pixels[valid] + 0.5, np.array(theirs["pixels"])[valid], atol=1e-9)
    for name, item in list(calibration.rig.items())[1:]:
        matrix = np.array(told["poses"][name])
        np.testing.assert_allclose(item.cam_from_rig.rotation, matrix[:, :3], atol=1e-12)
        np.testing.assert_allclose(item.cam_from_rig.translation, matrix[:, 3], atol=1e-12)
    for kind in ("text", "binary"):
        again = read(tmp_path / "theirs" / kind).calibration
        assert list(again) == list(calibration)
        for name, model in calibration.items():
            assert type(again[name]) is type(model)
            named = again[name].named_parameters()
            assert all(abs(named[key] - value) <= 1e-12 * max(1, abs(value)) for key, value in model.named_parameters().items())
            pose, wanted = again.rig[name].cam_from_rig, calibration.rig[name].cam_from_rig
            assert (pose.rotation - wanted.rotation).abs().max() < 1e-12
            assert (pose.translation - wanted.translation).abs().max() < 1e-12


def test_colmap_sees_nothing_beside_the_camera(tmp_path: Path) -> None:
    """What the note on 90 degrees says: pycolmap itself projects nothing there, our model of the same file does."""
    model = model_class("opencv-fisheye").examples()[1]
    write(tmp_path / "cameras.txt", Calibration({"1": model}))
    theta = np.radians([80.0, 89.0, 91.0, 100.0])
    rays = np.stack([np.sin(theta), np.zeros(4), np.cos(theta)], -1)
    pixels = np.array(told_by_pycolmap(tmp_path, "-", rays)["cameras"]["1"]["pixels"], dtype=float)
    assert np.isfinite(pixels[:2]).all() and np.isnan(pixels[2:]).all()
    assert model.project(rays)[1].all()
