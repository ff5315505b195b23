"""Photos that their EXIF orientation turns otherwise than the others of their camera.

A calibration is about the pixels of a sensor. Photos are used as their orientation turns them, which is the same for all photos
of a camera that is held the same way; one that is turned otherwise would have other pixels of the sensor, at the same size where
it is turned by half a turn.
"""

from collections import Counter
from collections.abc import Mapping, Sequence

from omnilines.files.photos import Photo, PhotoRef
from omnilines.photo_file import orientation_of_file

_TURNS = {
    1: "not at all",
    2: "to a mirror image",
    3: "by 180 degrees",
    4: "upside down to a mirror image",
    5: "on its side to a mirror image",
    6: "by 90 degrees to the right",
    7: "on its side to a mirror image",
    8: "by 90 degrees to the left",
}
"""By the value of the tag (Exif 2.3, 0x0112)."""


def turned_otherwise(photos: Sequence[Photo]) -> dict[str, str]:
    """Of photos of one camera, by name, those that are turned otherwise than most, each with a reason; where as many are turned
    one way as the other, those that are turned."""
    orientation = _orientations(photos)
    counts = Counter(orientation.values())
    usual = min(counts, key=lambda value: (-counts[value], value), default=1)
    return {name: _reason(value, usual) for name, value in orientation.items() if value != usual}


def by_camera(photos: Sequence[Photo], camera_of: Mapping[str, str]) -> dict[str, str]:
    """`turned_otherwise` of each camera's own photos."""
    return {
        name: reason
        for camera in dict.fromkeys(camera_of.values())
        for name, reason in turned_otherwise([photo for photo in photos if camera_of[photo.name] == camera]).items()
    }


def turned_note(photos: Sequence[Photo]) -> tuple[str, ...]:
    """That photos are used as their orientation turns them, for models that are shared with tools that do not turn them."""
    turned = [name for name, value in _orientations(photos).items() if value != 1]
    if not turned:
        return ()
    return (
        f"{len(turned)} of {len(photos)} photos, such as {turned[0]}, are used as their EXIF orientation turns them, and COLMAP, "
        "Nerfstudio and trainers take them unturned: cameras and poses agree there for photos alone that are saved upright.",
    )


def _orientations(photos: Sequence[Photo]) -> dict[str, int]:
    """By name; of photos in memory there is none, which is 1."""
    return {photo.name: orientation_of_file(photo.path) if isinstance(photo, PhotoRef) else 1 for photo in photos}


def _reason(value: int, usual: int) -> str:
    return (
        f"its EXIF orientation turns it {_TURNS[value]}, and the other photos {_TURNS[usual]}, where pixels have to be those of "
        "one sensor; give it the orientation of the others"
    )
