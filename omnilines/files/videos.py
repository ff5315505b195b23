"""Videos on disk: found by their suffix, read frame by frame by OpenCV's FFmpeg, never whole in memory; bags beside them."""

import contextlib
import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes
from camera_models.formats.values import is_text
from omnilines.files.bags import is_bag, split_topics, topics_of
from omnilines.files.footage import Footage, Frame
from omnilines.files.passed_over import look_beside
from omnilines.files.photos import PHOTO_SUFFIXES, UNREAD_SUFFIXES
from omnilines.files.topics import Topic
from omnilines.photo_file import quiet_codecs

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".insv", ".360")

COUNTED_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".insv", ".360")
"""Of containers that state how many frames they hold; of others the number is estimated from the length."""
LEAST_DECODED = 0.9
"""Of the length, or of the frames, that a video states."""
LATEST_MS = 1e10
"""Of a frame, four months: containers may state any time."""


@dataclass(frozen=True)
class Video(Footage):
    """A video file that can be read."""

    @staticmethod
    def of(path: str | Path) -> "Video":
        """Raises InputError where the file does not exist, or is no video that OpenCV decodes."""
        file = Path(path)
        read_bytes(file, most=1)  # says what is wrong with a path, and refuses pipes and devices
        if not is_text(str(file)):  # OpenCV ends the process over a name that is not UTF-8
            raise InputError(f"The name of the video {str(file)!r} holds characters that are not text; rename it.")
        with _opened(file) as source:
            rate, count = source.get(cv2.CAP_PROP_FPS), source.get(cv2.CAP_PROP_FRAME_COUNT)
            read, pixels = source.read()
        if not read:
            raise InputError(
                f"The video {file} cannot be decoded: it is damaged, empty, of another format, or was never closed, as where a "
                "camera lost power; copy it again, or convert it to MP4."
            )
        size = (pixels.shape[1], pixels.shape[0])
        # Containers of streams state no length, or a nonsense rate.
        return Video(file, rate if 1.0 <= rate <= 1000.0 else 30.0, int(count) if 0 < count < 1e8 else 0, size)

    @property
    def title(self) -> str:
        """The name of the file."""
        return self.path.name

    @property
    def name(self) -> str:
        """The name of the file without its suffix."""
        return self.path.stem

    @property
    def stamped(self) -> bool:
        """Each video begins at 0."""
        return False

    @property
    def begins_ns(self) -> None:
        """Containers tell the second at most."""

    def frames(self, wanted: Collection[int] | None = None) -> Iterator[Frame]:
        """All frames, or those of the indices wanted, in order; ends where the video does, or where it is damaged."""
        last = None if wanted is None else max(wanted, default=-1)
        with _opened(self.path) as source:
            index = 0
            while (last is None or index <= last) and _grabbed(source):
                if wanted is None or index in wanted:
                    time_ms = source.get(cv2.CAP_PROP_POS_MSEC)
                    read, pixels = source.retrieve()
                    if not read:
                        return
                    yield Frame(index, 1e-3 * time_ms if 0 < time_ms < LATEST_MS else index / self.frames_per_s, pixels)
                index += 1

    def doubts(self, times_s: Float[np.ndarray, " n"]) -> tuple[str, ...]:
        """That it ends before the length it states, or frames in between cannot be decoded."""
        counted = self.path.suffix.lower() in COUNTED_SUFFIXES
        end_s = times_s[-1] + 1.0 / self.frames_per_s
        whole = end_s >= LEAST_DECODED * self.duration_s and (not counted or len(times_s) >= LEAST_DECODED * self.count)
        if whole:
            return ()
        return (
            f"The video {self.title} states {self.count} frames in {self.duration_s:.1f} s, of which {len(times_s)} can be "
            f"decoded, the last at {times_s[-1]:.1f} s: it is damaged or cut short; copy it again.",
        )


def is_video(path: str | Path) -> bool:
    """Whether the name is that of a video."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def find_videos(paths: Sequence[str | Path]) -> list[Path]:
    """The videos among files, and in folders that hold videos and no photos, in order of their names; none where there are
    photos alone. Files in folders whose name begins with a dot are left out.

    A bag is as many videos as it has topics with images, each as `BAG:/topic`; where it has several, those that are named
    (`BAG:/one,/two`). Raises InputError where there are videos and photos, a folder or bag cannot be read, or topics of a bag
    are to be named.
    """
    videos: list[Path] = []
    others: list[Path] = []
    for path in map(Path, paths):
        bag, topics = split_topics(path)
        files = _files_in(path) if path.is_dir() and not is_bag(path) else []
        inside = [file for file in files if is_video(file) or is_bag(file)]
        if is_bag(bag):
            videos += topics_of(bag, topics)
        elif is_video(path) and not path.is_dir():
            videos.append(path)
        elif inside and not any(file.suffix.lower() in PHOTO_SUFFIXES for file in files):
            videos += [video for file in inside for video in (topics_of(file, ()) if is_bag(file) else [file])]
            look_beside([], (file for file in files if file.suffix.lower() in UNREAD_SUFFIXES))
        else:
            others.append(path)
    if videos and others:
        raise InputError(f"Videos or photos were expected, found {videos[0]} and {others[0]}; give them one after the other.")
    return list(dict.fromkeys(videos))


def open_videos(paths: Sequence[str | Path]) -> tuple[Footage, ...]:
    """What `find_videos` finds, opened; the times of topics count from the first stamp of all."""
    found = [Topic.of(path) if is_bag(split_topics(path)[0]) else Video.of(path) for path in find_videos(paths)]
    first_ns = min((one.origin_ns for one in found if isinstance(one, Topic)), default=0)
    return tuple(replace(one, origin_ns=first_ns) if isinstance(one, Topic) else one for one in found)


def _files_in(folder: Path) -> list[Path]:
    try:
        return sorted(entry for entry in folder.iterdir() if not entry.name.startswith(".") and not entry.is_dir())
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be read ({error.strerror}); give one that can be.") from None


def alike(one: Footage, other: Footage) -> bool:
    """Whether the frames of two videos may belong together by their numbers: rate and length agree."""
    return abs(one.frames_per_s - other.frames_per_s) < 1e-3 * one.frames_per_s and abs(one.count - other.count) <= 1


def together(videos: Sequence[Footage], instants: Sequence[tuple[int, ...]]) -> Iterator[tuple[Frame, ...]]:
    """The frames of all videos at some instants, each the number of a frame of every video; numbers do not fall from one to the
    next. It ends with the first video that does."""
    sources = [_Following(video.frames({instant[k] for instant in instants})) for k, video in enumerate(videos)]
    for instant in instants:
        shown = [source.at(index) for source, index in zip(sources, instant, strict=True)]
        found = [frame for frame in shown if frame is not None]
        if len(found) < len(shown):
            return
        yield tuple(found)


class _Following:
    """The frames of a video by their numbers, which do not fall."""

    def __init__(self, frames: Iterator[Frame]) -> None:
        self._frames = frames
        self._now = next(frames, None)

    def at(self, index: int) -> Frame | None:
        """The frame of a number; None where the video has ended."""
        while self._now is not None and self._now.index < index:
            self._now = next(self._frames, None)
        return self._now


OPEN_WITH = {
    # A file may name other files, or addresses, to be played in its place: nothing but the file itself is read.
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": "protocol_whitelist;file|format_whitelist;mov,mp4,matroska,webm,avi,mpeg,mpegts",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
}
"""Environment that OpenCV reads as it opens a video."""


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    source = cv2.VideoCapture()
    os.environ.update(OPEN_WITH)
    try:
        with quiet_codecs(), contextlib.suppress(cv2.error):
            source.open(str(path.absolute()), cv2.CAP_FFMPEG)
        yield source
    finally:
        source.release()


def _grabbed(source: Any) -> bool:
    try:
        return bool(source.grab())
    except cv2.error:
        return False
