"""How fast what a video shows moves, frame by frame, and the stillest sharp frame of each short stretch of it.

A frame that is exposed while the board or the camera moves is blurred, and with a rolling shutter it is sheared. Both grow with
the speed in the image, which dense optical flow (T. Kroeger et al., Fast optical flow using dense inverse search, ECCV 2016)
measures well enough on reduced frames.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from omnilines.footage.options import FrameOptions


@dataclass(frozen=True)
class Look:
    """What was measured of one frame."""

    motion_px: float
    """Root mean square speed of what the frame shows, in px of the full frame between it and its faster neighbour."""
    sharpness: float
    """Standard deviation of the Laplacian, in grey levels: to compare frames that show the same."""
    travelled_px: float
    """How far the middle half of the image has moved since the beginning."""
    change_grey: float = 0.0
    """Root mean square change of the reduced frame since the one before, in grey levels: grows with the speed of what it shows,
    and does not ask where that went, as flow does, which noise misleads where a wall is plain."""


@dataclass(frozen=True)
class Instant:
    """The frames of all cameras at one instant, and how they look."""

    index: tuple[int, ...]
    """Of the frame of each video."""
    time_s: tuple[float, ...]
    looks: tuple[Look, ...]

    @property
    def motion_px(self) -> float:
        """Of the camera that sees the fastest."""
        return max(look.motion_px for look in self.looks)

    @property
    def sharpness(self) -> float:
        """Of all cameras together."""
        return float(np.mean([look.sharpness for look in self.looks]))


class Meter:
    """Measures the frames of one video, one after the other."""

    def __init__(self, options: FrameOptions) -> None:
        self._width_px = options.flow_width_px
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._before: UInt8[np.ndarray, "h w"] | None = None
        self._travelled_px = 0.0

    def look(self, pixels: UInt8[np.ndarray, "h w 3"]) -> Look:
        """Of the next frame; its motion is that since the frame before."""
        grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
        scale = min(1.0, self._width_px / grey.shape[1])
        size = [max(1, round(scale * side)) for side in grey.shape[::-1]]
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1 else grey
        motion_px = change_grey = 0.0
        if self._before is not None and min(small.shape) >= LEAST_FLOW_SIDE_PX:
            flow = np.asarray(self._flow.calc(self._before, small, np.zeros((*small.shape, 2), np.float32)))
            speed_px = np.hypot(flow[..., 0], flow[..., 1]) / scale
            motion_px = float(np.sqrt(np.mean(speed_px**2)))
            change_grey = float(cv2.norm(small, self._before, cv2.NORM_L2)) / math.sqrt(small.size)
            self._travelled_px += float(np.median(speed_px))
        self._before = small
        return Look(motion_px, float(cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S))[1][0, 0]), self._travelled_px, change_grey)


LEAST_FLOW_SIDE_PX = 32
"""Smaller images have no patches to follow."""


def stillest(instants: Sequence[Instant], stretch_s: float, options: FrameOptions) -> Iterator[Instant]:
    """Of every stretch of so many seconds the stillest instant among the sharp ones."""
    best: Instant | None = None
    end_s = stretch_s
    for instant in _slower_side(instants):
        if instant.time_s[0] >= end_s and best is not None:
            yield best
            best = None
            end_s = stretch_s * (np.floor(instant.time_s[0] / stretch_s) + 1)
        if best is None or _is_better(instant, best, options.least_sharpness_share):
            best = instant
    if best is not None:
        yield best


def _slower_side(instants: Sequence[Instant]) -> Iterator[Instant]:
    """Instants whose motion is that to the faster of both neighbours: repeated frames do not move, but are no stiller for it."""
    before: Instant | None = None
    for instant in instants:
        if before is not None:
            looks = zip(before.looks, instant.looks, strict=True)
            yield replace(
                before, looks=tuple(replace(own, motion_px=max(own.motion_px, after.motion_px)) for own, after in looks)
            )
        before = instant
    if before is not None:
        yield before


def _is_better(one: Instant, other: Instant, least_share: float) -> bool:
    if one.sharpness < least_share * other.sharpness:
        return False
    return one.motion_px < other.motion_px or other.sharpness < least_share * one.sharpness


def spaced(travelled_px: Sequence[float], step_px: float, most: int) -> list[int]:
    """Which of the instants to keep so that what they show has moved by `step_px` from one to the next, `most` at most."""
    if not travelled_px:
        return []
    step = max(step_px, (travelled_px[-1] - travelled_px[0]) / max(most - 1, 1))
    kept = [0]
    for place, way in enumerate(travelled_px):
        if way - travelled_px[kept[-1]] >= step:
            kept.append(place)
    return kept[:most]
