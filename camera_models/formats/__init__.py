"""File formats of calibrations: which there are, and which of them a file is of. Listing them imports neither torch nor cv2.

    content = formats.read("camchain.yaml")                  # .calibration and .notes; the format by its contents
    formats.write("cameras.txt", content.calibration)        # the format by the name

A new format is one module with a `CalibrationFormat` (`formats.contract`) and one line in FORMATS.
"""

import codecs
import fnmatch
import importlib
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes

if TYPE_CHECKING:
    from camera_models.formats.calibration_data import Calibration
    from camera_models.formats.contract import CalibrationFormat, Content

HEAD = 65536
"""Bytes of a file by which its format is told."""


class FormatEntry(NamedTuple):
    """One format of the registry."""

    name: str
    """On the command line."""
    module: str
    """module:Class of a `CalibrationFormat`."""
    files: tuple[str, ...]
    """Names that are written in this format unless another is asked for, as shell patterns in lower case."""


# Formats with names of their own first; the last takes every other .yaml, so it must come after those whose files are .yaml too.
FORMATS: tuple[FormatEntry, ...] = (
    FormatEntry("colmap", "camera_models.formats.colmap:Colmap", ("cameras.txt", "cameras.bin")),
    FormatEntry("mrcal", "camera_models.formats.mrcal:Mrcal", ("*.cameramodel",)),
    FormatEntry("opensfm", "camera_models.formats.opensfm:OpenSfM", ("*camera_models*.json", "cameras.json")),
    FormatEntry("nerfstudio", "camera_models.formats.nerfstudio:Nerfstudio", ("*transforms*.json",)),
    FormatEntry("ftheta", "camera_models.formats.ftheta:FTheta", ("*ftheta*.json",)),
    FormatEntry("aria", "camera_models.formats.aria:Aria", ("*aria*.json",)),
    FormatEntry("openmvg", "camera_models.formats.openmvg:OpenMVG", ("*sfm_data*.json",)),
    FormatEntry("basalt", "camera_models.formats.basalt:Basalt", ("*.json",)),
    FormatEntry("caliscope", "camera_models.formats.caliscope:Caliscope", ("*camera_array*.toml",)),
    FormatEntry("anipose", "camera_models.formats.anipose:Anipose", ("*.toml",)),
    FormatEntry("usd", "camera_models.formats.usd:Usd", ("*.usda",)),
    FormatEntry("ocamcalib", "camera_models.formats.ocamcalib:OCamCalib", ("*calib_results*.txt", "*ocam*.txt", "*ocam*.yaml")),
    FormatEntry("kalibr", "camera_models.formats.kalibr:Kalibr", ("*camchain*.yaml", "*kalibr*.yaml")),
    FormatEntry("ros", "camera_models.formats.ros:RosCameraInfo", ("*camera_info*.yaml", "ost.yaml")),
    FormatEntry("camodocal", "camera_models.formats.camodocal:CamOdoCal", ("*camodocal*.yaml",)),
    FormatEntry("mc-calib", "camera_models.formats.mc_calib:MCCalib", ("*calibrated_cameras*.yml",)),
    FormatEntry("metashape", "camera_models.formats.metashape:Metashape", ("*metashape*.xml", "*agisoft*.xml")),
    FormatEntry("lensfun", "camera_models.formats.lensfun:Lensfun", ("*lensfun*.xml",)),
    FormatEntry("opencv", "camera_models.formats.opencv:OpenCV", ("*.yml", "*.xml", "*opencv*.yaml")),
    FormatEntry("omnilines", "camera_models.formats.native:Native", ("*.yaml",)),
)


def format_named(name: str) -> "CalibrationFormat":
    """The format of a name; raises InputError where there is none."""
    for entry in FORMATS:
        if entry.name == name:
            module, _, attribute = entry.module.partition(":")
            found: CalibrationFormat = getattr(importlib.import_module(module), attribute)()
            return found
    raise InputError(f"A format is one of {', '.join(entry.name for entry in FORMATS)}, found '{name}'; choose one of these.")


def format_of_file(path: str | Path) -> "CalibrationFormat":
    """The format that a file or a folder is of, by its contents; raises InputError where it is of none."""
    file = Path(path)
    parts = sorted(part for part in file.iterdir() if part.is_file()) if file.is_dir() else []
    for entry in FORMATS:
        candidate = format_named(entry.name)
        if file.is_dir() and not candidate.FOLDERS:
            own = [part for part in parts if part.suffix.lower() in candidate.SUFFIXES]
            recognised = bool(own) and all(candidate.recognises(part, _head(part)) for part in own)
        else:
            recognised = candidate.recognises(file, "" if file.is_dir() else _head(file))
        if recognised:
            return candidate
    raise InputError(
        f"{file} was expected to be a calibration of {', '.join(entry.name for entry in FORMATS)}, found none of these; name its "
        "format with `from_format`, or another file."
    )


def format_for_writing(path: str | Path) -> "CalibrationFormat":
    """The format that owns a file name: the one that it is the name of, else that of its pattern. Raises InputError where none
    does, or the format that it is the name of has no such files."""
    name = Path(path).name.lower()
    stem, suffix = Path(name).stem, Path(name).suffix
    if suffix and any(entry.name == stem for entry in FORMATS):
        named = format_named(stem)
        if suffix not in named.SUFFIXES:
            raise InputError(
                f"{named.TITLE} files end in {' or '.join(named.SUFFIXES)}, found '{Path(path).name}'; give such a name, or the "
                "format with `to_format`."
            )
        return named
    for entry in FORMATS:
        if any(fnmatch.fnmatchcase(name, pattern) for pattern in entry.files):
            return format_named(entry.name)
    raise InputError(
        f"A file name that tells the format was expected ({', '.join(pattern for entry in FORMATS for pattern in entry.files)}), "
        f"found '{Path(path).name}'; name the format with `to_format`."
    )


def read(path: str | Path, name: str | None = None, image_size: tuple[int, int] | None = None) -> "Content":
    """The calibration in a file or folder, in the format of a name or by its contents; `image_size` where the file has none."""
    return (format_of_file(path) if name is None else format_named(name)).read(path, image_size)


def write(path: str | Path, calibration: "Calibration", name: str | None = None) -> list[Path]:
    """Write a calibration in the format of a name or else that owns the file name; returns the files.

    Raises InputError where the format does not hold a camera exactly; `camera_models.formats.transfer` fits it first.
    """
    return (format_for_writing(path) if name is None else format_named(name)).write(path, calibration)


def _head(file: Path) -> str:
    return read_bytes(file, HEAD).removeprefix(codecs.BOM_UTF8).decode("latin-1")
