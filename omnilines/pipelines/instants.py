"""Videos -> instants: how every frame looks, and which frames of several videos are of the same instant."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from camera_models import InputError
from omnilines.files.footage import Footage
from omnilines.files.split import Split
from omnilines.files.videos import alike
from omnilines.footage.alignment import lead_s, put_together
from omnilines.footage.options import FrameOptions
from omnilines.footage.stillness import Instant, Look, Meter
from omnilines.progress import ProgressCallback


@dataclass(frozen=True)
class Lens:
    """A camera: a video, or a part of one that shows what several lenses see."""

    video: Footage
    split: Split | None
    part: int
    name: str

    def of(self, pixels: np.ndarray) -> np.ndarray:
        """What it sees of a frame of its video."""
        return pixels if self.split is None else self.split.parts(pixels)[self.part]

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height (px)."""
        width, height = self.video.image_size
        share = 1 if self.split is None else len(self.split.names)
        return (width, height // share) if self.split is not None and self.split.stacked else (width // share, height)


def lenses_of(videos: Sequence[Footage], split: Split | None) -> tuple[Lens, ...]:
    """In order. Raises InputError where two would have one name."""
    if split is None:
        lenses = tuple(Lens(video, None, 0, video.name) for video in videos)
    else:
        several = len(videos) > 1
        lenses = tuple(
            Lens(video, split, part, f"{video.name}-{name}" if several else name)
            for video in videos
            for part, name in enumerate(split.names)
        )
    names = [lens.name for lens in lenses]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            f"Videos with names of their own were expected, found two called {twice}; rename one of them, or leave it out."
        )
    return lenses


@dataclass(frozen=True)
class _Measured:
    """All frames of a video."""

    time_s: np.ndarray
    looks: tuple[tuple[Look, ...], ...]
    """Of each of its lenses, frame by frame."""

    @property
    def speed_px(self) -> np.ndarray:
        """Of each frame, in the mean of its lenses."""
        return np.array([[look.change_grey for look in own] for own in self.looks]).mean(0)


def instants_of(
    lenses: Sequence[Lens], options: FrameOptions, progress: ProgressCallback
) -> tuple[list[Instant], tuple[str, ...]]:
    """The instants that all lenses show, in order, and what a person should know of how they were put together.

    Videos of one rate and length whose frames are of the same times belong together frame by frame, others by time from their
    beginnings, unless the motion in them says that one began earlier; topics of bags by their stamps.
    """
    videos = tuple(dict.fromkeys(lens.video for lens in lenses))
    total = sum(video.count for video in videos)
    measured: list[_Measured] = []
    done = 0
    for video in videos:
        own = [lens for lens in lenses if lens.video == video]
        meters, times, looks = [Meter(options) for _ in own], list[float](), list[tuple[Look, ...]]()
        for frame in video.frames():
            looks.append(tuple(meter.look(lens.of(frame.pixels)) for meter, lens in zip(meters, own, strict=True)))
            times.append(frame.time_s)
            done += 1
            progress("reading frames", min(done, total), total)
        measured.append(_Measured(np.array(times), tuple(zip(*looks, strict=True))))
    if not all(len(one.time_s) for one in measured):
        return [], ()
    together, notes = _numbers(videos, measured, options)
    notes += tuple(doubt for video, one in zip(videos, measured, strict=True) for doubt in video.doubts(one.time_s))
    place = [videos.index(lens.video) for lens in lenses]
    part = [sum(other.video == lens.video for other in lenses[:k]) for k, lens in enumerate(lenses)]
    return [
        Instant(
            index=tuple(numbers[v] for v in place),
            time_s=tuple(float(measured[v].time_s[numbers[v]]) for v in place),
            looks=tuple(measured[v].looks[p][numbers[v]] for v, p in zip(place, part, strict=True)),
        )
        for numbers in together
    ], notes


def _numbers(
    videos: Sequence[Footage], measured: Sequence[_Measured], options: FrameOptions
) -> tuple[list[tuple[int, ...]], tuple[str, ...]]:
    """The frame of every video at each instant."""
    if len(videos) > 1 and all(video.stamped for video in videos):
        paired = put_together([one.time_s for one in measured], [0.0] * len(videos), options.most_gap_share)
        if not paired:
            spans = " and ".join(
                f"{v.title} from {m.time_s[0]:.3f} to {m.time_s[-1]:.3f} s" for v, m in zip(videos, measured, strict=True)
            )
            raise InputError(
                f"Frames with stamps of the same times were expected, found {spans}; record them with one clock, or give each "
                "camera alone."
            )
        return paired, ()
    first, leads_s, notes = measured[0], [0.0], list[str]()
    by_number = all(alike(videos[0], video) for video in videos) and _in_step([one.time_s for one in measured])
    for video, other in zip(videos[1:], measured[1:], strict=True):
        found = lead_s(first.time_s, first.speed_px, other.time_s, other.speed_px, options.least_overlap, options.significance)
        leads_s.append(found or 0.0)
        if found:
            earlier = "earlier" if found > 0 else "later"
            notes.append(
                f"{video.name} began {abs(found):.2f} s {earlier} than {videos[0].name}, as the motion in both says: their "
                "frames are put together by that."
            )
        elif found is None and not by_number:
            notes.append(f"{video.name} and {videos[0].name} are taken to have begun together: the motion in them does not tell.")
    if by_number and not any(leads_s):
        return [(k,) * len(videos) for k in range(min(len(one.time_s) for one in measured))], tuple(notes)
    return put_together([one.time_s for one in measured], leads_s, options.most_gap_share), tuple(notes)


def _in_step(times_s: Sequence[Float[np.ndarray, " _"]]) -> bool:
    """Whether frames of one number are of one time, to half the usual gap: phones drop a frame each where they like, so that
    their frame rate varies and numbers go apart, even where in the end as many are missing in both."""
    first, count = times_s[0], min(len(own) for own in times_s)
    most_s = 0.5 * float(np.median(np.diff(first))) if len(first) > 1 else math.inf
    return all(bool((np.abs(own[:count] - first[:count]) <= most_s + 1e-9).all()) for own in times_s)
