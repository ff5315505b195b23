"""Photos that are none, names that are none, and results that would go over what the user has."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from hostile.case import Case
from hostile.damage import PLACES
from hostile.good import give

from camera_models.formats.disk import MANIFEST, MOVING

PATTERN = ("--pattern", "checkerboard:7x5:30mm")
LENS = ("--calibration", "IN/calibration.yaml")
COMMANDS: dict[str, tuple[str, ...]] = {
    "detect": ("detect", "IN/photos", *PATTERN, "--out", "OUT"),
    "calibrate": ("calibrate", "IN/photos", *PATTERN, "--model", "opencv-fisheye", "--out", "OUT"),
    "extract": ("extract", "IN/photos", *LENS, "--out", "OUT"),
    "check": ("check", "IN/photos", *LENS, "--out", "OUT"),
    "lines": ("calibrate", "IN/photos", "--pattern", "lines", "--out", "OUT"),
    "directions": ("directions", "IN/photos", *LENS, "--orthogonal", "--out", "OUT"),
    "rectify": ("rectify", "IN/photos", *LENS, "--size", "64x48", "--out", "OUT"),
    "reconstruct": ("reconstruct", "IN/photos", *LENS, "--poses", "IN/poses.csv", "--out", "OUT"),
    "board": ("experiment", "board", "--data", "IN/photos", *PATTERN, "--out", "OUT"),
}


def png(width: int, height: int) -> bytes:
    """The header of a PNG of that size, and nothing else."""
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")


CONTENTS: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda good: b"",
    "text": lambda good: b"not a photo",
    "torn": lambda good: good[: len(good) // 3],
    "nuls": lambda good: b"\0" * 5000,
    "bomb": lambda good: png(60000, 60000),
    "endless": lambda good: png(2**31 - 1, 2**31 - 1),
    "no-pixels": lambda good: png(0, 0),
}


def only(make: Callable[[Path], None]) -> Callable[[Path], None]:
    """A folder with three of the same kind and nothing else."""

    def prepare(folder: Path) -> None:
        give("omnilines", "poses.csv")(folder)
        (folder / "IN/photos").mkdir()
        for k in range(3):
            make(folder / "IN/photos" / f"{k}.png")

    return prepare


def spoilt(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """A photo that is none."""
    good = cv2.imencode(".png", np.arange(48 * 64, dtype=np.uint8).reshape(48, 64))[1].tobytes()
    return lambda path: path.write_bytes(change(good)) and None


def named(*names: str) -> Callable[[Path], None]:
    """Small grey photos with names."""

    def prepare(folder: Path) -> None:
        give("omnilines", "poses.csv")(folder)
        for name in names:
            path = os.path.join(os.fsencode(folder / "IN/photos"), name.encode("utf-8", "surrogateescape"))
            os.makedirs(os.path.dirname(path), exist_ok=True)
            extension = f".{name.rsplit('.', 1)[-1]}"
            image = np.full((482, 646), 90, np.uint8)
            with open(path, "wb") as file:
                file.write(cv2.imencode(extension, image)[1].tobytes())

    return prepare


def linked(folder: Path) -> None:
    """Links that run in circles, and none that leads to a photo."""
    give("omnilines", "poses.csv")(folder)
    (folder / "IN/photos/a").mkdir(parents=True)
    (folder / "IN/photos/a/up").symlink_to("..")
    (folder / "IN/photos/self").symlink_to("self")
    (folder / "IN/photos/x.png").symlink_to("nowhere.png")


NAMES = {
    "escape": ("\x1b[31mred.png", "b.png", "c.png"),
    "bell": ("a\x07.png", "b.png", "c.png"),
    "newline": ("a\nomnilines: done.png", "b.png", "c.png"),
    "not-utf-8": ("a\udcff.png", "b.png", "c.png"),
}


def cases() -> Iterator[Case]:
    """All of them."""
    for name, command in COMMANDS.items():
        for what, change in CONTENTS.items():
            yield Case(f"{name}:{what}", command, only(spoilt(change)), "photo|image|corner|view|size")
        for what in ("folder", "fifo", "dev-zero", "dangling-link", "unreadable"):
            yield Case(f"{name}:{what}", command, only(PLACES[what]), "photo|image|corner|view|size", alone=False)
        for what, names in NAMES.items():
            yield Case(f"{name}:name-{what}", command, named(*names), "name|text|rename")
        yield Case(f"{name}:links", command, linked, "photo|image|x.png")
        yield Case(
            f"{name}:absent",
            (command[0], *(p.replace("photos", "none") for p in command[1:])),
            give("omnilines", "poses.csv"),
            "none",
        )
    for name in ("extract", "rectify", "reconstruct"):
        yield Case(f"{name}:equal-stems", COMMANDS[name], named("a.png", "a.jpg", "b.png"), "a.jpg|a.png")
    yield from over_inputs()


def over_inputs() -> Iterator[Case]:
    """Results must not go over what the user has."""

    def own(folder: Path) -> None:
        give("photos", "omnilines", "poses.csv", "segments.csv", "corners.csv")(folder)

    def command(name: str, out: str, *more: str) -> tuple[str, ...]:
        given = COMMANDS[name]
        return (*given[: given.index("--out") + 1], out, *more)

    scene = (*LENS, "--poses", "IN/poses.csv", "--segments", "IN/segments.csv")
    lines = {
        "rectify": command("rectify", "IN/photos"),
        "targets": (
            "render",
            "targets",
            "--pattern",
            "checkerboard:4x3:30mm",
            "--views",
            "2",
            "--size",
            "320x240",
            "--out",
            "IN/photos",
        ),
        "adjust": ("adjust", *scene, "--out", "IN"),
        "reconstruct": ("reconstruct", *scene, "--out", "IN"),
        "calibrate": ("calibrate", "IN/corners.csv", "--image-size", "646x482", "--model", "opencv-fisheye", "--out", "IN"),
        "convert": ("convert", "IN/calibration.yaml", "IN/calibration.yaml"),
        "convert-by-link": ("convert", "IN/calibration.yaml", "IN/link.yaml"),
        "pattern": ("pattern", "checkerboard:7x5:30mm", "--out", "IN/mine.pdf"),
        "pattern-folder": ("pattern", "checkerboard:7x5:30mm", "--out", "IN"),
        "detect": command("detect", "IN"),
        "calibrate-photos": command("calibrate", "IN"),
        "extract": command("extract", "IN"),
        "rectify-calibration": command("rectify", "IN"),
        "convert-own": ("convert", "IN/calibration.yaml", "IN/mine.yml"),
        "convert-errors": ("convert", "IN/calibration.yaml", "IN/new.yml", "--model", "unified", "--fov", "90"),
        "board": ("experiment", "board", "--data", "IN", "--out", "IN"),
        "wide": ("experiment", "wide", "--out", "IN"),
        "validate": ("validate", "--out", "IN"),
        "validate-scene": ("validate", "--scene", "room", "--out", "IN"),
        "scene": ("render", "scene", "--views", "2", "--size", "64x48", "--out", "IN/photos"),
        "work": command("reconstruct", "IN/mine"),
        "work-poses": ("reconstruct", "IN/photos", *LENS, "--poses", "IN/ours/work/poses.csv", "--out", "IN/ours"),
        "half-moved": ("adjust", "--calibration", "IN/half/calibration.yaml", *scene[2:], "--out", "OUT"),
    }

    def with_own_files(folder: Path) -> None:
        own(folder)
        for name in (
            "mine.pdf",
            "mine.yml",
            "checkerboard_7x5_30mm.svg",
            "report.html",
            "new.yml_conversion.csv",
            "mine/work/notes",
        ):
            (folder / "IN" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "IN" / name).write_bytes(b"mine")
        (folder / "IN/ours/work").mkdir(parents=True)
        (folder / "IN/ours/work" / MANIFEST).write_text('{"written": {}}')
        (folder / "IN/ours/work/poses.csv").write_bytes((folder / "IN/poses.csv").read_bytes())
        (folder / "IN/half" / MOVING).mkdir(parents=True)
        for name in ("calibration.yaml", f"{MOVING}/calibration.yaml"):
            (folder / "IN/half" / name).write_bytes((folder / "IN/calibration.yaml").read_bytes())
        (folder / "IN/link.yaml").symlink_to("calibration.yaml")
        (folder / "IN/photos/view00.png").write_bytes((folder / "IN/photos/0.png").read_bytes())

    for name, line in lines.items():
        yield Case(f"over:{name}", line, with_own_files, "IN|over|input")
