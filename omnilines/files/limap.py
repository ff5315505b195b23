"""LIMAP's folder (2.0): a COLMAP text model of the photos, and beside it the structures that its `HolisticReconstruction` reads.

    structures/structures2d.txt   photos; of each its id, then 0 points, lines, 0 groups, 0 edges / u v u v score / 0 edges
    structures/lines3D.txt        lines; of each its id, then x y z x y z / segments / photo, segment / uncertainty
    structures/groups3D.txt, structures/wireframe3D.txt    empty

Ids are those of `images.txt`, from 1; segments count those of a photo. Pixels are COLMAP's: the corner of the image is (0, 0).
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from camera_models.formats.disk import write_atomically
from omnilines.files.colmap_scene import COLMAP_FILES, colmap_cameras, write_colmap_scene
from omnilines.files.scene_folder import SceneTables
from omnilines.files.tables import number_cells

_SEGMENTS, _LINES, _GROUPS, _EDGES = (f"structures/{name}.txt" for name in ("structures2d", "lines3D", "groups3D", "wireframe3D"))
LIMAP_FILES = (*COLMAP_FILES, _SEGMENTS, _LINES, _GROUPS, _EDGES)
_CENTRE = 0.5
"""Of the first pixel, in COLMAP."""
_NO_UNCERTAINTY = "-1.0"
_SCORE = "1.0"


def write_limap(folder: Path, scene: SceneTables) -> tuple[str, ...]:
    """Write the photos with a pose, their segments and the lines that are known; what the files have no place for.

    Raises InputError where COLMAP does not hold a camera or the name of a photo.
    """
    cameras, said = colmap_cameras(scene.cameras)
    write_colmap_scene(folder, cameras, scene.poses, remarks=said)
    segments = scene.segments
    photo = {name: index + 1 for index, name in enumerate(scene.poses.images)}
    # A segment's photo by its id, 0 without a pose, and its number in that photo.
    image_id = np.array([photo.get(name, 0) for name in segments.images], dtype=int)[segments.image]
    number = _numbers(segments.image, len(segments.images))
    rows = _rows(segments.endpoints_px.reshape(-1, 4) + _CENTRE, folder / _SEGMENTS)
    texts = {_SEGMENTS: [str(len(photo))], _LINES: [str(int(scene.lines.known.sum()))], _GROUPS: ["0"], _EDGES: ["0"]}
    for one in photo.values():
        own = np.flatnonzero(image_id == one).tolist()
        texts[_SEGMENTS] += [str(one), f"0 {len(own)} 0 0", *(f"{rows[row]} {_SCORE}" for row in own), "0"]
    of_track = _by_track(segments.track, len(segments.tracks))
    place = {name: index for index, name in enumerate(segments.tracks)}
    ends = iter(_rows(scene.lines.ends_m[scene.lines.known].reshape(-1, 6), folder / _LINES))
    known = [name for name, there in zip(scene.lines.tracks, scene.lines.known.tolist(), strict=True) if there]
    for index, name in enumerate(known):
        seen = of_track[place[name]] if name in place else np.empty(0, dtype=int)
        seen = seen[image_id[seen] > 0]
        track = [f"{image_id[row]} {number[row]}" for row in seen.tolist()]
        texts[_LINES] += [str(index + 1), next(ends), str(len(track)), *track, _NO_UNCERTAINTY]
    for file, text in texts.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / file, "\n".join([*text, ""]))
    return (*said, "the names of tracks", "uncertainties")


def _numbers(image: Int[np.ndarray, " n"], images: int) -> Int[np.ndarray, " n"]:
    """How many rows of its photo stand before each."""
    order = np.argsort(image, kind="stable")
    first = np.searchsorted(image[order], np.arange(images))
    number = np.empty(len(image), dtype=int)
    number[order] = np.arange(len(image)) - first[image[order]]
    return number


def _by_track(track: Int[np.ndarray, " n"], tracks: int) -> list[Int[np.ndarray, " k"]]:
    """The rows of each track."""
    order = np.argsort(track, kind="stable")
    bounds = np.searchsorted(track[order], np.arange(tracks + 1))
    return [order[bounds[k] : bounds[k + 1]] for k in range(tracks)]


def _rows(values: Float[np.ndarray, "n k"], path: Path) -> list[str]:
    """Each row as a text."""
    cells = [number_cells(column, path, f"number {k + 1}") for k, column in enumerate(values.T)]
    return [" ".join(row) for row in zip(*cells, strict=True)]
