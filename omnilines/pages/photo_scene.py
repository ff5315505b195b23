"""Summary, JSON and report of the lines rebuilt from photos."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from camera_models import Calibration
from omnilines import report
from omnilines.files import PhotoRef
from omnilines.least_squares import Outcome
from omnilines.pages.noise_notes import noise_data, noise_notes
from omnilines.pipelines.line_scene import PhotoScene
from omnilines.pipelines.scene_frame import UNIT_KEY, SceneFrame
from omnilines.records import Summary
from omnilines.report.line_scene import (
    families_section,
    line_photos_section,
    line_table_section,
    photo_arcs_section,
    stage_section,
)
from omnilines.structure.families import Families


def scene_summary(scene: PhotoScene, photos: int, families: Families) -> Summary:
    """The figures that people read first."""
    lines = scene.scene.lines
    length = np.linalg.norm(lines.ends_m[:, 1] - lines.ends_m[:, 0], axis=-1)
    rows = (
        ("photos", f"{len(scene.segments.images)} of {photos}"),
        *((stage.stage, _stage(stage.kept, stage.dropped)) for stage in scene.stages),
        ("length of all lines", f"{float(length.sum()):.2f} {lines.unit.sign}"),
        ("photos that see a line", f"{float(np.median(lines.views)):.0f} (median)"),
        ("rms_px", f"{scene.scene.rms_px():.3f}"),
        ("slack of poses and calibration", f"{scene.slack_px:g} px"),
        ("median of the largest sigma of a line's ends across it", f"{float(np.median(lines.sigma_m)):.3g} {lines.unit.sign}"),
        ("families of parallel lines", str(len(families.members))),
    )
    outcome = scene.scene.adjusted.outcome
    notes = () if outcome is Outcome.CONVERGED else (outcome.value,)
    return Summary("Line scene", rows, (*notes, *noise_notes(scene.scene.adjusted.noise)))


def _stage(kept: int, dropped: Sequence[tuple[str, int]]) -> str:
    reasons = "; ".join(f"{count} {reason}" for reason, count in dropped)
    return f"{kept} ({reasons})" if reasons else str(kept)


def scene_data(scene: PhotoScene, frame: SceneFrame) -> dict[str, Any]:
    """What `--json` prints."""
    lines, families = frame.lines, frame.families
    return {
        "photos": list(scene.segments.images),
        UNIT_KEY: lines.unit.sign,
        "up": list(frame.up),
        "arcs": [{**asdict(photo), "share": photo.share} for photo in scene.photos],
        "stages": [asdict(stage) for stage in scene.stages],
        "lines": len(lines),
        "rms_px": scene.scene.rms_px(),
        "slack_px": scene.slack_px,
        "median_sigma_m": float(np.median(lines.sigma_m)),
        "noise": noise_data(scene.scene.adjusted.noise),
        "outcome": scene.scene.adjusted.outcome.name.lower(),
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
            for pair, angle, sigma in zip(
                families.right_angles.tolist(), families.angle_rad.tolist(), families.angle_sigma_rad.tolist(), strict=True
            )
        ],
    }


def scene_sections(
    scene: PhotoScene, cameras: Calibration, photos: Sequence[PhotoRef], frame: SceneFrame, summary: Summary
) -> list[report.Section]:
    """The sections of report.html."""
    lines, families, residual = frame.lines, frame.families, np.abs(scene.scene.residual_px)
    labels = [f"family {k + 1}" if k >= 0 else "no family" for k in families.family.tolist()]
    # All photo names end their path in the same folder.
    folder = photos[0].path.parents[len(photos[0].name.split("/")) - 1]
    told = {stage.stage for stage in scene.stages}
    figures = replace(summary, rows=tuple(row for row in summary.rows if row[0] not in told))
    return [
        report.summary_section(figures),
        report.scene_section(lines=lines, groups=labels, cameras=frame.poses, up=frame.up),
        stage_section(scene.stages),
        photo_arcs_section(scene.photos),
        line_photos_section(folder, lines, scene.segments, frame.poses, cameras),
        report.histogram_section(
            "Residuals", {"adjusted": residual[np.isfinite(residual)]}, "orthogonal distance of an observed end (px)"
        ),
        families_section(families),
        line_table_section(lines),
    ]
