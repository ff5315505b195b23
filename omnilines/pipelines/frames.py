"""Videos -> the frames worth keeping: still, sharp, and telling of the camera, or of the scene from somewhere new."""

import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib_patterns import Detection, DetectionOptions, Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import GeometryError, InputError
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.telling import ViewInformation, telling_instants, view_information
from omnilines.files import PhotoArray, write_png
from omnilines.files.footage import Footage
from omnilines.files.frames import TABLE, FrameRow, write_frames
from omnilines.files.sets import claimed
from omnilines.files.split import Split
from omnilines.files.videos import open_videos, together
from omnilines.footage.options import FrameOptions
from omnilines.footage.stillness import Instant, Look, spaced, stillest
from omnilines.pipelines.instants import Lens, instants_of, lenses_of
from omnilines.pipelines.photo_corners import corner_table
from omnilines.pipelines.recognise import as_printed
from omnilines.pipelines.rolling_frames import moving_runs, rolling_note
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.records import Corners

GUIDE = "scaramuzza"
"""The model by which views are compared: it fits lenses of every width."""
BESIDE = "it shows how the board moves beside one that tells much"
LOOKED_FIRST = 16
"""Frames of each video, evenly spread over it, that show how a board of tags is printed."""


@dataclass(frozen=True)
class ChosenFrames:
    """The frames of one or more videos that were looked at closely, and which of them were taken."""

    lenses: tuple[Lens, ...]
    """The cameras."""
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
        for video in dict.fromkeys(lens.video for lens in self.lenses):
            wanted: dict[int, list[FrameRow]] = {}
            for row in self.taken:
                if self.lenses[row.lens].video == video:
                    wanted.setdefault(row.index, []).append(row)
            for frame in video.frames(wanted.keys()):
                for row in wanted[frame.index]:
                    yield PhotoArray(row.image, self.lenses[row.lens].of(frame.pixels), row.time_s)

    def photos(self) -> list[PhotoArray]:
        """`read`, all in memory: for `detect`, `extract` and the like."""
        return list(self.read())

    def save(self, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
        """Write the frames as PNG, of several cameras a folder for each, and `frames.csv`, which says why; returns the files."""
        inputs = [lens.video.path for lens in self.lenses]
        with claimed(folder, self.names, inputs, by="frames") as out:
            for done, photo in enumerate(self.read(), 1):
                write_png(out / photo.name, photo.pixels)
                progress("writing frames", done, len(self.taken))
            write_frames(out / TABLE, self.rows, [lens.video.title for lens in self.lenses])
        return tuple(Path(folder) / name for name in self.names)


def frames(
    videos: str | Path | Sequence[str | Path],
    pattern: Pattern | str | Sequence[Pattern] | None = None,
    *,
    split: Split | str | None = None,
    mirrored: bool = False,
    detection: DetectionOptions = DetectionOptions(),
    options: FrameOptions = FrameOptions(),
    progress: ProgressCallback = silent,
) -> ChosenFrames:
    """Choose the frames of a video that are worth keeping; of several, which are those of a rig's cameras, the same instants.

    Of every short stretch the stillest sharp instant is looked at closely. With a `pattern`, its corners are found and a camera
    is calibrated from all of them: those instants are taken that together determine the cameras best, whose blur and distortion
    by motion (rolling shutter) count as noise. Without one, those are taken between which the scene has moved. Of one video of a
    target a few runs of moving frames are looked at too: a rolling shutter that they show is named in the notes. Of several
    targets, with a comma between their specifications, each that a frame shows counts.

    Videos of the same rate and length belong together frame by frame, others by time from their beginning, unless the motion in
    them says that one began earlier; topics of bags (`BAG:/topic`) by their stamps. Of several videos of a target the frames
    just before and after each instant are taken too:
    `calibrate_rig` compares the cameras' clocks by them. `split`, such as `left,right`, cuts frames that show two lenses side by
    side into those of two cameras. Raises InputError where there is no video, one cannot be decoded, or no frame shows the
    pattern.

        >>> chosen = ol.frames("board.mp4", "checkerboard:8x6:30mm")
        >>> 10 <= len(chosen.taken) <= 40, chosen.taken[0].reason
        (True, 'it tells much of the camera')
        >>> found = ol.detect(chosen.photos(), "checkerboard:8x6:30mm")
        >>> len(found.corners.images) == len(chosen.taken)
        True
    """
    given = [videos] if isinstance(videos, str | Path) else list(videos)
    sources = open_videos(given)
    if not sources:
        raise InputError(f"A video was expected, found none in {' '.join(map(str, given)) or 'an empty list'}; give one.")
    lenses = lenses_of(sources, Split.of(split) if isinstance(split, str) else split)
    targets, notes = _targets(pattern, sources, mirrored, detection, progress)
    instants, told = instants_of(lenses, options, progress)
    search, still = _Search(lenses, targets, mirrored, detection), _still(lenses, instants, options)
    run = _run_frames(sources, options) if targets else 1
    moving = moving_runs(still, instants, options) if len(targets) == 1 == run else []
    looked, followed = search.looked_and_followed(still, moving)
    if not looked:
        raise InputError(f"Frames were expected in {sources[0].location}, found none that can be decoded; convert it to MP4.")
    if not targets:
        return ChosenFrames(lenses, _of_scene(lenses, looked, options), notes + told)
    most = options.most_of_target if run == 1 else min(options.most_of_target, options.most_runs)
    chosen = _of_targets(lenses, looked, targets, most)
    rows = _with_runs(chosen, instants, run) if run > 1 else chosen.rows
    rolling = rolling_note(
        [(_image(lenses, 0, one), one.seen[0][0], one.time_s[0]) for one in followed], targets[0], lenses[0].image_size
    )
    return replace(chosen, rows=rows, notes=notes + told + chosen.notes + rolling)


def _targets(
    pattern: Pattern | str | Sequence[Pattern] | None,
    videos: Sequence[Footage],
    mirrored: bool,
    detection: DetectionOptions,
    progress: ProgressCallback,
) -> tuple[tuple[Pattern, ...], tuple[str, ...]]:
    """The targets as a few frames show that they are printed, and a note on each that is not as given."""
    if isinstance(pattern, str):
        pattern = [parse_pattern(text.strip()) for text in pattern.split(",")]
    given = [] if pattern is None else [pattern] if isinstance(pattern, Pattern) else [*pattern]
    first = _spread(videos) if any(target.plain_grid is None for target in given) else []
    found: list[Pattern] = []
    notes: list[str] = []
    for target in given:
        otherwise = None
        if target.plain_grid is None:
            # Of several boards each may show the tags of another.
            target, otherwise = as_printed(
                target, first, any_tags=len(given) == 1, mirrored=mirrored, options=detection, progress=progress
            )
        found.append(target)
        notes += [] if otherwise is None else [otherwise]
    return tuple(found), tuple(notes)


def _run_frames(videos: Sequence[Footage], options: FrameOptions) -> int:
    """How many consecutive frames are taken around each instant."""
    slowest = min(video.frames_per_s for video in videos)
    lasts_s = (options.frames_of_run - 1) / slowest
    return options.frames_of_run if (len(videos) > 1 or options.follow) and lasts_s <= options.longest_run_s else 1


def _still(lenses: Sequence[Lens], instants: Sequence[Instant], options: FrameOptions) -> list[Instant]:
    """The stillest instant of each short stretch."""
    longest_s = max(lens.video.duration_s for lens in lenses)
    stretch_s = max(1.0 / options.looked_per_s, longest_s / options.most_looked)
    return list(stillest(instants, stretch_s, options))


def _spread(videos: Sequence[Footage]) -> list[PhotoArray]:
    """A few frames from all over each video."""
    found = []
    for video in videos:
        wanted = {int(index) for index in np.linspace(0, max(video.count - 1, LOOKED_FIRST), LOOKED_FIRST)}
        found += [PhotoArray(f"{video.title}, frame {frame.index}", frame.pixels) for frame in video.frames(wanted)]
    return found


@dataclass(frozen=True)
class _Looked:
    """An instant whose pixels are gone, and what each camera sees of each target."""

    index: tuple[int, ...]
    time_s: tuple[float, ...]
    looks: tuple[Look, ...]
    seen: tuple[tuple[Detection, ...], ...]
    reasons: tuple[str | None, ...]

    @property
    def corners(self) -> tuple[int, ...]:
        """How many each camera sees."""
        return tuple(sum(map(len, own)) for own in self.seen)


@dataclass(frozen=True)
class _Search:
    """What is looked for in the frames."""

    lenses: tuple[Lens, ...]
    targets: tuple[Pattern, ...]
    mirrored: bool
    detection: DetectionOptions

    def looked(self, instants: Sequence[Instant]) -> list[_Looked]:
        """What is found in some instants, a few at a time in memory, on all cores."""
        if not self.targets:
            return [_unseen(one) for one in instants]
        videos = tuple(dict.fromkeys(lens.video for lens in self.lenses))
        place = [videos.index(lens.video) for lens in self.lenses]
        first = [place.index(number) for number in range(len(videos))]
        shown = together(videos, [tuple(one.index[k] for k in first) for one in instants])
        pictures = (
            (one, tuple(lens.of(frames[number].pixels) for lens, number in zip(self.lenses, place, strict=True)))
            for one, frames in zip(instants, shown, strict=False)
        )
        found: list[_Looked] = []
        while batch := list(itertools.islice(pictures, 2 * (os.cpu_count() or 1))):
            found += on_all_cores(self._closely, batch, "looking at frames", silent)
        return found

    def looked_and_followed(
        self, instants: Sequence[Instant], followed: Sequence[Instant]
    ) -> tuple[list[_Looked], list[_Looked]]:
        """What is found in some instants, and in others among which some of them may be."""
        every = sorted({*instants, *followed}, key=lambda one: one.index)
        found = {one.index: one for one in self.looked(every)}
        looked, moving = ([found[one.index] for one in some if one.index in found] for some in (instants, followed))
        return looked, moving

    def _closely(self, shown: tuple[Instant, tuple[np.ndarray, ...]]) -> _Looked:
        instant, pictures = shown
        seen = [
            [target.detect(pixels, mirrored=self.mirrored, options=self.detection) for target in self.targets]
            for pixels in pictures
        ]
        found = tuple(tuple(detection for detection, _ in own) for own in seen)
        reasons = tuple(next((why for detection, why in own if not len(detection)), None) for own in seen)
        return _Looked(instant.index, instant.time_s, instant.looks, found, reasons)


def _unseen(instant: Instant) -> _Looked:
    """An instant at which nobody looked for a target."""
    return _Looked(instant.index, instant.time_s, instant.looks, ((),) * len(instant.index), (None,) * len(instant.index))


def _with_runs(chosen: ChosenFrames, instants: Sequence[Instant], run: int) -> tuple[FrameRow, ...]:
    """The rows with the frames beside those taken, which are taken too."""
    place = {instant.index: k for k, instant in enumerate(instants)}
    by_instant: dict[int, list[FrameRow]] = {}
    rows = iter(chosen.rows)
    while own := list(itertools.islice(rows, len(chosen.lenses))):
        by_instant[place[tuple(row.index for row in own)]] = own
    for k in [k for k, own in by_instant.items() if own[0].taken]:
        low = max(0, min(k - run // 2, len(instants) - run))
        for beside in range(low, min(low + run, len(instants))):
            if beside not in by_instant:
                reasons = [[BESIDE] * len(chosen.lenses)]
                by_instant[beside] = list(_rows(chosen.lenses, [_unseen(instants[beside])], {0}, reasons))
            elif not by_instant[beside][0].taken:
                by_instant[beside] = [replace(row, taken=True, reason=BESIDE) for row in by_instant[beside]]
    return tuple(row for k in sorted(by_instant) for row in by_instant[k])


def _of_scene(lenses: Sequence[Lens], looked: Sequence[_Looked], options: FrameOptions) -> tuple[FrameRow, ...]:
    """Those between which what the first camera sees has moved."""
    way = [instant.looks[0].travelled_px for instant in looked]
    kept = set(spaced(way, options.step_share * lenses[0].image_size[0], options.most_of_scene))
    reasons = ["the scene has moved since the frame before" if place in kept else "it shows what another frame shows"
               for place in range(len(looked))]  # fmt: skip
    return _rows(lenses, looked, kept, [[reason] * len(lenses) for reason in reasons])


def _of_targets(lenses: tuple[Lens, ...], looked: Sequence[_Looked], targets: Sequence[Pattern], most: int) -> ChosenFrames:
    """Those that tell most of the cameras."""
    instants: dict[str, int] = {}
    cameras: list[ViewInformation] = []
    notes: list[str] = []
    names = " or ".join(target.specification for target in targets)
    for number, lens in enumerate(lenses):
        tables = []
        for k, target in enumerate(targets):
            views = [_view(_image(lenses, number, one), k) for one in looked]
            instants |= {view: place for place, view in enumerate(views)}
            named = [(view, one.seen[number][k]) for view, one in zip(views, looked, strict=True) if len(one.seen[number][k])]
            tables += [corner_table(named, target)] if named else []
        if not tables:
            why = (looked[0].reasons[number] or "").rstrip(".")
            if len(lenses) == 1:
                raise InputError(
                    f"The pattern {names} was expected in at least one of the {len(looked)} stillest frames "
                    f"of {lens.video.location}, found in none (first reason: {why}); check its counts of inner corners."
                )
            notes.append(f"{lens.name}: the pattern {names} was found in none of {len(looked)} frames.")
            continue
        corners = _joined(tables)
        try:
            cameras.append(view_information(corners, calibrate_camera(corners, lens.image_size, GUIDE)))
        except (InputError, GeometryError) as error:
            notes.append(f"{lens.name}: its frames are not compared by what they tell of the camera: {error}")
    seen = [place for place, one in enumerate(looked) if any(one.corners)]
    if cameras:
        kept = set(telling_instants(cameras, instants, len(looked), most))
        known = {name for camera in cameras for name in camera.names}
    else:
        kept = {seen[place] for place in np.linspace(0, len(seen) - 1, min(len(seen), most)).round().astype(int)}
        known = set()

    def reason(place: int, number: int) -> str:
        """Why the frame of a camera was taken, or was not."""
        one = looked[place]
        if place in kept:
            return "it tells much of the camera" if one.corners[number] else "another camera sees the target"
        if not one.corners[number]:
            return one.reasons[number] or "no corner was found"
        fits = not cameras or any(_view(_image(lenses, number, one), k) in known for k in range(len(targets)))
        return "others tell more of the camera" if fits else "its corners do not fit the camera"

    reasons = [[reason(place, number) for number in range(len(lenses))] for place in range(len(looked))]
    return ChosenFrames(lenses, _rows(lenses, looked, kept, reasons), tuple(notes))


def _image(lenses: Sequence[Lens], number: int, looked: _Looked) -> str:
    """The name of a frame as a photo; of several cameras those of one instant have the same in folders of their own."""
    if len(lenses) == 1:
        return f"{looked.index[0]:06d}.png"
    return f"{lenses[number].name}/{looked.index[0]:06d}.png"


def _view(image: str, target: int) -> str:
    """What a target in a frame is called."""
    return f"{image}, target {target + 1}" if target else image


def _joined(tables: Sequence[Corners]) -> Corners:
    """One table of views of several targets."""
    starts = np.cumsum([0, *(len(table.images) for table in tables)])
    names = tuple(name for table in tables for name in table.view_names)
    sigma_px = [table.sigma_px for table in tables if table.sigma_px is not None]
    return Corners(
        np.concatenate([table.view + start for table, start in zip(tables, starts[:-1], strict=True)]),
        names,
        names,
        np.concatenate([table.board_m for table in tables]),
        np.concatenate([table.pixels for table in tables]),
        np.concatenate(sigma_px),
    )


def _rows(
    lenses: Sequence[Lens], looked: Sequence[_Looked], kept: set[int], reasons: Sequence[Sequence[str]]
) -> tuple[FrameRow, ...]:
    return tuple(
        FrameRow(
            image=_image(lenses, number, one),
            lens=number,
            index=one.index[number],
            time_s=one.time_s[number],
            motion_px=one.looks[number].motion_px,
            sharpness=one.looks[number].sharpness,
            corners=one.corners[number],
            taken=place in kept,
            reason=reasons[place][number],
        )
        for place, one in enumerate(looked)
        for number in range(len(lenses))
    )
