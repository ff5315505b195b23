"""Which photo is meant by the names that another tool has for photos."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath


def matched_names(photos: Sequence[str], names: Sequence[str], where: str) -> tuple[dict[str, str], Mapping[str, str]]:
    """The name of each photo (a path relative to the photo folder) among `names`, and a sentence for each that has none.

    Names are matched as they stand; else by the longest run of folders and file name at the end that they have in common with one
    name alone (`a/left/1.png` and `left/1.png`); else by the file's name without its ending. What fits several is left out.
    `where` is what messages call the place of the names.
    """
    found, lost = {}, {}
    for photo in photos:
        name, reason = _match(photo, names, where)
        if name is None:
            lost[photo] = f"{photo} has no pose: {reason}."
        else:
            found[photo] = name
    twice = {name for name, count in Counter(found.values()).items() if count > 1}
    lost |= {
        photo: f"{photo} has no pose: several photos are like the image {name} of {where}."
        for photo, name in found.items()
        if name in twice
    }
    return {photo: name for photo, name in found.items() if name not in twice}, lost


def _match(photo: str, names: Sequence[str], where: str) -> tuple[str | None, str]:
    """The name of a photo, or None and why."""
    if photo in names:
        return photo, ""
    parts = PurePosixPath(photo).parts
    shared = {name: _common_end(parts, PurePosixPath(name.replace("\\", "/")).parts) for name in names}
    longest = max(shared.values(), default=0)
    if longest:
        best = [name for name in names if shared[name] == longest]
        return (best[0], "") if len(best) == 1 else (None, f"{len(best)} images of {where} are named like it")
    stem = PurePosixPath(photo).stem
    best = [name for name in names if PurePosixPath(name).stem == stem]
    if len(best) == 1:
        return best[0], ""
    return None, f"{len(best)} images of {where} are named like it" if best else f"{where} has no such image"


def _common_end(a: Sequence[str], b: Sequence[str]) -> int:
    count = 0
    for x, y in zip(reversed(a), reversed(b), strict=False):
        if x != y:
            break
        count += 1
    return count
