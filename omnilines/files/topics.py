"""A topic of a bag as footage: its images in the order of their header stamps, which are its times."""

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from camera_models.errors import InputError
from omnilines.files.bag_images import image_of
from omnilines.files.bags import messages, split_topics, topics_of
from omnilines.files.footage import Footage, Frame

LOOKED_FIRST = 32
"""Messages that tell size and rate."""
TRANSPORT = ("image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "image", "raw", "compressed")
"""What the name of a topic ends with behind that of its camera."""
LONGEST_NAME = 60


@dataclass(frozen=True)
class Topic(Footage):
    """A topic that can be read. Frames are its images of one size, each later than the one before."""

    topic: str
    origin_ns: int
    """Stamp from which times count."""
    by_receipt: bool
    """Whether times are those at which messages were recorded: header stamps are not set."""

    @staticmethod
    def of(path: str | Path) -> "Topic":
        """Of `BAG:/topic`, its times from its first. Raises InputError where none of its first messages has an image."""
        bag, named = split_topics(path)
        (one,) = topics_of(bag, named)
        topic = split_topics(one)[1][0]
        stamps_ns: list[int] = []
        received_ns: list[int] = []
        size: tuple[int, int] | None = None
        refused: InputError | None = None
        count = 0  # what a bag states of it may be anything
        for count, message in enumerate(messages(bag, topic), 1):
            if count > LOOKED_FIRST:
                continue
            try:
                image = image_of(message.kind, message.encoding, message.data)
            except InputError as error:
                refused = refused or error
                continue
            size = size or (image.pixels.shape[1], image.pixels.shape[0])
            stamps_ns.append(image.stamp_ns)
            received_ns.append(message.received_ns)
        if size is None:
            raise InputError(f"{path} was expected to have images, found none in its first messages: {refused}")
        by_receipt = not any(stamps_ns)
        times_ns = np.unique(received_ns if by_receipt else stamps_ns)
        gap_s = 1e-9 * float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 1.0
        return Topic(bag, 1.0 / gap_s, count, size, topic, int(times_ns[0]), by_receipt)

    @property
    def title(self) -> str:
        """The names of the bag and the topic."""
        return f"{self.path.name}:{self.topic}"

    @property
    def location(self) -> str:
        """`BAG:/topic`."""
        return f"{self.path}:{self.topic}"

    @property
    def name(self) -> str:
        """The topic without what says that it has images: /cam0/image_raw is cam0."""
        parts = [part for part in re.split(r"[^A-Za-z0-9_-]+", self.topic) if part]
        while len(parts) > 1 and parts[-1] in TRANSPORT:
            parts.pop()
        return "_".join(parts)[:LONGEST_NAME] or "camera"

    @property
    def stamped(self) -> bool:
        """Header stamps are of one clock, and so is the receipt of messages in one bag."""
        return True

    @property
    def begins_ns(self) -> int:
        """The stamp from which times count."""
        return self.origin_ns

    def frames(self, wanted: Collection[int] | None = None) -> Iterator[Frame]:
        """All frames, or those of the indices wanted; messages without an image, and those not later than the one before, are
        left out and not counted."""
        last = None if wanted is None else max(wanted, default=-1)
        index, before_ns = 0, None
        for message in messages(self.path, self.topic):
            if last is not None and index > last:
                return
            try:
                image = image_of(message.kind, message.encoding, message.data)
            except InputError:
                continue
            time_ns = message.received_ns if self.by_receipt else image.stamp_ns
            size = (image.pixels.shape[1], image.pixels.shape[0])
            if size != self.image_size or (before_ns is not None and time_ns <= before_ns):
                continue
            if wanted is None or index in wanted:
                yield Frame(index, 1e-9 * (time_ns - self.origin_ns), image.pixels)
            index, before_ns = index + 1, time_ns

    def doubts(self, times_s: Float[np.ndarray, " n"]) -> tuple[str, ...]:
        """Messages that gave no frame, and stamps that are not set."""
        lost = self.count - len(times_s)
        notes = []
        if lost > 0:
            notes.append(
                f"{lost} of {self.count} messages of {self.title} are left out: their image cannot be decoded, has another size "
                "or is not later than the one before."
            )
        if self.by_receipt:
            notes.append(
                f"The header stamps of {self.title} are 0: the times at which its messages were recorded stand for them, and "
                "clocks and a rolling shutter are no better known than these."
            )
        return tuple(notes)
