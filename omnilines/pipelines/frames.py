"""Videos -> the frames worth keeping: still, sharp, and telling of the camera, or of the scene from somewhere new."""

import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_patterns import Detection, DetectionOptions, Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import GeometryError, InputError
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.telling import ViewInformation, telling_instants, view_information
from omnilines.files import PhotoArray, write_png
from omnilines.files.frames import FrameRow, write_frames
from omnilines.files.videos import Video, find_videos, together
from omnilines.footage.options import FrameOptions
from omnilines.footage.stillness import Instant, Look, Meter, spaced, stillest
from omnilines.pipelines.detect import corner_table
from omnilines.progress import ProgressCallback, on_all_cores, silent

GUIDE = "scaramuzza"
"""The model by which views are compared: it fits lenses of every width."""
TABLE = "frames.csv"


@dataclass(frozen=True)
class ChosenFrames:
    """The frames of one or more videos that were looked at closely, and which of them were taken."""

    videos: tuple[Video, ...]
    rows: tuple[FrameRow, ...]
    """Of every frame that was looked at, with why it was taken or not."""
    notes: tuple[str, ...] = ()

    @property
    def taken(self) -> tuple[FrameRow, ...]:
        """The frames that were taken."""
        return tuple(row for row in self.rows if row.taken)

    @property
    def names(self) -> tuple[str, ...]:
        """Files that `save` writes."""
        return (*(row.image for row in self.taken), TABLE)

    def read(self) -> Iterator[PhotoArray]:
        """The frames taken, as photos; the videos are decoded once more."""
        for number, video in enumerate(self.videos):
            wanted = {row.index: row.image for row in self.taken if row.video == number}
            for frame in video.frames(wanted.keys()):
                yield PhotoArray(wanted[frame.index], frame.pixels)

    def photos(self) -> list[PhotoArray]:
        """`read`, all in memory: for `detect`, `extract` and the like."""
        return list(self.read())

    def save(self, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
        """Write the frames as PNG, of several videos one folder for each, and `frames.csv`, which says why; returns the files."""
        files = []
        for done, photo in enumerate(self.read(), 1):
            path = Path(folder) / photo.name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, photo.pixels)
            files.append(path)
            progress("writing frames", done, len(self.taken))
        table = Path(folder) / TABLE
        write_frames(table, self.rows, [video.path.name for video in self.videos])
        return (*files, table)


def frames(
    videos: str | Path | Sequence[str | Path],
    pattern: Pattern | str | None = None,
    *,
    mirrored: bool = False,
    detection: DetectionOptions = DetectionOptions(),
    options: FrameOptions = FrameOptions(),
    progress: ProgressCallback = silent,
) -> ChosenFrames:
    """Choose the frames of a video that are worth keeping; of several, which are those of a rig's cameras, the same instants.

    Of every short stretch the stillest sharp instant is looked at closely. With a `pattern`, its corners are found and a camera
    is calibrated from all of them: those instants are taken that together determine the cameras best, whose blur and distortion
    by motion (rolling shutter) count as noise. Without one, those are taken between which the scene has moved.

    Videos of the same rate and length belong together frame by frame, others by time from their beginning. Raises InputError
    where there is no video, one cannot be decoded, or no frame shows the pattern.

        >>> chosen = ol.frames("board.mp4", "checkerboard:8x6:30mm")
        >>> 10 <= len(chosen.taken) <= 40, chosen.taken[0].reason
        (True, 'it tells much of the camera')
        >>> found = ol.detect(chosen.photos(), "checkerboard:8x6:30mm")
        >>> len(found.corners.images) == len(chosen.taken)
        True
    """
    given = [videos] if isinstance(videos, str | Path) else list(videos)
    sources = tuple(Video.of(path) for path in find_videos(given))
    if not sources:
        raise InputError(f"A video was expected, found none in {' '.join(map(str, given)) or 'an empty list'}; give one.")
    _require_distinct_names(sources)
    target = parse_pattern(pattern) if isinstance(pattern, str) else pattern
    search = _Search(sources, target, mirrored, detection, options)
    looked = search.looked(progress)
    if not looked:
        raise InputError(f"Frames were expected in {sources[0].path}, found none that can be decoded; convert it to MP4.")
    if target is None:
        rows = _of_scene(sources, looked, options)
        return ChosenFrames(sources, rows)
    return _of_target(sources, looked, target, options)


def _require_distinct_names(videos: Sequence[Video]) -> None:
    names = [video.name for video in videos]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"Videos with names of their own were expected, found two called {twice}; rename one of them.")


@dataclass(frozen=True)
class _Looked:
    """An instant whose pixels are gone, and what each camera sees of the target."""

    index: tuple[int, ...]
    time_s: tuple[float, ...]
    looks: tuple[Look, ...]
    seen: tuple[Detection, ...]
    reasons: tuple[str | None, ...]


@dataclass(frozen=True)
class _Search:
    """What is looked for in the frames."""

    videos: tuple[Video, ...]
    target: Pattern | None
    mirrored: bool
    detection: DetectionOptions
    options: FrameOptions

    def looked(self, progress: ProgressCallback) -> list[_Looked]:
        """The stillest instants, a few at a time in memory, their targets found on all cores."""
        longest_s = max(video.duration_s for video in self.videos)
        stretch_s = max(1.0 / self.options.looked_per_s, longest_s / self.options.most_looked)
        still = stillest(self._instants(progress), stretch_s, self.options)
        found: list[_Looked] = []
        while batch := list(itertools.islice(still, 2 * (os.cpu_count() or 1))):
            found += on_all_cores(self._closely, batch, "looking at frames", silent)
        return found

    def _closely(self, instant: Instant) -> _Looked:
        if self.target is None:
            nothing = (Detection.empty(),) * len(instant.index)
            return _Looked(instant.index, instant.time_s, instant.looks, nothing, (None,) * len(nothing))
        seen = [self.target.detect(pixels, mirrored=self.mirrored, options=self.detection) for pixels in instant.pixels]
        return _Looked(instant.index, instant.time_s, instant.looks, tuple(d for d, _ in seen), tuple(r for _, r in seen))

    def _instants(self, progress: ProgressCallback) -> Iterator[Instant]:
        meters = [Meter(self.options) for _ in self.videos]
        total = max(video.count for video in self.videos)
        for done, shown in enumerate(together(self.videos), 1):
            looks = tuple(meter.look(frame.pixels) for meter, frame in zip(meters, shown, strict=True))
            yield Instant(
                tuple(frame.index for frame in shown),
                tuple(frame.time_s for frame in shown),
                tuple(frame.pixels for frame in shown),
                looks,
            )
            progress("reading frames", min(done, total), total)


def _of_scene(videos: Sequence[Video], looked: Sequence[_Looked], options: FrameOptions) -> tuple[FrameRow, ...]:
    """Those between which what the first camera sees has moved."""
    way = [instant.looks[0].travelled_px for instant in looked]
    kept = set(spaced(way, options.step_share * videos[0].image_size[0], options.most_of_scene))
    reasons = ["the scene has moved since the frame before" if place in kept else "it shows what another frame shows"
               for place in range(len(looked))]  # fmt: skip
    return _rows(videos, looked, kept, [[reason] * len(videos) for reason in reasons])


def _of_target(videos: tuple[Video, ...], looked: Sequence[_Looked], target: Pattern, options: FrameOptions) -> ChosenFrames:
    """Those that tell most of the cameras."""
    instants: dict[str, int] = {}
    cameras: list[ViewInformation] = []
    notes: list[str] = []
    for number, video in enumerate(videos):
        named = [(_image(videos, number, one), one.seen[number]) for one in looked if len(one.seen[number])]
        instants |= {_image(videos, number, one): place for place, one in enumerate(looked)}
        if not named:
            why = (looked[0].reasons[number] or "").rstrip(".")
            if len(videos) == 1:
                raise InputError(
                    f"The pattern {target.specification} was expected in at least one of the {len(looked)} stillest frames "
                    f"of {video.path}, found in none (first reason: {why}); check its counts of inner corners."
                )
            notes.append(f"{video.path.name}: the pattern {target.specification} was found in none of {len(looked)} frames.")
            continue
        corners = corner_table(named, target)
        try:
            cameras.append(view_information(corners, calibrate_camera(corners, video.image_size, GUIDE)))
        except (InputError, GeometryError) as error:
            notes.append(f"{video.path.name}: its frames are not compared by what they tell of the camera: {error}")
    seen = [place for place, one in enumerate(looked) if any(map(len, one.seen))]
    if cameras:
        kept = set(telling_instants(cameras, instants, len(looked), options.most_of_target))
        known = {name for camera in cameras for name in camera.names}
    else:
        kept = {
            seen[place] for place in np.linspace(0, len(seen) - 1, min(len(seen), options.most_of_target)).round().astype(int)
        }
        known = set()

    def reason(place: int, number: int) -> str:
        """Why the frame of a camera was taken, or was not."""
        one = looked[place]
        if place in kept:
            return "it tells much of the camera" if len(one.seen[number]) else "another camera sees the target"
        if not len(one.seen[number]):
            return one.reasons[number] or "no corner was found"
        fits = not cameras or _image(videos, number, one) in known
        return "others tell more of the camera" if fits else "its corners do not fit the camera"

    reasons = [[reason(place, number) for number in range(len(videos))] for place in range(len(looked))]
    return ChosenFrames(videos, _rows(videos, looked, kept, reasons), tuple(notes))


def _image(videos: Sequence[Video], number: int, looked: _Looked) -> str:
    """The name of a frame as a photo; of several videos those of one instant have the same in folders of their own."""
    if len(videos) == 1:
        return f"{looked.index[0]:06d}.png"
    return f"{videos[number].name}/{looked.index[0]:06d}.png"


def _rows(
    videos: Sequence[Video], looked: Sequence[_Looked], kept: set[int], reasons: Sequence[Sequence[str]]
) -> tuple[FrameRow, ...]:
    return tuple(
        FrameRow(
            image=_image(videos, number, one),
            video=number,
            index=one.index[number],
            time_s=one.time_s[number],
            motion_px=one.looks[number].motion_px,
            sharpness=one.looks[number].sharpness,
            corners=len(one.seen[number]),
            taken=place in kept,
            reason=reasons[place][number],
        )
        for place, one in enumerate(looked)
        for number in range(len(videos))
    )
