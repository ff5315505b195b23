"""omnilines convert: a calibration from one file format, or camera model, to another, with the conversion error."""

import csv
import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from camera_models import Calibration, Conversion, InputError
from camera_models.formats import format_for_writing, format_named, format_of_file
from camera_models.formats.disk import write_atomically
from camera_models.formats.transfer import Transfer, transfer
from omnilines.commands.result import CommandResult
from omnilines.provenance import provenance
from omnilines.records import Summary

COLUMNS = (
    "camera", "from_model", "to_model", "from_deg", "to_deg", "pixels", "rms_px", "max_px", "rms_deg", "max_deg",
)  # fmt: skip
"""Of the table of errors that is written beside."""
FIGURES = ("rms_px", "max_px", "rms_deg", "max_deg", "fov_deg")
"""Of a conversion as a whole."""


def convert(
    source: Path,
    out: Path,
    *,
    from_format: str | None = None,
    to_format: str | None = None,
    model: str | None = None,
    fov_deg: float | int | None = None,
    image_size: tuple[int, int] | None = None,
) -> CommandResult:
    """Read the calibration in `source`, write it to `out`, and say what was fitted and what was lost.

    Formats are told by the contents of `source` and the name of `out` unless named. A camera that the format of `out` cannot
    hold, or that is to become of another `model`, is fitted within `fov_deg`; its error over the field of view goes to
    `<out>_conversion.csv`. Raises InputError before anything is written.
    """
    reader = format_of_file(source) if from_format is None else format_named(from_format)
    writer = format_for_writing(out) if to_format is None else format_named(to_format)
    if out.exists() and out.resolve() == source.resolve():
        raise InputError(f"Another file than the input was expected to write to, found {out} twice; give another name.")
    content = reader.read(source, image_size)
    fit = transfer(content.calibration, writer, out, model, fov_deg)
    made_of = provenance({"file": source, "format": reader.NAME})
    calibration = fit.calibration
    if "provenance" in writer.keeps(out, calibration):
        figures = {name: {key: getattr(error, key) for key in FIGURES} for name, error in fit.conversions.items()}
        beside_it = {"conversion": figures, "source": calibration.provenance}
        calibration = replace(calibration, provenance=made_of | {key: value for key, value in beside_it.items() if value})
    files = writer.write(out, calibration)
    if fit.conversions:
        beside = out.with_name(f"{out.stem}_conversion.csv")
        write_atomically(beside, _table(content.calibration, fit.conversions))
        files.append(beside)
    notes = [f"{source}: {note}" for note in content.notes] + [f"{out}: {note}" for note in fit.notes]
    if fov_deg is not None and not fit.conversions:
        notes.append("--fov has no effect: every camera is held exactly.")
    data = {
        "from_format": reader.NAME,
        "to_format": writer.NAME,
        "cameras": {name: _camera_data(content.calibration, fit, name) for name in fit.calibration},
        "rig": bool(calibration.rig) and "rig" in writer.keeps(out, calibration),
        "dropped": list(fit.dropped),
        "notes": notes,
    }
    rows = [(name, _sentence(content.calibration, fit, name)) for name in fit.calibration]
    if data["rig"]:
        rows.append(("rig", f"poses of {len(calibration.rig)} cameras"))
    rows += [("written", str(path)) for path in files]
    summary = Summary(f"{reader.TITLE} -> {writer.TITLE}", tuple(rows))
    return CommandResult((summary,), data, files=tuple(files), warnings=tuple(notes))


def _camera_data(original: Calibration, fit: Transfer, name: str) -> dict[str, Any]:
    model, error = fit.calibration[name], fit.conversions.get(name)
    return {
        "from_model": original[name].NAME,
        "model": model.NAME,
        "form": fit.forms[name].name,
        "image_size": list(model.image_size),
        "parameters": model.named_parameters(),
        "exact": error is None,
        **{key: None if error is None else getattr(error, key) for key in FIGURES},
    }


def _sentence(original: Calibration, fit: Transfer, name: str) -> str:
    model, form, error = fit.calibration[name].NAME, fit.forms[name].name, fit.conversions.get(name)
    held = model if form == model else f"{model} as {form}"
    if error is None:
        return f"{held}, exactly"
    return (
        f"{original[name].NAME} fitted by {held}: {error.rms_px:.3g} px RMS, {error.max_px:.3g} px at most, within "
        f"{error.fov_deg:.0f} degrees"
    )


def _table(original: Calibration, conversions: Mapping[str, Conversion]) -> str:
    """Errors ring by ring from the centre outwards, one row each."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for name, conversion in conversions.items():
        for ring in conversion.rings:
            writer.writerow([name, original[name].NAME, conversion.model.NAME, *(getattr(ring, key) for key in COLUMNS[3:])])
    return text.getvalue()
