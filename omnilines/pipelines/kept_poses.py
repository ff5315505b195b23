"""Poses that photos were found to have, kept on disk: a run that was stopped, or that has other options, goes on from them."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from camera_models.formats.disk import write_atomically
from camera_models.pose import Pose
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.records import ImagePoses


def kept_poses(path: Path, inputs: str, find: Callable[[], PhotoPoses]) -> PhotoPoses:
    """What `find` gives, or gave for the same `inputs` (a fingerprint) before."""
    known = _read(path, inputs)
    if known is None:
        known = find()
        _write(path, inputs, known)
    return known


def _read(path: Path, inputs: str) -> PhotoPoses | None:
    """The poses in a file; None where it is absent, damaged, or of other inputs."""
    try:
        with np.load(path) as file:
            words = json.loads(str(file["words"]))
            if words["inputs"] != inputs:
                return None
            pose = Pose(torch.as_tensor(file["rotation"]), torch.as_tensor(file["translation"]))
            covariance = file["covariance"] if "covariance" in file else None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
    named = {name: None if words[name] is None else tuple(words[name]) for name in ("cameras", "frames")}
    poses = ImagePoses(tuple(words["images"]), pose, named["cameras"], covariance, named["frames"])
    return PhotoPoses(poses, words["left_out"], tuple(words["notes"]))


def _write(path: Path, inputs: str, found: PhotoPoses) -> None:
    poses = found.poses
    words: dict[str, Any] = {"inputs": inputs, "left_out": dict(found.left_out), "notes": found.notes}
    words |= {"images": poses.images, "cameras": poses.cameras, "frames": poses.frames}
    arrays = {"rotation": poses.cam_from_world.rotation.numpy(), "translation": poses.cam_from_world.translation.numpy()}
    if poses.covariance is not None:
        arrays["covariance"] = poses.covariance
    buffer = io.BytesIO()
    np.savez(buffer, words=np.array(json.dumps(words)), **arrays)  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())
