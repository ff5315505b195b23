"""Which photos of a rig are of one instant, by their names."""

import re
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath


def frame_of(name: PurePosixPath) -> str:
    """The instant of a photo: its path within its camera's folder, if it is in one, without the ending; where the file's name
    begins or ends with that of the folder (left/left01.png), without that."""
    if len(name.parts) < 2:
        return name.stem
    camera, inside = name.parts[0], PurePosixPath(*name.parts[1:])
    return (inside.parent / _without_camera(inside.stem, camera)).as_posix()


def instants(names: Sequence[str], camera_of: Mapping[str, str]) -> dict[str, str]:
    """The instant of each photo of a rig whose cameras are known: photos of one file name are of one, but for the name of the
    camera that it begins or ends with. Where a camera has two of one such name, their folders tell them apart."""
    own = {name: _without_camera(PurePosixPath(name).stem, camera_of[name]) for name in names}
    if len({(camera_of[name], instant) for name, instant in own.items()}) == len(own):
        return own
    folders = {name: [part for part in PurePosixPath(name).parent.parts if part != camera_of[name]] for name in names}
    return {name: PurePosixPath(*folders[name], instant).as_posix() for name, instant in own.items()}


def _without_camera(stem: str, camera: str) -> str:
    """A file's name without the camera's at its beginning or end; one of digits alone is none that files are called by."""
    if not re.search("[a-zA-Z]", camera):
        return stem
    own = re.escape(camera)
    return re.sub(rf"^{own}[-_. ]*(?=.)|(?<=.)[-_. ]*{own}$", "", stem, count=1, flags=re.IGNORECASE)
