"""Corners that photos were found to show, kept from one run to the next."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from calib_patterns import Detection
from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.files import Photo
from omnilines.pipelines.kept_results import inputs_of, keep_arrays, kept_arrays, kept_folder

Looked: TypeAlias = tuple[Detection, str | None, tuple[int, int] | None]
"""What one photo shows of the target, why it was skipped, and its size, None where it was not looked at."""
Again: TypeAlias = tuple[Photo, Detection, Pose | None]
"""A photo that is searched once the camera is known, what was found in it, and its pose where it is known."""
MADE_BY = (
    "calib_patterns",
    "camera_models",
    "omnilines.photo_file",
    "omnilines.photo_size",
    "omnilines.pipelines.camera_search",
    "omnilines.pipelines.detect",
    __name__,
)
"""Whose source decides what a photo is found to show."""
FOLDER = "corners"


@dataclass(frozen=True)
class KeptCorners:
    """Those of photos, in files; also that a photo shows none, for which it is searched the longest."""

    folder: Path
    asked: str
    """The target and all else that decides what is found."""

    @staticmethod
    def within(work: str | Path, asked: object) -> "KeptCorners":
        """Those of a folder, which is made. Raises InputError as `work_folder` does."""
        return KeptCorners(kept_folder(work, FOLDER), repr(asked))

    def known(self, item: tuple[Photo, str | None]) -> tuple[str | None, Looked | None]:
        """What the corners of one photo are kept by, and they, where they are."""
        photo, left_out = item
        inputs = None if left_out is not None else inputs_of(photo, self.asked, *MADE_BY)
        arrays = kept_arrays(self.folder, inputs)
        if arrays is None:
            return inputs, None
        width, height = arrays["size"].tolist()
        return inputs, (_detection(arrays), str(arrays["reason"]) or None, (width, height))

    def write(self, inputs: str | None, looked: Looked) -> None:
        """Keep those of a photo that was looked at."""
        found, reason, size = looked
        if inputs is not None and size is not None:
            beside = {"size": np.array(size), "reason": np.array(reason or "")}
            keep_arrays(self.folder, inputs, _arrays(found) | beside)


@dataclass(frozen=True)
class KeptSearch:
    """What a camera that is known led to in photos."""

    folder: Path
    asked: str
    """The target, the camera and all else that decides it."""

    @staticmethod
    def within(work: str | Path, asked: object) -> "KeptSearch":
        """As that of `KeptCorners`."""
        return KeptSearch(kept_folder(work, FOLDER), repr(asked))

    def known(self, item: Again) -> tuple[str | None, Detection | None]:
        """What the corners of one photo are kept by, and they, where they are."""
        photo, before, pose = item
        what = hashlib.sha256()
        for name, values in _arrays(before).items():
            what.update(f"{name} {values.dtype} {values.shape}".encode() + values.tobytes())
        if pose is not None:
            what.update(pose.rotation.detach().numpy().tobytes() + pose.translation.detach().numpy().tobytes())
        inputs = inputs_of(photo, f"{self.asked} {what.hexdigest()}", *MADE_BY)
        arrays = kept_arrays(self.folder, inputs)
        return inputs, None if arrays is None else _detection(arrays)

    def write(self, inputs: str | None, found: Detection) -> None:
        """Keep those of a photo that was searched."""
        if inputs is not None:
            keep_arrays(self.folder, inputs, _arrays(found))


def said_of(camera: CameraModel | None) -> object:
    """A camera among what decides what is found."""
    return None if camera is None else (camera.NAME, camera.image_size, camera.parameters.detach().tolist())


def _arrays(found: Detection) -> dict[str, np.ndarray]:
    arrays = {"ids": found.ids, "pixels": found.pixels, "sigma_px": found.sigma_px}
    return arrays if found.blur_px is None else arrays | {"blur_px": found.blur_px}


def _detection(arrays: Mapping[str, np.ndarray]) -> Detection:
    return Detection(arrays["ids"], arrays["pixels"], arrays["sigma_px"], arrays.get("blur_px"))
