"""Photos in which the target asked for is not found -> what they show in its place."""

from collections import Counter
from collections.abc import Sequence

from calib_patterns import DetectionOptions, Pattern
from calib_patterns.aprilgrid import AprilGrid
from calib_patterns.charuco import TAGS_OF_DICTIONARY, ChArUco
from calib_patterns.seen_board import SeenBoard, seen_board
from camera_models import InputError
from omnilines.files import Photo
from omnilines.progress import ProgressCallback, on_all_cores

TRIED = 6
"""Photos that are looked at, over all of them."""


def other_board(
    photos: Sequence[Photo], asked: Pattern, mirrored: bool, options: DetectionOptions, progress: ProgressCallback
) -> str | None:
    """One sentence on the target that photos without the one asked for show, where half of those looked at agree on it; None
    where they do not, or it may be the one asked for."""
    tried = [photos[k * len(photos) // TRIED] for k in range(TRIED)] if len(photos) > TRIED else list(photos)

    def look(photo: Photo) -> SeenBoard | None:
        """What one photo shows."""
        try:
            return seen_board(photo.read(), options)
        except InputError:
            return None  # it is named for that already

    looked = on_all_cores(look, tried, "looking for another target", progress)
    seen = _agreed([board for board in looked if board is not None], len(tried))
    return None if seen is None or _may_be(seen, asked, mirrored) else _sentence(seen, asked, mirrored)


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
    return SeenBoard(alike[0].name, wide, rows, tags, alike[0].shown)


def _plain(board: SeenBoard) -> object:
    """What does not differ from photo to photo: the size of a checkerboard, the family of tags."""
    if board.name == "checkerboard":
        return tuple(sorted((board.columns, board.rows)))
    return board.tags.rsplit("_", 1)[0]


def _may_be(seen: SeenBoard, asked: Pattern, mirrored: bool) -> bool:
    """Whether what is seen is the target asked for, or part of it."""
    if seen.name != asked.NAME or seen.shown not in ("", "mirrored" if mirrored else ""):
        return False
    if asked.plain_grid is not None:
        grid = sorted((asked.plain_grid.columns, asked.plain_grid.rows))
        return all(part <= whole for part, whole in zip(sorted((seen.columns, seen.rows)), grid, strict=True))
    return _alike(seen, asked)


def _alike(seen: SeenBoard, asked: Pattern) -> bool:
    """Whether a board with tags is the one asked for, or part of it, however it is shown."""
    if seen.name != asked.NAME or not isinstance(asked, ChArUco | AprilGrid):
        return False
    tags = asked.dictionary if isinstance(asked, ChArUco) else asked.tag_family
    return tags.rsplit("_", 1)[0] == seen.tags.rsplit("_", 1)[0] and seen.columns in (0, asked.nx) and seen.rows <= asked.ny


def _sentence(seen: SeenBoard, asked: Pattern, mirrored: bool) -> str:
    grid = asked.plain_grid
    columns, rows = seen.columns, seen.rows
    if seen.name == "checkerboard" and grid is not None and grid.columns < grid.rows:
        columns, rows = rows, columns
    size = f"{columns}x{rows} " if columns else ""
    what, text = {
        "checkerboard": (f"a checkerboard of {size}inner corners", f"checkerboard:{columns}x{rows} with its square"),
        "charuco": (f"a ChArUco board of {size}squares with tags of {seen.tags}", f"charuco:{size.strip() or 'NXxNY'}"),
        "aprilgrid": (f"an AprilGrid of {size}tags of {seen.tags}", f"aprilgrid:{size.strip() or 'NXxNY'}"),
    }[seen.name]
    if seen.name != "checkerboard":
        text += f" with its sizes and {seen.tags}"
    if seen.shown == "negative":
        return f"The photos look like {what} that is printed white on black, which is not read: invert the photos."
    if seen.shown and not mirrored and _alike(seen, asked):
        return (
            f"The photos look like {asked.specification} in a mirror: if they were flipped, as selfies often are, flip them "
            "back; if they were taken by way of a mirror, give `mirrored`."
        )
    if seen.shown and not mirrored:
        what, text = f"{what} in a mirror", f"{text}, and `mirrored`"
    return f"The photos look like {what}: if that is the target, give {text}."
