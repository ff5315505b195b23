"""Frames of videos looked at closely: what each camera sees of each target."""

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_patterns import Detection, DetectionOptions, Pattern
from omnilines.files import PhotoArray
from omnilines.files.videos import together
from omnilines.footage.stillness import Instant, Look
from omnilines.pipelines.detect import BYTES_PER_PIXEL, FirstLook
from omnilines.pipelines.instants import Lens
from omnilines.pipelines.kept_corners import Looked
from omnilines.pipelines.kept_results import look_at_rest
from omnilines.progress import ProgressCallback, silent

LOOKING = "looking at frames"


@dataclass(frozen=True)
class LookedInstant:
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
class FrameSearch:
    """What is looked for in the frames."""

    lenses: tuple[Lens, ...]
    targets: tuple[Pattern, ...]
    mirrored: bool
    detection: DetectionOptions
    work: str | Path | None
    """The folder in which what is found is kept, where there is one."""

    def looked(self, instants: Sequence[Instant], progress: ProgressCallback) -> list[LookedInstant]:
        """What is found in some instants, a few at a time in memory, on all cores."""
        if not self.targets:
            return [not_looked_at(one) for one in instants]
        videos = tuple(dict.fromkeys(lens.video for lens in self.lenses))
        place = [videos.index(lens.video) for lens in self.lenses]
        first = [place.index(number) for number in range(len(videos))]
        shown = together(videos, [tuple(one.index[k] for k in first) for one in instants])
        pictures = (
            (one, tuple(lens.of(frames[number].pixels) for lens, number in zip(self.lenses, place, strict=True)))
            for one, frames in zip(instants, shown, strict=False)
        )
        found: list[LookedInstant] = []
        progress(LOOKING, 0, len(instants))
        while batch := list(itertools.islice(pictures, 2 * (os.cpu_count() or 1))):
            found += self._closely(batch)
            progress(LOOKING, len(found), len(instants))
        return found

    def looked_and_followed(
        self, instants: Sequence[Instant], followed: Sequence[Instant], progress: ProgressCallback
    ) -> tuple[list[LookedInstant], list[LookedInstant]]:
        """What is found in some instants, and in others among which some of them may be."""
        every = sorted({*instants, *followed}, key=lambda one: one.index)
        found = {one.index: one for one in self.looked(every, progress)}
        looked, moving = ([found[one.index] for one in some if one.index in found] for some in (instants, followed))
        return looked, moving

    def _closely(self, shown: Sequence[tuple[Instant, tuple[np.ndarray, ...]]]) -> list[LookedInstant]:
        """What every camera sees of every target at each of some instants."""
        pictures = [PhotoArray(f"{k}", pixels) for _, own in shown for k, pixels in enumerate(own)]
        by_target = [self._seen(target, pictures) for target in self.targets]
        by_picture = list(zip(*by_target, strict=True))
        found, count = list[LookedInstant](), len(self.lenses)
        for k, (instant, _) in enumerate(shown):
            own = by_picture[k * count : (k + 1) * count]
            seen = tuple(tuple(detection for detection, _, _ in looks) for looks in own)
            reasons = tuple(next((why for detection, why, _ in looks if not len(detection)), None) for looks in own)
            found.append(LookedInstant(instant.index, instant.time_s, instant.looks, seen, reasons))
        return found

    def _seen(self, target: Pattern, pictures: Sequence[PhotoArray]) -> list[Looked]:
        first = FirstLook(target, None, self.mirrored, self.detection)
        return look_at_rest(
            first,
            [(picture, None) for picture in pictures],
            pictures,
            LOOKING,
            first.kept(self.work),
            executor=None,
            bytes_per_pixel=BYTES_PER_PIXEL,
            progress=silent,
        )


def not_looked_at(instant: Instant) -> LookedInstant:
    """An instant at which nobody looked for a target."""
    return LookedInstant(instant.index, instant.time_s, instant.looks, ((),) * len(instant.index), (None,) * len(instant.index))
