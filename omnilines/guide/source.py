"""Frames as they come: of a camera, of a video, or of a folder to which photos are added."""

import contextlib
import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt

from camera_models import InputError
from omnilines.files import PHOTO_SUFFIXES, read_photo
from omnilines.files.bags import is_bag, split_topics
from omnilines.files.footage import Footage
from omnilines.files.videos import Video, open_videos
from omnilines.photo_file import quiet_codecs

WAIT_S = 0.2
"""Between two looks into a folder."""


@dataclass(frozen=True, eq=False)
class Source:
    """Where frames come from."""

    given: str
    frames_per_s: float
    """Of a video, those that are looked at."""

    def __post_init__(self) -> None:
        """Raises InputError where there is no such source."""
        if self.live:
            return
        path = Path(self.given)
        if self._of_bag:
            self._footage()
            return
        if not os.path.lexists(path):
            raise InputError(
                f"A camera (0, 1, ...), a video or a folder was expected as `source`, found '{self.given}', which does not exist."
            )
        if path.is_dir():
            _photos_in(path)
        else:
            self._footage()

    @property
    def _of_bag(self) -> bool:
        return is_bag(split_topics(self.given)[0])

    def _footage(self) -> Footage:
        if not self._of_bag:
            return Video.of(self.given)
        found = open_videos([self.given])
        if len(found) > 1:
            raise InputError(f"One topic of a bag was expected as `source`, found {len(found)}; guide one camera at a time.")
        return found[0]

    @property
    def live(self) -> bool:
        """Whether it is a camera, whose frames do not wait."""
        return re.fullmatch("[0-9]{1,4}", self.given) is not None

    @property
    def ends(self) -> bool:
        """Whether it is a video or a topic of a bag, the frames of which are the same each time."""
        return not self.live and (self._of_bag or not Path(self.given).is_dir())

    @property
    def path(self) -> Path | None:
        """Of a video, a bag or a folder."""
        return None if self.live else split_topics(self.given)[0]

    def frames(self) -> Iterator[UInt[np.ndarray, "h w *channels"] | None]:
        """One after the other; None where there is none yet. A video ends, a camera and a folder do not.

        Raises InputError where no camera opens."""
        if self.live:
            return _of_camera(int(self.given))
        return _of_footage(self._footage(), self.frames_per_s) if self.ends else _of_folder(Path(self.given))


def _of_camera(index: int) -> Iterator[UInt[np.ndarray, "h w *channels"] | None]:
    capture = cv2.VideoCapture()
    with quiet_codecs(), contextlib.suppress(cv2.error):
        capture.open(index)
    if not capture.isOpened():
        raise InputError(f"A camera was expected at index {index}, found none that opens; give another `source`.")
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return _shots(capture)


def _shots(capture: cv2.VideoCapture) -> Iterator[UInt[np.ndarray, "h w *channels"] | None]:
    try:
        while True:
            came, pixels = capture.read()
            yield pixels if came else None
    finally:
        capture.release()


def _of_footage(video: Footage, frames_per_s: float) -> Iterator[UInt[np.ndarray, "h w *channels"] | None]:
    step = max(1, round(video.frames_per_s / frames_per_s))
    return (frame.pixels for frame in video.frames() if frame.index % step == 0)


def _of_folder(folder: Path) -> Iterator[UInt[np.ndarray, "h w *channels"] | None]:
    """Photos in the order in which they come; one that cannot be read is still being written, and is looked at again."""
    done: set[str] = set()
    while True:
        for path in _photos_in(folder):
            if path.name in done:
                continue
            try:
                pixels = read_photo(path)
            except InputError:
                continue
            done.add(path.name)
            yield pixels
        time.sleep(WAIT_S)
        yield None


def _photos_in(folder: Path) -> list[Path]:
    try:
        return [path for path in sorted(folder.iterdir()) if path.suffix.lower() in PHOTO_SUFFIXES]
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be read ({error.strerror}); give one that can be.") from None
