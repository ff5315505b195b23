"""Photos in which the target asked for is not found -> what they show in its place."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

from calib_patterns import INVERTED, DetectionOptions, Pattern
from calib_patterns.aprilgrid import AprilGrid
from calib_patterns.charuco import TAGS_OF_DICTIONARY, ChArUco
from calib_patterns.inverted import Inverted
from calib_patterns.seen_board import SeenBoard, seen_board
from camera_models import GeometryError, InputError
from omnilines.files import Photo
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.progress import ProgressCallback, on_all_cores

TRIED = 6
"""Photos that are looked at, over all of them."""


def other_board(
    photos: Sequence[Photo],
    asked: Pattern,
    mirrored: bool,
    options: DetectionOptions,
    progress: ProgressCallback,
    *,
    in_no_photo: bool,
) -> str | None:
    """One sentence on the target that photos without the one asked for show, where half of those looked at agree on it; None
    where they do not, or it may be the one asked for, unless that was found `in_no_photo`."""
    tried = [photos[k * len(photos) // TRIED] for k in range(TRIED)] if len(photos) > TRIED else list(photos)

    def look(photo: Photo) -> SeenBoard | None:
        """What one photo shows."""
        try:
            return seen_board(photo.read(), options)
        except InputError:
            return None  # it is named for that already

    looked = on_all_cores(look, tried, "looking for another target", progress)
    seen = _agreed([board for board in looked if board is not None], len(tried))
    if seen is None:
        return None
    if not _may_be(seen, asked, mirrored):
        return _sentence(seen, asked, mirrored)
    if asked.plain_grid is not None or not in_no_photo:
        return None
    if seen.otherwise:
        return (
            "The photos show its tags turned, or numbered in another order, than Kalibr's AprilGrid has them (from the bottom "
            "left upwards, each half a turn from OpenCV's pictures of tags): draw it as `pattern` or Kalibr does."
        )
    return "The photos show its tags, but not its corners where these sizes have them: measure squares and tags."


@contextmanager
def before_geometry(found: Mapping[str, PhotoCorners], progress: ProgressCallback) -> Iterator[None]:
    """Where a calibration from corners by camera is refused, what photos show in place of the target asked for is said first:
    geometry speaks of the corners that were taken for it. A camera without a name is the only one."""
    try:
        yield
    except (InputError, GeometryError) as error:
        others = ((name, own.pattern, _other_in_all(own, progress)) for name, own in found.items())
        name, pattern, other = next(((name, own, other) for name, own, other in others if other), ("", None, None))
        if pattern is None:
            raise
        given, reason = pattern.specification, str(error).partition(";")[0].rstrip(".")
        where = f"Camera {name}: " if name else ""
        raise type(error)(
            f"{where}{other} The corners that seem to be those of {given} leave the camera open ({reason})."
        ) from error


def _other_in_all(found: PhotoCorners, progress: ProgressCallback) -> str | None:
    """`other_board` of all photos: tags of another layout agree with this one here and there."""
    asked = found.pattern
    if found.other is not None or asked is None or asked.plain_grid is not None:
        return found.other
    return other_board(found.photos, asked, found.mirrored, found.options, progress, in_no_photo=False)


def _agreed(seen: Sequence[SeenBoard], tried: int) -> SeenBoard | None:
    """What half of the photos show, two at least where there are as many."""
    kinds = Counter((board.name, board.shown, _plain(board)) for board in seen)
    if not kinds:
        return None
    kind, count = kinds.most_common(1)[0]
    if count < min(2, tried) or 2 * count < tried:
        return None
    alike = [board for board in seen if (board.name, board.shown, _plain(board)) == kind]
    if alike[0].name == "checkerboard":
        return alike[0]
    columns = Counter(board.columns for board in alike if board.columns).most_common(1)
    wide = columns[0][0] if columns else 0
    rows = max((board.rows for board in alike if board.columns == wide), default=0)
    tags = max((board.tags for board in alike), key=lambda name: TAGS_OF_DICTIONARY.get(name, 0))
    return SeenBoard(alike[0].name, wide, rows, tags, alike[0].shown, 2 * sum(board.otherwise for board in alike) > len(alike))


def _plain(board: SeenBoard) -> object:
    """What does not differ from photo to photo: the size of a checkerboard, the family of tags."""
    if board.name == "checkerboard":
        return tuple(sorted((board.columns, board.rows)))
    return board.tags.rsplit("_", 1)[0]


def _may_be(seen: SeenBoard, asked: Pattern, mirrored: bool) -> bool:
    """Whether what is seen is the target asked for, or part of it."""
    printed = _printed(asked)
    if printed.plain_grid is not None:
        grid = sorted((printed.plain_grid.columns, printed.plain_grid.rows))
        own = sorted((seen.columns, seen.rows))
        return seen.name == printed.NAME and all(part <= whole for part, whole in zip(own, grid, strict=True))
    ways = {"negative"} if isinstance(asked, Inverted) else {"", "mirrored" if mirrored else ""}
    return seen.shown in ways and _alike(seen, printed)


def _printed(asked: Pattern) -> Pattern:
    """What is black on white of a target."""
    return asked.printed if isinstance(asked, Inverted) else asked


def _alike(seen: SeenBoard, printed: Pattern) -> bool:
    """Whether a board with tags is the one asked for, or part of it, however it is shown."""
    if seen.name != printed.NAME or not isinstance(printed, ChArUco | AprilGrid):
        return False
    if _tags(seen, printed) != _tags_of(printed):
        return False
    # `seen_board` knows the usual layout alone.
    usual = printed.with_first_tag(0) == printed and not (isinstance(printed, ChArUco) and printed.legacy)
    return not usual or (seen.columns in (0, printed.nx) and seen.rows <= printed.ny)


def _tags_of(printed: ChArUco | AprilGrid) -> str:
    return printed.dictionary if isinstance(printed, ChArUco) else printed.tag_family


def _tags(seen: SeenBoard, asked: Pattern) -> str:
    """The dictionary or family of the tags that are seen: the one asked for where it has them too."""
    printed = _printed(asked)
    if isinstance(printed, ChArUco | AprilGrid) and _tags_of(printed).rsplit("_", 1)[0] == seen.tags.rsplit("_", 1)[0]:
        return _tags_of(printed)
    return seen.tags


def _specification(seen: SeenBoard, asked: Pattern) -> str:
    """To be given for what is seen; sizes as they were given where they are of the same kind of target."""
    printed, size = _printed(asked), f"{seen.columns}x{seen.rows}" if seen.columns else "NXxNY"
    sizes = {"checkerboard": "SQUARE", "charuco": "SQUARE:TAG", "aprilgrid": "TAG:GAP"}[seen.name]
    if printed.NAME == seen.name:
        sizes = ":".join(printed.specification.split(":")[2 : 2 + sizes.count(":") + 1])
    parts = [seen.name, size, sizes, _tags(seen, asked), INVERTED if seen.shown == "negative" else ""]
    return ":".join(part for part in parts if part)


def _sentence(seen: SeenBoard, asked: Pattern, mirrored: bool) -> str:
    grid = asked.plain_grid
    if seen.name == "checkerboard" and grid is not None and grid.columns < grid.rows:
        seen = replace(seen, columns=seen.rows, rows=seen.columns)
    if seen.shown == "mirrored" and not mirrored and _alike(seen, _printed(asked)):
        return (
            f"The photos look like {asked.specification} in a mirror: if they were flipped, as selfies often are, flip them "
            "back; if they were taken by way of a mirror, give `mirrored`."
        )
    size, tags = f"{seen.columns}x{seen.rows} " if seen.columns else "", _tags(seen, asked)
    what = {
        "checkerboard": f"a checkerboard of {size}inner corners",
        "charuco": f"a ChArUco board of {size}squares with tags of {tags}",
        "aprilgrid": f"an AprilGrid of {size}tags of {tags}",
    }[seen.name]
    text = _specification(seen, asked)
    if seen.shown == "negative":
        what = f"{what}, white on black"
    elif seen.shown and not mirrored:
        what, text = f"{what} in a mirror", f"{text}, and `mirrored`"
    return f"The photos look like {what}: if that is the target, give {text}."
