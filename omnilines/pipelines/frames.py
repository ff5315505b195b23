"""Videos -> the frames worth keeping: still, sharp, and telling of the camera, or of the scene from somewhere new."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib_patterns import DetectionOptions, Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import InputError
from camera_models.typed import typed
from omnilines.files import PhotoArray
from omnilines.files.footage import Footage
from omnilines.files.split import Split
from omnilines.files.videos import open_videos
from omnilines.footage.options import FrameOptions
from omnilines.footage.stillness import Instant, stillest
from omnilines.options import require_ranges
from omnilines.pipelines.chosen_frames import ChosenFrames, frames_of_scene, frames_of_targets, image_name, with_runs
from omnilines.pipelines.instants import Lens, instants_of, lenses_of
from omnilines.pipelines.looked_frames import FrameSearch
from omnilines.pipelines.recognise import as_printed
from omnilines.pipelines.rolling_frames import moving_runs, rolling_note
from omnilines.progress import ProgressCallback, silent

LOOKED_FIRST = 16
"""Frames of each video, evenly spread over it, that show how a board of tags is printed."""


@typed
def frames(
    videos: str | Path | Sequence[str | Path],
    pattern: Pattern | str | Sequence[Pattern] | None = None,
    *,
    split: Split | str | None = None,
    mirrored: bool = False,
    work: str | Path | None = None,
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
    side into those of two cameras. What frames show of a target is kept in the folder `work`, where one is given, as by `detect`.
    Raises InputError where there is no video, one cannot be decoded, or no frame shows the
    pattern.

        >>> chosen = ol.frames("board.mp4", "checkerboard:8x6:30mm")
        >>> 10 <= len(chosen.taken) <= 40, chosen.taken[0].reason
        (True, 'it tells much of the camera')
        >>> found = ol.detect(chosen.photos(), "checkerboard:8x6:30mm")
        >>> len(found.corners.images) == len(chosen.taken)
        True
    """
    require_ranges(detection)
    require_ranges(options)
    given = [videos] if isinstance(videos, str | Path) else list(videos)
    sources = open_videos(given)
    if not sources:
        raise InputError(f"A video was expected, found none in {' '.join(map(str, given)) or 'an empty list'}; give one.")
    lenses = lenses_of(sources, Split.of(split) if isinstance(split, str) else split)
    targets, notes = _targets(pattern, sources, mirrored, detection, progress)
    instants, told = instants_of(lenses, options, progress)
    search, still = FrameSearch(lenses, targets, mirrored, detection, work), _still(lenses, instants, options)
    run = _run_frames(sources, options) if targets else 1
    moving = moving_runs(still, instants, options) if len(targets) == 1 == run else []
    looked, followed = search.looked_and_followed(still, moving, progress)
    if not looked:
        raise InputError(f"Frames were expected in {sources[0].location}, found none that can be decoded; convert it to MP4.")
    if not targets:
        return ChosenFrames(lenses, frames_of_scene(lenses, looked, options), notes + told)
    most = options.most_of_target if run == 1 else min(options.most_of_target, options.most_runs)
    chosen = frames_of_targets(lenses, looked, targets, most, told)
    rows = with_runs(chosen, instants, run) if run > 1 else chosen.rows
    rolling = rolling_note(
        [(image_name(lenses, 0, one), one.seen[0][0], one.time_s[0]) for one in followed], targets[0], lenses[0].image_size
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
