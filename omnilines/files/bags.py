"""Bags: recordings of ROS 1 (`.bag`), ROS 2 (a folder with metadata.yaml, or `.db3`) and MCAP (`.mcap`), read message by message
by rosbags and mcap, which are an extra. A topic with images is a camera; `BAG:/topic` names it.

What these readers raise over a damaged file may be anything: it becomes one sentence here.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes
from camera_models.formats.values import is_text
from camera_models.formats.yaml_text import read_yaml
from omnilines.files.bag_images import IMAGE_TYPES
from omnilines.machine import available_bytes

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
METADATA, METADATA_KEY = "metadata.yaml", b"rosbag2_bagfile_information"
HEAD_BYTES = 4096
SHOWN_TOPICS = 12
SHOWN_CHARACTERS = 160
COMPRESSIONS = ("", "none", "lz4", "zstd")
"""Of chunks of MCAP."""


class Message(NamedTuple):
    """A message of an image."""

    received_ns: int
    """By the clock of the recorder."""
    kind: str
    """Its type, as ROS 2 writes it."""
    encoding: str
    """ros1, cdr, protobuf or json."""
    data: bytes


class _Channel(NamedTuple):
    kind: str
    total: int
    """Of its messages, as the bag says."""


class _Bag(NamedTuple):
    """A bag that is open."""

    topics: dict[str, _Channel]
    messages: Callable[[str], Iterator[Message]]
    """Those of a topic."""


def is_bag(path: str | Path) -> bool:
    """Whether a file has the name of a bag, or a folder is one of ROS 2."""
    found = Path(path)
    if found.suffix.lower() in BAG_SUFFIXES and not found.is_dir():
        return True
    with contextlib.suppress(OSError, InputError):
        return (found / METADATA).is_file() and METADATA_KEY in read_bytes(found / METADATA, most=HEAD_BYTES)
    return False


def split_topics(path: str | Path) -> tuple[Path, tuple[str, ...]]:
    """`BAG:/one,/two` as the bag and its topics; any other path with none."""
    bag, colon, topics = str(path).partition(":/")
    while colon and not is_bag(bag):
        # A name may hold the sign too.
        more, colon, topics = topics.partition(":/")
        bag += f":/{more}"
    return (Path(bag), tuple(f"/{topic.strip().lstrip('/')}" for topic in topics.split(","))) if colon else (Path(path), ())


def topics_of(bag: Path, wanted: Sequence[str]) -> list[Path]:
    """The topics of a bag that are wanted, each as `BAG:/topic`; with none wanted, its only one with images.

    Raises InputError where the bag cannot be read, or has no such topic, or several and none is named.
    """
    with _opened(bag) as opened:
        topics = dict(opened.topics)
    images = [name for name, channel in topics.items() if channel.kind in IMAGE_TYPES and channel.total]
    empty = [name for name, channel in topics.items() if channel.kind in IMAGE_TYPES and not channel.total]
    for name in wanted:
        if name not in images:
            found = "one without a message" if name in empty else f"a topic of {topics[name].kind}" if name in topics else "none"
            raise InputError(f"The bag {bag} was expected to have images in {name}, found {found}; {_choice(bag, images)}.")
    if not wanted and not images:
        held = _listed([f"{name} ({channel.kind})" for name, channel in topics.items()]) or "no topic at all"
        why = f"only {_listed(empty)}, without a message" if empty else held
        raise InputError(f"The bag {bag} was expected to have a topic with images, found {why}; give another.")
    if not wanted and len(images) > 1:
        raise InputError(
            f"One topic with images was expected in the bag {bag}, found {len(images)}: {_listed(images)}; name that of the "
            f"camera, or of a rig one for each, as {bag}:{images[0]},{images[1]}."
        )
    return [Path(f"{bag}:{name}") for name in dict.fromkeys(wanted or images)]


def messages(bag: Path, topic: str) -> Iterator[Message]:
    """The messages of a topic, as they were recorded. Raises InputError where the bag cannot be read up to its end."""
    with _opened(bag) as opened:
        yield from opened.messages(topic)


def _choice(bag: Path, images: Sequence[str]) -> str:
    return f"choose from {_listed(images)}" if images else f"no topic of {bag.name} has any"


def _listed(names: Sequence[str]) -> str:
    shown = [name if is_text(name) and len(name) <= SHOWN_CHARACTERS else repr(name[:SHOWN_CHARACTERS]) for name in names]
    return ", ".join(shown[:SHOWN_TOPICS]) + (f" and {len(shown) - SHOWN_TOPICS} more" if len(shown) > SHOWN_TOPICS else "")


@contextlib.contextmanager
def _opened(bag: Path) -> Iterator[_Bag]:
    """Raises InputError where rosbags and mcap are not installed, or it cannot be read."""
    if bag.is_dir():
        read_yaml(bag / METADATA)  # refuses what is nested or endless
    else:
        read_bytes(bag, most=1)  # says what is wrong with a path, and refuses pipes and devices
    try:
        import mcap.reader  # noqa: F401
        import rosbags.rosbag1
        import rosbags.rosbag2
    except ImportError as error:
        raise InputError(
            f"A bag needs rosbags and mcap, found them missing ({error}); pip install 'omnilines[bags]' brings them."
        ) from error
    try:
        if bag.suffix.lower() == ".mcap" and not bag.is_dir():
            with bag.open("rb") as stream:
                yield _of_mcap(stream)
        else:
            first = bag.suffix.lower() == ".bag"
            with rosbags.rosbag1.Reader(bag) if first else rosbags.rosbag2.Reader(bag) as reader:
                yield _of_ros(reader, "ros1" if first else "cdr")
    except InputError:
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:SHOWN_CHARACTERS].rstrip(".") or type(error).__name__
        raise InputError(
            f"The bag {bag} cannot be read ({said}): it is damaged, cut short or of another version; repair it with rosbag "
            "reindex, ros2 bag reindex or mcap recover, or copy it again."
        ) from error


def _of_ros(reader: Any, encoding: str) -> _Bag:
    """An open reader of rosbags."""

    def messages(topic: str) -> Iterator[Message]:
        own = [connection for connection in reader.connections if connection.topic == topic]
        for connection, received_ns, data in reader.messages(own):
            yield Message(received_ns, connection.msgtype, encoding, bytes(data))

    return _Bag({name: _Channel(one.msgtype or "several types", one.msgcount) for name, one in reader.topics.items()}, messages)


def _of_mcap(stream: Any) -> _Bag:
    """An open file of MCAP, whatever was recorded in it."""
    from mcap.reader import NonSeekingReader, SeekingReader

    def every(topics: list[str] | None) -> Iterator[Any]:
        stream.seek(0)
        return NonSeekingReader(stream).iter_messages(topics, log_time_order=False)

    def messages(topic: str) -> Iterator[Message]:
        for schema, channel, message in every([topic]):
            yield Message(message.log_time, _ros2_name(schema), channel.message_encoding, message.data)

    summary = SeekingReader(stream).get_summary()
    topics: dict[str, _Channel] = {}
    if summary is None or summary.statistics is None or not summary.channels:
        for schema, channel, _ in every(None):
            count = topics[channel.topic].total if channel.topic in topics else 0
            topics[channel.topic] = _Channel(_ros2_name(schema), count + 1)
        return _Bag(topics, messages)
    for chunk in summary.chunk_indexes:
        _require_readable(chunk.compression, chunk.uncompressed_size)
    for number, channel in summary.channels.items():
        count = summary.statistics.channel_message_counts.get(number, 0)
        topics[channel.topic] = _Channel(_ros2_name(summary.schemas.get(channel.schema_id)), count)
    return _Bag(topics, messages)


def _require_readable(compression: str, size: int) -> None:
    """Raises ValueError where a chunk of MCAP cannot be unpacked."""
    if compression not in COMPRESSIONS:
        raise ValueError(f"chunks packed by {compression[:SHOWN_CHARACTERS]!r}")
    if size > (available_bytes() or size):
        raise ValueError(f"a chunk of {size / 1e9:.0f} GB, more than the memory")


def _ros2_name(schema: Any) -> str:
    """sensor_msgs/Image of ROS 1 is sensor_msgs/msg/Image."""
    name = "" if schema is None else str(schema.name)
    package, slash, kind = name.partition("/")
    return f"{package}/msg/{kind}" if slash and "/" not in kind else name
