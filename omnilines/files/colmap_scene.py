"""A COLMAP text model of photos: cameras.txt, images.txt, an empty points3D.txt; of a scene lines.txt too, which COLMAP skips.

    images.txt   IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line for points, here empty
    lines.txt    TRACK X1 Y1 Z1 X2 Y2 Z2 VIEWS; the header names the unit

Rigs and frames are left to COLMAP, which gives every camera a rig of its own where the model has none (pycolmap 4.2).

    held, remarks = colmap_cameras(cameras)                          # fitted where COLMAP does not hold them exactly
    write_colmap_scene(folder, held, poses, lines, remarks=remarks)
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, CameraModel
from camera_models.errors import InputError
from camera_models.formats import format_named
from camera_models.formats.disk import staged, write_atomically
from camera_models.formats.quaternions import quaternion_for_file
from camera_models.formats.transfer import transfer
from omnilines.files.obj import safe_name
from omnilines.files.tables import number_cells
from omnilines.records import ImagePoses, Lines

COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")
LINES_FILE = "lines.txt"
"""Of a model without lines, and of its lines."""
_GREY = "128 128 128"
_STALE = ("images.bin", "points3D.bin", "frames.bin", "frames.txt")
"""Files that are not written here and that COLMAP would read; the format of the cameras looks for those of its own."""


def colmap_cameras(
    cameras: Mapping[str, CameraModel], fov_deg: float | int | None = None
) -> tuple[dict[str, CameraModel], tuple[str, ...]]:
    """The cameras as COLMAP holds them, and one sentence for each thing that is lost by that.

    A camera of a model that COLMAP does not have is fitted, within `fov_deg` across or all that its image sees, by the nearest
    one that it has; the sentence states the error. Raises InputError where no model of COLMAP comes near.
    """
    calibration = cameras if isinstance(cameras, Calibration) else Calibration(dict(cameras))
    # What else a calibration knows is not asked of COLMAP here.
    bare = Calibration(dict(calibration), {name: e for name, e in calibration.estimates.items() if e.max_angle_deg is not None})
    fit = transfer(bare, format_named("colmap"), Path("cameras.txt"), fov_deg=fov_deg)
    sentences = [
        f"Camera {name} ({bare[name].NAME}) is fitted by {fit.forms[name].name}: {error.rms_px:.3g} px RMS and "
        f"{error.max_px:.3g} px at most within {error.fov_deg:.0f} degrees."
        for name, error in fit.conversions.items()
    ]
    limits = [note for note in fit.notes if not note.startswith("Not kept:")]
    return dict(fit.calibration), (*sentences, *limits)


def check_colmap_folder(folder: Path, images: Sequence[str]) -> None:
    """Raises InputError where a folder holds parts of another model, or the name of an image has a blank, which would end it."""
    stale = [name for name in _STALE if (folder / name).exists()]
    if stale:
        raise InputError(
            f"{folder}: no files of another COLMAP model were expected, found {', '.join(stale)}, which COLMAP would "
            "read with the new ones; remove them or give another folder."
        )
    for image in images:
        if len(image.split()) != 1:
            raise InputError(f"COLMAP's text files take names without blanks, found '{image}'; rename the photo.")


def write_colmap_scene(
    folder: Path,
    cameras: Mapping[str, CameraModel],
    poses: ImagePoses,
    lines: Lines | None = None,
    *,
    remarks: Sequence[str] = (),
    points_m: Float[np.ndarray, "n 3"] | None = None,
) -> tuple[Path, ...]:
    """Write the files into a folder, which is made where it is absent; the lines are those that are known.

    Without lines there is no lines.txt, and COLMAP's reconstruction from known poses may begin with the model; `points_m` are
    written as points that no photo is said to see. The cameras of photos are named in `poses` (the first camera where they are
    not). `remarks` stand at the top of cameras.txt. Raises InputError where COLMAP does not hold a camera exactly
    (`colmap_cameras` fits it), the photo of a pose has no camera or a name with a blank, which would end it, a number is not
    finite, or the folder holds parts of another model.
    """
    check_colmap_folder(folder, poses.images)
    colmap, calibration = format_named("colmap"), Calibration(dict(cameras))
    ((camera_file, camera_text),) = colmap.documents(folder / "cameras.txt", calibration).items()
    number = dict(zip(calibration, colmap.names(calibration), strict=True))
    texts = {
        camera_file: "".join(f"# {remark}\n" for remark in remarks) + str(camera_text),
        folder / "images.txt": _images(folder / "images.txt", number, poses),
        folder / "points3D.txt": _points(folder / "points3D.txt", points_m),
    }
    if lines is not None:
        texts[folder / LINES_FILE] = _lines(folder / LINES_FILE, lines)
    try:
        if os.path.abspath(folder / COLMAP_FILES[0]) not in staged:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be made ({error.strerror}); give another path.") from None
    for path, text in texts.items():
        write_atomically(path, text)
    return tuple(texts)


def _images(path: Path, number: Mapping[str, str], poses: ImagePoses) -> str:
    names = poses.cameras or (next(iter(number)),) * len(poses)
    pose = torch.cat([quaternion_for_file(poses.cam_from_world.rotation), poses.cam_from_world.translation], -1)
    columns = zip("qw qx qy qz tx ty tz".split(), pose.detach().cpu().numpy().T, strict=True)
    cells = zip(*(number_cells(values, path, name) for name, values in columns), strict=True)
    rows = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[], none here"]
    for k, (image, camera, values) in enumerate(zip(poses.images, names, cells, strict=True), 1):
        if camera not in number:
            known = ", ".join(number)
            raise InputError(f"The camera of {image} was expected to be one of {known}, found '{camera}'; correct the poses.")
        rows += [f"{k} {' '.join(values)} {number[camera]} {image}", ""]
    return "\n".join(rows) + "\n"


def _points(path: Path, points_m: Float[np.ndarray, "n 3"] | None) -> str:
    rows = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    if points_m is not None:
        cells = [number_cells(column, path, name) for column, name in zip(points_m.T, "xyz", strict=True)]
        rows += [f"{k} {' '.join(row)} {_GREY} 0" for k, row in enumerate(zip(*cells, strict=True), 1)]
    return "\n".join([*rows, ""])


def _lines(path: Path, lines: Lines) -> str:
    known = lines.known
    ends = lines.ends_m[known].reshape(-1, 6).T
    cells = [number_cells(column, path, name) for column, name in zip(ends, "x1 y1 z1 x2 y2 z2".split(), strict=True)]
    names = [safe_name(track) for track, there in zip(lines.tracks, known.tolist(), strict=True) if there]
    rows = [" ".join(row) for row in zip(names, *cells, map(str, lines.views[known].tolist()), strict=True)]
    head = "# TRACK (bytes that are no letter, digit or _ . - ~ as %XX), X1, Y1, Z1, X2, Y2, Z2 (" + lines.unit.words + "), VIEWS"
    return "\n".join([head, *rows]) + "\n"
