"""Calibrations of every format that are torn, of another kind, or hold numbers that no camera has."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from hostile.case import Case
from hostile.damage import BYTES, NUMBERS, PLACES, replace_number
from hostile.good import FILES, FX, SIZE, give

Change = Callable[[bytes], bytes]
BINARY_NUMBERS = ("nan", "inf", "beyond-reason", "zero", "negative")
TEXT_ONLY = ("utf-16", "not-utf-8", "deep-lists", "deep-maps", "deep-indents", "script")


def spoilt(kind: str, change: Change, *others: str) -> Callable[[Path], None]:
    """The good file of a kind, changed."""

    def prepare(folder: Path) -> None:
        give(kind, *others)(folder)
        path = folder / "IN" / FILES[kind][0]
        content = path.read_bytes()
        path.write_bytes(change(content))

    return prepare


def replaced(kind: str, place: Callable[[Path], None]) -> Callable[[Path], None]:
    """Something else in place of the file of a kind."""

    def prepare(folder: Path) -> None:
        (folder / "IN").mkdir()
        place(folder / "IN" / FILES[kind][0])

    return prepare


def convert(kind: str, *options: str) -> tuple[str, ...]:
    """The command that reads a file of a kind."""
    name, own, _ = FILES[kind]
    return ("convert", f"IN/{name}", "OUT.json", "--from", own, "--to", "omnilines", *options)


def exchange(old: bytes, new: bytes, most: int = -1) -> Change:
    """One text for another, which has to be there."""

    def change(content: bytes) -> bytes:
        assert old in content, (old, content[:400])
        return content.replace(old, new, most)

    return change


WIDTHS = {"no-width": b"0", "negative-width": b"-640", "wide": b"1000000000", "half-width": b"640.5"}
TORN_AND_WHOLE = {("omnilines-rig", "torn-third"), ("omnilines-rig", "torn-half"), ("kalibr", "torn-third")}
"""Cut between two cameras or parts: what is left is a file of fewer."""
OTHER_UNITS = ("metashape", "opensfm", "lensfun")
"""Their files hold no focal length fx in pixels."""


def cases() -> Iterator[Case]:
    """All of them."""
    for kind in FILES:
        yield from damaged(kind)
        yield from misplaced(kind)
        yield from numbered(kind)
    yield from told_by_contents()
    yield from of_their_own()


def damaged(kind: str) -> Iterator[Case]:
    """Its bytes are spoilt."""
    name, own, _ = FILES[kind]
    for what, change in BYTES.items():
        if (kind == "colmap-bin" and what in TEXT_ONLY) or (kind, what) in TORN_AND_WHOLE:
            continue
        alone = "deep" in what and own == "opencv"
        yield Case(f"{kind}:{what}", convert(kind), spoilt(kind, change), f"IN/{name}", alone=alone)


def misplaced(kind: str) -> Iterator[Case]:
    """Something else is in its place."""
    for what, place in PLACES.items():
        yield Case(f"{kind}:{what}", convert(kind), replaced(kind, place), f"IN/{FILES[kind][0]}")


def numbered(kind: str) -> Iterator[Case]:
    """It holds numbers that no camera has."""
    name, binary = f"IN/{FILES[kind][0]}", kind == "colmap-bin"
    for what, number in NUMBERS.items():
        if kind in OTHER_UNITS:
            break
        # Below zero the polynomial is that of a mirror.
        if (kind.startswith("ocamcalib") and what == "negative") or (binary and what not in BINARY_NUMBERS):
            continue
        yield Case(f"{kind}:focal-{what}", convert(kind), spoilt(kind, lambda c, n=number: replace_number(c, FX, n)), name)
    for what, width in WIDTHS.items():
        if not binary:
            yield Case(f"{kind}:{what}", convert(kind), spoilt(kind, exchange(str(SIZE[0]).encode(), width)), name)


def told_by_contents() -> Iterator[Case]:
    """The format is not named."""
    for what in ("empty", "nuls", "noise", "html", "deep-lists"):
        for kind in ("omnilines", "opencv-xml", "basalt", "colmap-bin"):
            name = f"IN/{FILES[kind][0]}"
            yield Case(f"told:{kind}:{what}", ("convert", name, "OUT.yaml"), spoilt(kind, BYTES[what]), name)
    name = "IN/calibration.yaml"
    for what in ("absent", "folder", "fifo", "dev-zero", "dangling-link", "unreadable", "two-terabytes"):
        yield Case(f"told:{what}", ("convert", name, "OUT.yaml"), replaced("omnilines", PLACES[what]), name)


def _bomb(levels: int) -> bytes:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, levels)]
    return "\n".join(lines).encode() + b"\n"


XML = b'<?xml version="1.0"?>\n'
NATIVE: dict[str, tuple[str, Change]] = {
    "alias-bomb": (
        "omnilines",
        lambda c: c + b"provenance:\n" + b"".join(b"  " + line + b"\n" for line in _bomb(9).splitlines()),
    ),
    "alias-bomb-of-maps": (
        "omnilines",
        lambda c: c + b"provenance:\n  b0: &b0 {a: 1}\n" + b"".join(
            b"  b%d: &b%d {%s}\n" % (k, k, b", ".join(b"k%d: *b%d" % (j, k - 1) for j in range(10))) for k in range(1, 9)
        ),
    ),
    "alias-of-itself": ("omnilines", lambda c: c + b"provenance: &p {again: *p}\n"),
    "key-twice": ("omnilines", lambda c: c + b"cameras: {}\n"),
    "two-documents": ("omnilines", lambda c: c + b"---\n" + c),
    "version-2": ("omnilines", exchange(b"version: 1", b"version: 2")),
    "version-true": ("omnilines", exchange(b"version: 1", b"version: true")),
    "unknown-model": ("omnilines", exchange(b"model: opencv-fisheye", b"model: periscope")),
    "model-a-list": ("omnilines", exchange(b"model: opencv-fisheye", b"model: [opencv-fisheye]")),
    "no-cameras": ("omnilines", lambda c: b"format: omnilines-calibration\nversion: 1\ncameras: {}\n"),
    "cameras-a-list": ("omnilines", lambda c: b"format: omnilines-calibration\nversion: 1\ncameras: [1, 2]\n"),
    "unknown-parameter": ("omnilines", exchange(b"cx:", b"xc:")),
    "wild-k1": ("omnilines", exchange(b"k1: -0.01", b"k1: 1.0e+50")),
    "far-centre": ("omnilines", exchange(b"cx: 325.0", b"cx: 1.0e+9")),
    "camera-named-with-escape": ("omnilines", exchange(b"cam0:", b'"\\e[31mcam0":')),
    "camera-without-name": ("omnilines", exchange(b"cam0:", b'"":')),
    "degree-beyond-reason": ("ocamcalib", lambda c: c.replace(b"5 ", b"100000 ", 1)),
    "view-outside": (
        "omnilines", lambda c: c + b"views:\n  - {image: ../../secret.png, camera: cam0, used: true}\n"
    ),
    "view-absolute": ("omnilines", lambda c: c + b"views:\n  - {image: /etc/passwd, camera: cam0, used: true}\n"),
    "view-of-no-camera": ("omnilines", lambda c: c + b"views:\n  - {image: a.png, camera: cam7, used: true}\n"),
    "negative-sigma": ("omnilines", exchange(b"parameters:", b"sigma: {fx: -1.0}\n    parameters:")),
    "angle-of-400": ("omnilines", exchange(b"parameters:", b"max_angle_deg: 400\n    parameters:")),
    "covariance-of-one": ("omnilines", exchange(b"parameters:", b"covariance: [[1.0]]\n    parameters:")),
    "rig-of-another": ("omnilines-rig", exchange(b"rig:\n  cam0:", b"rig:\n  cam5:")),
    "quaternion-of-zero": ("omnilines-rig", lambda c: c.replace(b"[1.0, 0.0, 0.0, 0.0]", b"[0.0, 0.0, 0.0, 0.0]")),
    "translation-beyond-reason": ("omnilines-rig", lambda c: c.replace(b"translation_m: [0.1,", b"translation_m: [1.0e+200,")),
    "last-row": ("kalibr", exchange(b"[0.0, 0.0, 0.0, 1.0]", b"[0.0, 0.0, 0.5, 1.0]")),
    "rotation-of-none": ("kalibr", lambda c: c.replace(b"0.995", b"0.5")),
    "intrinsics-of-three": ("kalibr", exchange(b", 325.0, 236.0]", b", 325.0]")),
    "cameras-with-a-gap": ("kalibr", exchange(b"cam1:", b"cam2:")),
    "basalt-pose-of-zero": ("basalt", lambda c: re.sub(rb'("q[wxyz]"): [-0-9.e]+', rb"\1: 0.0", c)),
    "basalt-sizes": ("basalt", lambda c: c.replace(b'"resolution": [', b'"resolution": [[1, 2], ')),
    "ros-matrix-of-eight": ("ros", exchange(b"325.0,", b"")),
    "opencv-matrix-of-eight": ("opencv-xml", exchange(b"<rows>3</rows>", b"<rows>1000000000</rows>")),
    "opencv-entity-bomb": (
        "opencv-xml",
        lambda c: XML + b'<!DOCTYPE l [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>\n<opencv_storage><x>&b;</x></opencv_storage>\n',
    ),
    "opencv-20000-deep": (
        "opencv-xml",
        lambda c: XML + b"<opencv_storage>" + b"<a>" * 20000 + b"</a>" * 20000 + b"</opencv_storage>\n",
    ),
    "opencv-base64-without-end": (
        "opencv-pair",
        lambda c: c.replace(b"dt: d\n   data: ", b"dt:!!binary : ", 4),
    ),
    "opencv-last-row": ("opencv-xml", lambda c: c.replace(b"0. 0. 1.</data>", b"0. 0. 7.</data>")),
    "pair-rotation-of-none": ("opencv-pair", lambda c: c.replace(b"9.9500", b"1.5").replace(b"0.9950", b"0.5")),
    "colmap-id-twice": ("colmap-txt", exchange(b"\n2 ", b"\n1 ")),
    "colmap-count": ("colmap-bin", lambda c: (1 << 60).to_bytes(8, "little") + c[8:]),
    "mrcal-code": ("mrcal", lambda c: b"__import__('os').system('touch HIT')\n"),
    "mrcal-power": ("mrcal", lambda c: b"{'lensmodel': 9**9**9**9}\n"),
    "ocam-slope": ("ocamcalib", lambda c: c.replace(b" 0.0 ", b" 3.0 ", 1)),
    "ocam-affine-wild": ("ocamcalib", lambda c: c.replace(b"1.0 0.0 0.0", b"1e9 0.0 0.0")),
    "focal-of-nothing": ("omnilines", exchange(b"fx: 170.25", b"fx: 1.0e-9")),
    "opencv-marker-of-two": ("opencv-yml", exchange(b"fisheye_model: 1", b"fisheye_model: 2")),
    "opencv-models-of-nine": ("opencv-rig", exchange(b"[ 1, 0, 1 ]", b"[ 9, 0, 1 ]")),
    "opencv-half-a-pose": ("opencv-pair", lambda c: c[: c.index(b"T: !!")]),
    "opencv-text-for-xi": ("opencv-yml", lambda c: c + b'xi: "a"\n'),
    "lensfun-entity-bomb": ("lensfun", lambda c: b'<!DOCTYPE l [<!ENTITY a "ha">]>\n<lensdatabase>&a;</lensdatabase>\n'),
    "lensfun-20000-deep": ("lensfun", lambda c: b"<lensdatabase>" + b"<a>" * 20000 + b"</a>" * 20000 + b"</lensdatabase>"),
    "lensfun-crop-of-nothing": ("lensfun", lambda c: c.replace(b"<cropfactor>1<", b"<cropfactor>0<")),
    "lensfun-focal-of-nan": ("lensfun", lambda c: re.sub(rb'focal="[-0-9.e]+"', b'focal="nan"', c)),
    "lensfun-focal-of-nothing": ("lensfun", lambda c: re.sub(rb'focal="[-0-9.e]+"', b'focal="0"', c)),
    "lensfun-focal-beyond-reason": ("lensfun", lambda c: re.sub(rb'focal="[-0-9.e]+"', b'focal="1e99"', c)),
    "lensfun-that-is-flat": ("lensfun", lambda c: re.sub(rb'model="poly5"', b'model="ptlens" a="1" b="0" c="0"', c)),
    "lensfun-unknown-type": ("lensfun", lambda c: c.replace(b">fisheye<", b">panoramic<")),
    "lensfun-no-lens": ("lensfun", lambda c: b"<lensdatabase/>\n"),
    "lensfun-aspect-of-nothing": ("lensfun", lambda c: re.sub(rb"<aspect-ratio>[^<]+<", b"<aspect-ratio>4:0<", c)),
    "ocam-affine-singular": ("ocamcalib", lambda c: c.replace(b"1.0 0.0 0.0", b"0.0 0.0 0.0")),
}  # fmt: skip


def of_their_own() -> Iterator[Case]:
    """What can be wrong in one format."""
    for what, (kind, change) in NATIVE.items():
        alone = what in ("opencv-20000-deep", "mrcal-power")
        yield Case(f"own:{what}", convert(kind), spoilt(kind, change), FILES[kind][0], alone=alone)
