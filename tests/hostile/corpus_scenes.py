"""Scenes for export, photos without straight lines for `check` and calibration from lines, videos for `frames`."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from hostile.case import Case
from hostile.damage import BYTES, NUMBERS, PLACES, replace_number
from hostile.good import FX, give

from omnilines.files.scene_folder import SCENE_TABLES

OUTS = {"dxf": "OUT/a.dxf", "glb": "OUT/a.glb", "geojson": "OUT/a.geojson", "nerfstudio": "OUT/a.json", "limap": "OUT/limap"}
CHECK = ("check", "IN/photos", "--calibration", "IN/calibration.yaml")
LINES = ("calibrate", "IN/photos", "--pattern", "lines", "--out", "OUT")
Bytes = Callable[[bytes], bytes]
SIZE = (482, 646)


def in_scene(name: str, change: Bytes) -> Callable[[Path], None]:
    """The good scene with other bytes in one of its files."""

    def prepare(folder: Path) -> None:
        give("scene")(folder)
        path = folder / "IN/scene" / name
        content = path.read_bytes()
        path.write_bytes(change(content))

    return prepare


def in_place_of(name: str, place: Callable[[Path], None]) -> Callable[[Path], None]:
    """The good scene with something else in place of one of its files."""

    def prepare(folder: Path) -> None:
        give("scene")(folder)
        (folder / "IN/scene" / name).unlink()
        place(folder / "IN/scene" / name)

    return prepare


def rows(change: Callable[[list[bytes]], list[bytes]]) -> Bytes:
    """A table with other rows, the header first."""
    return lambda content: b"\n".join(change(content.rstrip().split(b"\n"))) + b"\n"


def cells(column: int, text: bytes, row: int = 1) -> Bytes:
    """Another text in one cell."""

    def change(table: list[bytes]) -> list[bytes]:
        own = table[row].split(b",")
        own[column] = text
        return [*table[:row], b",".join(own), *table[row + 1 :]]

    return rows(change)


def exported(to: str = "dxf", scene: str = "IN/scene") -> tuple[str, ...]:
    """The command that writes the scene in a format."""
    return ("export", scene, OUTS[to], *(("--origin", "48.1,11.6,520") if to == "geojson" else ()))


SPOILT_ROWS: dict[str, tuple[str, Bytes, str]] = {
    "lines:twice": ("lines.csv", rows(lambda table: [*table, table[1]]), "lines.csv"),
    "lines:end-nan": ("lines.csv", cells(1, b"nan"), "lines.csv"),
    "lines:end-beyond-doubles": ("lines.csv", cells(1, b"1e999"), "lines.csv"),
    "lines:status-of-none": ("lines.csv", rows(lambda table: [row.replace(b",ok", b",fine") for row in table]), "lines.csv"),
    "lines:name-escape": ("lines.csv", cells(0, b"\x1b[31mred"), "lines.csv"),
    "poses:of-no-camera": ("poses.csv", cells(1, b"cam7"), "poses.csv"),
    "poses:of-other-photos": (
        "poses.csv",
        rows(lambda table: [table[0], *(b"other" + row for row in table[1:])]),
        "poses.csv and segments.csv",
    ),
    "poses:quaternion-of-zero": (
        "poses.csv",
        rows(lambda table: [table[0], *(b",".join([*row.split(b",")[:2], *[b"0"] * 7]) for row in table[1:])]),
        "poses.csv",
    ),
}
"""What is wrong -> the file, its change, what the sentence names."""


def cases() -> Iterator[Case]:
    """All of them."""
    yield from of_export()
    yield from of_lines()
    yield from of_frames()


def of_export() -> Iterator[Case]:
    """Folders that hold no scene, or a torn one."""
    for name in SCENE_TABLES:
        for what, change in BYTES.items():
            # A table or a calibration that ends with a whole row is one of fewer; half of these poses end within a last number.
            torn = what in ("torn-third", "torn-half")
            whole = (torn and name == "calibration.yaml") or (name, what) == ("poses.csv", "torn-half")
            status = (0, 2) if whole else (2,)
            yield Case(f"scene:{name}:{what}", exported(), in_scene(name, change), f"{name}|a.dxf", status=status)
        for what, place in PLACES.items():
            yield Case(f"scene:{name}:{what}", exported(), in_place_of(name, place), name)
    for what, number in NUMBERS.items():
        change = lambda content, n=number: replace_number(content, FX, n)  # noqa: E731
        yield Case(f"scene:focal-{what}", exported("limap"), in_scene("calibration.yaml", change), "calibration.yaml")
    for what, (name, change, says) in SPOILT_ROWS.items():
        for to in OUTS:
            yield Case(f"scene:{what}:{to}", exported(to), in_scene(name, change), says)
    for to in OUTS:
        line_free = in_scene("lines.csv", rows(lambda table: table[:1]))
        yield Case(f"scene:no-lines:{to}", exported(to), line_free, "lines +0", status=(0,))
    for place in ("nowhere", "IN", "IN/scene/lines.csv", "/dev/null", ""):
        yield Case(f"scene:at={place!r}", exported(scene=place), give("scene"), "folder|value")
    for out in ("OUT/lines", "OUT/lines.obj", "", ".", "/dev/null", "/proc/x.dxf"):
        yield Case(f"scene:out={out!r}", ("export", "IN/scene", out), give("scene"), "name|format|written|folder|OUT|value|place")
    for name in SCENE_TABLES:
        for to in OUTS:
            over = ("export", "IN/scene", f"IN/scene/{name}", "--to", to, *exported(to)[3:])
            yield Case(f"scene:over-{name}:{to}", over, give("scene"), "IN/scene|over|input|folder")
    for place in ("", ",", "nan,0,0", "91,0,0", "0,0,1e999", "0,0", "0,0,0,0", "x", "1e400,0,0", "0,9e99,0", "--photos"):
        yield Case(f"scene:origin={place!r}", ("export", "IN/scene", "OUT/a.geojson", "--origin", place), give("scene"), "origin")
    yield Case("scene:no-origin", ("export", "IN/scene", "OUT/a.geojson"), give("scene"), "origin")
    yield Case("scene:origin-of-dxf", (*exported(), "--origin", "0,0,0"), give("scene"), "origin")
    yield Case("scene:format", (*exported(), "--to", "bundler"), give("scene"), "bundler")
    yield Case("scene:photos", (*exported("nerfstudio"), "--photos", "nowhere"), give("scene"), "nowhere")
    yield Case("scene:photos-of-dxf", (*exported(), "--photos", "IN/scene"), give("scene"), "photos")


def photos(make: Callable[[int], np.ndarray | None], count: int = 3) -> Callable[[Path], None]:
    """A folder of photos."""

    def prepare(folder: Path) -> None:
        give("omnilines", "omnilines-rig")(folder)
        (folder / "IN/photos").mkdir()
        for k in range(count):
            image = make(k)
            if image is not None:
                assert cv2.imwrite(str(folder / "IN/photos" / f"{k}.png"), image)

    return prepare


def of_one_grey(k: int) -> np.ndarray:
    """Without any edge."""
    return np.full(SIZE, 90, np.uint8)


def of_noise(k: int) -> np.ndarray:
    """Edges everywhere, of nothing."""
    return np.random.default_rng(k).integers(0, 255, SIZE, dtype=np.uint8)


def of_circles(k: int) -> np.ndarray:
    """Curves that are straight in no camera."""
    image = np.full(SIZE, 200, np.uint8)
    rng = np.random.default_rng(k)
    for _ in range(25):
        middle = tuple(int(value) for value in rng.uniform((0, 0), (646, 482)))
        cv2.circle(image, middle, int(rng.uniform(12, 60)), int(rng.integers(0, 120)), 3, cv2.LINE_AA)
    return image


def of_one_line(k: int) -> np.ndarray:
    """The same line in every photo."""
    image = of_one_grey(k)
    cv2.line(image, (30, 60), (600, 400), 220, 3, cv2.LINE_AA)
    return image


EMPTY: dict[str, Callable[[int], np.ndarray]] = {
    "grey": of_one_grey, "noise": of_noise, "circles": of_circles, "one-line": of_one_line,
    "tiny": lambda k: np.full((3, 4), 7 * k, np.uint8), "one-pixel": lambda k: np.full((1, 1), 7, np.uint8),
}  # fmt: skip


def of_lines() -> Iterator[Case]:
    """Photos in which no straight line tells anything."""
    for what, make in EMPTY.items():
        yield Case(f"lines:{what}", LINES, photos(make), "line|arc|chain|curve|photo|small", status=(2,))
        yield Case(f"check:{what}", CHECK, photos(make), "line|arc|chain|curve|photo|size|small", status=(0, 1, 2))
    yield Case("lines:none", LINES, photos(of_noise, 0), "photos")
    yield Case("check:none", CHECK, photos(of_noise, 0), "photos")
    yield Case("lines:one", LINES, photos(of_one_line, 1), "line|photo")
    sizes = photos(lambda k: of_noise(k)[: 482 - 10 * k])
    yield Case("lines:sizes", LINES, sizes, "size|line|photo")
    yield Case("check:sizes", CHECK, sizes, "size|arc|line", status=(1, 2))
    rig = (*CHECK[:3], "IN/rig.yaml")
    yield Case("check:rig", rig, photos(of_noise), "camera")
    for option, value in {"--mask": "nowhere.png", "--calibration": "nowhere.yaml", "--set": "check.none=1"}.items():
        line = tuple(word for at, word in enumerate(CHECK) if option not in (word, CHECK[at - 1]))
        yield Case(f"check:{option}", (*line, option, value), photos(of_noise), "nowhere|check.none")
    for option, value in {
        "--model": "fish", "--image-size": "646x482", "--refine-board": "surface", "--boards": "moving", "--split": "left,left",
        "--set": "lines.none=1", "--coefficients": "99", "--degree": "99", "--pattern": "lines,lines",
    }.items():  # fmt: skip
        line = tuple(word for at, word in enumerate(LINES) if option not in (word, LINES[at - 1]))
        said = f"{option[2:].replace('-', '[-_ ]')}|{value.partition('=')[0]}|one camera"
        yield Case(f"lines:{option}", (*line, option, value), photos(of_circles), said)


def video(change: Bytes = lambda content: content) -> Callable[[Path], None]:
    """A short video, spoilt."""

    def prepare(folder: Path) -> None:
        give("a.avi")(folder)
        path = folder / "IN/a.avi"
        path.write_bytes(change(path.read_bytes()))

    return prepare


def of_frames() -> Iterator[Case]:
    """Videos that are none, and targets that are not in them."""
    command = ("frames", "IN/a.avi", "--out", "OUT")
    for what in ("empty", "one-nul", "nuls", "noise", "html", "script"):
        yield Case(f"frames:{what}", command, video(BYTES[what]), "a.avi")
    yield Case("frames:cut", command, video(lambda content: content[:3000]), "a.avi", status=(0, 2))
    whole = video()
    board = (*command, "--pattern", "checkerboard:7x5:30mm")
    yield Case("frames:no-board", board, whole, "target|corner|pattern|board|frame")
    yield Case("frames:split", (*command, "--split", "left,left"), whole, "left")
    yield Case("frames:options", (*command, "--set", "frames.most_of_target=5"), whole, "most_of_target")
