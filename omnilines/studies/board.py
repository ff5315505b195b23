"""The dissertation's fisheye experiment on photos of one's own.

Calibrate from the photos, take the rows and columns of the board as lines, perturb the poses, triangulate, adjust, and compare
with the board before and after.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from camera_models import CameraModel, InputError
from camera_models.formats.disk import read_text
from camera_models.pose import Pose
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import adjust_lines, drop_unknown
from omnilines.calibration.board_lines import board_lines
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.single import calibrate_camera
from omnilines.files import read_corners, read_photo
from omnilines.least_squares import Progress
from omnilines.pipelines.detect import detect
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.progress import ProgressCallback, silent
from omnilines.records import ImagePoses
from omnilines.studies.board_figures import BoardExperiment, measure
from omnilines.synthetic.poses import perturbed_poses
from omnilines.triangulation import triangulate
from omnilines.triangulation.observations import PlaneObservations

MODEL = "scaramuzza"
DEGREE = 4
"""Of the polynomial, as in the dissertation."""


@dataclass(frozen=True)
class BoardOptions:
    """How poses are disturbed, and what rebuilds the lines."""

    perturb_deg: float = 1.0
    """Turn of every pose about a random axis through its camera."""
    perturb_m: float = 0.01
    """Shift of every camera in a random direction."""
    seed: int = 0
    """What these are drawn from."""
    triangulation: str = "dual"
    """Method of `omnilines.triangulation` that the lines begin with."""
    method: Mapping[str, Any] = field(default_factory=dict)
    """Options of that method."""
    cost: str = "sector"
    """Of the adjustment."""

    def __post_init__(self) -> None:
        """Refuse what is no disturbance."""
        angle, shift = self.perturb_deg, self.perturb_m
        if not (math.isfinite(angle) and math.isfinite(shift) and angle >= 0 and shift >= 0):
            raise InputError(f"A perturbation of at least 0 degrees and 0 m was expected, found {angle} and {shift}.")


def board_corners(data: str | Path, pattern_spec: str, progress: ProgressCallback = silent) -> PhotoCorners:
    """The corners of a plane target in a folder of photos, or those of the corners.csv in a folder, or of such a table.

    Of a table `pattern_spec` is not used. Its photos are looked for in `images` beside it, their size in `reference.json` (key
    image_size) or in the photos. Raises InputError for unusable data.
    """
    given = Path(data)
    path = given / "corners.csv" if given.is_dir() else given
    if path.name.endswith(".csv") and path.is_file():
        corners = read_corners(path)
        folder = path.parent / "images"
        return PhotoCorners(corners, _image_size(path, folder / corners.images[0]), photo_folder=folder)
    return detect([given], pattern_spec, progress=progress)


def _image_size(corners_csv: Path, photo: Path) -> tuple[int, int]:
    reference = corners_csv.parent / "reference.json"
    if reference.is_file():
        try:
            width, height = json.loads(read_text(reference))["image_size"]
            return int(width), int(height)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f'{reference}: "image_size": [width, height] was expected, found none; add it.') from error
    if not photo.is_file():
        raise InputError(
            f"The image size of {corners_csv} was expected in reference.json or from the photo {photo}, found neither; give one."
        )
    image = read_photo(photo)
    return image.shape[1], image.shape[0]


def board_calibration(found: PhotoCorners, model: str = MODEL, progress: ProgressCallback = silent) -> CameraCalibration:
    """The camera of the photos, its polynomial of the dissertation's degree. Raises GeometryError where they determine none."""

    def tell(step: Progress) -> None:
        progress("refining the camera", step.iteration, 0)

    options = {"degree": DEGREE} if model == MODEL else {}
    calibration = calibrate_camera(found.corners, found.image_size, model, options=options, callback=tell)
    return replace(calibration, views=calibration.views + found.skipped)


def board_experiment(
    found: PhotoCorners,
    calibration: CameraCalibration,
    options: BoardOptions = BoardOptions(),
    progress: ProgressCallback = silent,
) -> BoardExperiment:
    """Perturb, triangulate, adjust and measure. Raises InputError where too few lines are left, and GeometryError where boards or
    lines determine nothing."""
    board = board_lines(found.corners, calibration.kept)
    poses = _poses(calibration)
    disturbed = perturbed_poses(poses.cam_from_world, options.perturb_deg, options.perturb_m, options.seed)
    perturbed = replace(poses, cam_from_world=disturbed)
    cameras: dict[str, CameraModel] = {"cam0": calibration.model}
    table = arcs_from_segments(board.segments, perturbed, cameras)
    progress("triangulating", 0, 0)
    start = perturbed.cam_from_world
    planes = PlaneObservations.from_arcs(table.arcs.bearings, start[table.arcs.image], table.arcs.track, table.arcs.tracks)
    first = triangulate(options.triangulation, planes, **options.method)
    arcs, tracks = drop_unknown(table.arcs, first.known)
    ends, column = torch.as_tensor(board.ends_m)[tracks], torch.as_tensor(board.column)[tracks]
    if min(int(column.sum()), int((~column).sum())) < 2:
        raise InputError(
            f"At least 2 rows and 2 columns with a line were expected, found {int((~column).sum())} and {int(column.sum())}; "
            "perturb the poses less or give more photos."
        )

    def tell(step: Progress) -> None:
        progress("adjusting lines and poses", step.iteration, 0)

    adjusted = adjust_lines(arcs, first.lines[tracks], start, cost=options.cost, callback=tell)
    return BoardExperiment(
        found.corners,
        calibration,
        board,
        perturbed,
        first.status_names,
        arcs,
        tracks,
        adjusted,
        measure(arcs, first.lines[tracks], start, ends, column),
        measure(arcs, adjusted.state.chart.lines(), adjusted.state.cam_from_world, ends, column),
        options.cost,
    )


def _poses(calibration: CameraCalibration) -> ImagePoses:
    used = [(view.image, view.cam_from_board) for view in calibration.views if view.used and view.cam_from_board is not None]
    return ImagePoses(tuple(image for image, _ in used), Pose.stack([pose for _, pose in used]), ("cam0",) * len(used))
