"""Calibration targets: geometry, rendering and detection.

    board = calib_patterns.pattern("checkerboard:8x6:32.5mm")
    detection, reason = board.detect(image)

`PATTERNS` lists the targets without importing their modules; all else is loaded on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from camera_models.errors import InputError

if TYPE_CHECKING:
    from calib_patterns._pattern import Detection, Pattern, parse_length
    from calib_patterns.options import DetectionOptions

__all__ = ["PATTERNS", "Detection", "DetectionOptions", "Pattern", "parse_length", "pattern", "pattern_class"]

PATTERNS: tuple[tuple[str, str], ...] = (
    ("checkerboard", "calib_patterns.checkerboard:Checkerboard"),
    ("charuco", "calib_patterns.charuco:ChArUco"),
    ("aprilgrid", "calib_patterns.aprilgrid:AprilGrid"),
)
"""(name in a specification, "module:Class"), the most common target first, as help texts list them."""

INVERTED = "inverted"
"""Last part of a specification of what is printed white on black."""

_LAZY = {
    "Detection": "calib_patterns._pattern",
    "DetectionOptions": "calib_patterns.options",
    "Pattern": "calib_patterns._pattern",
    "parse_length": "calib_patterns._pattern",
}


def pattern_class(name: str) -> "type[Pattern]":
    """The class of a registered name; raises InputError for an unknown one."""
    location = dict(PATTERNS).get(name)
    if location is None:
        known = ", ".join(known_name for known_name, _ in PATTERNS)
        raise InputError(f"Expected a pattern that starts with one of: {known}; found '{name}'; write it as name:arguments.")
    module, _, attribute = location.partition(":")
    return getattr(importlib.import_module(module), attribute)


def pattern(specification: str) -> "Pattern":
    """The target written as `name:arguments`, for example `checkerboard:8x6:32.5mm` (lengths in mm, cm or m); with `:inverted`
    after it printed white on black.

    Raises InputError when the name is unknown or the arguments are malformed.
    """
    name, _, arguments = specification.strip().partition(":")
    rest, _, last = arguments.rpartition(":")
    if last.strip() == INVERTED:
        return importlib.import_module("calib_patterns.inverted").Inverted(pattern_class(name)._from_arguments(rest))
    return pattern_class(name)._from_arguments(arguments)


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'calib_patterns' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
