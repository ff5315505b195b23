"""Frames of videos looked at closely: what each camera sees of each target."""

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_patterns import Detection, DetectionOptions, Pattern
from omnilines.files.videos import together
from omnilines.footage.stillness import Instant, Look
from omnilines.pipelines.instants import Lens
from omnilines.progress import on_all_cores, silent


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

    def looked(self, instants: Sequence[Instant]) -> list[LookedInstant]:
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
        while batch := list(itertools.islice(pictures, 2 * (os.cpu_count() or 1))):
            found += on_all_cores(self._closely, batch, "looking at frames", silent)
        return found

    def looked_and_followed(
        self, instants: Sequence[Instant], followed: Sequence[Instant]
    ) -> tuple[list[LookedInstant], list[LookedInstant]]:
        """What is found in some instants, and in others among which some of them may be."""
        every = sorted({*instants, *followed}, key=lambda one: one.index)
        found = {one.index: one for one in self.looked(every)}
        looked, moving = ([found[one.index] for one in some if one.index in found] for some in (instants, followed))
        return looked, moving

    def _closely(self, shown: tuple[Instant, tuple[np.ndarray, ...]]) -> LookedInstant:
        instant, pictures = shown
        seen = [
            [target.detect(pixels, mirrored=self.mirrored, options=self.detection) for target in self.targets]
            for pixels in pictures
        ]
        found = tuple(tuple(detection for detection, _ in own) for own in seen)
        reasons = tuple(next((why for detection, why in own if not len(detection)), None) for own in seen)
        return LookedInstant(instant.index, instant.time_s, instant.looks, found, reasons)


def not_looked_at(instant: Instant) -> LookedInstant:
    """An instant at which nobody looked for a target."""
    return LookedInstant(instant.index, instant.time_s, instant.looks, ((),) * len(instant.index), (None,) * len(instant.index))
