"""Photos of a target by several cameras -> its corners in each: from a folder for each camera, or from a table."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

import numpy as np

from calib_patterns import DetectionOptions, Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import InputError
from camera_models.formats.forms import listed
from omnilines.calibration.numbering import Lattice, Numbering
from omnilines.calibration.rig.views import ONE_BOARD
from omnilines.files import Photo, Photos, find_photos, is_rig_table, photo_folder, photos_of, write_corners
from omnilines.files.frames import times_of
from omnilines.files.sets import claimed
from omnilines.files.videos import find_videos
from omnilines.pipelines.detect import detect
from omnilines.pipelines.photo_corners import CORNERS, IN_MEMORY, PhotoCorners
from omnilines.pipelines.recognise import as_printed
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Corners, ViewResult

SHOWN_NAMES = 5
"""Photos without a partner are listed up to this number."""


@dataclass(frozen=True)
class CameraCorners:
    """What was found of one pattern in the photos of one camera."""

    camera: str
    found: PhotoCorners

    @property
    def pattern(self) -> Pattern:
        """The target that was looked for."""
        assert self.found.pattern is not None
        return self.found.pattern


@dataclass(frozen=True)
class RigCorners:
    """Corners of a rig, and what is known beside them, so that the rig can lead to more of them."""

    corners: Corners
    image_sizes: Mapping[str, tuple[int, int]]
    """Of every camera with corners."""
    numberings: Mapping[str, Numbering] | None = None
    """Of each board, where the pattern is known."""
    seen_from_front: bool = False
    photo_folder: Path | None = None
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What they were made from, for the provenance of results."""
    skipped: tuple[ViewResult, ...] = ()
    notes: tuple[str, ...] = ()
    cameras: tuple[CameraCorners, ...] = ()
    """One by one; none where the corners are from a table."""
    times_s: Mapping[str, float] = field(default_factory=dict)
    """When photos were taken, by name and by the clock of each camera, as far as that is known."""

    @staticmethod
    def of_table(
        corners: Corners,
        image_sizes: Mapping[str, tuple[int, int]],
        source: str | Path = IN_MEMORY,
        photo_folder: Path | None = None,
    ) -> "RigCorners":
        """Corners of a table; `image_sizes` by camera, "" standing for all others; `source` is named in errors and in the
        provenance.

        Without frames the instant is the view, where two cameras have views of one name, and else the name of the photo as in
        folders. Raises InputError where the table names no cameras, a size is missing or a corner lies outside the image.
        """
        cameras = corners.cameras or ()
        if not cameras:
            raise InputError(f"{source}: the camera of every view was expected, found none; name them, or calibrate one camera.")
        require_all_named("`image_size`", image_sizes, tuple(dict.fromkeys(cameras)))
        sizes = {name: image_sizes.get(name, image_sizes.get("")) for name in dict.fromkeys(cameras)}
        found = {name: size for name, size in sizes.items() if size is not None}
        missing = [name for name in sizes if name not in found]
        if missing:
            raise InputError(
                f"`image_size` was expected for every camera of {source}, found none for '{missing[0]}'; give one for all, or "
                f"{missing[0]}=WIDTHxHEIGHT."
            )
        _require_inside(corners, cameras, found, source)
        frames = corners.frames or _frames(corners, cameras)
        return RigCorners(replace(corners, frames=frames), found, photo_folder=photo_folder, inputs={"corners": source})

    @property
    def remarks(self) -> dict[str, str]:
        """What a person should know of single photos that are used all the same: blur."""
        views = [(item.found.corners.view_names, item.found.remarks) for item in self.cameras]
        return {name: remark for names, own in views for name, remark in zip(names, own, strict=True) if remark}

    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write `corners.csv` into a folder, which is made if absent; returns the files."""
        with claimed(folder, [CORNERS], by="detect") as out:
            write_corners(out / CORNERS, self.corners)
        return (out / CORNERS,)


def require_all_named(option: str, given: Mapping[str, Any], cameras: Collection[str]) -> None:
    """Raises InputError where a value by camera is of none of these, or that for all others, under "", is of no other."""
    unknown = [name for name in given if name and name not in cameras]
    if unknown:
        raise InputError(f"{option}: cameras among {listed(cameras)} were expected, found '{unknown[0]}'; correct the name.")
    if "" in given and not set(cameras) - set(given):
        raise InputError(f"{option}: a value for other cameras was given, found all of them named; leave it out.")


def _require_inside(corners: Corners, cameras: Sequence[str], sizes: Mapping[str, tuple[int, int]], source: str | Path) -> None:
    limit = np.array([sizes[name] for name in cameras])[corners.view] - 0.5
    outside = ((corners.pixels < -0.5) | (corners.pixels > limit)).any(-1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        view, (u, v) = int(corners.view[row]), corners.pixels[row]
        width, height = sizes[cameras[view]]
        raise InputError(
            f"{source}: every corner was expected inside the image of {width}x{height} px of {cameras[view]}, found ({u:g}, "
            f"{v:g}) in view {corners.view_names[view]}; check `image_size` (width x height)."
        )


def _frames(corners: Corners, cameras: Sequence[str]) -> tuple[str, ...]:
    """The instant of every view by its name."""
    seen = Counter({(camera, name): 1 for camera, name in zip(cameras, corners.view_names, strict=True)})
    common = max(Counter(name for _, name in seen).values()) > 1
    names = [PurePosixPath(image) for image in corners.images]
    return corners.view_names if common else tuple(frame_of(n) if len(n.parts) > 1 else n.stem for n in names)


def is_rig(paths: Sequence[Path]) -> bool:
    """Whether this is a rig: a table with several cameras or boards; one folder whose photos all lie in two or more sub-folders,
    or such folders side by side, at least one file name standing in two of them; or several videos."""
    if videos := find_videos(paths):
        return len(videos) > 1
    if len(paths) == 1 and paths[0].suffix.lower() == ".csv":
        return paths[0].is_file() and is_rig_table(paths[0])
    return all(path.is_dir() for path in paths) and bool(shared_frames(find_photos(paths)))


def shared_frames(photos: Sequence[Photo]) -> tuple[str, ...]:
    """The folders of photos of which at least two hold one file name; none where a photo lies beside them."""
    names = [PurePosixPath(photo.name) for photo in photos]
    if any(len(name.parts) < 2 for name in names):
        return ()
    counts = Counter({(name.parts[0], frame_of(name)): 1 for name in names})
    common = max(Counter(frame for _, frame in counts).values()) > 1
    return tuple(dict.fromkeys(name.parts[0] for name in names)) if common else ()


def frame_of(name: PurePosixPath) -> str:
    """The instant of a photo: its path within its camera's folder, if it is in one, without the ending; where the file's name
    begins or ends with that of the folder (left/left01.png), without that."""
    if len(name.parts) < 2:
        return name.stem
    camera, inside = name.parts[0], PurePosixPath(*name.parts[1:])
    stem = inside.stem
    if re.search("[a-zA-Z]", camera):
        own = re.escape(camera)
        stem = re.sub(rf"^{own}[-_. ]*(?=.)|(?<=.)[-_. ]*{own}$", "", stem, count=1, flags=re.IGNORECASE)
    return (inside.parent / stem).as_posix()


def detect_rig(
    photos: Photos,
    patterns: str | Sequence[str],
    *,
    mirrored: bool = False,
    perhaps_mirrored: Sequence[str] | None = None,
    camera: str | None = None,
    options: DetectionOptions = DetectionOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> RigCorners:
    """Find one or more targets in the photos of every camera of a rig.

    `photos` are a folder with one sub-folder for each camera, these sub-folders, the frames that `frames` chose, or photos by
    camera as `detect` takes them; those of the same name are of the same instant. With `camera` all are of one camera of that
    name, which sees several targets that are fixed to one another, such as the faces of a cube. Where no tag is read in the
    photos of a camera among `perhaps_mirrored` (by default of any), they are read as mirror images; with `mirrored` all are.
    `executor` as in `detect`.
    Raises InputError where no camera sees a target.

        >>> found = ol.detect_rig("rig/", "checkerboard:8x6:30mm")
        >>> found.image_sizes, found.corners.frames[:2]
        ({'left': (640, 480), 'right': (640, 480)}, ('0', '1'))
    """
    specs = [patterns] if isinstance(patterns, str) else patterns
    boards = [parse_pattern(text) for text in specs]
    by_camera = _by_camera(photos, camera)
    several = len(boards) > 1
    found: list[CameraCorners] = []
    notes = [] if camera is not None else list(_mismatches(by_camera))
    every = [photo for own in by_camera.values() for photo in own]
    for k, board in enumerate(boards):
        # Of several boards each may show the tags of another.
        boards[k], otherwise = as_printed(
            board, every, any_tags=not several, mirrored=mirrored, options=options, progress=progress
        )
        notes += [otherwise] if otherwise else []
    for name, own in by_camera.items():
        perhaps = perhaps_mirrored is None or name in perhaps_mirrored
        for board in boards:
            try:
                looked = _look(own, board, perhaps, mirrored=mirrored, options=options, executor=executor, progress=progress)
                found.append(CameraCorners(name, looked))
            except InputError as error:
                notes.append(f"Camera {name}: {error}")
    folder = Path(photos) if isinstance(photos, str | Path) else None if isinstance(photos, Mapping) else photo_folder(every)
    if not found:
        where = "" if folder is None else f" in {folder}"
        raise InputError(f"A pattern was expected in the photos of some camera{where}, found none; {notes[-1]}")
    plain = any(board.plain_grid is not None for board in boards)
    return replace(
        corners_of_cameras(found, several, times_of(every, folder)),
        numberings={board.specification if several else ONE_BOARD: _numbering(board) for board in boards},
        seen_from_front=not plain,
        photo_folder=folder,
        inputs={"photos": folder or IN_MEMORY, "pattern": ",".join(board.specification for board in boards)},
        notes=tuple(notes),
    )


def _by_camera(photos: Photos, camera: str | None) -> dict[str, list[Photo]]:
    """The photos of each camera, whose name stands before theirs; all of one `camera` where that is given."""
    if camera is not None:
        if isinstance(photos, Mapping):
            raise InputError("`camera` was expected with the photos of one, found photos by camera; leave it out.")
        return {camera: photos_of(photos)}
    if isinstance(photos, Mapping):
        return {
            camera: [replace(photo, name=f"{camera}/{photo.name}") for photo in photos_of(own)] for camera, own in photos.items()
        }
    found: dict[str, list[Photo]] = {}
    for photo in photos_of(photos):
        found.setdefault(PurePosixPath(photo.name).parts[0], []).append(photo)
    return found


def corners_of_cameras(
    found: Sequence[CameraCorners], several_boards: bool, times_s: Mapping[str, float] = MappingProxyType({})
) -> RigCorners:
    """One table of what was found in the photos of all cameras, which may have been taken at known times."""
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
        np.array([times_s[image] for image in images]) if times_s.keys() >= set(images) else None,
    )
    sizes = {item.camera: item.found.image_size for item in found}
    # A photo that shows another of the boards is not skipped.
    skipped = tuple(
        replace(view, camera=item.camera) for item in found for view in item.found.skipped if view.image not in images
    )
    return RigCorners(corners, sizes, skipped=skipped, cameras=tuple(found), times_s=times_s)


def _look(
    photos: Sequence[Photo],
    pattern: Pattern,
    perhaps_mirrored: bool,
    *,
    mirrored: bool,
    options: DetectionOptions,
    executor: Executor | None,
    progress: ProgressCallback,
) -> PhotoCorners:
    look = partial(detect, photos, pattern, recognise=False, options=options, executor=executor, progress=progress)
    try:
        return look(mirrored=mirrored)
    except InputError:
        # Tags are not read in a mirror image; the corners of a plain board are found either way.
        if pattern.plain_grid is not None or not perhaps_mirrored or mirrored:
            raise
        return look(mirrored=True)


def _numbering(pattern: Pattern) -> Numbering:
    """Tags name every corner; the squares of a plain board only have two colours."""
    if pattern.plain_grid is None:
        return Numbering()
    lattice = Lattice.of(pattern.points_m)
    return Numbering(lattice, coloured=True, trusted=False)


def _mismatches(by_camera: Mapping[str, Sequence[Photo]]) -> list[str]:
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
