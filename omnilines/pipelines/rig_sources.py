"""Where the corners of a rig come from: a folder with one sub-folder per camera, or a table with a camera column."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from calib_patterns import Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import InputError
from omnilines.calibration.numbering import Lattice, Numbering
from omnilines.calibration.rig.views import ONE_BOARD
from omnilines.files import PhotoRef, find_photos, is_rig_table, read_rig_corners
from omnilines.pipelines.detect import PhotoCorners, detect_corners
from omnilines.progress import ProgressCallback
from omnilines.records import Corners, ViewResult

SHOWN_NAMES = 5
"""Photos without a partner are listed up to this number."""


@dataclass(frozen=True)
class RigSource:
    """Corners of a rig, and what is known beside them."""

    corners: Corners
    image_sizes: Mapping[str, tuple[int, int]]
    """Of every camera with corners."""
    numberings: Mapping[str, Numbering] | None
    """Of each board, where the pattern is known."""
    seen_from_front: bool
    photo_folder: Path | None
    inputs: Mapping[str, str | Path]
    skipped: tuple[ViewResult, ...] = ()
    notes: tuple[str, ...] = ()
    photos: tuple["CameraPhotos", ...] = ()

    @property
    def remarks(self) -> dict[str, str]:
        """What a person should know of single photos that are used all the same: blur."""
        views = [(item.found.corners.view_names, item.found.remarks) for item in self.photos]
        return {name: remark for names, own in views for name, remark in zip(names, own, strict=True) if remark}


@dataclass(frozen=True)
class CameraPhotos:
    """The photos of one camera and what was found in them of one pattern."""

    camera: str
    pattern: Pattern
    photos: tuple[PhotoRef, ...]
    found: PhotoCorners
    mirrored: bool


def is_rig(paths: Sequence[Path]) -> bool:
    """Whether this is a rig: a table with several cameras or boards; one folder whose photos all lie in two or more sub-folders,
    at least one file name standing in two of them."""
    if len(paths) != 1:
        return False
    path = paths[0]
    if path.suffix.lower() == ".csv":
        return path.is_file() and is_rig_table(path)
    if not path.is_dir():
        return False
    names = [PurePosixPath(photo.name) for photo in find_photos([path])]
    if any(len(name.parts) < 2 for name in names):
        return False
    counts = Counter({(name.parts[0], frame_of(name)): 1 for name in names})
    return len({camera for camera, _ in counts}) > 1 and max(Counter(frame for _, frame in counts).values()) > 1


def frame_of(name: PurePosixPath) -> str:
    """The instant of a photo: its path within its camera's folder without the ending; where the file's name begins or ends with
    that of the folder (left/left01.png), without that."""
    camera, inside = name.parts[0], PurePosixPath(*name.parts[1:])
    stem = inside.stem
    if re.search("[a-zA-Z]", camera):
        own = re.escape(camera)
        stem = re.sub(rf"^{own}[-_. ]*(?=.)|(?<=.)[-_. ]*{own}$", "", stem, count=1, flags=re.IGNORECASE)
    return (inside.parent / stem).as_posix()


def rig_from_table(path: Path, image_sizes: Mapping[str, tuple[int, int]]) -> RigSource:
    """The corners of a table; `image_sizes` by camera, "" standing for all others. Raises InputError where a size is missing or a
    corner lies outside the image.

    Without a column `frame` the instant is the view, where two cameras have views of one name, and else the name of the photo as
    in folders.
    """
    corners = read_rig_corners(path)
    cameras = corners.cameras or ()
    sizes = {name: image_sizes.get(name, image_sizes.get("")) for name in dict.fromkeys(cameras)}
    found = {name: size for name, size in sizes.items() if size is not None}
    missing = [name for name in sizes if name not in found]
    if missing:
        raise InputError(
            f"--image-size was expected for every camera of {path}, found none for '{missing[0]}'; give one for all, or "
            f"{missing[0]}=WIDTHxHEIGHT."
        )
    limit = np.array([found[name] for name in cameras])[corners.view] - 0.5
    outside = ((corners.pixels < -0.5) | (corners.pixels > limit)).any(-1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        view, (u, v) = int(corners.view[row]), corners.pixels[row]
        width, height = found[cameras[view]]
        raise InputError(
            f"{path}: every corner was expected inside the image of {width}x{height} px of {cameras[view]}, found ({u:g}, {v:g}) "
            f"in view {corners.view_names[view]}; check --image-size (width x height)."
        )
    frames = corners.frames
    if frames is None:
        seen = Counter({(camera, name): 1 for camera, name in zip(cameras, corners.view_names, strict=True)})
        common = max(Counter(name for _, name in seen).values()) > 1
        names = [PurePosixPath(image) for image in corners.images]
        frames = corners.view_names if common else tuple(frame_of(n) if len(n.parts) > 1 else n.stem for n in names)
    beside = [folder for folder in (path.parent / "images", path.parent) if (folder / corners.images[0]).is_file()]
    return RigSource(replace(corners, frames=frames), found, None, False, beside[0] if beside else None, {"corners": path})


def rig_from_photos(
    folder: Path, patterns: Sequence[str], mirrored: Sequence[str], every_mirror: bool, progress: ProgressCallback
) -> RigSource:
    """Corners of one or more patterns in the photos of every camera. `mirrored` are cameras that may look into a mirror: where no
    tag is read in their photos as they are, they are read as mirror images.

    Raises InputError where no camera sees a pattern.
    """
    boards = [parse_pattern(text) for text in patterns]
    by_camera: dict[str, list[PhotoRef]] = {}
    for photo in find_photos([folder]):
        by_camera.setdefault(PurePosixPath(photo.name).parts[0], []).append(photo)
    several = len(boards) > 1
    found: list[CameraPhotos] = []
    notes = list(_mismatches(by_camera))
    for camera, photos in by_camera.items():
        for board in boards:
            try:
                found.append(_look(camera, photos, board, camera in mirrored, every_mirror, progress))
            except InputError as error:
                notes.append(f"Camera {camera}: {error}")
    if not found:
        raise InputError(f"A pattern was expected in the photos of some camera in {folder}, found none; {notes[-1]}")
    plain = any(board.plain_grid is not None for board in boards)
    return replace(
        source_of(found, folder, several),
        numberings={board.specification if several else ONE_BOARD: _numbering(board) for board in boards},
        seen_from_front=not plain,
        inputs={"photos": folder, "pattern": ",".join(board.specification for board in boards)},
        notes=tuple(notes),
    )


def source_of(found: Sequence[CameraPhotos], folder: Path, several_boards: bool) -> RigSource:
    """One table of what was found in the photos of all cameras."""
    tables = [item.found.corners for item in found]
    starts = np.cumsum([0, *(len(table.images) for table in tables)])
    images = tuple(image for table in tables for image in table.images)
    each = [item for item, table in zip(found, tables, strict=True) for _ in table.images]
    sigma = [table.sigma_px for table in tables if table.sigma_px is not None]
    ids = [table.ids for table in tables if table.ids is not None]
    corners = Corners(
        np.concatenate([table.view + start for table, start in zip(tables, starts[:-1], strict=True)]),
        images,
        images,
        np.concatenate([table.board_m for table in tables]),
        np.concatenate([table.pixels for table in tables]),
        np.concatenate(sigma) if len(sigma) == len(tables) else None,
        np.concatenate(ids) if len(ids) == len(tables) else None,
        tuple(item.camera for item in each),
        tuple(frame_of(PurePosixPath(image)) for image in images),
        tuple(item.pattern.specification for item in each) if several_boards else None,
    )
    sizes = {item.camera: item.found.image_size for item in found}
    skipped = tuple(replace(view, camera=item.camera) for item in found for view in item.found.skipped)
    return RigSource(corners, sizes, None, False, folder, {}, skipped, (), tuple(found))


def _look(
    camera: str, photos: Sequence[PhotoRef], pattern: Pattern, may_be_mirror: bool, mirror: bool, progress: ProgressCallback
) -> CameraPhotos:
    plain = pattern.plain_grid is not None
    try:
        found, mirrored = detect_corners(photos, pattern, mirrored=mirror, progress=progress), mirror
    except InputError:
        # Tags are not read in a mirror image; the corners of a plain board are found either way.
        if plain or not may_be_mirror or mirror:
            raise
        found, mirrored = detect_corners(photos, pattern, mirrored=True, progress=progress), True
    return CameraPhotos(camera, pattern, tuple(photos), found, mirrored)


def _numbering(pattern: Pattern) -> Numbering:
    """Tags name every corner; the squares of a plain board only have two colours."""
    if pattern.plain_grid is None:
        return Numbering()
    lattice = Lattice.of(pattern.points_m)
    return Numbering(lattice, coloured=True, trusted=False)


def _mismatches(by_camera: Mapping[str, Sequence[PhotoRef]]) -> list[str]:
    """A sentence for each camera with photos that no other camera has a photo of the same instant to."""
    frames = {camera: {frame_of(PurePosixPath(p.name)): p.name for p in photos} for camera, photos in by_camera.items()}
    counts = Counter(frame for own in frames.values() for frame in own)
    found = []
    for camera, own in frames.items():
        alone = [name for frame, name in own.items() if counts[frame] == 1]
        if alone:
            shown = ", ".join(alone[:SHOWN_NAMES]) + (", ..." if len(alone) > SHOWN_NAMES else "")
            found.append(
                f"{len(alone)} of {len(own)} photos of camera {camera} have no photo of the same name in another camera's folder "
                f"and count for {camera} alone: {shown}."
            )
    return found
