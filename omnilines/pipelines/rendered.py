"""Rendered photos with the camera, the poses and the truth: what `render` returns, and its files."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import UInt8

from calib_patterns import Pattern
from camera_models import Calibration, CameraEstimate, CameraModel, save
from camera_models.formats.calibration_data import ViewRecord
from camera_models.pose import Pose
from camera_models.typed import typed
from omnilines.files import write_corners, write_png, write_poses
from omnilines.files.folders import OF_RENDER
from omnilines.files.sets import claimed
from omnilines.files.true_edges import Stretches, TrueEdges, write_stretches, write_true_edges
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import Corners, ImagePoses
from omnilines.scenes import PolygonScene, largest_angle
from omnilines.synthetic.targets import simulate_corners

Photo = UInt8[np.ndarray, "h w *channels"]

TRUE_CORNERS = "true_corners.csv"
"""Not `corners.csv`: the name of detected corners, which other commands would take instead of the photos."""
TRUTH, VISIBILITY = "truth.csv", "visibility.csv"


class RenderedPhotos(Mapping[str, Photo]):
    """Photos by their names. Each is rendered anew as it is read, and the same each time: they need no memory together."""

    def __init__(self, names: Sequence[str], render: Callable[[int], Photo]) -> None:
        self._index = {name: k for k, name in enumerate(names)}
        self._render = render

    def __getitem__(self, name: str) -> Photo:
        return self._render(self._index[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._index)

    def __len__(self) -> int:
        return len(self._index)


@dataclass(frozen=True, eq=False)
class Rendered:
    """Photos through a known camera and where each was taken."""

    TRUTH_FILES: ClassVar[tuple[str, ...]]
    """What else is known of the photos."""
    photos: Mapping[str, Photo]
    """Name -> (h, w) grey or (h, w, 3) BGR, 8 bits."""
    camera: CameraModel
    poses: ImagePoses
    seed: int
    inputs: Mapping[str, Any]
    """What was asked for, as `calibration.yaml` states it."""

    @property
    def calibration(self) -> Calibration:
        """The true camera, under the name cam0."""
        estimate = CameraEstimate(max_angle_deg=math.degrees(self._shown_rad()))
        return Calibration({"cam0": self.camera}, {"cam0": estimate}, provenance=provenance(self.inputs, self.seed))

    @typed
    def save(self, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
        """Write the photos (PNG), calibration.yaml, poses.csv and the tables of the truth; returns the files.

        Raises InputError for a folder that cannot be made.
        """
        with claimed(folder, self.file_names, by=OF_RENDER) as out:
            photos = [out / name for name in self.photos]
            progress("rendering photos", 0, len(photos))
            for k, path in enumerate(photos):
                write_png(path, self.photos[path.name])
                progress("rendering photos", k + 1, len(photos))
            save(out / "calibration.yaml", self.calibration)
            write_poses(out / "poses.csv", self.poses)
            self._save_truth(out)
        return tuple(out / name for name in self.file_names)

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        return (*self.photos, "calibration.yaml", "poses.csv", *self.TRUTH_FILES)

    def _shown_rad(self) -> float:
        """How far off axis the photos show anything."""
        raise NotImplementedError

    def _save_truth(self, folder: Path) -> None:
        """Write what else is known of the photos."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class RenderedTargets(Rendered):
    """Photos of a calibration target, which is the world of the poses."""

    TRUTH_FILES = (TRUE_CORNERS,)
    pattern: Pattern
    fov_deg: float
    """Angle across the image circle."""
    max_angle_rad: float
    """The largest angle off axis at which a corner was to be shown."""

    @property
    def cam_from_board(self) -> Pose:
        """Where each photo sees the target."""
        return self.poses.cam_from_world

    @property
    def corners(self) -> Corners:
        """Where the camera sees the corners, exactly."""
        return simulate_corners(self.camera, self.pattern, self.cam_from_board, 0.0, self.seed)

    @property
    def calibration(self) -> Calibration:
        """The true camera, under the name cam0, and where each photo sees the target."""
        count = len(self.pattern.points_m)
        views = tuple(
            ViewRecord(image, "cam0", True, corners_used=count, cam_from_board=self.cam_from_board[k])
            for k, image in enumerate(self.poses.images)
        )
        return replace(super().calibration, views=views)

    def _shown_rad(self) -> float:
        return self.max_angle_rad

    def _save_truth(self, folder: Path) -> None:
        write_corners(folder / TRUE_CORNERS, self.corners)


@dataclass(frozen=True, eq=False)
class RenderedScene(Rendered):
    """Photos of a scene of straight edges, in whose world the poses are."""

    TRUTH_FILES = (TRUTH, VISIBILITY)
    name: str
    """Of the scene."""
    scene: PolygonScene
    circle_rad: float
    """Half the angle across the image circle; pi where there is none."""
    edges: TrueEdges
    stretches: Stretches
    """What each photo sees of the edges."""

    def _shown_rad(self) -> float:
        return largest_angle(self.camera, self.circle_rad)

    def _save_truth(self, folder: Path) -> None:
        write_true_edges(folder / TRUTH, self.edges)
        write_stretches(folder / VISIBILITY, self.stretches, self.edges)
