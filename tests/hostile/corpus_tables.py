"""Tables of corners, poses and segments that are torn, of another kind, beyond reason, or not of this scene."""

import csv
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from hostile.case import Case
from hostile.damage import BYTES, PLACES
from hostile.good import give, pose_of, table

Rows = list[list[str]]
Change = Callable[[Rows], Rows]
SCENE = ("omnilines", "poses.csv", "segments.csv")
LENS = ("--calibration", "IN/calibration.yaml")
COMMANDS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "corners": (
        "corners.csv",
        ("corners.csv",),
        (
            "calibrate",
            "IN/corners.csv",
            "--image-size",
            "646x482",
            "--model",
            "opencv-fisheye",
            "--out",
            "OUT",
        ),
    ),
    "poses": (
        "poses.csv",
        SCENE,
        (
            "reconstruct",
            *LENS,
            "--poses",
            "IN/poses.csv",
            "--segments",
            "IN/segments.csv",
            "--out",
            "OUT",
        ),
    ),
    "segments": (
        "segments.csv",
        SCENE,
        (
            "adjust",
            *LENS,
            "--poses",
            "IN/poses.csv",
            "--segments",
            "IN/segments.csv",
            "--out",
            "OUT",
        ),
    ),
}
"""Table -> its file, the good inputs, the command that reads it."""
CELLS = {
    "empty": "",
    "nan": "nan",
    "inf": "-inf",
    "beyond-doubles": "1e999",
    "beyond-reason": "1e300",
    "word": "left",
    "underscore": "1_000",
    "5000-digits": "1" * 5000,
    "escape": "\x1b[31m7",
    "comma": "12,5",
    "hex": "0x1F",
}
NAMES = {
    "outside": "../../secret.png",
    "absolute": "/etc/passwd",
    "drive": "C:\\secret.png",
    "escape": "\x1b]0;hit\x07.png",
    "newline": "a\nb.png",
}
NUMBER_COLUMN = {"corners": 4, "poses": 6, "segments": 2}
IMAGE_COLUMN = {"corners": 1, "poses": 0, "segments": 0}


def changed(kind: str, change: Change) -> Callable[[Path], None]:
    """The good table with other rows; the first is the header."""
    name, given, _ = COMMANDS[kind]

    def prepare(folder: Path) -> None:
        give(*given)(folder)
        path = folder / "IN" / name
        rows = list(csv.reader(path.read_text().splitlines()))
        header, *others = change(rows)
        table(path, tuple(header), [list(row) for row in others])

    return prepare


def rewritten(kind: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """The good table with other bytes."""
    name, given, _ = COMMANDS[kind]

    def prepare(folder: Path) -> None:
        give(*given)(folder)
        path = folder / "IN" / name
        path.write_bytes(change(path.read_bytes()))

    return prepare


def replaced(kind: str, place: Callable[[Path], None]) -> Callable[[Path], None]:
    """Something else in place of the table."""
    name, given, _ = COMMANDS[kind]

    def prepare(folder: Path) -> None:
        give(*given)(folder)
        (folder / "IN" / name).unlink()
        place(folder / "IN" / name)

    return prepare


def cell(row: int, column: int, text: str) -> Change:
    """Another text in one cell."""

    def change(rows: Rows) -> Rows:
        return [[text if (k, j) == (row, column) else old for j, old in enumerate(own)] for k, own in enumerate(rows)]

    return change


def column(name: str, texts: Callable[[int], str]) -> Change:
    """Another column, or other cells in one that is there."""

    def change(rows: Rows) -> Rows:
        at = rows[0].index(name) if name in rows[0] else len(rows[0])
        values = [name, *map(texts, range(len(rows) - 1))]
        return [[*row[:at], value, *row[at + 1 :]] for row, value in zip(rows, values, strict=True)]

    return change


BYTES_OF_TABLES: dict[str, Callable[[bytes], bytes]] = {
    "semicolons": lambda content: content.replace(b",", b";"),
    "tabs": lambda content: content.replace(b",", b"\t"),
    "header-alone": lambda content: content.split(b"\n", 1)[0] + b"\n",
    "no-header": lambda content: content.split(b"\n", 1)[1],
    "open-quote": lambda content: content.replace(b"\r\n", b'\r\n"', 1),
    "a-row-too-long": lambda content: content + b"1,2,3,4,5,6,7,8,9,10,11,12,13\r\n",
    "a-row-too-short": lambda content: content + b"1,2\r\n",
    "a-field-of-a-megabyte": lambda content: content + b"x" * 1_000_000 + b",1\r\n",
}
NOT_OF_TABLES = ("deep-indents", "torn-third", "torn-half")


def cases() -> Iterator[Case]:
    """All of them."""
    for kind, (name, _, command) in COMMANDS.items():
        for what, change in {**BYTES, **BYTES_OF_TABLES}.items():
            if what not in NOT_OF_TABLES:
                yield Case(f"{kind}:{what}", command, rewritten(kind, change), f"IN/{name}")
        yield Case(
            f"{kind}:torn", command, rewritten(kind, lambda content: content[: len(content) * 2 // 3 - 9]), f"IN/{name}|line"
        )
        for what, place in PLACES.items():
            yield Case(f"{kind}:{what}", command, replaced(kind, place), f"IN/{name}")
        for what, text in CELLS.items():
            yield Case(
                f"{kind}:cell-{what}",
                command,
                changed(kind, cell(7 if kind != "poses" else 3, NUMBER_COLUMN[kind], text)),
                f"IN/{name}",
            )
        for what, text in NAMES.items():
            yield Case(f"{kind}:image-{what}", command, changed(kind, cell(2, IMAGE_COLUMN[kind], text)), f"IN/{name}")
        yield Case(f"{kind}:a-column-twice", command, changed(kind, lambda rows: [[*row, row[-1]] for row in rows]), f"IN/{name}")
        yield Case(f"{kind}:a-column-less", command, changed(kind, lambda rows: [row[:-1] for row in rows]), f"IN/{name}")
        yield Case(f"{kind}:every-row-twice", command, changed(kind, lambda rows: rows + rows[1:]), f"IN/{name}|line|twice|same")
    yield from of_sigmas()
    yield from of_corners()
    yield from of_scenes()


def of_sigmas() -> Iterator[Case]:
    """Standard deviations that none has."""
    for kind in ("corners", "segments"):
        name, _, command = COMMANDS[kind]
        for what in ("0", "-1", "nan", "inf", "1e300", "1e-300", "one"):
            yield Case(
                f"{kind}:sigma-{what}", command, changed(kind, column("sigma_px", lambda k, w=what: w)), f"IN/{name}.*sigma_px"
            )
    name, _, command = COMMANDS["segments"]

    def covariance(suu: str, suv: str) -> Change:
        def change(rows: Rows) -> Rows:
            for column_name in ("suu1", "svv1", "suu2", "svv2"):
                rows = column(column_name, lambda k: suu)(rows)
            for column_name in ("suv1", "suv2"):
                rows = column(column_name, lambda k: suv)(rows)
            return rows

        return change

    for what, (suu, suv) in {
        "indefinite": ("1", "2"),
        "zero": ("0", "0"),
        "tiny": ("1e-300", "0"),
        "huge": ("1e300", "0"),
    }.items():
        yield Case(f"segments:covariance-{what}", command, changed("segments", covariance(suu, suv)), f"IN/{name}.*su[uv]")
    yield Case("segments:covariance-of-one-end", command, changed("segments", column("suu1", lambda k: "1")), f"IN/{name}.*su")


def of_corners() -> Iterator[Case]:
    """Corners that say nothing of a camera."""
    _, _, command = COMMANDS["corners"]
    changes: dict[str, tuple[Change, str]] = {
        "all-one-pixel": (
            lambda rows: column("u_px", lambda k: "3")(column("v_px", lambda k: "4")(rows)),
            "pixel|corner|board|view",
        ),
        "all-one-board-point": (lambda rows: column("board_x_m", lambda k: "0")(rows), "corner|board|view"),
        "outside-the-image": (column("u_px", lambda k: str(9000 + k)), "image-size"),
        "millimetres-of-light-years": (column("board_x_m", lambda k: str(k * 1e12)), "board_x_m"),
        "one-view": (lambda rows: [rows[0], *(row for row in rows[1:] if row[0] == "v0")], "view"),
        "ids-of-words": (column("id", lambda k: "first"), "id"),
    }
    for what, (change, says) in changes.items():
        yield Case(f"corners:{what}", command, changed("corners", change), says)


def _inverted(rows: Rows) -> Rows:
    found = [rows[0]]
    for row in rows[1:]:
        w, x, y, z = map(float, row[2:6])
        angle = 2 * math.acos(max(-1.0, min(1.0, w)))
        axis = np.array([x, y, z]) / max(1e-12, math.sqrt(1 - w * w)) * angle
        pose = pose_of(tuple(axis.tolist()), tuple(map(float, row[6:9]))).inverse()
        found.append([*row[:2], *map(repr, pose.quaternion.tolist()), *map(repr, pose.translation.tolist())])
    return found


def _of_blender(rows: Rows) -> Rows:
    """Of cameras with y up and z back: turned about x by half a turn."""
    found = [rows[0]]
    for row in rows[1:]:
        w, x, y, z = row[2:6]
        tx, ty, tz = map(float, row[6:9])
        found.append([*row[:2], f"-{x}".replace("--", ""), w, f"-{z}".replace("--", ""), y, repr(tx), repr(-ty), repr(-tz)])
    return found


def _centres(rows: Rows) -> Rows:
    """With the camera's centre in place of t."""
    pairs = zip(rows[1:], _inverted(rows)[1:], strict=True)
    return [rows[0], *([*own[:6], *other[6:9]] for own, other in pairs)]


def _by_hand(rows: Rows) -> Rows:
    """Poses of another scene altogether."""
    generator = torch.Generator().manual_seed(3)
    return [rows[0], *([*row[:2], *map(str, torch.randn(7, generator=generator).tolist())] for row in rows[1:])]


def of_scenes() -> Iterator[Case]:
    """Poses and segments that are good tables, but not of this scene."""
    _, _, command = COMMANDS["poses"]
    poses: dict[str, tuple[Change, str]] = {
        "inverted": (_inverted, "inverted .world_from_cam.: as given they explain 0 of 10 tracks, read so 10"),
        "xyzw": (
            lambda rows: [rows[0], *([*row[:2], *row[3:6], row[2], *row[6:]] for row in rows[1:])],
            "order x, y, z, w",
        ),
        "of-another-scene": (_by_hand, "at random"),
        "cameras-of-blender": (_of_blender, "OpenGL, Blender"),
        "centres": (_centres, "centre for t"),
        "all-in-one-place": (
            lambda rows: [rows[0], *([*row[:6], "0", "0", "0"] for row in rows[1:])],
            "poses|place|centre|baseline|track|apart",
        ),
        "quaternions-of-zero": (
            lambda rows: [rows[0], *([*row[:2], "0", "0", "0", "0", *row[6:]] for row in rows[1:])],
            "poses.*qw",
        ),
        "far-away": (lambda rows: [rows[0], *([*row[:6], "1e200", "0", "0"] for row in rows[1:])], "poses.*tx"),
        "unknown-camera": (column("camera", lambda k: "cam9"), "cam9"),
        "of-other-photos": (column("image", lambda k: f"other{k}.png"), "No segment|photo|pose"),
        "of-one-photo": (lambda rows: rows[:2], "photo|pose|view|track|segment"),
    }
    # Directions tell no scale: the result is right but for its lengths, and says so.
    yield Case(
        "poses:millimetres",
        command,
        changed("poses", lambda rows: [rows[0], *([*row[:6], *(str(1e3 * float(c)) for c in row[6:9])] for row in rows[1:])]),
        "millimetres",
        status=(0,),
    )
    for what, (change, says) in poses.items():
        yield Case(f"poses:{what}", command, changed("poses", change), says, status=(1, 2))
    _, _, command = COMMANDS["segments"]
    segments: dict[str, tuple[Change, str]] = {
        "one-pixel-long": (lambda rows: [rows[0], *([*row[:2], "5", "6", "5", "6"] for row in rows[1:])], "segments"),
        "far-outside": (
            lambda rows: column("u1_px", lambda k: "9e6")(column("u2_px", lambda k: "-9e6")(rows)),
            "segment|pixel|image|track",
        ),
        "all-one-track": (column("track", lambda k: "one"), "track|segment|line|explain"),
        "no-track": (column("track", lambda k: ""), "track|segment"),
        "every-one-its-own": (column("track", lambda k: str(k)), "track|segment|photo"),
        "mixed": (column("track", lambda k: str((7 * k + k // 9) % 10)), "track|segment|explain|consist|line"),
        "unknown-camera": (column("camera", lambda k: "cam9"), "cam9"),
    }
    for what, (change, says) in segments.items():
        yield Case(f"segments:{what}", command, changed("segments", change), says, status=(1, 2))

    def other_lens(folder: Path) -> None:
        give(*SCENE)(folder)
        path = folder / "IN/calibration.yaml"
        path.write_text(path.read_text().replace("fx: 170.25", "fx: 770.25").replace("fy: 171.5", "fy: 771.5"))

    yield Case("scene:of-another-camera", command, other_lens, "another camera.*4.6 times its angles", status=(2,))
