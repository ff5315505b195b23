"""Summary, JSON and report of a line scene: of lines that were matched in photos, or of a table of matched segments."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from camera_models.wording import rounded
from omnilines import report
from omnilines.adjustment.suspects import Suspect
from omnilines.files.scene_folder import UNIT_KEY, UP_KEY
from omnilines.least_squares import Outcome
from omnilines.pages.limits_of_lines import SAMPLE, length, scene_advice, sigma_with_supposed_m
from omnilines.pages.noise_notes import noise_data, noise_notes, noise_row
from omnilines.pipelines.scene import FromPhotos, Scene
from omnilines.pipelines.supposed_errors import SUPPOSED_PX
from omnilines.records import LengthUnit, Lines, Summary
from omnilines.report.line_scene import (
    families_section,
    line_photos_section,
    line_table_section,
    photo_arcs_section,
    stage_section,
)
from omnilines.report.numbers import figure
from omnilines.structure.families import Families

SHOWN_SUSPECTS = 5
"""Observations named in a note; all of them are in `--json` and the report."""


def scene_summary(scene: Scene) -> Summary:
    """The figures that people read first."""
    of_photos = scene.from_photos
    rows, notes = _of_tables(scene) if of_photos is None else _of_photos(scene, of_photos)
    return Summary("Line scene", rows, notes, verdict=_verdict(scene), advice=scene_advice(scene))


def _verdict(scene: Scene) -> str:
    """How many lines there are and how well they are known, or why they are not to be trusted."""
    doubts = [check.name for check in scene.checks if not check.holds]
    if doubts:
        return f"These lines are not to be trusted: {', '.join(doubts)} {'is' if len(doubts) == 1 else 'are'} beyond the limit."
    lines = scene.lines
    weak = sum(status == "weak" for status in lines.status)
    sigma, with_supposed = scene.median_sigma_m(), sigma_with_supposed_m(scene)
    known = "" if math.isnan(sigma) else f", half of them known across to {_known_to(scene, sigma)} or better"
    if not math.isnan(with_supposed):
        known += f" (to {_known_to(scene, with_supposed)} if the calibration is off by {SUPPOSED_PX:g} px)"
    faint = f"; {weak} of them {'is' if weak == 1 else 'are'} weak" if weak else ""
    photos = str(len(scene.poses)) if scene.from_photos is None else _used(scene, scene.from_photos)
    by = {one.by for one in scene.contradicted}
    doubted = f"; but {'they' if 'lines' in by else 'points'} contradict the calibration" if by else ""
    return f"{int(lines.known.sum())} lines from {photos} photos{known}{faint}{doubted}."


def _used(scene: Scene, of_photos: FromPhotos) -> str:
    """How many photos, of how many where some were not used."""
    used = len(scene.segments.images)
    return str(used) if used == of_photos.given else f"{used} of {of_photos.given}"


def _known_to(scene: Scene, sigma: float) -> str:
    """A standard deviation in millimetres; where the scale is open, as a share of the distance from which lines are seen."""
    if scene.lines.unit is LengthUnit.METRES:
        return length(sigma, scene.lines.unit)
    middles, centres = scene.lines.ends_m[scene.lines.known].mean(1), scene.poses.cam_from_world.centre.numpy()
    middles, centres = (points[:: 1 + len(points) // SAMPLE] for points in (middles, centres))
    away = np.linalg.norm(middles[:, None] - centres, axis=-1)
    return f"{rounded(100 * sigma / float(np.median(away)))} percent of their distance"


def _of_photos(scene: Scene, of_photos: FromPhotos) -> tuple[tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Rows and notes."""
    lines = scene.lines
    length = np.linalg.norm(lines.ends_m[:, 1] - lines.ends_m[:, 0], axis=-1)
    rows = (
        ("photos", f"{len(scene.segments.images)} of {of_photos.given}"),
        *((stage.stage, _stage(stage.kept, stage.dropped)) for stage in scene.stages),
        *_by_chance(lines),
        ("length of all lines", f"{float(length.sum()):.2f} {lines.unit.sign}"),
        ("photos that see a line", f"{float(np.median(lines.views)):.0f} (median)"),
        ("rms_px", figure(scene.adjusted.rms_px(), ".3f")),
        ("slack for errors of poses and calibration", f"{of_photos.tolerance_px:g} px"),
        *_asked(scene),
        ("bow of long edges", f"{100 * of_photos.bow_share:g} percent of their length"),
        ("uncertainty of a line across it (sigma_m, median)", figure(scene.median_sigma_m(), ".3g", lines.unit.sign)),
        *_by_calibration(scene),
        ("families of parallel lines", str(len(of_photos.families.members))),
    )
    return rows, (*_outcome(scene), *noise_notes(scene.adjusted.adjusted.noise))


def _by_calibration(scene: Scene) -> tuple[tuple[str, str], ...]:
    """What of that is for errors of the calibration, where these are known."""
    if scene.lines.calibration_sigma_m is None:
        return ()
    sigma, sign = scene.median_calibration_sigma_m(), scene.lines.unit.sign
    return (("of it, by errors of the calibration", figure(sigma, ".3g", sign)),)


def _asked(scene: Scene) -> tuple[tuple[str, str], ...]:
    """How far lines, and points, move the image of each camera that has parameters, and what of that is noise."""
    moved: dict[str, list[str]] = {}
    for one in scene.asked:
        moved.setdefault(one.by, []).append(f"{one.name} {figure(one.drift_px, '.2g')} px (noise {figure(one.sigma_px, '.2g')})")
    return tuple((f"change of the calibration that {by} ask for", ", ".join(cameras)) for by, cameras in moved.items())


def _by_chance(lines: Lines) -> tuple[tuple[str, str], ...]:
    """How many of the lines are there by chance, where that was looked for."""
    if lines.chance_share is None:
        return ()
    count = float(np.nansum(lines.chance_share))
    return (("of them expected to be there by chance", f"about {count:.0f} ({100 * count / len(lines):.1f} percent)"),)


def _stage(kept: int, dropped: Sequence[tuple[str, int]]) -> str:
    reasons = "; ".join(f"{count} {reason}" for reason, count in dropped)
    return f"{kept} ({reasons})" if reasons else str(kept)


def _outcome(scene: Scene) -> tuple[str, ...]:
    """Why the adjustment ended, where it did not converge."""
    outcome = scene.adjusted.adjusted.outcome
    if outcome is Outcome.DEGENERATE and "poses" in scene.options.refine:
        return (
            f"{outcome.value} No uncertainty is stated: hold the poses (`refine` lines), or give photos that share more lines.",
        )
    return () if outcome is Outcome.CONVERGED else (outcome.value,)


def _of_tables(scene: Scene) -> tuple[tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Rows and notes."""
    adjusted, lines, options = scene.adjusted, scene.lines, scene.options
    rows = (
        ("tracks", str(len(lines))),
        ("lines", ", ".join(f"{count} {status}" for status, count in Counter(lines.status).most_common())),
        ("photos", str(len(scene.poses))),
        ("triangulation and cost", f"{options.triangulation}, {options.cost}"),
        ("refined", ", ".join(options.refine)),
        ("rms_px before", figure(adjusted.rms_px(before=True), ".4f")),
        ("rms_px after", figure(adjusted.rms_px(), ".4f")),
        ("uncertainty of a line across it (sigma_m, median)", figure(scene.median_sigma_m(), ".3g", lines.unit.sign)),
        *_by_calibration(scene),
        ("noise of the end points", noise_row(adjusted.adjusted.noise)),
    )
    far_share = len(adjusted.suspect) / max(1, len(scene.segments.image))
    notes = _named("do not belong to their track and were left out", adjusted.wrong)
    notes += _named("lie farther from their line than 99.9 percent should", adjusted.suspect)
    return rows, (*notes, *_outcome(scene), *noise_notes(adjusted.adjusted.noise, far_share))


def _named(what: str, found: tuple[Suspect, ...]) -> tuple[str, ...]:
    """One sentence on observations, the first few by name."""
    if not found:
        return ()
    shown = ", ".join(f"{s.track} in {s.image} ({s.distance_px:.1f} px)" for s in found[:SHOWN_SUSPECTS])
    more = f" and {len(found) - SHOWN_SUSPECTS} more" if len(found) > SHOWN_SUSPECTS else ""
    return (f"{len(found)} observations {what}: {shown}{more}.",)


def scene_data(scene: Scene) -> dict[str, Any]:
    """What `--json` prints."""
    return _data_of_tables(scene) if scene.from_photos is None else _data_of_photos(scene, scene.from_photos)


def _data_of_photos(scene: Scene, of_photos: FromPhotos) -> dict[str, Any]:
    lines, adjusted = scene.lines, scene.adjusted.adjusted
    return {
        "photos": list(scene.segments.images),
        UNIT_KEY: lines.unit.sign,
        UP_KEY: list(scene.up),
        "arcs": [{**asdict(photo), "share": photo.share} for photo in scene.photos],
        "stages": [asdict(stage) for stage in scene.stages],
        "lines": len(lines),
        "lines_by_chance": None if lines.chance_share is None else float(np.nansum(lines.chance_share)),
        "rms_px": scene.adjusted.rms_px(),
        "slack_px": of_photos.tolerance_px,
        "asked_cameras": [asdict(one) | {"contradicted": one in scene.contradicted} for one in scene.asked],
        "bow_share": of_photos.bow_share,
        "median_sigma_m": scene.median_sigma_m(),
        "median_calibration_sigma_m": None if lines.calibration_sigma_m is None else scene.median_calibration_sigma_m(),
        "noise": noise_data(adjusted.noise),
        "outcome": adjusted.outcome.name.lower(),
        **_data_of_families(of_photos.families),
    }


def _data_of_families(families: Families) -> dict[str, Any]:
    angles = zip(families.right_angles.tolist(), families.angle_rad.tolist(), families.angle_sigma_rad.tolist(), strict=True)
    return {
        "families": [
            {
                "direction": families.direction[k].tolist(),
                "sigma_deg": math.degrees(float(families.sigma_rad[k])),
                "lines": int(families.members[k]),
            }
            for k in range(len(families.members))
        ],
        "right_angles": [
            {"families": pair, "angle_deg": math.degrees(angle), "sigma_deg": math.degrees(sigma)}
            for pair, angle, sigma in angles
        ],
    }


def _data_of_tables(scene: Scene) -> dict[str, Any]:
    adjusted, lines = scene.adjusted, scene.lines
    return {
        "tracks": len(lines),
        UNIT_KEY: scene.lines.unit.sign,
        UP_KEY: list(scene.up),
        "status": dict(Counter(scene.lines.status)),
        "rms_px_before": adjusted.rms_px(before=True),
        "rms_px": adjusted.rms_px(),
        "median_sigma_m": scene.median_sigma_m(),
        "median_calibration_sigma_m": None if lines.calibration_sigma_m is None else scene.median_calibration_sigma_m(),
        "noise": noise_data(adjusted.adjusted.noise),
        "outcome": adjusted.adjusted.outcome.name.lower(),
        "iterations": adjusted.adjusted.iterations,
        "left_out": list(adjusted.table.left_out),
        "wrong": [asdict(suspect) for suspect in adjusted.wrong],
        "suspect": [asdict(suspect) for suspect in adjusted.suspect],
        "cameras": {name: model.named_parameters() for name, model in zip(scene.cameras, adjusted.cameras, strict=False)},
    }


def scene_sections(scene: Scene, remarks: Sequence[str] = ()) -> list[report.Section]:
    """The sections of report.html; `remarks` are said beside the notes of the scene."""
    summary, of_photos = scene_summary(scene), scene.from_photos
    residual = np.abs(scene.adjusted.residual_px)
    adjusted = residual[np.isfinite(residual)]
    title, label = "Residuals", "orthogonal distance of an observed end (px)"
    if of_photos is None:
        before = np.abs(scene.adjusted.residual_before_px)
        distances = {"triangulated": before[np.isfinite(before)], "adjusted": adjusted}
        return [
            report.verdict_section(summary),
            report.scene_section(lines=scene.lines, segments=scene.segments, cameras=scene.poses, up=scene.up),
            report.summary_section(summary),
            *([report.checks_section(scene.checks)] if scene.checks else []),
            report.histogram_section(title, distances, label),
        ]
    groups = [f"family {k + 1}" if k >= 0 else "no family" for k in of_photos.families.family.tolist()]
    named = {stage.stage for stage in scene.stages}
    rows = tuple(row for row in summary.rows if row[0] not in named)
    photos = () if of_photos.folder is None else (of_photos.folder,)
    unused = Summary("Photos that were not used", tuple((one.photo, one.text) for one in scene.details))
    return [
        report.verdict_section(summary),
        report.scene_section(lines=scene.lines, groups=groups, segments=scene.segments, cameras=scene.poses, up=scene.up),
        report.summary_section(replace(summary, rows=rows, notes=(*scene.told, *remarks, *summary.notes))),
        stage_section(scene.stages),
        photo_arcs_section(scene.photos),
        *(line_photos_section(folder, scene.lines, scene.segments, scene.poses, scene.cameras) for folder in photos),
        *([report.summary_section(unused, title=unused.title)] if unused.rows else []),
        report.histogram_section(title, {"adjusted": adjusted}, label),
        families_section(of_photos.families),
        line_table_section(scene.lines),
    ]
