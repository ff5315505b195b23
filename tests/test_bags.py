"""Bags of ROS 1 and 2 and MCAP: topics are cameras, header stamps their times; what is no such bag is refused in a sentence."""

import base64
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import mcap.writer
import numpy as np
import pytest
import torch
from bag_messages import ROS, header, packed, raw
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

import camera_models
import omnilines as ol
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import graded_background, render_target
from camera_models import InputError
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.files.bag_images import _bgr8
from omnilines.files.bags import is_bag, split_topics
from omnilines.files.topics import Topic
from omnilines.files.videos import find_videos, open_videos
from omnilines.footage.options import FrameOptions
from omnilines.guide.source import Source

BOARD = "checkerboard:8x6:30mm"
LENS = camera_models.OpenCVFisheye([120.0, 120.0, 191.5, 143.5, 0.02, -0.004, 0.0, 0.0], (384, 288))
BEGIN_NS = 1_700_000_000_123_456_789
STEP_NS = 100_000_000
Shot = tuple[str, int, Any]
"""Topic, stamp (ns) and message."""


def write_bag(path: Path, shots: Sequence[Shot], delay_ns: int = 7_000_000, **options: Any) -> Path:
    """A bag by rosbags' own writer: `.bag` of ROS 1, else a folder of ROS 2; messages are received `delay_ns` late."""
    first = path.suffix == ".bag"
    store = ROS["ros1" if first else "cdr"]
    compression = options.pop("compression", None)
    bag = Writer1(path) if first else Writer2(path, version=9, **options)
    if compression is not None:
        bag.set_compression(*([compression] if first else compression))
    with bag:
        connections: dict[str, Any] = {}
        for topic, stamp_ns, message in shots:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=store)
            data = (store.serialize_ros1 if first else store.serialize_cdr)(message, message.__msgtype__)
            bag.write(connections[topic], stamp_ns + delay_ns, data)
    return path


def grey(number: int, size: tuple[int, int] = (48, 36)) -> np.ndarray:
    """A picture that tells which it is."""
    return np.random.default_rng(number).integers(0, 255, size[::-1], dtype=np.uint8)


def plain(store: Any, topic: str, count: int, encoding: str = "mono8") -> list[Shot]:
    return [(topic, t, raw(store, t, grey(k), encoding)) for k in range(count) for t in [BEGIN_NS + k * STEP_NS]]


@pytest.mark.parametrize("kind", ["bag", "bz2", "lz4", "sqlite3", "mcap", "zstd file", "zstd message", "db3", "inner mcap"])
def test_every_kind_of_bag_gives_its_frames(kind: str, tmp_path: Path) -> None:
    first = kind in ("bag", "bz2", "lz4")
    store = ROS["ros1" if first else "cdr"]
    shots = plain(store, "/cam0/image_raw", 5)
    other = store.types["std_msgs/msg/String"]("not an image")
    shots.insert(2, ("/chatter", BEGIN_NS, other))
    options: dict[str, Any] = {}
    if kind in ("bz2", "lz4"):
        options["compression"] = Writer1.CompressionFormat[kind.upper()]
    if kind.startswith("zstd"):
        options["compression"] = (CompressionMode[kind.split()[1].upper()], CompressionFormat.ZSTD)
    if "mcap" in kind:
        options["storage_plugin"] = StoragePlugin.MCAP
    path = write_bag(tmp_path / ("shots.bag" if first else "shots"), shots, **options)
    if kind in ("db3", "inner mcap"):
        (path,) = path.glob("*.db3" if kind == "db3" else "*.mcap")
    assert is_bag(path) and find_videos([path]) == [Path(f"{path}:/cam0/image_raw")]
    (topic,) = open_videos([path])
    assert (topic.count, topic.image_size, topic.name) == (5, (48, 36), "cam0")
    assert topic.frames_per_s == pytest.approx(10.0)
    frames = list(topic.frames())
    assert [one.index for one in frames] == [0, 1, 2, 3, 4]
    assert np.allclose([one.time_s for one in frames], np.arange(5) * 0.1, atol=1e-9)
    for k, one in enumerate(frames):
        assert np.array_equal(one.pixels, np.repeat(grey(k)[..., None], 3, 2))
    assert [one.index for one in topic.frames([3, 1])] == [1, 3]
    assert topic.doubts(np.array([one.time_s for one in frames])) == ()


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def foxglove(encoding: str, stamp_ns: int, image: bytes) -> bytes:
    """foxglove.CompressedImage, as its schema says."""
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    if encoding == "json":
        stamp = {"sec": seconds, "nsec": nanoseconds}
        said = {"timestamp": stamp, "frame_id": "c", "data": base64.b64encode(image).decode(), "format": "png"}
        return json.dumps(said).encode()
    stamp = b"\x08" + varint(seconds) + b"\x10" + varint(nanoseconds)
    return b"\x0a" + varint(len(stamp)) + stamp + b"\x22\x01c" + b"\x12" + varint(len(image)) + image + b"\x1a\x03png"


def write_mcap(path: Path, messages: Sequence[tuple[str, str, str, int, bytes]], **options: Any) -> Path:
    """Topic, name of the schema, encoding of the message, time of receipt (ns) and data, by mcap's own writer."""
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **options)
        writer.start()
        channels: dict[str, int] = {}
        for topic, schema, encoding, time_ns, data in messages:
            if topic not in channels:
                number = writer.register_schema(schema, "", b"")
                channels[topic] = writer.register_channel(topic, encoding, number)
            writer.add_message(channels[topic], time_ns, data, time_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
@pytest.mark.parametrize("indexed", [True, False])
def test_mcap_of_foxglove(encoding: str, indexed: bool, tmp_path: Path) -> None:
    pictures = [cv2.imencode(".png", grey(k))[1].tobytes() for k in range(3)]
    stamps = [BEGIN_NS + k * STEP_NS for k in range(3)]
    shots = [
        ("/camera", "foxglove.CompressedImage", encoding, 5 + stamp, foxglove(encoding, stamp, picture))
        for stamp, picture in zip(stamps, pictures, strict=True)
    ]
    options = {} if indexed else {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False}
    (topic,) = open_videos([write_mcap(tmp_path / "a.mcap", shots, **options)])
    frames = list(topic.frames())
    assert [round(one.time_s, 9) for one in frames] == [0.0, 0.1, 0.2] and topic.name == "camera"
    assert np.array_equal(frames[2].pixels[..., 0], grey(2))


def test_a_topic_of_several_channels_is_one(tmp_path: Path) -> None:
    """Each publisher has its own, of which one may have sent nothing."""
    path = tmp_path / "two.mcap"
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "protobuf", b"")
        image = cv2.imencode(".png", grey(0))[1].tobytes()
        channels = [writer.register_channel("/camera", "protobuf", schema, {"publisher": str(k)}) for k in range(3)]
        for k in range(4):
            stamp = BEGIN_NS + k * STEP_NS
            writer.add_message(channels[k % 2], stamp, foxglove("protobuf", stamp, image), stamp)
        writer.finish()
    (topic,) = open_videos([path])
    assert topic.count == 4 and len(list(topic.frames())) == 4


def test_mcap_of_ros_1(tmp_path: Path) -> None:
    store = ROS["ros1"]
    message = raw(store, BEGIN_NS, grey(0), "mono8")
    data = bytes(store.serialize_ros1(message, message.__msgtype__))
    path = write_mcap(tmp_path / "one.mcap", [("/cam/image_raw", "sensor_msgs/Image", "ros1", BEGIN_NS, data)])
    (topic,) = open_videos([path])
    (only,) = topic.frames()
    assert np.array_equal(only.pixels[..., 0], grey(0)) and only.time_s == 0.0


def test_topics_are_chosen_by_name(tmp_path: Path) -> None:
    store = ROS["cdr"]
    names = ("/cam0/image_raw", "/cam1/image_raw")
    path = write_bag(tmp_path / "rig", [shot for name in names for shot in plain(store, name, 3)])
    with pytest.raises(InputError) as told:
        find_videos([path])
    assert all(f"{path}:{names[0]},{names[1]}" in str(told.value) and name in str(told.value) for name in names)
    both = find_videos([f"{path}:/cam0/image_raw,/cam1/image_raw"])
    assert both == [Path(f"{path}:{name}") for name in names] == find_videos([f"{path}:{name}" for name in names])
    assert [one.name for one in open_videos(both)] == ["cam0", "cam1"]
    with pytest.raises(InputError, match=r"images in /cam2, found none; choose from /cam0/image_raw, /cam1/image_raw"):
        find_videos([f"{path}:/cam2"])
    assert split_topics("folder:/of/photos") == (Path("folder:/of/photos"), ())
    folder = tmp_path / "both"
    folder.mkdir()
    for name in ("left", "right"):
        write_bag(folder / f"{name}.bag", plain(ROS["ros1"], "/image_raw", 3))
    assert [one.title for one in open_videos([folder])] == ["left.bag:/image_raw", "right.bag:/image_raw"]


def test_stamps_put_cameras_together(tmp_path: Path) -> None:
    """The second camera began two frames later, and one of its frames was not recorded."""
    store = ROS["cdr"]
    left = plain(store, "/left/image_raw", 12)
    right = [(f"/right{topic[5:]}", stamp, message) for topic, stamp, message in left[2:6] + left[7:]]
    path = write_bag(tmp_path / "rig", sorted([*left, *right], key=lambda shot: shot[1]))
    chosen = ol.frames(f"{path}:/left/image_raw,/right/image_raw", options=FrameOptions(looked_per_s=400.0, step_share=0.0))
    by_lens = [{row.image[-10:]: row for row in chosen.rows if row.lens == lens} for lens in (0, 1)]
    times = [[row.time_s for row in rows.values()] for rows in by_lens]
    assert repr(chosen) == f"ChosenFrames(taken={len(chosen.taken)} of {len(chosen.rows)})"
    assert np.allclose(times[0], times[1]) and len(times[0]) == 9 and chosen.notes == ()
    assert np.allclose(times[0], np.delete(np.arange(2, 12), 4) * 0.1)
    later = [(topic, stamp + 10**12, message) for topic, stamp, message in plain(store, "/late/image_raw", 3)]
    for _, stamp, message in later:
        message.header = header(store, stamp)
    path = write_bag(tmp_path / "apart", [*left, *later])
    with pytest.raises(InputError, match="stamps of the same times"):
        ol.frames(f"{path}:/left/image_raw,/late/image_raw")


@pytest.mark.full
def test_a_rig_is_calibrated_from_its_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As Kalibr is used: a bag and a target in, the camchain out."""
    board, right = pattern(BOARD), camera_models.OpenCVFisheye([125.0, 125.0, 190.0, 145.0, 0.01, -0.002, 0.0, 0.0], (384, 288))
    right_from_left = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([-0.05, 0.0, 0.0], dtype=torch.float64))
    poses = random_board_poses(board, LENS, 12, math.radians(60), seed=2)
    store, shots = ROS["cdr"], list[Shot]()
    for name, model, seen in (("left", LENS, poses), ("right", right, right_from_left @ poses)):
        wall = graded_background(model, np.random.default_rng(0))
        for k in range(12):
            pose, stamp = Pose(seen.rotation[k], seen.translation[k]), BEGIN_NS + k * 10 * STEP_NS
            picture = render_target(board, model, pose, blur_px=0.5, noise_grey=2.0, background=wall, seed=k)
            message = packed(store, stamp, picture, ".png", "mono8; png compressed")
            shots.append((f"/{name}/image_raw/compressed", stamp, message))
    path = write_bag(tmp_path / "rig", sorted(shots, key=lambda shot: shot[1]), storage_plugin=StoragePlugin.MCAP)
    topics = f"{path}:/left/image_raw/compressed,/right/image_raw/compressed"
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", topics, "--pattern", BOARD, "--model", "opencv-fisheye", "--out", str(out)])
    assert ended.value.code == 0, capsys.readouterr().err
    found = ol.load(out / "calibration.yaml")
    assert list(found) == ["left", "right"] and abs(found["right"].named_parameters()["fx"] - 125.0) < 0.5
    assert np.allclose(found.rig["right"].cam_from_rig.translation, [-0.05, 0.0, 0.0], atol=1e-3)
    table = (out / "frames" / "frames.csv").read_text()
    assert f"left/000003.png,{path.name}:/left/image_raw/compressed,3,3.000000" in table


def test_guide_takes_a_topic(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", plain(ROS["ros1"], "/cam", 6))
    source = Source(f"{path}:/cam", 5.0)
    assert source.ends and source.path == path and len(list(source.frames())) == 3
    both = write_bag(tmp_path / "both", [shot for name in ("/a", "/b") for shot in plain(ROS["cdr"], name, 2)])
    with pytest.raises(InputError, match="One topic of a bag was expected as `source`, found 2"):
        Source(f"{both}:/a,/b", 5.0)


def test_what_is_left_out_is_said(tmp_path: Path) -> None:
    store = ROS["ros1"]
    shots = plain(store, "/cam", 8)
    shots[3][2].data = shots[3][2].data[:40]
    shots[5] = ("/cam", shots[5][1], raw(store, shots[5][1], grey(5, (20, 20)), "mono8"))
    chosen = ol.frames(write_bag(tmp_path / "a.bag", [*shots, shots[0]]))
    (note,) = chosen.notes
    assert note.startswith("3 of 9 messages of a.bag:/cam are left out")
    unset = plain(store, "/cam", 4)
    for _, _, message in unset:
        message.header = header(store, 0)
    chosen = ol.frames(write_bag(tmp_path / "b.bag", unset), options=FrameOptions(looked_per_s=400.0))
    assert "header stamps of b.bag:/cam are 0" in chosen.notes[0]
    assert np.allclose([row.time_s for row in chosen.rows], np.arange(4) * 0.1)


def hostile(folder: Path) -> Iterator[tuple[str, Path, str]]:
    """Bags that are none, and what is said of them."""
    store1, store2 = ROS["ros1"], ROS["cdr"]
    whole = write_bag(folder / "whole.bag", plain(store1, "/cam", 6)).read_bytes()
    for name, content in {
        "cut": whole[: len(whole) // 2], "text": b"not a bag\n", "version": whole.replace(b"V2.0", b"V1.2", 1),
        "chunks": whole.replace(b"chunk_count=\x01\0\0\0", b"chunk_count=\xff\xff\xff\xff", 1),
        "connections": whole.replace(b"conn_count=\x01\0\0\0", b"conn_count=\xff\xff\xff\xff", 1),
        "packed": whole.replace(b"compression=none", b"compression=nope", 1),
    }.items():  # fmt: skip
        (folder / f"{name}.bag").write_bytes(content)
        yield name, folder / f"{name}.bag", "cannot be read"
    (folder / "empty.bag").write_bytes(b"")
    yield "empty", folder / "empty.bag", "cannot be read"
    yield "absent", folder / "absent.mcap", "does not exist"
    word = store2.types["std_msgs/msg/String"]("word")
    yield "no images", write_bag(folder / "words", [("/chatter", 1, word)]), "/chatter"
    depth = raw(store2, 1, np.ones((4, 4), np.float32), "32FC1")
    yield "depth", write_bag(folder / "depth", [("/depth", 1, depth)]), "32FC1"
    torn = raw(store2, 1, grey(0), "mono8")
    torn.height = 2**31
    yield "huge", write_bag(folder / "huge", [("/cam", 1, torn)]), "2147483648"
    jpeg = packed(store2, 1, grey(0), ".jpg", "jpeg")
    jpeg.data = jpeg.data[:30]
    yield "jpeg", write_bag(folder / "jpeg", [("/cam", 1, jpeg)]), "cannot be decoded"
    with Writer2(folder / "silent", version=9) as bag:
        bag.add_connection("/cam", "sensor_msgs/msg/Image", typestore=store2)
    yield "silent", folder / "silent", "without a message"
    image = ("/cam", "foxglove.CompressedImage", "protobuf", 1, b"\x12\xff\xff\xff\xff\x0f12")
    yield "protobuf", write_mcap(folder / "p.mcap", [image]), "damaged or cut short"
    yield "flatbuffer", write_mcap(folder / "f.mcap", [(*image[:2], "flatbuffer", *image[3:])]), "flatbuffer"
    content = write_mcap(folder / "whole.mcap", [image] * 20).read_bytes()
    (folder / "cut.mcap").write_bytes(content[: len(content) // 2])
    yield "cut mcap", folder / "cut.mcap", "cannot be read"
    (folder / "packed.mcap").write_bytes(content.replace(b"zstd", b"nope"))
    yield "packed mcap", folder / "packed.mcap", "packed by 'nope'"
    split = write_bag(folder / "split", plain(store2, "/cam", 3))
    (split / "metadata.yaml").write_text((split / "metadata.yaml").read_text().replace("split.db3", "other.db3"))
    yield "half", split, "missing"
    torn_db = write_bag(folder / "torn", plain(store2, "/cam", 30))
    (data,) = torn_db.glob("*.db3")
    data.write_bytes(data.read_bytes()[:9000])
    yield "torn", torn_db, "cannot be read"


def test_hostile_bags_are_refused_in_one_sentence(tmp_path: Path) -> None:
    seen = 0
    for name, path, said in hostile(tmp_path):
        with pytest.raises(InputError) as told:
            ol.frames(path)
        text = str(told.value)
        assert said in text and path.name in text and "\n" not in text and text.endswith(".") and len(text) < 700, (name, text)
        seen += 1
    assert seen == 19


def test_a_name_that_leads_out_of_the_folder_stays_inside() -> None:
    topic = Topic(Path("a.bag"), 10.0, 1, (4, 4), "/../../etc/image_raw", 0, False)
    assert topic.name == "etc" and _bgr8(np.zeros((2, 2), np.uint8), None).shape == (2, 2, 3)


def test_frames_of_a_bag_find_their_poses_in_a_trajectory(tmp_path: Path) -> None:
    """Their stamps are in frames.csv: the body stood at x = k when the frame k was taken."""
    store, rng = ROS["ros1"], np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (36, 400, 3), dtype=np.uint8), (5, 5), 0)
    stamps_ns = [BEGIN_NS + k * STEP_NS for k in range(8)]
    shots = [
        ("/cam0/image_raw", t, raw(store, t, np.ascontiguousarray(wide[:, 6 * k : 6 * k + 48]), "bgr8"))
        for k, t in enumerate(stamps_ns)
    ]
    bag = write_bag(tmp_path / "a.bag", shots)
    chosen = ol.frames(f"{bag}:/cam0/image_raw")
    assert [row.stamp_ns for row in chosen.rows] == [stamps_ns[row.index] for row in chosen.rows]
    chosen.save(tmp_path / "frames")
    rows = [f"{t // 10**9}.{t % 10**9:09d} {k}.0 0 0 0 0 0 1" for k, t in enumerate(stamps_ns)]
    (tmp_path / "trajectory.txt").write_text("\n".join(rows) + "\n")
    camera = camera_models.OpenCVFisheye([15.0, 15.0, 23.5, 17.5, 0.0, 0.0, 0.0, 0.0], (48, 36))
    posed = ol.estimate_poses(tmp_path / "frames", camera, tmp_path / "trajectory.txt")
    assert len(chosen.taken) > 2
    expected = {row.image: float(row.index) for row in chosen.taken}
    found = dict(zip(posed.poses.images, posed.poses.cam_from_world.centre[:, 0].tolist(), strict=True))
    assert found == pytest.approx(expected, abs=1e-6)
