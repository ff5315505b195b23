"""Files mutated at random: whatever a reader is given, nothing but InputError leaves it, in one sentence that names the file."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hostile.good import FILES, store
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from camera_models.errors import InputError
from camera_models.formats import format_of_file, read
from omnilines.files import read_corners, read_lines, read_photo, read_poses, read_rig_corners, read_segments
from omnilines.files.true_edges import read_true_edges

FEW, MANY = 50, 5000
PIECES = (
    b"",
    b"\0",
    b"\n",
    b",",
    b'"',
    b"'",
    b"{",
    b"[",
    b"]}",
    b"- ",
    b": ",
    b"&a ",
    b"*a",
    b"nan",
    b".inf",
    b"-1",
    b"0",
    b"1e999",
    b"1e300",
    b"1e-300",
    b"5e-324",
    b"9" * 400,
    b"true",
    b"null",
    b"~",
    b"\xff",
    b"\xef\xbb\xbf",
    b"\xc3",
    "\u2028".encode(),
    b"!!binary ",
    b"<a>",
    b"</data>",
    b"<!--",
    b"&lt;",
    b"__import__('os')",
    b"-0.0",
    b"0x10",
    b"1_0",
    b"18446744073709551616",
    b"#",
    b"%YAML 9.9\n",
    b"\x1b[31m",
)
NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
LINES = """track,x1_m,y1_m,z1_m,x2_m,y2_m,z2_m,views,rms_px,sigma_m,status
a,0.5,1.0,2.0,0.5,1.5,2.5,4,0.3,0.001,ok
b,,,,,,,2,,,too_few_views
"""
EDGES = "edge,x1_m,y1_m,z1_m,x2_m,y2_m,z2_m\na,0.5,1.0,2.0,0.5,1.5,2.5\nb,0.5,1.0,2.0,0.5,1.5,9.5\n"


def _png() -> bytes:
    image = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def first_rows(name: str) -> bytes:
    return b"\n".join((store() / name).read_bytes().split(b"\n")[:30]) + b"\n"


READERS: dict[str, tuple[str, Callable[[], bytes], Callable[[Path], Any]]] = {
    **{
        kind: (name, lambda kind=kind, name=name: (store() / kind / name).read_bytes(), lambda path, own=own: read(path, own))
        for kind, (name, own, _) in FILES.items()
    },
    "told-by-contents": ("camera.yaml", lambda: (store() / "kalibr/camchain.yaml").read_bytes(), format_of_file),
    "corners": ("corners.csv", lambda: first_rows("corners.csv"), read_corners),
    "rig-corners": ("corners.csv", lambda: first_rows("corners.csv"), read_rig_corners),
    "poses": ("poses.csv", lambda: (store() / "poses.csv").read_bytes(), read_poses),
    "segments": ("segments.csv", lambda: first_rows("segments.csv"), read_segments),
    "lines": ("lines.csv", LINES.encode, read_lines),
    "true-edges": ("truth.csv", EDGES.encode, read_true_edges),
    "photo": ("photo.png", _png, read_photo),
}  # fmt: skip
"""What is read -> the file's name, good content, the reader."""

STEPS = st.tuples(
    st.sampled_from(("insert", "replace", "cut", "repeat", "end", "flip", "number")),
    st.floats(0, 1),
    st.floats(0, 1),
    st.sampled_from(PIECES),
)


def mutated(content: bytes, steps: list[tuple[str, float, float, bytes]]) -> bytes:
    """The content after a few steps, each at a place given by a share of its length."""
    for what, where, how_far, piece in steps:
        low = int(where * len(content))
        high = min(len(content), low + 1 + int(how_far * 40))
        if what == "insert":
            content = content[:low] + piece + content[low:]
        elif what == "replace":
            content = content[:low] + piece + content[high:]
        elif what == "cut":
            content = content[:low] + content[high:]
        elif what == "repeat":
            content = content[:high] + content[low:high] * (1 + int(20 * how_far)) + content[high:]
        elif what == "end":
            content = content[:low]
        elif what == "flip" and low < len(content):
            content = content[:low] + bytes([content[low] ^ (1 << int(7 * how_far))]) + content[low + 1 :]
        elif what == "number":
            found = list(NUMBER.finditer(content))
            if found:
                at = found[min(len(found) - 1, int(where * len(found)))]
                content = content[: at.start()] + piece + content[at.end() :]
    return content


def fuzz(reader: str, examples: int, folder: Path) -> None:
    name, good, function = READERS[reader]
    path, whole = folder / name, good()
    refused = 0
    path.write_bytes(whole)
    function(path)

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=examples == FEW,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(STEPS, min_size=1, max_size=4))
    def one(steps: list[tuple[str, float, float, bytes]]) -> None:
        nonlocal refused
        path.write_bytes(mutated(whole, steps))
        try:
            function(path)
        except InputError as error:
            refused += 1
            assert name in str(error) and len(str(error)) < 2000

    one()
    assert refused > examples // 10


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_only_input_errors_leave_a_reader(reader: str, tmp_path: Path) -> None:
    fuzz(reader, FEW, tmp_path)


@pytest.mark.full
@pytest.mark.parametrize("reader", READERS)
def test_only_input_errors_leave_a_reader_however_often(reader: str, tmp_path: Path) -> None:
    fuzz(reader, MANY, tmp_path)
