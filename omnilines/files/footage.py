"""What gives frames one after the other: a video, or the images of one topic of a bag."""

import abc
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True)
class Frame:
    """A frame."""

    index: int
    """From 0, of those that can be decoded."""
    time_s: float
    """From the beginning: of a video, as its container says, by the frame rate where it does not; of a topic, as `Topic` says."""
    pixels: UInt8[np.ndarray, "h w 3"]
    """BGR, upright as the container says."""


@dataclass(frozen=True)
class Footage(abc.ABC):
    """Frames of one camera that can be read, in order and more than once."""

    path: Path
    frames_per_s: float
    count: int
    """Of its frames, as the file says: an estimate."""
    image_size: tuple[int, int]

    @property
    @abc.abstractmethod
    def title(self) -> str:
        """What a person calls it: the name of its file, with the topic of a bag."""

    @property
    def location(self) -> str:
        """Where it is, as it is given."""
        return str(self.path)

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Of the camera that took it, where nothing else is known."""

    @property
    @abc.abstractmethod
    def stamped(self) -> bool:
        """Whether its times are by a clock that other footage has too, so that they tell which frames belong together."""

    @property
    @abc.abstractmethod
    def begins_ns(self) -> int | None:
        """Its beginning by the clock of the recording, which trajectories have too; None where it tells none."""

    @property
    def duration_s(self) -> float:
        """About; 0 where the file does not say."""
        return self.count / self.frames_per_s

    @abc.abstractmethod
    def frames(self, wanted: Collection[int] | None = None) -> Iterator[Frame]:
        """All frames, or those of the indices wanted, in order."""

    @abc.abstractmethod
    def doubts(self, times_s: Float[np.ndarray, " n"]) -> tuple[str, ...]:
        """What a person should know where these are the times of all frames that could be decoded, one or more."""
