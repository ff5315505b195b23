"""omnilines convert: a calibration from one file format, or camera model, to another, with the conversion error."""

from pathlib import Path
from typing import Any

from omnilines.commands.result import CommandResult
from omnilines.pipelines import convert as pipeline
from omnilines.pipelines.convert import FIGURES, ConversionResult
from omnilines.records import Check, Summary

MOST_OFF = 0.002
"""Of the longer side of the image, by which a fitted camera may be off from the one that was read (RMS)."""


def convert(source: Path, out: Path, **options: Any) -> CommandResult:
    """Read the calibration in `source`, write it to `out`, and say what was fitted and what was lost; `options` are those of the
    pipeline. Raises InputError before anything is written."""
    result = pipeline.convert(source, out, **options)
    files = result.save()
    assert result.reader is not None
    rig = bool(result.calibration.rig) and "rig" in result.writer.keeps(out, result.calibration)
    data = {
        "from_format": result.reader.NAME,
        "to_format": result.writer.NAME,
        "cameras": {name: _camera_data(result, name) for name in result.calibration},
        "rig": rig,
        "dropped": list(result.dropped),
        "notes": list(result.notes),
    }
    rows = [(name, _sentence(result, name)) for name in result.calibration]
    if rig:
        rows.append(("rig", f"poses of {len(result.calibration.rig)} cameras"))
    rows += [("written", str(path)) for path in files]
    summary = Summary(f"{result.reader.TITLE} -> {result.writer.TITLE}", tuple(rows))
    return CommandResult((summary,), data, _checks(result), files, warnings=result.notes)


def _checks(result: ConversionResult) -> tuple[Check, ...]:
    """Whether each fitted camera is still the one that was read."""
    checks = []
    for name, error in result.errors.items():
        limit = MOST_OFF * max(result.original[name].image_size)
        checks.append(Check(f"RMS error of {name}, beside 0.2 % of the image", error.rms_px, limit, "px", error.rms_px <= limit))
    for name, near in result.fit.nearly.items():
        if near.begins:
            continue
        limit = MOST_OFF * max(result.original[name].image_size)
        checks.append(Check(f"Largest error of the {near.what} of {name}", near.off_px, limit, "px", near.off_px <= limit))
    return tuple(checks)


def _camera_data(result: ConversionResult, name: str) -> dict[str, Any]:
    model, error, near = result.calibration[name], result.errors.get(name), result.fit.nearly.get(name)
    return {
        "from_model": result.original[name].NAME,
        "model": model.NAME,
        "form": result.fit.forms[name].name,
        "image_size": list(model.image_size),
        "parameters": model.named_parameters(),
        "exact": error is None and (near is None or near.begins),
        **{key: None if error is None else getattr(error, key) for key in FIGURES},
    }


def _sentence(result: ConversionResult, name: str) -> str:
    model, form, error = result.calibration[name].NAME, result.fit.forms[name].name, result.errors.get(name)
    held = model if form == model else f"{model} as {form}"
    near = result.fit.nearly.get(name)
    if error is None:
        return f"{held}, exactly" if near is None or near.begins else f"{held}, its {near.what} {near.off_px:.2g} px off at most"
    return (
        f"{result.original[name].NAME} fitted by {held}: {error.rms_px:.3g} px RMS, {error.max_px:.3g} px at most, within "
        f"{error.fov_deg:.0f} degrees"
    )
