"""cv2.FileStorage as a mapping: matrices as arrays, numbers, texts and lists of them."""

import itertools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from camera_models.errors import InputError
from camera_models.formats.disk import read_text

DEEPEST = 64
_COLUMNS = 2
_BASE64 = r"!!binary|type_id\s*=\s*[\"']binary|\$base64\$"
_TAG = re.compile(r"</?[A-Za-z_][^<>]*(?<!/)>")
_SYNTAX = {".xml": ".xml", ".json": ".json"}


def read_storage(path: Path) -> dict[str, Any]:
    """The top level of a file; raises InputError where it cannot be parsed."""
    text = read_text(path)
    if _depth(text) > DEEPEST:
        raise InputError(
            f"{path} was expected to be a calibration of OpenCV, found one nested more than {DEEPEST} deep; restore it."
        )
    if re.search(_BASE64, text):
        # OpenCV 5.0 waits forever for the end of some that are cut short.
        raise InputError(
            f"{path} must hold its matrices as numbers, found some in base64; write them with cv2.FileStorage_WRITE."
        )
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        return {key: _value(root.getNode(key), key) for key in root.keys()}
    except (cv2.error, SystemError) as error:
        # The constructor raises cv2.error as the cause of a SystemError.
        cause = error.__cause__ or error
        said = getattr(cause, "err", None) or "not a file of cv2.FileStorage"
        raise InputError(f"{path} cannot be parsed by OpenCV ({said}); correct it or restore the file.") from None


def _depth(text: str) -> int:
    """An upper bound of the nesting, as XML or as YAML and JSON; OpenCV's parsers recurse, and the process ends."""
    if text.lstrip().startswith("<"):
        steps = [-1 if tag.startswith("</") else 1 for tag in _TAG.findall(text)]
        blocks = 0
    else:
        steps = [1 if mark in "[{" else -1 for mark in re.findall(r"[\[\]{}]", text)]
        # Each level of a block is indented by a column or more, or begins with a dash in the same line.
        blocks = max((len(start) for start in re.findall(r"^[ \-]*", text, re.M)), default=0) // _COLUMNS
    return max(itertools.accumulate(steps), default=0) + blocks


def _value(node: Any, name: str) -> Any:
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return float(node.real())
    if node.isString():
        return node.string()
    if node.isSeq():
        parts = [_value(node.at(index), name) for index in range(node.size())]
        return np.array(parts, dtype=np.float64) if parts and all(isinstance(part, int | float) for part in parts) else parts
    if node.isMap():
        keys = node.keys()
        return _matrix(node, name) if "data" in keys else {key: _value(node.getNode(key), name) for key in keys}
    return None


def _matrix(node: Any, name: str) -> Any:
    """The array of a node with its shape (rows and cols, or sizes), dt and data, which OpenCV itself takes on trust."""
    sizes, kind, data = (node.getNode(key) for key in ("sizes", "dt", "data"))
    sides = [node.getNode(key) for key in ("rows", "cols")] if sizes.empty() else _parts(sizes)
    layout = re.fullmatch(r"(\d{0,3})[a-z]", kind.string()) if kind.isString() else None
    if layout is None or not all(side.isInt() for side in sides):
        raise InputError(f"The matrix {name} must have rows, cols (or sizes), dt and a list of data, found others; correct it.")
    shape = [*(int(side.real()) for side in sides), int(layout[1] or 1)]
    count = len(_parts(data))
    if min(shape) < 1 or math.prod(shape) != count:
        raise InputError(f"The matrix {name} must hold {' x '.join(map(str, shape))} numbers, found {count}; correct it.")
    return node.mat()


def _parts(node: Any) -> list[Any]:
    """The items of a sequence; XML has one item as the item itself."""
    return [node.at(index) for index in range(node.size())] if node.isSeq() else [node] if node.isInt() or node.isReal() else []


def storage_text(data: Mapping[str, Any], suffix: str) -> str:
    """What cv2.FileStorage writes of matrices, numbers, texts and lists of texts, in the syntax that the suffix asks for.

    Raises InputError for a text that it would read as another, or as none: it writes some without the quotes that they need.
    """
    storage = cv2.FileStorage(_SYNTAX.get(suffix, ".yml"), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in data.items():
        storage.write(key, value)
    written: str = storage.releaseAndGetString()
    for key, value in data.items():
        for text in value if isinstance(value, list) else ():
            if not _comes_back(text, suffix):
                raise InputError(f"Texts that OpenCV reads as it writes them were expected in {key}, found {text!r}; rename it.")
    return written


def _comes_back(text: str, suffix: str) -> bool:
    """Whether OpenCV reads a text as it writes it. In XML one text alone is no list."""
    storage = cv2.FileStorage(_SYNTAX.get(suffix, ".yml"), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("texts", [text, "text"])
    written = storage.releaseAndGetString()
    try:
        again = cv2.FileStorage(written, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError):
        return False
    return _value(again.getNode("texts"), "texts") == [text, "text"]
