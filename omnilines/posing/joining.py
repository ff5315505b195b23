"""Photos joined by COLMAP, with all that they have in common or without what goes along with the camera, and why they are not."""

from dataclasses import replace
from pathlib import Path

from camera_models import GeometryError
from camera_models.formats.disk import own_folder
from camera_models.pose import Pose
from omnilines.posing.carried_along import without_carried
from omnilines.posing.colmap_mapper import MapperInput, map_photos
from omnilines.posing.growth import Matches, PairMatches
from omnilines.posing.one_place import at_one_place
from omnilines.posing.options import PosingOptions
from omnilines.progress import ProgressCallback

TO_MASK = "leave out a vehicle, a mount, a hand or a date that photos always show, with `mask`."
LEFT_OUT = (
    "Photos could be joined only without what lies at one place in all of them, which goes along with the camera, or far away: "
    f"{TO_MASK}"
)
ONE_PLACE = (
    "A turn of the camera alone explains most of what {} of {} photos have in common: from about one place hardly anything has a "
    "depth, so that poses and lines are doubtful, far more than they state; move the camera between photos."
)
LEAST_PHOTOS = 3


def joined(
    given: MapperInput, matches: Matches, work: Path, seed: int, progress: ProgressCallback, options: PosingOptions
) -> tuple[list[dict[int, Pose]], Matches, tuple[str, ...]]:
    """The parts that COLMAP joins, by all matches or, where there is none, by those that do not go along with the camera; these
    matches, and what is to be said of them. Raises GeometryError where there is none either way."""

    parts = mapped(given, matches.clear, work, seed, progress, options)
    if parts:
        return parts, matches, ()
    without = others(given, matches, options)
    fewer = _number(without.clear) < _number(matches.clear)
    parts = mapped(given, without.clear, work, seed, progress, options) if fewer else []
    if not parts:
        raise GeometryError(_why_not(given, matches, seed, options))
    return parts, without, (LEFT_OUT,)


def mapped(
    given: MapperInput, clear: PairMatches, work: Path, seed: int, progress: ProgressCallback, options: PosingOptions
) -> list[dict[int, Pose]]:
    """The parts that COLMAP joins by these matches."""
    work.mkdir(parents=True, exist_ok=True)
    with own_folder(work, "colmap.") as folder:
        return map_photos(replace(given, matches=clear), folder / "mapper", seed, progress, options)


def others(given: MapperInput, matches: Matches, options: PosingOptions) -> Matches:
    """The matches that do not go along with the camera."""
    return Matches(*(without_carried(given.features, one, given.camera, options) for one in (matches.clear, matches.faint)))


def about_one_place(given: MapperInput, matches: Matches, seed: int, options: PosingOptions) -> tuple[str, ...]:
    """What is to be said of photos that have poses where those at one place and every other instant are too few places."""
    here = at_one_place(given.features, matches.clear, seed, options)
    places = len(set(given.frame) - {given.frame[k] for k in here}) + 1
    return (ONE_PLACE.format(len(here), len(given.frame)),) if here and places < LEAST_PHOTOS else ()


def _why_not(given: MapperInput, matches: Matches, seed: int, options: PosingOptions) -> str:
    """Why no photos could be joined, and what to do."""
    count = len(given.features)
    if count < LEAST_PHOTOS:
        return f"{LEAST_PHOTOS} photos of one scene or more were expected to find their poses, found {count}; give more."
    return from_one_place(given, matches, seed, options) or (
        f"Photos with enough in common to find their poses were expected, found {count} that COLMAP could not join; "
        "take more photos with smaller steps between them, or give poses."
    )


def from_one_place(given: MapperInput, matches: Matches, seed: int, options: PosingOptions) -> str:
    """That most photos are from one place, and what to do: nothing has a depth from there, however much photos overlap. Empty
    where they are not."""
    count, here = len(given.features), len(at_one_place(given.features, matches.clear, seed, options))
    if 2 * here <= count:
        return ""
    if 2 * _number(others(given, matches, options).clear) < _number(matches.clear):
        return (
            f"Photos from different places were expected to find their poses, found that most of what {here} of {count} photos "
            "have in common lies at the same place in each: the camera stood still, or it sees what goes along with it; move the "
            f"camera between photos, and {TO_MASK}"
        )
    return (
        f"Photos from different places were expected to find their poses, found {here} of {count} at one place, from where "
        "nothing has a depth: a turn of the camera alone explains what they have in common; move the camera between photos."
    )


def _number(matches: PairMatches) -> int:
    return sum(map(len, matches.values()))
