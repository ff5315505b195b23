"""Tables and report of the experiment on the model house."""

from typing import Any

from omnilines import report
from omnilines.records import Summary
from omnilines.studies.distances import json_rows
from omnilines.studies.house import ADJUSTMENT, FROM_MATCHES, FROM_MATRICES, SHOWN, HouseStudy


def house_summaries(study: HouseStudy) -> tuple[Summary, ...]:
    """The data, and the figures of every stage."""
    segments, poses = study.house.segments, study.house.poses
    setting = (("lines, views, segments", f"{len(segments.tracks)}, {len(poses)}, {len(segments)}"),)
    given, found, adjusted = (
        tuple((f.method, f.described()) for f in study.figures if f.stage == stage)
        for stage in (FROM_MATRICES, FROM_MATCHES, ADJUSTMENT)
    )
    note = "Orthogonal distance of both end points of every segment from the projected line, without sign."
    published = "The published figures rest on poses from the same point matches, by a factorisation."
    return (
        Summary("The model house", setting),
        Summary("Triangulation from the poses of the matrices", given, (note,)),
        Summary("Triangulation from poses of the point matches", found, (published,)),
        Summary("Lines and poses adjusted", adjusted),
    )


def house_data(study: HouseStudy) -> dict[str, Any]:
    """For `--json`."""
    return {
        "tracks": len(study.house.segments.tracks),
        "views": len(study.house.poses),
        "segments": len(study.house.segments),
        "rows": json_rows(study.figures),
    }


def house_sections(study: HouseStudy) -> list[report.Section]:
    """All sections, in reading order."""
    quantity = "orthogonal distance of an end point (px)"
    by_stage = {
        stage: {f.method: f.distance_px for f in study.figures if f.stage == stage} for stage in (FROM_MATRICES, ADJUSTMENT)
    }
    return [
        report.summary_section(*house_summaries(study)),
        report.checks_section(study.checks),
        report.histogram_section("Residuals after triangulation", by_stage[FROM_MATRICES], quantity, logarithmic=True),
        report.histogram_section("Residuals after adjustment", by_stage[ADJUSTMENT], quantity, logarithmic=True),
        report.scene_section(lines=study.shown.lines, cameras=study.shown.poses, title=f"Lines and cameras, {SHOWN} cost"),
    ]
