"""Ways to spoil a file: its bytes, its numbers, or what stands in its place."""

import os
import re
import struct
from collections.abc import Callable
from pathlib import Path

FLOAT = re.compile(rb"-?\d+\.\d*(?:[eE][-+]?\d+)?")
UNREADABLE = "/proc/self/mem"
"""A regular file that even root cannot read from its beginning."""


def _deep(start: bytes, end: bytes = b"", count: int = 40000) -> Callable[[bytes], bytes]:
    return lambda content: start * count + end * count


BYTES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "blank": lambda content: b" \n\n\t\n",
    "one-nul": lambda content: b"\0",
    "nuls": lambda content: b"\0" * len(content),
    "torn-third": lambda content: content[: len(content) // 3],
    "torn-half": lambda content: content[: len(content) // 2],
    "zeros-at-the-end": lambda content: content[: len(content) // 2] + b"\0" * (len(content) - len(content) // 2),
    "utf-16": lambda content: content.decode("latin-1").encode("utf-16"),
    "not-utf-8": lambda content: content[:20] + b"\xff\xfe\x80" + content[20:],
    "noise": lambda content: bytes((31 * k * k + 7 * k + 200) % 256 for k in range(3000)),
    "html": lambda content: b"<!DOCTYPE html><html><body>404 not found</body></html>\n",
    "deep-lists": _deep(b"[", b"]"),
    "deep-maps": _deep(b"{a: "),
    "deep-indents": lambda content: b"- " * 40000 + b"1\n",
    "script": lambda content: b"!!python/object/apply:os.system ['touch HIT']\n",
}
"""Of any text; the format of the file is named beside, so that it is read as one."""

NUMBERS: dict[str, bytes] = {
    "nan": b"nan",
    "yaml-nan": b".nan",
    "inf": b"inf",
    "yaml-inf": b".inf",
    "beyond-doubles": b"1e999",
    "beyond-reason": b"1.0e+300",
    "400-digits": b"1" * 400,
    "5000-digits": b"1" * 5000,
    "negative": b"-170.25",
    "zero": b"0.0",
    "word": b"wide",
}
"""In place of a focal length."""


def replace_number(content: bytes, value: float, other: bytes) -> bytes:
    """The content with another text (or, in a binary file, number) in place of a number, wherever it stands."""
    binary = struct.pack("<d", value)
    if binary in content:
        return content.replace(binary, struct.pack("<d", float(other.lstrip(b"."))))
    changed = FLOAT.sub(lambda found: other if abs(float(found[0])) == value else found[0], content)
    assert changed != content, f"no {value} in {content[:300]!r}"
    return changed


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _link(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 41)


PLACES: dict[str, Callable[[Path], None]] = {
    "absent": lambda path: None,
    "folder": lambda path: path.mkdir(),
    "fifo": _fifo,
    "dev-zero": _link("/dev/zero"),
    "dev-null": _link("/dev/null"),
    "dangling-link": _link("nowhere"),
    "link-to-itself": lambda path: path.symlink_to(path.name),
    "unreadable": _link(UNREADABLE),
    "two-terabytes": _sparse,
}
"""What stands in place of a file."""
