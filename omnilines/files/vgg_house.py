"""Matched line segments with projection matrices as Oxford's Visual Geometry Group publishes them (the model house).

A folder holds `2D/NAME.###.lines` (x0 y0 x1 y1 and more, one segment a row), `2D/NAME.nview-lines` (one row a line: the row of
its segment in every view from 0, or an asterisk) and `3D/NAME.###.P`, the 3x4 matrices P = s K [R t], s > 0. They are decomposed
into calibrated cameras. Where the world of the matrices is left-handed (det R < 0, as the house's is), its z axis is mirrored.
`2D/NAME.###.corners` and `2D/NAME.nview-corners` hold point matches in the same way, -1 for none.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg
from jaxtyping import Float, Int

from camera_models import CameraModel, InputError, Pinhole
from camera_models.formats.disk import read_text
from camera_models.pose import Pose
from camera_models.typed import typed
from omnilines.records import ImagePoses, Segments

IMAGE_SIZE = (768, 576)
"""Of the photos of the house; the files do not say it."""
MISSING = ("*", "-1")


@dataclass(frozen=True)
class MatchedLines:
    """Segments, the poses of their photos, and a pinhole camera for each photo."""

    segments: Segments
    poses: ImagePoses
    cameras: dict[str, CameraModel]


@typed
def read_vgg_lines(folder: str | Path) -> MatchedLines:
    """The segments of all tracks; photos are `000.png`, ... with cameras `cam000`, ..., tracks are numbered by row.

    Raises InputError naming the file where one is missing or is not of this format.
    """
    base = Path(folder)
    name, matrices = _named(base)
    numbers = [path.name.split(".")[-2] for path in matrices]
    cameras, poses = _cameras([_matrix(path) for path in matrices], numbers)
    lines = [_numbers(base / "2D" / f"{name}.{number}.lines", 4) for number in numbers]
    image, track, row = _matches(_table(base, "lines"), [len(segments) for segments in lines])
    ends = np.stack([lines[i][k].reshape(2, 2) for i, k in zip(image.tolist(), row.tolist(), strict=True)])
    tracks = tuple(str(k) for k in range(int(track.max()) + 1))
    return MatchedLines(Segments(image, poses.images, track, tracks, ends, cameras=poses.cameras), poses, cameras)


@dataclass(frozen=True)
class MatchedPoints:
    """Corners that are the same point in two views or more, one row each."""

    view: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]


@typed
def read_vgg_points(folder: str | Path) -> MatchedPoints:
    """The point matches beside the lines of `read_vgg_lines`, points numbered by row; raises InputError as it does."""
    name, matrices = _named(Path(folder))
    table = _table(Path(folder), "corners")
    corners = [_numbers(Path(folder) / "2D" / f"{name}.{path.name.split('.')[-2]}.corners", 2) for path in matrices]
    view, point, row = _matches(table, [len(found) for found in corners])
    pixels = np.stack([corners[i][k] for i, k in zip(view.tolist(), row.tolist(), strict=True)])
    often = np.bincount(point)[point] >= 2
    return MatchedPoints(view[often], np.unique(point[often], return_inverse=True)[1], pixels[often])


def _table(base: Path, kind: str) -> Path:
    tables = sorted(base.glob(f"2D/*.nview-{kind}"))
    if len(tables) != 1:
        raise InputError(
            f"One file 2D/*.nview-{kind} was expected in {base}, found {len(tables)}; give the folder with 2D and 3D in it."
        )
    return tables[0]


def _named(base: Path) -> tuple[str, list[Path]]:
    """The name of the data and the files of the matrices."""
    name = _table(base, "lines").name.removesuffix(".nview-lines")
    matrices = sorted(base.glob(f"3D/{name}.[0-9]*.P"))
    if len(matrices) < 2:
        raise InputError(f"Matrices 3D/{name}.###.P of at least 2 views were expected in {base}, found {len(matrices)}.")
    return name, matrices


def _numbers(path: Path, columns: int) -> Float[np.ndarray, "n k"]:
    """The first columns of a file of numbers, which may hold more."""
    try:
        rows = [[float(cell) for cell in line.split()[:columns]] for line in read_text(path).splitlines() if line.strip()]
        values = np.array(rows, dtype=np.float64)
    except ValueError:
        values = np.empty(0)
    if values.ndim != 2 or values.shape[1] != columns or not np.isfinite(values).all():
        raise InputError(f"{path}: rows of {columns} finite numbers or more were expected, found others; correct the file.")
    return values


def _matrix(path: Path) -> Float[np.ndarray, "3 4"]:
    matrix = _numbers(path, 4)
    if matrix.shape != (3, 4) or np.linalg.matrix_rank(matrix[:, :3]) < 3:
        raise InputError(f"{path}: a 3x4 matrix of a camera with a centre was expected, found none; correct the file.")
    return matrix


def _matches(path: Path, counts: list[int]) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """View, track and row in the view's file of every observation; columns beyond the views are padding."""
    rows = [line.split()[: len(counts)] for line in read_text(path).splitlines() if line.strip()]
    found = []
    for track, cells in enumerate(rows):
        for view, cell in enumerate(cells):
            if cell in MISSING:
                continue
            if not cell.isdigit() or int(cell) >= counts[view]:
                raise InputError(
                    f"{path}, row {track + 1}: rows 0 to {counts[view] - 1} of view {view} or an asterisk were expected, found "
                    f"'{cell}'; correct the file."
                )
            found.append((view, track, int(cell)))
    if not found:
        raise InputError(f"{path}: at least one match was expected, found none; give another file.")
    image, track_of, row = np.array(found, dtype=np.int64).T
    return image, track_of, row


def _cameras(matrices: list[Float[np.ndarray, "3 4"]], numbers: list[str]) -> tuple[dict[str, CameraModel], ImagePoses]:
    """P[:, :3] = K R with a positive diagonal of K (RQ decomposition); a left-handed world is mirrored in z."""
    cameras: dict[str, CameraModel] = {}
    rotations, translations = [], []
    for matrix, number in zip(matrices, numbers, strict=True):
        k, r = scipy.linalg.rq(matrix[:, :3])
        signs = np.diag(np.sign(np.diag(k)))
        k, r = k @ signs, signs @ r
        mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(r))])
        rotation = r @ mirror
        centre = mirror @ -np.linalg.solve(matrix[:, :3], matrix[:, 3])
        k = k / k[2, 2]
        parameters = [k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1], *([0.0] * 8)]
        cameras[f"cam{number}"] = Pinhole(parameters, IMAGE_SIZE, 0)
        rotations.append(rotation)
        translations.append(-rotation @ centre)
    poses = Pose.of(np.stack(rotations), np.stack(translations))
    return cameras, ImagePoses(tuple(f"{number}.png" for number in numbers), poses, tuple(cameras))
