"""A calibration made fit for another file format, or another camera model, with the error of every camera that was fitted."""

import csv
import io
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from camera_models import Calibration, CameraEstimate, CameraModel, Conversion, InputError
from camera_models.formats import FORMATS, format_for_writing, format_named, format_of_file
from camera_models.formats.camera_doubts import camera_doubts
from camera_models.formats.contract import CalibrationFormat
from camera_models.formats.disk import write_atomically
from camera_models.formats.transfer import Transfer, transfer
from camera_models.typed import typed
from camera_models.wording import listed
from omnilines.files.folders import OF_CONVERT
from omnilines.files.sets import claimed
from omnilines.provenance import provenance

COLUMNS = (
    "camera", "from_model", "to_model", "from_deg", "to_deg", "pixels", "rms_px", "max_px", "rms_deg", "max_deg",
)  # fmt: skip
"""Of the table of errors that is written beside."""
FIGURES = ("rms_px", "max_px", "rms_deg", "max_deg", "fov_deg")
"""Of a conversion as a whole."""
IN_MEMORY = "in memory"
LARGE_PX = 1.0
"""RMS error of a conversion that is more than calibrations are off by, where it is not known how well one fits."""
TANGENTIAL = ("p0", "p1", "p2", "s0", "s1", "s2", "s3")
"""Parameters of a lens that is not round, which purely radial models have no place for."""


@dataclass(frozen=True, eq=False)
class ConversionResult:
    """A calibration as a format holds it, and how it differs from what was given. Nothing is written before `save`."""

    original: Calibration
    fit: Transfer
    calibration: Calibration
    """What the file will hold, with its provenance."""
    reader: CalibrationFormat | None
    """Of the file that was read, if it was one."""
    writer: CalibrationFormat
    out: Path
    read: tuple[Path, ...]
    """The file that was read, or the files of a folder."""
    notes: tuple[str, ...]
    """What is lost, and where the format's own tool ends, one sentence each."""

    def __repr__(self) -> str:
        return f"ConversionResult({self.calibration}, format={self.writer.NAME!r}, out={str(self.out)!r})"

    @property
    def errors(self) -> Mapping[str, Conversion]:
        """How far a fitted camera is from the original, by name; the other cameras are held exactly."""
        return self.fit.conversions

    @property
    def dropped(self) -> tuple[str, ...]:
        """What the file has no place for."""
        return self.fit.dropped

    def save(self) -> tuple[Path, ...]:
        """Write the file or folder that the conversion is for, and `<out>_conversion.csv` where a camera was fitted; returns the
        files."""
        # A folder that is a link is written where it leads.
        out = Path(os.path.realpath(self.out)) if self.out.is_dir() else self.out
        files = list(self.writer.documents(out, self.calibration))
        # A folder may hold the cameras in one format beside another.
        which = out.name if out in files else f"{out.name} to {self.writer.NAME}"
        if self.errors:
            files.append(out.with_name(f"{out.name}_conversion.csv"))
        names = [path.relative_to(out.parent).as_posix() for path in files]
        with claimed(out.parent, names, self.read, by=f"{OF_CONVERT}{which}"):
            self.writer.write(out, self.calibration)
            if self.errors:
                write_atomically(files[-1], self._table())
        return tuple(files)

    def _table(self) -> str:
        """Errors ring by ring from the centre outwards, one row each."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        for name, error in self.errors.items():
            for ring in error.rings:
                writer.writerow([name, self.original[name].NAME, error.model.NAME, *(getattr(ring, key) for key in COLUMNS[3:])])
        return text.getvalue()


@typed
def convert(
    source: str | Path | Calibration,
    out: str | Path,
    *,
    from_format: str | None = None,
    to_format: str | None = None,
    model: str | None = None,
    fov_deg: float | int | None = None,
    image_size: tuple[int, int] | None = None,
) -> ConversionResult:
    """A calibration, or the one in a file or folder, as `out` can hold it. Nothing is written yet.

    Formats are told by the contents of `source` and the name of `out` unless named. A camera that the format of `out` cannot
    hold, or that is to become of another `model`, is fitted within `fov_deg`. `image_size` where the file does not hold it.
    Raises InputError where there is no such format or model, or none that holds the field of view of a camera.

        >>> conversion = ol.convert("calibration.yaml", "cameras.txt", model="opencv-fisheye")
        >>> list(conversion.calibration), conversion.errors
        (['cam0'], {})
        >>> [path.name for path in conversion.save()]
        ['cameras.txt']
    """
    path = Path(out)
    reader: CalibrationFormat | None = None
    said: tuple[str, ...] = ()
    if isinstance(source, Calibration):
        calibration = source
        if from_format is not None or image_size is not None:
            raise InputError("`from_format` and `image_size` are of a file, found a calibration in memory; leave them out.")
    else:
        reader, calibration, said = _read(Path(source), path, from_format, image_size)
    writer = format_for_writing(path) if to_format is None else format_named(to_format)
    fit = transfer(calibration, writer, path, model, fov_deg)
    if fov_deg is not None and not fit.conversions:
        raise InputError("`fov_deg` is of a camera that is fitted, found every camera held exactly; leave it out.")
    final = fit.calibration
    if "provenance" in writer.keeps(path, final):
        made_of = {"file": IN_MEMORY} if reader is None else {"file": source, "format": reader.NAME}
        figures = {name: {key: getattr(error, key) for key in FIGURES} for name, error in fit.conversions.items()}
        beside = {"conversion": figures, "source": final.provenance}
        final = replace(final, provenance=provenance(made_of) | {key: value for key, value in beside.items() if value})
    notes = [f"{source}: {note}" for note in said] + [
        f"{path}: {note}" for note in (*_losses(calibration, fit, writer), *fit.notes)
    ]
    read = () if isinstance(source, Calibration) else (Path(source), *(Path(source).iterdir() if Path(source).is_dir() else ()))
    return ConversionResult(calibration, fit, final, reader, writer, path, read, tuple(notes))


def _losses(original: Calibration, fit: Transfer, writer: CalibrationFormat) -> list[str]:
    """Of each camera that the file holds worse than the calibration fits its corners, what is lost and what would hold it."""
    sentences = []
    for name, error in fit.conversions.items():
        camera, known_px = original[name], original.estimates.get(name, CameraEstimate()).rms_px_per_point
        if error.rms_px <= (LARGE_PX if known_px is None else known_px):
            continue
        beside = "" if known_px is None else f", {error.rms_px / known_px:.2g} times the {known_px:.2g} px RMS of its calibration"
        fitted, given = error.model.named_parameters(), camera.named_parameters()
        lost = [f"{key} = {given[key]:.3g}" for key in TANGENTIAL if given.get(key) and key not in fitted]
        why = f": {error.model.NAME} has no place for {listed(lost)}" if lost else ""
        sentences.append(f"{name} is {error.rms_px:.3g} px RMS off in this file{beside}{why}; {_better(camera, error, writer)}.")
    return sentences


def _better(camera: CameraModel, error: Conversion, writer: CalibrationFormat) -> str:
    """What to do for a smaller error."""
    if writer.form_of(camera) is not None:
        return "leave `model` out, and it is held exactly"
    formats = [entry.name for entry in FORMATS if format_named(entry.name).form_of(camera) is not None]
    again = "" if error.model.NAME == camera.NAME else f"calibrate with `model` {error.model.NAME}, or "
    return f"{again}write it exactly with one of `to_format` {listed(formats)}"


def _read(
    source: Path, out: Path, from_format: str | None, image_size: tuple[int, int] | None
) -> tuple[CalibrationFormat, Calibration, tuple[str, ...]]:
    """The format of a file, the calibration in it and what was noted of it."""
    reader = format_of_file(source) if from_format is None else format_named(from_format)
    if out.exists() and out.resolve() == source.resolve():
        raise InputError(f"Another file than the input was expected to write to, found {out} twice; give another name.")
    if image_size is not None and _holds_size(reader, source):
        raise InputError(f"`image_size` was expected where the file does not hold it, found it in {source}; leave it out.")
    content = reader.read(source, image_size)
    return reader, content.calibration, (*content.notes, *camera_doubts(content.calibration))


def _holds_size(reader: CalibrationFormat, source: Path) -> bool:
    """Whether a file can be read without being told the size of the image."""
    try:
        reader.read(source)
    except InputError:
        return False
    return True
