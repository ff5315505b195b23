"""What an attack of its own found: corners of no camera, names that are no text, files of the kernel, torn files of a run."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from hostile.case import Case
from hostile.corpus_formats import convert, exchange, spoilt
from hostile.corpus_tables import COMMANDS, Change, Rows, changed, column
from hostile.good import give

from camera_models import load
from omnilines.pipelines.arcs import SHORT_ARCS, extract

CORNERS = COMMANDS["corners"][2]
PATTERN = ("--pattern", "checkerboard:7x5:30mm")


def scattered(rows: Rows) -> Rows:
    """Corners all over the image, without any order."""
    sideways = column("u_px", lambda k: str(k * 7919 % 640 + 0.5))(rows)
    return column("v_px", lambda k: str(k * 104729 % 480 + 0.5))(sideways)


def ending(name: str, end: str) -> Change:
    """Cells of a column with an end of their own."""

    def change(rows: Rows) -> Rows:
        at = rows[0].index(name)
        return [rows[0], *([*row[:at], row[at] + end, *row[at + 1 :]] for row in rows[1:])]

    return change


def kernel_log(folder: Path) -> None:
    """Among photos a link to a file that is one by its kind, and would be waited for."""
    give("photos", "omnilines", "poses.csv")(folder)
    (folder / "IN/photos/log.png").symlink_to("/proc/kmsg")


def cases() -> Iterator[Case]:
    """All of them."""
    for model in ("opencv-fisheye", "fisheye624", "scaramuzza", "unified", "pinhole", "double-sphere"):
        command = tuple(model if word == "opencv-fisheye" else word for word in CORNERS)
        yield Case(f"corners:scattered-{model}", command, changed("corners", scattered), "[Cc]orners|angles")
    for kind in ("segments", "poses", "corners"):
        name = {"segments": "track", "poses": "camera", "corners": "view"}[kind]
        for what, end in {"escape": "\x1b[31m", "newline": "\nomnilines: done"}.items():
            yield Case(f"{kind}:{name}-{what}", COMMANDS[kind][2], changed(kind, ending(name, end)), f"column {name}")
    for kind, place in {"segments": "image", "corners": "image"}.items():
        long = changed(kind, ending(place, "x" * 3000))
        yield Case(f"{kind}:long-name", COMMANDS[kind][2], long, r"xxx\.\.\.xxx|photos", status=(0, 2))
    detect = ("detect", "IN/photos", *PATTERN, "--out", "OUT")
    yield Case("detect:kernel-log", detect, kernel_log, "log.png", status=(0, 2))
    sfm = ("reconstruct", "IN/photos", "--calibration", "IN/calibration.yaml", "--poses", "sfm", "--out", "OUT")
    for metres in ("1e300", "1e-300", "nan", "-2"):
        known = ("--scale-from", f"0.png,1.png:{metres}")
        yield Case(f"sfm:scale-{metres}", (*sfm, *known), give("photos", "omnilines"), "scale-from.*METRES")
    out = "OUT/" + "x" * 5000
    yield Case("detect:long-path", ("detect", "IN/photos", *PATTERN, "--out", out), give("photos"), r"xxx\.\.\.")
    yield Case(
        "colmap-txt:underscores", convert("colmap-txt"), spoilt("colmap-txt", exchange(b"646 482", b"6_46 482")), "cameras.txt"
    )
    ocam = spoilt("ocamcalib", exchange(b"482 646", b"4_82 646"))
    yield Case("ocamcalib:underscores", convert("ocamcalib"), ocam, "calib_results.txt")
    yield from of_models()
    yield from of_kept()
    yield from of_masks()
    yield from of_photos()
    yield from of_other_conventions()


RECONSTRUCT = ("reconstruct", "IN/photos", "--calibration", "IN/calibration.yaml", "--out", "OUT", "--poses")


def of_models() -> Iterator[Case]:
    """COLMAP models whose poses are none."""

    def model(row: str) -> Callable[[Path], None]:
        def prepare(folder: Path) -> None:
            give("photos", "omnilines")(folder)
            (folder / "IN/model").mkdir()
            (folder / "IN/model/cameras.txt").write_text("1 PINHOLE 646 482 170 170 323 241\n")
            (folder / "IN/model/images.txt").write_text(f"{row}\n\n2 1 0 0 0 0 0 1 1 1.png\n\n")
            (folder / "IN/model/points3D.txt").write_text("")

        return prepare

    def binary(images: bytes) -> Callable[[Path], None]:
        def prepare(folder: Path) -> None:
            model("")(folder)
            (folder / "IN/model/cameras.bin").write_bytes(bytes(8))
            (folder / "IN/model/points3D.bin").write_bytes(bytes(8))
            (folder / "IN/model/images.bin").write_bytes(images)

        return prepare

    for what, content in {"cut": b"\6" + bytes(9), "counts": b"\xff" * 8, "name": b"\1" + bytes(71) + b"view"}.items():
        yield Case(f"colmap-bin:{what}", (*RECONSTRUCT, "IN/model"), binary(content), "images.bin.*COLMAP model")
    rows = {
        "quaternion-of-zero": "1 0 0 0 0 0 0 1 1 0.png",
        "not-a-number": "1 nan 0 0 0 0 0 1 1 0.png",
        "beyond-reason": "1 1 0 0 0 1e300 0 1 1 0.png",
        "no-name": "1 1 0 0 0 0 0 1 1",
        "twice": "2 1 0 0 0 0 0 1 1 0.png",
    }
    for what, row in rows.items():
        yield Case(f"colmap:{what}", (*RECONSTRUCT, "IN/model"), model(row), "COLMAP model")


def of_masks() -> Iterator[Case]:
    """Masks that say nothing, or are no masks."""
    commands = {
        "extract": ("extract", "IN/photos", "--calibration", "IN/calibration.yaml", "--out", "OUT", "--mask"),
        "reconstruct": (*RECONSTRUCT, "IN/poses.csv", "--mask"),
    }
    masks: dict[str, tuple[str, np.ndarray | None, str]] = {
        "black": ("m.png", np.zeros((482, 646), np.uint8), "m.png.*white"),
        "of-ones": ("m.png", np.ones((482, 646), np.uint8), "m.png.*white"),
        "eight-bits-in-sixteen": ("m.png", np.full((482, 646), 255, np.uint16), "m.png.*white"),
        "of-another-size": ("m.png", np.full((646, 482), 255, np.uint8), "m.png.*646x482"),
        "a-photo": ("photos/1.png", None, "1.png.*among"),
        "among-photos": ("photos/mask.png", np.full((482, 646), 255, np.uint8), "mask.png.*among"),
    }
    for name, command in commands.items():
        for what, (place, pixels, says) in masks.items():

            def prepare(folder: Path, place: str = place, pixels: np.ndarray | None = pixels) -> None:
                give("photos", "omnilines", "poses.csv")(folder)
                if pixels is not None:
                    assert cv2.imwrite(str(folder / "IN" / place), pixels)

            yield Case(f"mask:{name}:{what}", (*command, f"IN/{place}"), prepare, says)


def of_photos() -> Iterator[Case]:
    """Photos whose first bytes point beyond all files, and those that are as narrow as a line."""
    heads = {
        "tiff-beyond": b"MM\0+\0\x08\0\0" + b"\xff" * 8 + bytes(200),
        "jpeg-of-marks": b"\xff\xd8" + b"\xff" * 2_000_000,
        "jpeg-of-empty-segments": b"\xff\xd8" + b"\xff\xe0\0\2" * 500_000,
        "jpeg-ends-in-a-mark": b"\xff\xd8\xff",
    }
    rectify = ("rectify", "IN/photos", "--calibration", "IN/calibration.yaml", "--size", "64x48", "--out", "OUT")
    extract_line = ("extract", "IN/photos", "--calibration", "IN/calibration.yaml", "--out", "OUT")
    detect = ("detect", "IN/photos", *PATTERN, "--out", "OUT")
    for what, content in heads.items():

        def among(folder: Path, content: bytes = content) -> None:
            give("photos", "omnilines")(folder)
            (folder / "IN/photos/9.jpg").write_bytes(content)

        yield Case(f"photo:rectify:{what}", rectify, among, "9.jpg is skipped", status=(0,))
        yield Case(f"photo:extract:{what}", extract_line, among, "9.jpg is skipped", status=(0,))

    def narrow(width: int, height: int) -> Callable[[Path], None]:
        def prepare(folder: Path) -> None:
            (folder / "IN/photos").mkdir(parents=True)
            image = np.random.default_rng(0).integers(0, 255, (height, width), dtype=np.uint8)
            assert cv2.imwrite(str(folder / "IN/photos/a.png"), image)
            sides = f"model: pinhole, image_size: [{width}, {height}]"
            numbers = ", ".join(f"{name}: 0" for name in ("skew", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
            camera = f"{{{sides}, parameters: {{fx: 9000, fy: 9000, cx: {width / 2}, cy: {height / 2}, {numbers}}}}}"
            text = f"format: omnilines-calibration\nversion: 1\ncameras:\n  cam0: {camera}\n"
            (folder / "IN/calibration.yaml").write_text(text)

        return prepare

    for what, size in {"wide": (70000, 40), "tall": (24, 70000)}.items():
        yield Case(f"narrow:detect:{what}", detect, narrow(*size), "too small to show")
        tags = (*detect[:2], "--pattern", "aprilgrid:6x6:35mm:0.3:36h11", *detect[4:])
        yield Case(f"narrow:tags:{what}", tags, narrow(*size), "too small to show")
        # Its picture is reduced to what a JPEG can be.
        yield Case(f"narrow:extract:{what}", extract_line, narrow(*size), "Arcs", status=(0,))


def of_kept() -> Iterator[Case]:
    """What an earlier run kept of its arcs is damaged: it is made anew."""
    spoilt: dict[str, Callable[[bytes], bytes]] = {
        "empty": lambda content: b"",
        "torn": lambda content: content[:2000],
        "of-another": lambda content: content[:-1],
    }
    for what, change in spoilt.items():

        def prepare(folder: Path, change: Callable[[bytes], bytes] = change) -> None:
            give("photos", "omnilines", "poses.csv")(folder)
            extract(folder / "IN/photos", load(folder / "IN/calibration.yaml"), options=SHORT_ARCS, work=folder / "OUT/work")
            for kept in (folder / "OUT/work/arcs").iterdir():
                kept.write_bytes(change(kept.read_bytes()))

        case = (*RECONSTRUCT, "IN/poses.csv")
        yield Case(f"kept:{what}", case, prepare, "lines|No line", status=(0, 1, 2), changes=("OUT/work/arcs/*",))


def of_other_conventions() -> Iterator[Case]:
    """Tables that another tool wrote, in its own way; and files that hold a camera of another image."""

    def cells(names: tuple[str, ...], change: Callable[[list[float]], list[float]]) -> Change:
        def changed_cells(rows: Rows) -> Rows:
            at = [rows[0].index(name) for name in names]
            found = [rows[0]]
            for row in rows[1:]:
                new = dict(zip(at, change([float(row[k]) for k in at]), strict=True))
                found.append([str(new.get(k, cell)) for k, cell in enumerate(row)])
            return found

        return changed_cells

    width, height = 646, 482
    ends, pose = ("u1_px", "v1_px", "u2_px", "v2_px"), ("qw", "qx", "qy", "qz")
    segments: dict[str, tuple[Callable[[list[float]], list[float]], str]] = {
        "v-up": (lambda e: [e[0], height - 1 - e[1], e[2], height - 1 - e[3]], "count v from the bottom|left-handed"),
        "turned": (
            lambda e: [width - 1 - e[0], height - 1 - e[1], width - 1 - e[2], height - 1 - e[3]],
            "turned by 180|-x, -y, z",
        ),
        "by-axis": (lambda e: [e[0], e[2], e[1], e[3]], "u1, u2, v1, v2|inside the image"),
        "shares": (lambda e: [e[0] / width, e[1] / height, e[2] / width, e[3] / height], "shares of the image"),
        "half-size": (lambda e: [cell / 2 for cell in e], "323x241 px"),
    }
    for what, (change, says) in segments.items():
        yield Case(f"convention:{what}", COMMANDS["segments"][2], changed("segments", cells(ends, change)), says)
    quaternion = cells(pose, lambda q: [*q[1:], q[0]])
    yield Case("convention:xyzw", COMMANDS["segments"][2], changed("poses", quaternion), "x, y, z, w")
    again = changed(
        "poses",
        lambda rows: [rows[0], *([row[0], *other[1:]] for row, other in zip(rows[1:], rows[2:] + rows[1:2], strict=True))],
    )
    rough = "DOES NOT HOLD|at random"
    yield Case("convention:poses-of-other-photos", COMMANDS["poses"][2], again, rough, status=(1, 2))
    yield Case("convention:no-inverse", convert("ocamcalib"), spoilt("ocamcalib", _no_inverse), "inverse polynomial", status=(0,))
    sizes = spoilt("omnilines", exchange(b"[646, 482]", b"[482, 646]"))
    yield Case("convention:sides-swapped", convert("omnilines"), sizes, "swapped", status=(0,))


def _no_inverse(content: bytes) -> bytes:
    rows = content.split(b"\n")
    at = next(k for k, row in enumerate(rows) if k > 4 and row.split(b" ")[0].isdigit())
    return b"\n".join([*rows[:at], b"0", *rows[at + 1 :]])
