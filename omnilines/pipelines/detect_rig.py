"""Photos of a target by several cameras -> its corners in each: from a folder for each camera, or from a table."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from types import MappingProxyType

import numpy as np

from calib_patterns import DetectionOptions, Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import InputError
from camera_models.typed import typed
from omnilines.calibration.numbering import Lattice, Numbering
from omnilines.calibration.rig.views import ONE_BOARD
from omnilines.files import Photo, Photos, find_photos, is_rig_table, photo_folder, photos_of
from omnilines.files.frames import times_of
from omnilines.files.videos import find_videos
from omnilines.options import require_ranges
from omnilines.pipelines.detect import detect
from omnilines.pipelines.photo_corners import CORNERS, IN_MEMORY, PhotoCorners
from omnilines.pipelines.recognise import as_printed
from omnilines.pipelines.rig_corners import SHOWN_NAMES, CameraCorners, RigCorners
from omnilines.posing.instant_names import frame_of
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Corners


def is_rig(paths: Sequence[Path]) -> bool:
    """Whether this is a rig: a table with several cameras or boards; one folder whose photos all lie in two or more sub-folders,
    or such folders side by side, at least one file name standing in two of them; or several videos."""
    if videos := find_videos(paths):
        return len(videos) > 1
    if len(paths) == 1 and paths[0].suffix.lower() == ".csv":
        return paths[0].is_file() and is_rig_table(paths[0])
    return all(path.is_dir() for path in paths) and bool(shared_frames(find_photos(paths)))


def table_without_photos(paths: Sequence[Path]) -> Path | None:
    """The corners.csv of the one folder given, where it holds neither photos nor videos."""
    if len(paths) != 1 or not (table := paths[0] / CORNERS).is_file() or find_videos(paths):
        return None
    try:
        find_photos(paths)
    except InputError:
        return table
    return None


def shared_frames(photos: Sequence[Photo]) -> tuple[str, ...]:
    """The folders of photos of which at least two hold one file name; none where a photo lies beside them."""
    names = [PurePosixPath(photo.name) for photo in photos]
    if any(len(name.parts) < 2 for name in names):
        return ()
    counts = Counter({(name.parts[0], frame_of(name)): 1 for name in names})
    common = max(Counter(frame for _, frame in counts).values()) > 1
    return tuple(dict.fromkeys(name.parts[0] for name in names)) if common else ()


@typed
def detect_rig(
    photos: Photos,
    patterns: str | Sequence[str],
    *,
    mirrored: bool = False,
    perhaps_mirrored: Sequence[str] | None = None,
    camera: str | None = None,
    work: str | Path | None = None,
    options: DetectionOptions = DetectionOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> RigCorners:
    """Find one or more targets in the photos of every camera of a rig.

    `photos` are a folder with one sub-folder for each camera, these sub-folders, the frames that `frames` chose, or photos by
    camera as `detect` takes them; those of the same name are of the same instant. With `camera` all are of one camera of that
    name, which sees several targets that are fixed to one another, such as the faces of a cube. Where no tag is read in the
    photos of a camera among `perhaps_mirrored` (by default of any), they are read as mirror images; with `mirrored` all are.
    `work` and `executor` as in `detect`.
    Raises InputError where no camera sees a target.

        >>> found = ol.detect_rig("rig/", "checkerboard:8x6:30mm")
        >>> found.image_sizes, found.corners.frames[:2]
        ({'left': (640, 480), 'right': (640, 480)}, ('0', '1'))
    """
    require_ranges(options)
    specs = [patterns] if isinstance(patterns, str) else patterns
    boards = [parse_pattern(text) for text in specs]
    by_camera = _by_camera(photos, camera)
    several = len(boards) > 1
    found, blind = list[CameraCorners](), dict[str, str]()
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
                look = partial(
                    detect, own, board, recognise=False, work=work, options=options, executor=executor, progress=progress
                )
                looked = _look(look, board, perhaps, mirrored=mirrored)
                found.append(CameraCorners(name, looked))
                notes += [f"Camera {name}: {looked.other}"] if looked.other and not several else []
            except InputError as error:
                notes.append(f"Camera {name}: {error}")
                blind[name] = str(error).rstrip(".")
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
        blind={name: reason for name, reason in blind.items() if name not in {item.camera for item in found}},
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


def _look(look: Callable[..., PhotoCorners], pattern: Pattern, perhaps_mirrored: bool, *, mirrored: bool) -> PhotoCorners:
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
